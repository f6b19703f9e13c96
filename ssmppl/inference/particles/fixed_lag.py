"""Fixed-lag smoothing: marginals of x_t from the genealogy of a particle filter.

Kitagawa (1996), section 3; Olsson, Cappé, Douc and Moulines (2008) for bias against degeneracy:
p(x_t | y_{1:T}) is approximated by p(x_t | y_{1:t+L}), from the ancestors at t of the weighted
particles at t + L. It costs O(N) for each step and lag, needs no transition density, and gives
marginals only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssmppl.inference.particles.backward import ParticleSystem

LAG = 20


@dataclass(frozen=True)
class LagMoments:
    """mean (T, D), covariance (T, D, D), cross (T, D, D) with the step before, row 0 zero,
    quantiles (T, P, D), and distinct (T,): ancestors of which they are made."""

    mean: np.ndarray
    covariance: np.ndarray
    cross: np.ndarray
    quantiles: np.ndarray
    distinct: np.ndarray


def lag_moments(system: ParticleSystem, lag: int, levels: np.ndarray) -> LagMoments:
    """Moments of x_t given about y_{1:t+lag}; a lag of T - 1 or more uses the whole genealogy."""
    steps, d, n = system.particles.shape
    out = LagMoments(
        np.empty((steps, d)), np.empty((steps, d, d)), np.zeros((steps, d, d)),
        np.empty((steps, len(levels), d)), np.empty(steps, dtype=int),
    )  # fmt: skip
    for t in range(steps):
        last = min(t + lag, steps - 1)
        index = np.arange(n)
        for later in range(last, t, -1):
            index = system.ancestors[later, index]
        kept = system.weights[last] > 0.0  # the others may be anywhere
        index, w = index[kept], system.weights[last][kept]
        x = system.particles[t][:, index]
        out.mean[t] = x @ w
        z = x - out.mean[t][:, None]
        out.covariance[t] = (z * w) @ z.T
        out.distinct[t] = len(np.unique(index))
        for k in range(d):
            order = np.argsort(x[k])
            at = np.searchsorted(np.cumsum(w[order]), levels)
            out.quantiles[t, :, k] = x[k, order[np.minimum(at, len(w) - 1)]]
        if t > 0:
            before = system.particles[t - 1][:, system.ancestors[t, index]]
            z_before = before - (before @ w)[:, None]
            out.cross[t] = (z * w) @ z_before.T
    return out
