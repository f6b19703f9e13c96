"""Who is taken for whom: the table's arithmetic, and rivals in data simulated with each."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from ssmppl.diagnosis.experiment import recovery as module
from ssmppl.diagnosis.experiment.recovery import Recovery, finalists, recovery
from ssmppl.diagnosis.fitting.densities import density_of
from ssmppl.diagnosis.fitting.fit import FROM_START
from ssmppl.diagnosis.run.checkpoint import Checkpoint
from ssmppl.diagnosis.run.seeds import child_seed
from ssmppl.inference.run.seeds import random_state, seed_sequence
from tests.diagnosis.selection.test_shaping import ROWS, candidate, refitted, setting
from tests.models import gaps as models


def made(observed, *sets):
    return Recovery((7, 3), np.array(observed), np.array(sets, dtype=float))


def test_the_set_holds_what_lies_no_further_behind_than_in_its_own_data():
    """Of 20 sets the largest of the truth's distances, and no more than that."""
    first = np.zeros((20, 2))
    first[:, 1] = -5.0
    second = np.column_stack([np.arange(20.0) - 16.5, np.zeros(20)])  # ahead by 0.5, 1.5, 2.5
    found = made([10.0, 8.0], first, second)
    np.testing.assert_array_equal(found.behind, [0.0, 2.0])
    np.testing.assert_array_equal(found.cuts, [0.0, 2.5])
    assert found.inside == {7, 3}
    assert made([10.0, 7.4], first, second).inside == {7}
    np.testing.assert_allclose(found.named, [[1.0, 0.0], [0.15, 0.85]])


def test_sets_that_came_to_no_numbers_do_not_count():
    first = np.zeros((20, 2))
    first[:, 1] = -5.0
    first[:5] = np.nan
    second = first[:, ::-1]
    found = made([10.0, 8.0], first, second)
    np.testing.assert_allclose(found.named, np.eye(2))
    np.testing.assert_array_equal(found.cuts, [0.0, 0.0])


def test_finalists_are_the_first_and_who_comes_near_it():
    def of(*scores):
        return [SimpleNamespace(score=s) for s in scores]

    refits = of(100.0, 120.0, 49.0, 90.0, 51.0, 60.0, 70.0)
    assert [r.score for r in finalists(refits)] == [100.0, 90.0, 70.0, 60.0]
    assert finalists([]) == []


INPUT = models.inputs_of("oscillator", ROWS)["u"]


@pytest.fixture(scope="module")
def late():
    """An input six rows late, and refits of a delay and of a lag."""
    augmented, experiments, base = setting(np.r_[[INPUT[0]] * 6, INPUT[:-6]] - INPUT)
    delay = candidate("input delay", equation="u").with_shape(delay=6)
    lag = candidate("actuator lag", equation="u").with_shape(k=5)
    refits = [refitted(augmented, base, c, experiments, 0.9) for c in (delay, lag)]
    return augmented, experiments, refits


def taken(late, checkpoint=None, seed=3):
    augmented, experiments, refits = late
    for k, r in enumerate(refits):
        object.__setattr__(r, "index", (k,))
    kept = checkpoint or Checkpoint(None, {})
    return recovery(augmented, refits, experiments, seed_sequence(seed), kept), kept


def test_the_truth_is_recognised_and_what_the_data_exclude_is_out(late, monkeypatch):
    monkeypatch.setattr(module, "REACH", 0.0)
    found, kept = taken(late)
    assert found.columns == (0, 1)
    assert found.simulated.shape == (2, module.SETS, 2)
    np.testing.assert_allclose(found.named.sum(axis=1), 1.0)
    assert found.named[0, 0] >= 0.75  # by chance 15 of 20 or more once in 48 times
    assert found.inside == {0}
    gains = [r.fit.log_likelihood for r in late[2]]
    assert found.behind[1] == pytest.approx(gains[0] - gains[1], abs=1.0)  # but for the priors
    again, _ = taken(late, kept)
    np.testing.assert_array_equal(again.simulated, found.simulated)
    other, _ = taken(late, seed=4)
    assert not np.array_equal(other.simulated, found.simulated)


def test_each_set_is_of_its_truth_and_each_rival_is_at_its_top(late, monkeypatch):
    """The sets are those of the simulator at the refit, and the densities those of whole fits."""
    monkeypatch.setattr(module, "REACH", 0.0)
    _, experiments, refits = late
    found, _ = taken(late)
    for i in (0, module.SETS + 1):
        truth = refits[i // module.SETS]
        stream = random_state(child_seed(seed_sequence(3), i))
        drawn = truth.fitter.simulator.sets(experiments, truth.fit.theta, stream)
        for j, r in enumerate(refits):
            fit = r.fitter.fit(drawn, seed_sequence(1), r.fit.by_parameter, FROM_START)
            prior = density_of(fit.space, lambda theta: 0.0)(fit.z)
            value = found.simulated[i // module.SETS, i % module.SETS, j]
            assert value == pytest.approx(fit.log_likelihood + prior, abs=0.05)


def test_what_the_choice_of_a_shape_is_worth_is_taken_off_everywhere(late, monkeypatch):
    monkeypatch.setattr(module, "REACH", 0.0)
    augmented, experiments, (delay, lag) = late
    found, kept = taken(late)
    dear, _ = taken((augmented, experiments, [delay, replace(lag, cost=3.0)]), kept)
    np.testing.assert_allclose(dear.observed, found.observed - [0.0, 3.0])
    np.testing.assert_allclose(dear.simulated, found.simulated - [0.0, 3.0])


def test_of_one_alone_nothing_is_said(late):
    augmented, experiments, refits = late
    one = recovery(augmented, refits[:1], experiments, seed_sequence(3), Checkpoint(None, {}))
    assert one is None


def test_where_most_sets_fail_nothing_is_said(late, monkeypatch):
    monkeypatch.setattr(module, "REACH", 0.0)
    monkeypatch.setattr(module, "LEAST", module.SETS + 1)
    assert taken(late)[0] is None
