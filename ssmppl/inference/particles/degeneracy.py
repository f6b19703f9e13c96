"""A warning where a particle smoother has collapsed: its draws of a state share a few values."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from ssmppl.data import Experiment
from ssmppl.data.times import label_text
from ssmppl.inference.particles.backward import ParticleSystem

FEW = 0.01  # of the values that there could be, below which the spread of the draws means little


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
        f"the smoother has collapsed: at t={worst + 1}{label} its {draws} draws share {count} "
        f"value{'s' if count > 1 else ''} of the states, so that their spread is not that of the "
        f"posterior, there and at {len(rows) - 1} other rows. {fix}"
    )
    warnings.warn(text, stacklevel=4)
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
