"""A climb by noisy scores.

A quasi-Newton ascent: z <- z + H^-1 g on the unconstrained scale, with H an estimate of the
information, kept up by damped BFGS updates (Nocedal and Wright 2006, procedure 18.2); near the top
the steps shrink as 1 / k, which averages the noise out (Robbins and Monro 1951).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ssmppl.inference.optimisation.newton import bfgs_update, newton_step

Point = tuple[float, np.ndarray]  # value and gradient

NEAR = 1.0  # nats from the top where the first phase ends
MOST_STEPS = 20  # of the first phase
AVERAGED = 6  # steps of the second phase
TINY = 1e-12  # information in any units, as of a parameter in millions
CLIFF = 30.0  # nats that a step of it may lose: Monte Carlo noise seldom explains more
FARTHEST = 1.5  # that one step may go on the unconstrained scale, in any coordinate


def stochastic_quasi_newton(
    gradient: Callable[[np.ndarray], Point | None], z: np.ndarray, found: Point, h: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """(z, H, distance from the top in nats) where the climb from z (F,) ends.

    gradient : value and gradient at a point, with noise; None where there are none. found : these
    at z. h : (F, F) minus the second derivatives there, about.
    """
    value, g = found
    size = 1.0
    for _ in range(MOST_STEPS):
        step = newton_step(g, h, TINY)
        if 0.5 * g @ step < NEAR:
            break
        step *= size * _step_share(step)
        new = gradient(z + step)
        if new is None or new[0] < value - 3.0:  # beyond what Monte Carlo noise explains
            size *= 0.4
            if size < 0.01:
                break
            continue
        h = bfgs_update(h, step, g - new[1])
        z, (value, g), size = z + step, new, min(1.0, 2.0 * size)
    distance, size = np.inf, 1.0
    for k in range(AVERAGED):
        step = newton_step(g, h, TINY)
        distance = 0.5 * float(g @ step)
        step *= size * _step_share(step) / (k + 1.0)
        new = gradient(z + step)
        if new is None or new[0] < value - CLIFF:
            size *= 0.4
            continue
        z, (value, g) = z + step, new
    return z, h, distance


def _step_share(step: np.ndarray) -> float:
    """The share of a step that goes no farther than `FARTHEST`; a step may be 0, or have no
    coordinate at all."""
    return FARTHEST / max(FARTHEST, float(np.max(np.abs(step), initial=0.0)))
