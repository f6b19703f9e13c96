"""Models of refits, made once whichever threads ask for them."""

import threading
from concurrent.futures import ThreadPoolExecutor

from ssmppl.diagnosis.fitting.augmented_models import AugmentedModels
from ssmppl.diagnosis.model.candidates import offers
from ssmppl.diagnosis.model.smoothing import Settings
from ssmppl.inference.run.problem import missing_of, pose
from tests.diagnosis.harness import scales
from tests.models import gaps as models

ROWS, THREADS = 40, 4


def test_threads_that_ask_at_once_get_one_model():
    model, inputs = models.build("oscillator"), models.inputs_of("oscillator", ROWS)
    drawn = models.ssm.simulate(
        model, models.THETA["oscillator"], steps=ROWS, inputs=inputs, seed=1
    )
    problem = pose(model, inputs | {"y": drawn["y"].values[0]})
    augmented = AugmentedModels(problem.trace, missing_of(problem.experiments), {}, Settings())
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
