"""Slice steps where floating-point numbers are far apart."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy import stats

from ssmppl.analysis.lambdify import python_sum
from ssmppl.expressions.expr import apply, symbol
from ssmppl.inference.updates.draw_update import _guarded
from ssmppl.inference.updates.slices import slice_step
from tests.statistics.checks import seed_of

ENOUGH = 10_000  # calls of a density in one step


def test_steps_end_where_no_number_lies_between():
    """At 2e16 neighbours are four apart, more than the width at which an interval is small enough:
    halving it never gets there, and a step must end all the same."""
    rng, x = np.random.default_rng(seed_of("slices", "far")), 2e16
    for _ in range(300):
        calls = itertools.count()

        def wide(v, calls=calls):
            assert next(calls) < ENOUGH
            return -0.5 * (v / 1e17) ** 2

        x = slice_step(wide, x, rng, width=8.0)
        assert np.isfinite(x)


def test_the_width_may_be_less_than_the_spacing():
    """Then there may be no way to go, which is an answer too."""
    rng = np.random.default_rng(seed_of("slices", "narrow"))
    assert np.isfinite([slice_step(lambda v: 0.0, 2e16, rng) for _ in range(50)]).all()


def test_an_infinite_density_is_no_place_to_stay():
    """That of a Gamma of shape 1/2 from 1 on, at 1 itself: no slice would ever leave it."""
    a = symbol("parameter", "a")
    density = _guarded(python_sum([apply("log", a - 1.0), a], [a]))
    assert density([1.0], [-0.5, -1.0]) == -np.inf
    assert density([2.0], [-0.5, -1.0]) == -2.0


@pytest.mark.parametrize("edge", [0.5, 5.0])
def test_no_step_leads_to_where_the_density_is_infinite(edge):
    """A normal law, and +inf beyond an edge: draws of it up to the edge, by doubling that looks
    beyond; and from there no step is made."""

    def log_density(x):
        return np.inf if x > edge else -0.5 * x * x

    rng = np.random.default_rng(seed_of("slices", "infinite", edge))
    x, draws = 0.0, []
    for k in range(8000):
        x = slice_step(log_density, x, rng)
        if k % 4 == 0:
            draws.append(x)
    law = stats.truncnorm(-np.inf, edge)
    assert stats.kstest(draws, law.cdf).pvalue > 1e-3
    assert slice_step(log_density, edge + 1.0, rng) == edge + 1.0
