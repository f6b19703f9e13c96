"""Statistics of one data set from its smoothed scores per step, S (..., T, K).

Quadratic forms 1/2 sum_st k(s, t) S_s S_t for the kernel k of a latent process. They take the first
row of each experiment in `starts`, and cost a pass over the rows. A row without information is 0.

Scores are compared on the scale of the observed information, that which each data set holds. What
acts only where a state seldom goes (a stop, an overflow, a curve far out) has next to no
information in most simulated sets and very much in a few. Its variance over the sets is that of
the few, and one of them may lie forty standard deviations out: enough to hide everything else in
the distribution of the largest. Given where the states went the information is known, and the score
is compared with that (D. Cox and D. Hinkley, *Theoretical Statistics* 1974, section 4.8, on
observed and expected information): a score S with the sum of squares R of its rows is divided by
sqrt(R / (2 r)) where R is more than twice the r of a typical set. Below that nothing is changed, as
R counts what is unmodelled along with the information, and scores whose rows depend on each other
have more of it than their squares say.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ssmppl.diagnosis.effects.candidate import WHOLE, segments

FREE = 2.0  # times a typical set's sum of squares, up to which a score is left as it is


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
            past = solve_banded((1, 0), bands, moved.reshape(len(rows), -1), check_finite=False)
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


def typical_squares(squares: np.ndarray) -> np.ndarray:
    """(K,) median of sums of squares (B, K) over the sets that have any; NaN where none has."""
    some = np.where(squares > 0.0, squares, np.nan)
    none = np.all(np.isnan(some), axis=0)
    return np.where(none, np.nan, np.nanmedian(np.where(none, 0.0, some), axis=0))


def information_scale(squares: np.ndarray, typical: np.ndarray) -> np.ndarray:
    """What scores with sums of squares (..., K) are divided by, where (K,) are typical."""
    return np.sqrt(np.fmax(squares / (FREE * typical), 1.0))
