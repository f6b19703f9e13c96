"""Fixed-lag smoothing, marginals of x_t from the genealogy of a particle filter; and a warning
where a particle smoother has collapsed, its draws of a state sharing a few values.

Kitagawa (1996), section 3; Olsson, Cappé, Douc and Moulines (2008) for bias against degeneracy:
p(x_t | y_{1:T}) is approximated by p(x_t | y_{1:t+L}), from the ancestors at t of the weighted
particles at t + L. It costs O(N) for each step and lag, needs no transition density, and gives
marginals only.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ssmppl.data import Experiment
from ssmppl.data.times import label_text
from ssmppl.errors import warn
from ssmppl.inference.particles.backward import ParticleSystem

LAG = 20
FEW = 0.01  # of the values that there could be, below which the spread of the draws means little


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


def distinct(paths: np.ndarray) -> np.ndarray:
    """How many values x_t has among draws (M, T, D): (T,)."""
    order = np.lexsort(np.moveaxis(paths, 2, 0), axis=0)  # of the draws, at each t
    ordered = np.take_along_axis(paths, order[:, :, None], axis=0)
    return 1 + np.sum(np.any(ordered[1:] != ordered[:-1], axis=2), axis=0)


def collapse(
    found: np.ndarray, system: ParticleSystem, draws: int, experiment: Experiment, fix: str
) -> dict[str, Any]:
    """What goes to the attributes: nothing, or the warning, which is also given.

    found : (T,) distinct values that are left. system : of the filter, for how many values there
    could be, since a discrete state or a known start has few of its own. draws : M.
    """
    suspect = np.flatnonzero(found < FEW * min(draws, system.particles.shape[2]))
    rows = [t for t in suspect if found[t] < FEW * _values(system.particles[t], system.weights[t])]
    if not rows:
        return {}
    worst = min(rows, key=lambda t: found[t])
    label = "" if experiment.time is None else f" (time {label_text(experiment.time[worst])})"
    count = int(found[worst])
    text = (
        f"particle degeneracy at t={worst + 1}{label}: only {count} distinct "
        f"particle{'s' if count > 1 else ''} among {draws} draws, and too few at {len(rows) - 1} "
        f"other rows; the smoothing variance is underestimated there. {fix}"
    )
    warn(text)
    return {"smoothing_warning": text}


def _values(particles: np.ndarray, weights: np.ndarray) -> float:
    """How many values there are among particles (D, N), by the weights (N,) where they are shared.

    A value that many particles have can be all that the data leave; of values that one particle
    has each, a single one with all the weight is what is warned of.
    """
    values, which = np.unique(particles, axis=1, return_inverse=True)
    count = values.shape[1]
    if 2 * count > len(weights):
        return count
    return float(1.0 / np.sum(np.bincount(which.ravel(), weights) ** 2))
