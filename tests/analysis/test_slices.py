"""Slice steps where floating-point numbers are far apart."""

from __future__ import annotations

import itertools

import numpy as np

from ssmppl.analysis.slices import slice_step
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
