"""When the gap opens: the stretch of time that carries more of a statistic than its share.

The scores of a group summed over J bins of time, W_1 .. W_J, add up to S~. Projected on the
estimated strengths c = V^- S~ they are the statistic bin by bin. Under a missing term that acts all
the time, E W_w = V_w c for every window w: what a window has beyond its share,

    a_w - r_w a,    a_w = c' W_w,    r_w = cov(a_w, a) / var(a),

then has mean zero whether there is a gap or not, so that simulated sets without one calibrate its
largest value over windows. (Nyblom's argument, with a free beginning and end.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ssmppl.errors import ArgumentError
from ssmppl.gap.efficient import regress
from ssmppl.gap.familywise import tail_p
from ssmppl.gap.localise import Group

BINS = 24
LEAST_VARIANCE = 1e-3  # of a window's contrast, in shares of the whole: less is all of the record


@dataclass(frozen=True)
class When:
    """Rows first <= t < last that carry the gap; all of them where it is not confined.

    share : of the statistic that falls into the stretch. z : its excess, standardised.
    p : that a term acting all the time shows as large an excess somewhere.
    """

    first: int
    last: int
    share: float
    z: float
    p: float
    confined: bool


def bin_edges(rows: int, starts: Sequence[int] = (0,), bins: int = BINS) -> np.ndarray:
    """(J + 1,) first rows of about `bins` equal bins, no bin reaching across experiments."""
    ends = [*starts, rows]
    found = [0]
    for a, b in pairwise(ends):
        count = max(1, min(round(bins * (b - a) / rows), b - a))
        found += np.linspace(a, b, count + 1).round().astype(int)[1:].tolist()
    return np.unique(found)


def binned(scores: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """(..., J, D) sums of scores (..., T, D) over bins."""
    return np.add.reduceat(np.asarray(scores, float), np.asarray(edges)[:-1], axis=-2)


def when(
    group: Group,
    columns: np.ndarray,
    observed: np.ndarray,
    nuisance: np.ndarray,
    observed_nuisance: np.ndarray,
    edges: np.ndarray,
    *,
    alpha: float = 0.05,
) -> When:
    """The stretch of time that carries the group's statistic, and whether it is a stretch at all.

    Parameters
    ----------
    group : from `group_score`; its strengths are what the scores are projected on.
    columns, observed : (B, J, D), (J, D) scores summed over bins (`binned`).
    nuisance, observed_nuisance : (B, J, P), (J, P) likewise; scores of other groups may be
        appended, to be projected out too.
    edges : (J + 1,) from `bin_edges`.

    Raises
    ------
    ArgumentError : fewer than three bins, or shapes that do not belong together.
    """
    columns, observed = np.asarray(columns, float), np.asarray(observed, float)
    sets, bins, width = columns.shape
    if bins < 3 or len(edges) != bins + 1 or observed.shape != (bins, width):
        raise ArgumentError(
            f"scores of shape {columns.shape}, observed {observed.shape}, {len(edges)} edges",
            fix="give (B, J, D), (J, D) and J + 1 edges, with J at least 3",
        )
    left = _left(columns, observed, nuisance, observed_nuisance)
    total = left.sum(axis=1)
    strength = total @ group.inverse  # (B + 1, D) the observed set last
    first, last = np.triu_indices(bins + 1, 1)
    inside = last - first < bins
    first, last = first[inside], last[inside]
    summed = np.concatenate([np.zeros((sets + 1, 1, width)), np.cumsum(left, axis=1)], axis=1)
    windows = summed[:, last] - summed[:, first]  # (B + 1, windows, D)
    null = windows[:sets]
    own = np.einsum("bwi,bwj->wij", null, null) / sets
    cross = np.einsum("bwi,bj->wij", null, total[:sets]) / sets
    whole = total[:sets].T @ total[:sets] / sets

    a = np.einsum("bwi,bi->bw", windows, strength)
    carried = np.sum(total * strength, axis=1)[:, None]

    def moment(matrices: np.ndarray, product: np.ndarray) -> np.ndarray:
        """c_b' M c_b, M the mean over the simulated sets other than b."""
        of_all = np.einsum("bi,wij,bj->bw", strength, matrices, strength, optimize=True)
        others = (sets * of_all[:sets] - product[:sets]) / (sets - 1)
        return np.concatenate([others, of_all[sets:]])

    scale = np.maximum(moment(whole[None], carried**2), 1e-300)
    part = moment(cross, a * carried) / scale
    variance = np.maximum(moment(own, a**2) / scale - part**2, LEAST_VARIANCE) * scale
    # `part` is a regression coefficient from as many sets: its error counts where a is large.
    excess = (a - part * carried) / np.sqrt(variance * (1.0 + carried**2 / scale / sets))
    largest = excess.max(axis=1)
    best = int(np.argmax(excess[-1]))
    z = float(largest[-1])
    p = tail_p(z, largest[:sets])
    if p > alpha:
        return When(int(edges[0]), int(edges[-1]), 1.0, z, p, False)
    share = float(a[-1, best] / max(float(carried[-1, 0]), 1e-300))
    return When(int(edges[first[best]]), int(edges[last[best]]), share, z, p, True)


def _left(
    columns: np.ndarray, observed: np.ndarray, nuisance: np.ndarray, seen: np.ndarray
) -> np.ndarray:
    """(B + 1, J, D) efficient scores by bin, each set's as the other sets predict them; last: seen.

    Scaled to the variance of a residual, as the totals in `Fit.studentised` are.
    """
    totals = nuisance.sum(axis=1)
    fit = regress(columns.sum(axis=1), totals)
    gram = fit.whiten @ fit.whiten.T  # inverse of the regressors' sums of squares
    without = np.einsum("bp,bd->bpd", totals @ gram, fit.left_out)
    left = columns - nuisance @ (fit.coefficients - without)
    last = (observed - seen @ fit.coefficients) / np.sqrt(1.0 + fit.leverage_of(seen.sum(axis=0)))
    return np.concatenate([left * np.sqrt(1.0 - fit.leverage)[:, None, None], last[None]])
