"""A quasi-Newton climb by values and exact gradients: BFGS with a dense inverse Hessian.

Nocedal and Wright 2006, "Numerical optimization", algorithm 6.1 with the scaling (6.20); the line
search is the bracketing for the weak conditions of Wolfe of Lewis and Overton 2013, "Nonsmooth
optimization via quasi-Newton methods", Mathematical Programming 141, algorithm 2.6, which needs no
value where there is none: such a step is too long.

The problems have a few to a few dozen numbers. At that size the linear algebra of a library that
shares it out among threads waits for these longer than it computes; here nothing is but products of
a small matrix with a vector.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

Function = Callable[[np.ndarray], tuple[float, np.ndarray]]

INCREASE, SLOPE = 1e-4, 0.9  # of Wolfe's conditions
TRIALS = 60  # points on one line
GAIN = 1e-13  # of a step, relative to 1 or the value: the climb is at its end
GRADIENT = 1e-7  # largest entry: likewise


def quasi_newton(
    function: Function, start: np.ndarray, steps: int, visit: Callable[[np.ndarray], None]
) -> str:
    """Climb from start (d,), at most so many steps; returns why it ended.

    function : z (d,) -> (value, gradient (d,)), -inf where there is none. visit : told of every
    iterate, the start too.
    """
    z = np.array(start, dtype=float)
    value, slope = function(z)
    visit(z)
    if not value > -np.inf:
        return "there is no value at the start"
    inverse = np.eye(len(z))
    for k in range(steps):
        if np.max(np.abs(slope)) <= GRADIENT:
            return "the gradient is zero"
        direction = inverse @ slope
        if k == 0:
            direction = slope / max(1.0, float(np.sqrt(slope @ slope)))
        found = _wolfe(function, z, value, slope, direction)
        if found is None:
            return "no step climbs any more"
        new, value_new, slope_new = found
        moved, change = new - z, slope - slope_new
        curved = float(moved @ change)
        if curved > 0.0:
            if k == 0:
                inverse *= curved / float(change @ change)
            by = inverse @ change
            inverse += np.outer(moved, moved) * ((curved + float(change @ by)) / curved**2)
            cross = np.outer(by, moved) / curved
            inverse -= cross + cross.T
        gained = value_new - value
        z, value, slope = new, value_new, slope_new
        visit(z)
        if gained <= GAIN * max(abs(value), 1.0):
            return "the value does not increase any more"
    return "the steps are used up"


def _wolfe(
    function: Function, z: np.ndarray, value: float, slope: np.ndarray, direction: np.ndarray
) -> tuple[np.ndarray, float, np.ndarray] | None:
    """(point, value, gradient) a step along the direction; None where none climbs."""
    rise = float(slope @ direction)
    if not rise > 0.0:
        return None
    low, high, size = 0.0, np.inf, 1.0
    best: tuple[np.ndarray, float, np.ndarray] | None = None
    for _ in range(TRIALS):
        new = z + size * direction
        if np.array_equal(new, z):
            break
        value_new, slope_new = function(new)
        if not value_new >= value + INCREASE * size * rise:
            high = size
        elif float(slope_new @ direction) > SLOPE * rise:
            low, best = size, (new, value_new, slope_new)
        else:
            return new, value_new, slope_new
        size = 0.5 * (low + high) if high < np.inf else 4.0 * low
    return best if best is not None and best[1] > value else None
