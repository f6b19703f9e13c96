"""Statistics of score series against their kernels written out, and Nyblom's law."""

from __future__ import annotations

import numpy as np
import pytest

from ssmppl.diagnosis.screening import statistics
from ssmppl.errors import ArgumentError
from tests.statistics.checks import seed_of

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

    walk = statistics.random_walk(scores, starts)
    np.testing.assert_allclose(walk, form(np.minimum.outer(time, time)))
    rho = [0.0, 0.5, 0.95, -0.4]
    found = statistics.autoregressive(scores, rho, starts)
    for i, r in enumerate(rho):
        np.testing.assert_allclose(found[..., i], form(np.power(r, apart.astype(float))))


def test_one_set_at_a_time_gives_the_same(scores):
    np.testing.assert_allclose(statistics.random_walk(scores[1], STARTS),
                               statistics.random_walk(scores, STARTS)[1])  # fmt: skip
    np.testing.assert_allclose(statistics.autoregressive(scores[1], [0.8], STARTS),
                               statistics.autoregressive(scores, [0.8], STARTS)[1])  # fmt: skip


@pytest.mark.parametrize("starts", [(1,), (0, 60), (0, 5, 5), ()])
def test_starts_that_make_no_experiments(scores, starts):
    with pytest.raises(ArgumentError, match="experiments that start at rows"):
        statistics.random_walk(scores, starts)
