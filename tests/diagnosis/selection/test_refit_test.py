"""Which candidates the test of a refit's gain refits in each simulated set."""

from types import SimpleNamespace

import numpy as np
import pytest

from ssmppl.diagnosis.screening.familywise import familywise
from ssmppl.diagnosis.selection import refit_test

SHAPES = 200  # of the one group whose largest statistic is high by chance


def test_the_highest_on_the_common_scale_come_first(monkeypatch):
    """A break at any of many dates has the largest statistic of all, and yet stands below what has
    one shape; a candidate that says nothing is not refitted."""
    rng = np.random.default_rng(0)
    groups = np.array([0] * SHAPES + [1, 2, 3])
    sided = np.array([0] * SHAPES + [0, 1, 0])
    null = rng.standard_normal((400, len(groups)))
    statistic = np.zeros(len(groups))
    statistic[17], statistic[SHAPES:] = 3.1, (2.7, -4.0, 9.0)
    family = familywise(statistic, null, sided=sided, groups=groups)
    found = SimpleNamespace(
        statistic=statistic, sided=sided, status=("",) * (len(groups) - 1) + ("constant",)
    )
    screen = SimpleNamespace(groups=groups, family=family)
    assert refit_test._best(screen, found) == [SHAPES, 17, SHAPES + 1]
    monkeypatch.setattr(refit_test, "TRIED", 1)
    assert refit_test._best(screen, found) == [SHAPES]


def test_p_of_gains_falls_with_the_gain_to_that_of_the_largest():
    simulated = np.linspace(0.1, 8.0, 99)
    test = refit_test.GainTest(7.0, 3, simulated, 0.025)
    assert test.p_of(7.0) == (np.sum(simulated >= 7.0) + 1) / 100
    assert test.p_of(9.0) == test.p_of(7.0)  # by nearer dates than the sets have
    assert test.p_of(4.0) == (np.sum(simulated >= 4.0) + 1) / 100
    assert test.p_of(-1.0) == 1.0


def test_far_beyond_the_sets_p_is_that_of_their_tail():
    """Also of a refit that gains next to as much: its p jumped to that of the count."""
    simulated = np.linspace(0.1, 4.0, 30)
    test = refit_test.GainTest(30.0, 3, simulated, 0.025)
    assert test.decided
    assert test.p_of(30.0) < 0.0025
    assert test.p_of(29.9) == pytest.approx(test.p_of(30.0), rel=0.1)
    assert test.p_of(3.0) > 0.2
    near = refit_test.GainTest(4.5, 3, simulated, 0.025)
    assert not near.decided
    assert near.p_of(4.5) == 1 / 31
    few = refit_test.GainTest(30.0, 3, simulated[:20], 0.025)
    assert not few.decided


def test_sets_end_where_nothing_can_be_rejected_any_more():
    lost = refit_test.GainTest(1.0, 3, np.array([2.0, 3.0, 0.5]), 0.025)
    assert lost.decided
    assert not refit_test.GainTest(2.5, 3, np.array([2.0, 3.0, 0.5]), 0.025).decided
    nothing = refit_test.GainTest(-np.inf, None, np.empty(0), 0.025)  # a fit failed
    assert nothing.p_of(10.0) == 1.0
