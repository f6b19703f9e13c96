"""Statistics of one data set from its smoothed scores per step, S (..., T, K).

Quadratic forms 1/2 sum_st k(s, t) S_s S_t for the kernel k of a latent process. They take the first
row of each experiment in `starts`, and cost a pass over the rows. A row without information is 0.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ssmppl.gap.profiles import WHOLE, segments


def autoregressive(
    scores: np.ndarray, rho: Sequence[float], starts: Sequence[int] = WHOLE
) -> np.ndarray:
    """1/2 sum_st rho^|s - t| S_s S_t for each rho: (..., K, R), of an AR(1) load of variance 1."""
    from scipy.linalg import solve_banded  # slow to import

    scores = np.asarray(scores, float)
    found = np.zeros((*scores.shape[:-2], scores.shape[-1], len(rho)))
    for s in segments(scores.shape[-2], starts):
        part = scores[..., s, :]
        own = 0.5 * np.sum(part**2, axis=-2)
        rows = np.moveaxis(part, -2, 0)  # (T, ..., K)
        for i, r in enumerate(rho):
            moved = np.concatenate([np.zeros_like(rows[:1]), r * rows[:-1]])
            bands = np.stack([np.ones(len(rows)), np.full(len(rows), -r)])
            past = solve_banded((1, 0), bands, moved.reshape(len(rows), -1))
            # past_t = sum_{j >= 1} r^j S_{t-j}
            found[..., i] += own + np.sum(rows * past.reshape(rows.shape), axis=0)
    return found


def random_walk(scores: np.ndarray, starts: Sequence[int] = WHOLE) -> np.ndarray:
    """1/2 sum_st min(s, t) S_s S_t: (..., K), of a walk that restarts with each experiment.

    min(s, t) counts the innovations that two rows share, so that the form is half the sum of the
    squared sums from each row on: J. Nyblom and T. Makelainen, *CSDA* 1 (1983).
    """
    scores = np.asarray(scores, float)
    found = np.zeros((*scores.shape[:-2], scores.shape[-1]))
    for s in segments(scores.shape[-2], starts):
        onwards = np.cumsum(scores[..., s, :][..., ::-1, :], axis=-2)
        found += 0.5 * np.sum(onwards**2, axis=-2)
    return found
