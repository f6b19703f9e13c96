"""The stretch of time: level under no gap and under a lasting one, and where an event is placed."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from ssmppl.diagnosis.screening.location import bin_edges, binned, group_score, when
from ssmppl.errors import ArgumentError
from tests.statistics.checks import LEVEL, seed_of

B, P, J, D = 200, 4, 20, 4


class World:
    """Scores by bin; the information per bin varies threefold over time."""

    def __init__(self, *name):
        self.rng = np.random.default_rng(seed_of("when", *name))
        self.mix = self.rng.standard_normal((D, D)) / 2 + np.eye(D)
        self.absorbed = self.rng.standard_normal((P, D)) / 2
        self.size = np.linspace(0.5, 1.5, J)
        self.direction = self.rng.standard_normal(D)

    def __call__(self, sets, nats=0.0, inside=slice(0, J)):
        root = np.sqrt(self.size)[:, None]
        nuisance = self.rng.standard_normal((sets, J, P)) * root
        scores = self.rng.standard_normal((sets, J, D)) @ self.mix * root
        v, on = self.mix.T @ self.mix, np.zeros(J)
        on[inside] = 1.0
        gain = 0.5 * self.direction @ v @ self.direction * np.sum(on * self.size)
        shift = (on * self.size)[:, None] * (v @ self.direction) * np.sqrt(nats / gain)
        return scores + nuisance @ self.absorbed + shift, nuisance

    def found(self, nats=0.0, inside=slice(0, J)):
        s, n = self(B)
        seen, seen_n = (a[0] for a in self(1, nats, inside))
        g = group_score(s.sum(1), seen.sum(0), n.sum(1), seen_n.sum(0))
        return when(g, s, seen, n, seen_n, np.arange(J + 1) * 10)


@pytest.mark.parametrize("nats", [0.0, 30.0])
@pytest.mark.slow
def test_a_lasting_gap_is_not_confined(nats):
    """The level is 5% without a gap, and with one of 30 nats that acts all the time."""
    world, times = World("level", nats), 150
    found = [world.found(nats) for _ in range(times)]
    count = sum(w.confined for w in found)
    assert stats.binomtest(count, times, 0.05).pvalue > LEVEL
    assert all((w.first, w.last, w.share) == (0, 200, 1.0) for w in found if not w.confined)


def test_an_event_is_placed():
    """25 nats in bins 7 to 11: said to be confined, and to about those rows."""
    world, times = World("event"), 60
    found = [world.found(25.0, slice(7, 12)) for _ in range(times)]
    held = [w for w in found if w.confined]
    assert len(held) >= stats.binom.ppf(LEVEL, times, 0.9)
    assert abs(np.median([w.first for w in held]) - 70) <= 10
    assert abs(np.median([w.last for w in held]) - 120) <= 10
    assert np.median([w.share for w in held]) > 0.5


def test_bins():
    edges = bin_edges(100, (0, 30), 10)
    np.testing.assert_array_equal(edges, [0, 10, 20, 30, 40, 50, 60, 70, 80, 90, 100])
    assert 30 in bin_edges(100, (0, 30), 4)
    s = np.random.default_rng(seed_of("bins")).standard_normal((2, 100, 3))
    np.testing.assert_allclose(binned(s, edges)[:, 4], s[:, 40:50].sum(axis=1))
    assert bin_edges(5, bins=24).tolist() == [0, 1, 2, 3, 4, 5]


def test_too_few_bins():
    world = World("few")
    s, n = world(B)
    g = group_score(s.sum(1), s[0].sum(0), n.sum(1), n[0].sum(0))
    with pytest.raises(ArgumentError, match="J at least 3"):
        when(g, s[:, :2], s[0, :2], n[:, :2], n[0, :2], np.arange(3))
