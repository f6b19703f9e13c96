"""Quantiles of mixtures by their distribution functions."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

MOST = 200  # halvings: of an interval between any two floats that differ in size by less than 1e40
ROUNDING = 1e-12  # by which sums of probabilities may miss a level


def inverted(
    below: Callable[[np.ndarray], np.ndarray], level: float, low: np.ndarray, high: np.ndarray,
    whole: bool,
) -> np.ndarray:  # fmt: skip
    """The smallest values at which distribution functions reach a level, by bisection.

    below : values -> P(Y <= value), in the shape of low and high, between which they lie: of a
        mixture the least and the largest quantile of its parts. whole : whether values are whole
        numbers.
    """
    low, high = low.copy(), high.copy()
    for _ in range(MOST):
        middle = 0.5 * low + 0.5 * high
        if whole:
            middle = np.floor(middle)
            open_ = low < high
        else:
            open_ = high - low > 2.0**-52 * np.maximum(np.abs(low), np.abs(high))
        if not open_.any():
            break
        reached = below(middle) >= level - ROUNDING * whole
        high = np.where(open_ & reached, middle, high)
        low = np.where(open_ & ~reached, middle + 1.0 if whole else middle, low)
    return high
