"""Quasi-Newton ascent by noisy gradients.

z <- z + H^-1 g on the unconstrained scale, with H an estimate of the information, kept up by damped
BFGS updates (Nocedal and Wright 2006, procedure 18.2); near the top the steps shrink as 1 / k,
which averages the noise out (Robbins and Monro 1951).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

MOST_STEPS = 20  # of the first phase
NEAR = 1.0  # nats from the top where the first phase ends
AVERAGED = 6  # steps of the second phase
CLIFF = 30.0  # nats that a step of it may lose: Monte Carlo noise seldom explains more
FARTHEST = 1.5  # that one step may go on the unconstrained scale, in any coordinate

Point = tuple[float, np.ndarray]  # value and gradient


def noisy_climb(
    gradient: Callable[[np.ndarray], Point | None], z: np.ndarray, found: Point, h: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """(z, H, distance from the top in nats) where the climb from z (F,) ends.

    gradient : value and gradient at a point, with noise; None where there are none. found : these
    at z. h : (F, F) minus the second derivatives there, about.
    """
    value, g = found
    size = 1.0
    for _ in range(MOST_STEPS):
        step = _step(h, g)
        if 0.5 * g @ step < NEAR:
            break
        step *= size * _shortened(step)
        new = gradient(z + step)
        if new is None or new[0] < value - 3.0:  # beyond what Monte Carlo noise explains
            size *= 0.4
            if size < 0.01:
                break
            continue
        h = _update(h, step, g - new[1])
        z, (value, g), size = z + step, new, min(1.0, 2.0 * size)
    distance, size = np.inf, 1.0
    for k in range(AVERAGED):
        step = _step(h, g)
        distance = 0.5 * float(g @ step)
        step *= size * _shortened(step) / (k + 1.0)
        new = gradient(z + step)
        if new is None or new[0] < value - CLIFF:
            size *= 0.4
            continue
        z, (value, g) = z + step, new
    return z, h, distance


def _shortened(step: np.ndarray) -> float:
    """The share of a step that goes no farther than `FARTHEST`; a step may be 0, or have no
    coordinate at all."""
    return FARTHEST / max(FARTHEST, float(np.max(np.abs(step), initial=0.0)))


def _step(h: np.ndarray, g: np.ndarray) -> np.ndarray:
    """H^-1 g, with the small eigenvalues of the scaled H lifted."""
    scale = np.sqrt(np.maximum(np.diagonal(h), 1e-12))
    values, vectors = np.linalg.eigh(h / np.outer(scale, scale))
    values = np.maximum(values, 1e-3)
    return (vectors @ ((vectors.T @ (g / scale)) / values)) / scale


def _update(h: np.ndarray, s: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Damped BFGS: H such that H s is about y, positive definite still (procedure 18.2)."""
    hs = h @ s
    curvature, along = float(s @ hs), float(s @ y)
    if along < 0.2 * curvature:
        y = (weight := 0.8 * curvature / (curvature - along)) * y + (1.0 - weight) * hs
        along = float(s @ y)
    return h - np.outer(hs, hs) / curvature + np.outer(y, y) / along
