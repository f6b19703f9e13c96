"""Models of refits, made once whichever threads ask for them."""

import pickle
import threading
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

from ssmppl.diagnosis.fitting import augmented_models
from ssmppl.diagnosis.fitting.augmented_models import AugmentedModels
from ssmppl.diagnosis.model.candidates import offers
from ssmppl.diagnosis.model.smoothing import Settings
from ssmppl.inference.run.problem import missing_of, pose
from tests.diagnosis.harness import scales
from tests.models import gaps as models

ROWS, THREADS = 40, 4


def _posed():
    model, inputs = models.build("oscillator"), models.inputs_of("oscillator", ROWS)
    drawn = models.ssm.simulate(
        model, models.THETA["oscillator"], steps=ROWS, inputs=inputs, seed=1
    )
    problem = pose(model, inputs | {"y": drawn["y"].values[0]})
    return problem, AugmentedModels(problem.trace, missing_of(problem.experiments), {}, Settings())


def test_threads_that_ask_at_once_get_one_model():
    problem, augmented = _posed()
    offered, _ = offers(
        problem.trace, scales(problem.trace, ROWS), ["periodic forcing", "constant load"]
    )
    wanted = [(), *((c,) for c in offered[:3])]
    together = threading.Barrier(THREADS)

    def ask(k):
        together.wait(60)
        return {c: augmented.fitter(c) for c in wanted[k:] + wanted[:k]}

    with ThreadPoolExecutor(THREADS) as threads:
        found = list(threads.map(ask, range(THREADS)))
    for candidates in wanted:
        assert len({id(each[candidates].smoother) for each in found}) == 1
        assert len({id(each[candidates].problem.program) for each in found}) == 1


def test_a_process_keeps_what_it_made_for_the_next_stage(monkeypatch):
    """What is sent again is what was received before, with its fitters; not so with another
    initial distribution."""
    _, augmented = _posed()
    first_stage, second_stage = pickle.dumps(augmented), pickle.dumps(augmented)
    augmented.initial_law = SimpleNamespace(laws=())
    changed = pickle.dumps(augmented)
    monkeypatch.setattr(
        augmented_models, "_received", augmented_models.UnpackedCache(most=4)
    )  # another process
    received = pickle.loads(first_stage)
    made = received.base_fitter
    assert received is not augmented
    again = pickle.loads(second_stage)
    assert again is received
    assert again.base_fitter is made
    other = pickle.loads(changed)
    assert other is not received
    assert other.initial_law == augmented.initial_law
