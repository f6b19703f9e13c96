"""The log posterior density on the unconstrained scale, without its Jacobian: what fits climb."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ssmppl.inference.optimisation.parts import Increments, Parts, parts_of, summed
from ssmppl.inference.preparation.space import Space

POINTS, SPREAD, CLIMBS = 45, 1.5, 3  # round a start, where many points are looked at together


def density_of(
    space: Space, log_likelihood: Callable[[np.ndarray], float]
) -> Callable[[np.ndarray], float]:
    """z (F,) -> log likelihood + log prior density of theta, -inf off the support."""

    def value(z: np.ndarray) -> float:
        theta, log_prior, log_jacobian = space.point(z)
        if not log_prior + log_jacobian > -np.inf:
            return -np.inf
        found = log_likelihood(theta) + log_prior
        return found if np.isfinite(found) else -np.inf

    return value


def one_by_one(function: Callable[[np.ndarray], float]) -> Callable[[np.ndarray], np.ndarray]:
    """The function z (F,) -> value of many points (B, F) -> (B,)."""
    return lambda points: np.array([function(z) for z in points])


def densities_of(space: Space, increments: Increments) -> Callable[[np.ndarray], Parts]:
    """As `density_of`, of many points z (B, F) at once, by parts."""

    def values(z: np.ndarray) -> Parts:
        found = [space.point(row) for row in z]
        theta, prior, jacobian = (np.array(part) for part in zip(*found, strict=True))
        return parts_of(increments, theta, np.where(jacobian > -np.inf, prior, -np.inf))

    return values


def best_of_many(
    densities: Callable[[np.ndarray], Parts], points: Sequence[np.ndarray],
    seed: np.random.SeedSequence,
) -> np.ndarray:  # fmt: skip
    """(K, F) the best of these points and of others round the first."""
    rng = np.random.default_rng(seed)
    z = points[0]
    every = np.vstack([*points, z + SPREAD * rng.standard_normal((POINTS, len(z)))])
    return every[np.argsort(-summed(densities(every)))[:CLIMBS]]
