"""Statistics of score series against their kernels written out, and Nyblom's law."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from ssmppl.errors import ArgumentError
from ssmppl.gap import series
from tests.statistics.checks import LEVEL, seed_of

STARTS = (0, 17, 40)
ROWS = 60


@pytest.fixture
def scores():
    return np.random.default_rng(seed_of("series")).standard_normal((3, ROWS, 2))


def within(starts):
    """(T, T) 1 where both rows are of one experiment, and (T,) time in it, from 1."""
    label = np.searchsorted(starts, np.arange(ROWS), side="right")
    time = np.arange(ROWS) - np.array(starts)[label - 1] + 1
    return (label[:, None] == label).astype(float), time


@pytest.mark.parametrize("starts", [(0,), STARTS])
def test_quadratic_forms_against_their_kernels(scores, starts):
    same, time = within(starts)
    apart = np.abs(np.subtract.outer(time, time))

    def form(kernel):
        return 0.5 * np.einsum("btk,ts,bsk->bk", scores, kernel * same, scores)

    np.testing.assert_allclose(series.lag_one(scores, starts), form(apart == 1))
    walk = series.random_walk(scores, starts)
    np.testing.assert_allclose(walk, form(np.minimum.outer(time, time)))
    rho = [0.0, 0.5, 0.95, -0.4]
    found = series.autoregressive(scores, rho, starts)
    for i, r in enumerate(rho):
        np.testing.assert_allclose(found[..., i], form(np.power(r, apart.astype(float))))


def test_one_set_at_a_time_gives_the_same(scores):
    np.testing.assert_allclose(series.random_walk(scores[1], STARTS),
                               series.random_walk(scores, STARTS)[1])  # fmt: skip
    np.testing.assert_allclose(series.autoregressive(scores[1], [0.8], STARTS),
                               series.autoregressive(scores, [0.8], STARTS)[1])  # fmt: skip


def test_weighted_sums(scores):
    _, time = within(STARTS)
    length = np.diff([*STARTS, ROWS])[np.searchsorted(STARTS, np.arange(ROWS), side="right") - 1]
    np.testing.assert_allclose(series.drift(scores, STARTS),
                               np.einsum("t,btk->bk", time / length, scores))  # fmt: skip
    dates = [0, 5, 59]
    for i, d in enumerate(dates):
        np.testing.assert_allclose(series.steps(scores, dates)[..., i], scores[:, d:].sum(axis=1))
        np.testing.assert_allclose(series.pulses(scores, dates, 7)[..., i],
                                   scores[:, d : d + 7].sum(axis=1), atol=1e-12)  # fmt: skip


def test_break_dates_keep_away_from_the_ends():
    dates = series.break_dates(300, 10, 0.1, (0, 100))
    assert dates.min() == 10
    assert dates.max() == 280
    assert not np.any((dates > 90) & (dates < 120))
    assert series.break_dates(3).size == 0


@pytest.mark.parametrize("starts", [(1,), (0, 60), (0, 5, 5), ()])
def test_starts_that_make_no_experiments(scores, starts):
    with pytest.raises(ArgumentError, match="experiments that start at rows"):
        series.random_walk(scores, starts)


# 5% points of Nyblom's law with 1 and 2 parameters: of the Cramer-von Mises statistic (Anderson and
# Darling 1952), and of the table of Hansen (1992).
@pytest.mark.parametrize(("parameters", "critical"), [(1, 0.46136), (2, 0.749)])
def test_nyblom_hansen_has_its_law(parameters, critical):
    """White scores of a known covariance: the joint statistic exceeds its 5% point 5% of the time.

    The scores' total is left in, as in sets that are simulated without a refit.
    """
    rng, times = np.random.default_rng(seed_of("nyblom", parameters)), 3000
    root = np.tril(rng.standard_normal((parameters, parameters))) + 2 * np.eye(parameters)
    s = rng.standard_normal((times, 400, parameters)) @ root.T + 0.05
    single, joint = series.nyblom_hansen(s, 400 * root @ root.T)
    count = int(np.sum(joint > critical))
    assert stats.binomtest(count, times, 0.05).pvalue > LEVEL
    if parameters == 1:
        np.testing.assert_allclose(single[:, 0], joint)
    else:
        for column in single.T:
            assert stats.binomtest(int(np.sum(column > 0.46136)), times, 0.05).pvalue > LEVEL


def test_nyblom_hansen_sees_a_break_and_bears_a_parameter_without_information():
    rng = np.random.default_rng(seed_of("nyblom break"))
    s = rng.standard_normal((400, 3))
    s[:200, 1] += 0.3
    s[200:, 1] -= 0.3
    s[:, 2] = 0.0
    single, joint = series.nyblom_hansen(s, np.diag([400.0, 400.0, 0.0]))
    assert single[1] > 1.0 > single[0]
    assert single[2] == 0.0
    assert joint == pytest.approx(single.sum())
