"""Which rows are used for what."""

import numpy as np
import pytest
from scipy import stats

import ssmppl as ssm
from ssmppl.data import bind
from ssmppl.diagnosis.heldout.row_split import FOLDS, GAP, folds, long_enough, three_parts, without
from ssmppl.diagnosis.model.simulated_records import Simulator
from ssmppl.inference.exact.kalman import kalman_model
from ssmppl.inference.run.problem import pose
from ssmppl.inference.run.seeds import random_state
from ssmppl.language.tracing import trace
from tests.diagnosis.small import level, levels
from tests.models import gaps as models
from tests.statistics.checks import seed_of


def experiments(*sizes):
    return bind(trace(level()), [levels(n) for n in sizes])


@pytest.mark.parametrize("sizes", [(300,), (1000,), (200, 150)])
def test_parts_follow_each_other(sizes):
    parts = three_parts(experiments(*sizes))
    for e, a, b, chosen, confirm in zip(
        parts.reference_train,
        parts.first,
        parts.second,
        parts.reference_validation,
        parts.held_out,
        strict=True,
    ):
        assert e.steps == a < b
        np.testing.assert_array_equal(np.flatnonzero(chosen), np.arange(a + GAP, b))
        np.testing.assert_array_equal(np.flatnonzero(confirm), np.arange(b + GAP, len(confirm)))
    whole = experiments(*sizes)
    for e, part in zip(whole, parts.train, strict=True):
        np.testing.assert_array_equal(e.y[: part.steps], part.y)
        np.testing.assert_array_equal(e.observed["y"][: part.steps], part.observed["y"])


def test_short_experiments_beside_a_long_one():
    """No part has more rows than there are, and no row is in two of them."""
    whole = experiments(400, 1, 2, 3, 4, 9)
    parts = three_parts(whole)
    for part in (parts.reference_train, parts.train):
        for e in part:
            assert len(e.y) == len(e.seen) == len(e.u) == len(e.observed["y"]) == e.steps
    assert [e.steps for e in parts.train] == [280, 1, 2, 3, 3, 6]
    for e, train, confirm in zip(whole, parts.train, parts.held_out, strict=True):
        assert confirm.shape == (e.steps,)
        assert not confirm[: train.steps].any()
        assert confirm.any() == (train.steps < e.steps)
    for screen, chosen in zip(parts.reference_train, parts.reference_validation, strict=True):
        assert not chosen[: screen.steps].any()
    assert [c.sum() for c in parts.held_out] == [115, 0, 0, 0, 1, 1]


def test_what_is_long_enough():
    assert long_enough(experiments(300))
    assert long_enough(experiments(200, 100))
    assert not long_enough(experiments(299))
    assert not long_enough(experiments(*[2] * 150))  # no row is behind the cuts
    assert not long_enough(experiments(*[3] * 99, 20))
    assert long_enough(experiments(*[3] * 99, 100))


@pytest.mark.parametrize("sizes", [(80,), (50, 37)])
def test_every_row_is_left_out_once(sizes):
    whole = experiments(*sizes)
    found = folds(whole)
    assert len(found) == FOLDS
    for i, e in enumerate(whole):
        times = np.sum([f.left_out[i] for f in found], axis=0)
        np.testing.assert_array_equal(times, np.ones(e.steps))
        for f in found:
            rows, train = f.left_out[i], f.train[i]
            assert not train.seen[rows].any()
            assert train.seen[~rows].all()
            assert not train.y[rows].any()
            assert np.isnan(train.observed["y"][rows]).all()
            np.testing.assert_array_equal(train.y[~rows], e.y[~rows])
    sizes = [sum(int(rows.sum()) for rows in f.left_out) for f in found]
    assert max(sizes) - min(sizes) <= 1


def test_what_is_fed_back_stays():
    """x_{t+1} needs y_t: the likelihood of the rows that are left is that of p(y_t | y_{1:t-1})."""
    model = ssm.Model("fed back")
    model.initial(lambda: {"x": ssm.Normal(50, sd=5)})
    model.transition(lambda x, y: {"x": ssm.Normal(50 + 0.6 * (y - 50), sd=1)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=0.5)})
    rng = np.random.default_rng(seed_of("fed back"))
    y = 50 + rng.standard_normal(20)
    problem = pose(model, {"y": y})
    mean = np.array([50.0, *(50 + 0.6 * (y[:-1] - 50))])
    sd = np.sqrt(np.array([25.0, *[1.0] * 19]) + 0.25)
    density = stats.norm(mean, sd).logpdf(y)
    exact = kalman_model(problem.trace)
    for fold in folds(problem.experiments, 4, fed_back=True):
        (rows,), (e,) = fold.left_out, fold.train
        assert not e.seen[rows].any()
        assert np.isnan(e.observed["y"][rows]).all()
        found = exact.log_likelihood([e], np.zeros(0))
        assert found == pytest.approx(density[~rows].sum(), abs=1e-9)


def test_simulated_sets_keep_what_was_fed_back():
    """x_{t+1} = y_t exactly: what is drawn has to follow from the y that the set hands on."""
    model = ssm.Model("repeated")
    model.initial(lambda: {"x": ssm.Normal(5, sd=1)})
    model.transition(lambda x, y: {"x": ssm.Normal(y + 10, sd=1e-6)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=1e-6)})
    problem = pose(model, {"y": np.zeros(12)})
    rows = np.arange(12) // 3 == 1
    held = without(problem.experiments[0], rows, fed_back=True)
    simulator = Simulator(problem.program, problem.program.missing, None)
    (drawn,) = simulator.sets([held], np.zeros(0), random_state(np.random.SeedSequence(1)))
    np.testing.assert_allclose(np.diff(drawn.y[:, 0]), 10.0, atol=1e-4)
    np.testing.assert_array_equal(drawn.seen, held.seen)


def test_what_is_missing_stays_missing():
    data = models.simulated("vector", 30)
    data["y"][4, 1] = np.nan
    (e,) = bind(trace(models.build("vector")), data)
    rows = np.arange(30) >= 25
    found = without(e, rows)
    assert found.seen[4].tolist() == [1.0, 0.0]
    assert not found.seen[25:].any()
    assert np.isnan(found.observed["y"][25:]).all()
