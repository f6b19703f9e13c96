"""F against the true model and F* on fresh data, where both are known."""

import numpy as np
import pandas as pd
import pytest

from bench.gap.fit import fit
from bench.gap.fresh import arrays, parameters, reference, share, through
from bench.gap.run import MODELS
from bench.gap.truth import SYSTEMS
from ssmppl.modelfile import load_model

SYSTEM = SYSTEMS["thermal"]


@pytest.fixture(scope="module")
def case():
    """A set with a strong delay: (its table, its answer, base and true models refitted)."""
    rng = np.random.default_rng(5)
    p = SYSTEM.drawn_parameters(rng)
    U = SYSTEM.excite(rng, SYSTEM.steps)
    _, Y = SYSTEM.simulate(p, SYSTEM.strengths({"delay": 2.0}), U, rng)
    data = pd.DataFrame(np.hstack([U, Y]), columns=[*SYSTEM.inputs, *SYSTEM.channels])
    answer = {
        "parameters": dict(sorted(zip(SYSTEM.parameters, p.tolist(), strict=True))),  # as sealed
        "effects": [{"key": "delay", "strength": 2.0}],
        "seed": 7,
    }
    base = reference(SYSTEM, {**answer, "effects": []}, U, Y)
    true = reference(SYSTEM, answer, U, Y)
    return data, answer, base, true


def test_fresh_runs_are_of_the_sets_own_system():
    """What an answer holds, keys sorted, simulates the set again."""
    system = SYSTEMS["pendulum"]
    rng = np.random.default_rng(3)
    p = system.drawn_parameters(rng)
    U = system.excite(rng, system.steps)
    answer = {"parameters": dict(sorted(zip(system.parameters, p.tolist(), strict=True)))}
    np.testing.assert_array_equal(parameters(system, answer), p)
    none = system.strengths({})
    one, other = (
        system.simulate(v, none, U, np.random.default_rng(4))[1]
        for v in (p, parameters(system, answer))
    )
    np.testing.assert_array_equal(one, other)


def test_a_closed_loop_runs_again_with_the_same_references_and_commands_of_its_own():
    system = SYSTEMS["servo"]
    rng = np.random.default_rng(8)
    p = system.drawn_parameters(rng)
    excited = system.excite(rng, system.steps)
    U, _, Y = system.recorded(p, system.strengths({}), excited, rng)
    data = pd.DataFrame(np.hstack([U, Y]), columns=[*system.inputs, *system.channels])
    answer = {
        "parameters": dict(zip(system.parameters, p.tolist(), strict=True)),
        "effects": [],
        "seed": 8,
    }
    seen = []

    def rows(frame, repeats):
        seen.append(arrays(system, frame))
        return np.zeros((repeats, len(frame)))

    share(rows, rows, rows, system, answer, data)
    fresh = seen[3:]
    assert len(fresh) == 60
    for V, Z in fresh:
        memory = np.zeros(system.memory)
        again = [system.control(y, w, memory) for y, w in zip(Z, excited, strict=True)]
        np.testing.assert_array_equal(V, again)
        assert np.abs(V - U).max() > 0


@pytest.mark.slow
def test_the_true_model_closes_all_and_the_base_nothing(case):
    data, answer, base, true = case
    all_of_it = share(base, true, true, SYSTEM, answer, data)
    assert all_of_it["F"] == pytest.approx(1)
    assert all_of_it["F_star"] == pytest.approx(1)
    nothing = share(base, base, true, SYSTEM, answer, data)
    assert nothing["F"] == nothing["F_star"] == 0


def test_a_mixture_of_both_closes_part_and_its_interval_holds_the_part(case):
    data, answer, base, true = case

    def between(rows, repeats):
        return 0.3 * base(rows, repeats) + 0.7 * true(rows, repeats)

    part = share(base, between, true, SYSTEM, answer, data)
    assert part["F_star"] == pytest.approx(0.7)
    # every block has the same share, so the interval is a point, but for rounding
    assert part["low"] - 1e-9 <= 0.7 <= part["high"] + 1e-9


@pytest.mark.slow
def test_a_models_increments_are_those_of_the_exact_filter(case):
    """Row by row within the particles' error, and a bias of about 1 / (2 N) of their variance."""
    data, answer, base, _ = case
    U, Y = arrays(SYSTEM, data)
    model = load_model(str(MODELS / "thermal.py"))
    p = parameters(SYSTEM, answer)
    found = fit(SYSTEM, U, Y, (), p, SYSTEM.strengths({}), int(0.7 * len(Y)))
    fitted = dict(zip(SYSTEM.parameters, found.p, strict=True))
    estimates = through(model, fitted)(data, 8)
    exact = base(data, 1)[0]
    error = estimates.std(axis=0, ddof=1) / np.sqrt(8)
    off = np.abs(estimates.mean(axis=0) - exact)
    # Student's t with 7 degrees of freedom lies beyond 4 in 1 row of 190
    assert np.mean(off < 4 * error + 0.02) > 0.97
