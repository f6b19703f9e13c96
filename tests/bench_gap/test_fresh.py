"""F against the true model and F* on fresh data, where both are known."""

import numpy as np
import pandas as pd
import pytest

from bench.gap.fit import fit
from bench.gap.fresh import Predictive, arrays, parameters, reference, refitted, share, through
from bench.gap.run import MODELS
from bench.gap.truth import SYSTEMS
from ssmppl.modelfile import load_model
from tests.statistics.checks import seed_of

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

    def total(frame):
        seen.append(arrays(system, frame))
        return 0.0

    model = Predictive(lambda frame, repeats: np.zeros((repeats, len(frame))), total)
    share(model, model, model, system, answer, data)
    fresh = seen
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

    between = Predictive(
        lambda frame, repeats: 0.3 * base.rows(frame, repeats) + 0.7 * true.rows(frame, repeats),
        lambda frame: 0.3 * base.total(frame) + 0.7 * true.total(frame),
    )
    part = share(base, between, true, SYSTEM, answer, data)
    assert part["F_star"] == pytest.approx(0.7)
    # every block has the same share, so the interval is a point, but for rounding
    assert part["low"] - 1e-9 <= 0.7 <= part["high"] + 1e-9


@pytest.mark.slow
def test_a_models_densities_are_those_of_the_exact_filter(case):
    """Of the rows behind the cut, of a linear model: row by row, and together."""
    data, answer, base, _ = case
    U, Y = arrays(SYSTEM, data)
    model = load_model(str(MODELS / "thermal.py"))
    p = parameters(SYSTEM, answer)
    found = fit(SYSTEM, U, Y, (), p, SYSTEM.strengths({}), int(0.7 * len(Y)))
    ours = through(model, dict(zip(SYSTEM.parameters, found.p, strict=True)))
    exact = base.rows(data, 1)[0]
    assert not exact[: int(0.7 * len(Y))].any()
    np.testing.assert_allclose(ours.rows(data, 2), [exact] * 2, rtol=1e-6, atol=1e-8)
    assert ours.total(data) == pytest.approx(base.total(data), rel=1e-7)


@pytest.mark.slow
def test_a_pendulum_without_noise_is_not_lost():
    """A bootstrap filter of 1,000 particles loses it by thousands of nats; the true filter is an
    approximation here itself, whose predictions are exact to a fraction of a nat."""
    system = SYSTEMS["swing"]
    rng = np.random.default_rng(seed_of("swing"))
    p = system.drawn_parameters(rng)
    U = system.excite(rng, system.steps)
    _, Y = system.simulate(p, system.strengths({}), U, rng)
    data = pd.DataFrame(np.hstack([U, Y]), columns=[*system.inputs, *system.channels])
    answer = {"parameters": dict(zip(system.parameters, p.tolist(), strict=True)), "effects": []}
    true = reference(system, answer, U, Y)
    found = refitted(system, answer, U, Y)
    ours = through(
        load_model(str(MODELS / "swing.py")), dict(zip(system.parameters, found.p, strict=True))
    )
    assert ours.total(data) == pytest.approx(true.total(data), abs=5.0)
    rows = ours.rows(data, 8)
    assert rows.sum(axis=1).mean() == pytest.approx(ours.total(data), abs=5.0)
    assert rows.sum(axis=1).std() < 2.0
