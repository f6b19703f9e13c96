"""Scores of what acts seldom: on the scale of the information that a data set holds."""

from __future__ import annotations

import numpy as np
import pytest

from ssmppl.diagnosis.screening.efficient_score import SELDOM, Null, efficient
from ssmppl.diagnosis.screening.familywise import familywise, tail_p
from ssmppl.diagnosis.screening.statistics import FREE, information_scale, typical_squares
from tests.statistics.checks import seed_of

ROWS = 200


def seldom(rng, sets):
    """Scores of a stop at height 3 that a slow state reaches in few sets, row by row (B, T): its
    activity times a normal disturbance."""
    level = 1.2 * rng.standard_normal((sets, 1)) + rng.standard_normal((sets, ROWS))
    active = np.maximum(level - 3.0, 0.0)
    return active * rng.standard_normal((sets, ROWS))


def test_division():
    usual = np.array([2.0, 2.0, 2.0, np.nan])
    by = information_scale(np.array([1.0, 4.0 * FREE, 36.0 * FREE, 5.0]), usual)
    np.testing.assert_allclose(by, [1.0, np.sqrt(2.0), np.sqrt(18.0), 1.0])
    assert np.all(information_scale(np.zeros(4), usual) == 1.0)


def test_typical_is_of_one_set():
    squares = np.array(
        [[1.0, np.nan, 0.0, 0.0], [2.0, np.nan, 0.0, 7.0], [900.0, np.nan, 0.0, 0.0]]
    )
    np.testing.assert_array_equal(typical_squares(squares), [2.0, np.nan, np.nan, 7.0])


def test_a_statistic_that_seldom_knows_anything_does_not_lie_far_out():
    """Its largest among 200 sets sets the bar for all others: on the scale of what was seen it is
    like that of other statistics, as it is twice as far out."""
    rng = np.random.default_rng(seed_of("seldom"))
    raw, scaled = [], []
    for _ in range(20):
        rows = seldom(rng, 200)
        s, squares = rows.sum(axis=1), np.sum(rows**2, axis=1)
        by = information_scale(squares[:, None], typical_squares(squares[:, None]))[:, 0]
        for values, out in ((s, raw), (s / by, scaled)):
            law = Null.of(values[:, None], np.zeros((200, 0)))
            found = efficient(law, np.zeros(1), np.zeros(0))
            out.append(np.abs(found.null).max())
    assert np.median(raw) > 2.0 * np.median(scaled)
    assert np.median(scaled) < 4.5


@pytest.mark.parametrize("strength", [0.0, 0.25])
def test_level_and_power(strength):
    """The level of the test stays, and where data know of the effect it is found."""
    rng = np.random.default_rng(seed_of("seldom", strength))
    found = []
    for _ in range(300):
        rows = seldom(rng, 200)
        squares = np.sum(rows**2, axis=1, keepdims=True)
        usual = typical_squares(squares)
        own = seldom(rng, 1)[0] if strength == 0.0 else None
        if own is None:  # a set in which the state was up there, and the effect acted
            active = np.maximum(1.5 + rng.standard_normal(ROWS) - 1.0, 0.0)
            own = active * (rng.standard_normal(ROWS) + strength * active)
        law = Null.of(
            rows.sum(axis=1, keepdims=True) / information_scale(squares, usual), np.zeros((200, 0))
        )
        by = information_scale(np.array([np.sum(own**2)]), usual)
        seen = efficient(law, np.array([own.sum()]) / by, np.zeros(0))
        found.append(tail_p(abs(seen.statistic[0]), np.abs(seen.null[:, 0])))
    share = np.mean(np.array(found) <= 0.05)
    print(strength, share)
    if strength == 0.0:
        assert share <= 0.05 + 3.0 * np.sqrt(0.05 * 0.95 / 300)
    else:
        assert share >= 0.9


def test_one_set_that_tells_of_a_column_does_not_stand_for_all_candidates():
    """A rectifying sensor whose values are never negative but in one set of two hundred: beside
    zeros that one lies infinitely far out, and no other candidate would ever be found."""
    rng = np.random.default_rng(seed_of("one set"))
    columns = rng.standard_normal((200, 3))
    columns[:, 1], columns[60, 1] = 0.0, 5.0
    found = efficient(Null.of(columns, np.zeros((200, 0))), np.array([5.0, 5.0, 0.5]), np.zeros(0))
    assert found.status == ("", SELDOM, "")
    assert np.all(found.null[:, 1] == 0.0)
    assert found.statistic[1] == found.gain[1] == 0.0
    family = familywise(found.statistic, found.null)
    assert family.p[0] < 0.01


def test_a_column_is_compared_with_the_sets_that_tell_of_it():
    """Thirty sets in a thousand, standard normal where it says anything: three is three standard
    deviations, not seventeen, in the null distribution and for the data."""
    rng = np.random.default_rng(seed_of("thirty sets"))
    columns = np.zeros((1000, 1))
    columns[:30, 0] = rng.standard_normal(30)
    found = efficient(Null.of(columns, np.zeros((1000, 0))), np.array([3.0]), np.zeros(0))
    assert found.status == ("",)
    size = np.sqrt(np.mean(columns[:30] ** 2))
    assert found.statistic[0] == pytest.approx(3.0 / size, rel=0.01)
    assert found.z[0] == pytest.approx(3.0 / size, rel=0.15)  # V is at least above its own error
    assert np.abs(found.null).max() < 4.5
