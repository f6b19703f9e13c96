"""Information matrices that steps and standard errors can be made of."""

from __future__ import annotations

import numpy as np

SPREAD = 0.1  # least information of a logarithm that steps are made with
INFLATED = 10.0  # times the curvature, in any direction, that no scatter of the scores makes


def positive_definite(information: np.ndarray, logarithms: np.ndarray) -> np.ndarray:
    """The projection of `information` (F, F) on positive definite matrices, for steps of a climb.

    logarithms : (F,) are known to have moderate units, and steps of them are kept moderate.
    """
    scale = np.sqrt(np.maximum(np.abs(np.diagonal(information)), np.where(logarithms, SPREAD, 0.0)))
    scale = np.where(scale > 0.0, scale, 1.0)
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    projected = (vectors * np.maximum(np.abs(values), 0.05)) @ vectors.T
    return projected * np.outer(scale, scale)


def not_inflated(
    simulated: np.ndarray, curvature: np.ndarray, free: tuple[np.ndarray, ...]
) -> np.ndarray:
    """The information by simulated scores (F, F), or the curvature of the likelihood, where that is
    one and far less.

    A score is a mean of complete-data scores over smoothed trajectories. Where a state has no noise
    and is observed next to exactly, each of these is next to infinite, and their mean mostly its
    Monte Carlo error: its square is no information.

    free : the index of what is at no bound, as of `np.ix_`.
    """
    one, other = simulated[free], curvature[free]
    if not (np.all(np.isfinite(other)) and np.all(np.linalg.eigvalsh(other) > 0.0)):
        return simulated
    if not np.all(np.isfinite(one)):
        return curvature
    root = np.linalg.inv(np.linalg.cholesky(other))
    return curvature if np.linalg.eigvalsh(root @ one @ root.T)[-1] > INFLATED else simulated
