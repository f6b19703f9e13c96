"""Family-wise p-values from the same simulated sets that gave the statistics their scale.

P. Westfall and S. Young, *Resampling-Based Multiple Testing* (1993), step-down maxT; the
correlations between candidates are in the maxima. A family of shapes of one effect (break dates,
delays, dead-zone widths) counts as one hypothesis whose statistic is its largest member.

The largest of hundreds of shapes lies higher by chance than a single statistic. Left as they are,
such families alone would make the distribution of the largest of all, and whatever has one shape
would have to stand as high as they do. So hypotheses are put on one scale before they are compared,
as the smallest p in place of the largest statistic does (section 2.5 there), but by a `NullScale`
of two numbers for each: the p values themselves would have to be counted far beyond the simulated
range.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import log_ndtr, ndtri_exp

from ssmppl.errors import ArgumentError

TAIL = 0.1  # share of the maxima to which the tail is fitted
FEWEST_IN_TAIL = 10
HEAVIEST = 0.5  # shape of a generalised Pareto law, beyond which its variance is infinite
MEDIAN, UPPER = 0.5, 0.95  # quantiles that set a scale
OUTER = 1.959963984540054  # the upper one of |normal|
BOTH = 2.409420839653209  # normals whose largest has the median of |normal|: log 1/2 / log 3/4


@dataclass(frozen=True)
class NullScale:
    """The common scale of groups: what is as rare for one |normal| as a height is for its group.

    number : (G,) of independent normals whose largest has the group's median. stretch : (G,) at
    least 1, by which its upper quantile lies further out than theirs.
    """

    number: np.ndarray
    stretch: np.ndarray

    @classmethod
    def of(cls, null: np.ndarray) -> NullScale:
        """The scale from simulated heights (B, G)."""
        middle = np.quantile(null, MEDIAN, axis=0)
        number = np.log(MEDIAN) / np.minimum(log_ndtr(middle), -1e-300)
        upper = np.quantile(_as_one(null, number), UPPER, axis=0)
        return cls(number, np.maximum(upper / OUTER, 1.0))

    def put(self, heights: np.ndarray) -> np.ndarray:
        """(..., G) heights on the common scale, on which they keep their order."""
        return _as_one(heights, self.number) / self.stretch


def _as_one(heights: np.ndarray, number: np.ndarray) -> np.ndarray:
    """z with P(|normal| > z) = P(largest of `number` normals > height)."""
    log_below = np.minimum(number * log_ndtr(heights), -1e-300)
    # far out 1 - Phi^n is n (1 - Phi), whose logarithm does not vanish
    log_above = np.where(
        log_below > -1e-12,
        np.log(number) + log_ndtr(-np.asarray(heights)),
        np.log(-np.expm1(np.minimum(log_below, -1e-300))),
    )
    return -ndtri_exp(log_above - np.log(2.0))


@dataclass(frozen=True)
class FamilyWise:
    """p-values with the whole family taken into account.

    labels : (G,) of the groups. p : (G,) step-down adjusted. p_single : (G,) against the
        distribution of
    the largest of all. best : (G,) column that leads its group. height : (G,) its statistic on the
    common scale. maxima : (B,) largest on that scale of each simulated set. scale : of the groups.
    sided : (G,) whether its strength has a sign.
    """

    labels: np.ndarray
    p: np.ndarray
    p_single: np.ndarray
    best: np.ndarray
    height: np.ndarray
    maxima: np.ndarray
    scale: NullScale
    sided: np.ndarray

    @property
    def leaders(self) -> list[int]:
        """The column that leads each group, that of the highest group first."""
        return [int(k) for k in self.best[np.argsort(-self.height, kind="stable")]]

    def put(self, label: int, height: float) -> float:
        """The height of a statistic of one group on the common scale."""
        at = int(np.searchsorted(self.labels, label))
        return float(NullScale(self.scale.number[at], self.scale.stretch[at]).put(np.array(height)))

    def cost(self, label: int) -> float:
        """Nats that the choice among a group's shapes is worth: log of their effective number,
        where the choice of a sign counts for nothing."""
        at = int(np.searchsorted(self.labels, label))
        return float(max(np.log(self.scale.number[at] / (1.0 if self.sided[at] else BOTH)), 0.0))

    def of_columns(self, groups: np.ndarray) -> np.ndarray:
        """(K,) the p of each column's group."""
        return self.p[np.searchsorted(self.labels, groups)]


def heights(statistic: np.ndarray, sided: np.ndarray | int = 0) -> np.ndarray:
    """How far statistics (..., K) lie out in the direction that counts: |z|, z or -z."""
    return np.where(np.equal(sided, 0), np.abs(statistic), np.sign(sided) * statistic)


def familywise(
    observed: np.ndarray,
    null: np.ndarray,
    *,
    sided: np.ndarray | int = 0,
    groups: np.ndarray | None = None,
) -> FamilyWise:
    """Step-down p-values of observed statistics (K,), null (B, K) of comparable scale.

    sided : as in `Null`. groups : (K,) labels of families of shapes; None: each column by itself.
    """
    observed, null = np.asarray(observed, float), np.asarray(null, float)
    if null.ndim != 2 or observed.shape != null.shape[1:] or not observed.size:
        raise ArgumentError(
            f"observed statistics of shape {observed.shape}, null ones of {null.shape}",
            fix="give (K,) and (B, K) with K at least 1",
        )
    marks = np.arange(observed.size) if groups is None else np.asarray(groups)
    labels, member = np.unique(marks, return_inverse=True)
    high, high_null = heights(observed, sided), heights(null, sided)
    best = np.array([np.flatnonzero(member == g)[np.argmax(high[member == g])]
                     for g in range(len(labels))])  # fmt: skip
    raw_null = np.stack([high_null[:, member == g].max(axis=1) for g in range(len(labels))], 1)
    scale = NullScale.of(raw_null)
    top, top_null = scale.put(high[best]), scale.put(raw_null)
    order = np.argsort(-top, kind="stable")
    # Column j: the largest among the groups that stand no higher than the j-th in the data.
    rest = np.maximum.accumulate(top_null[:, order[::-1]], axis=1)[:, ::-1]
    stepped = np.array([tail_p(top[g], rest[:, j]) for j, g in enumerate(order)])
    p = np.empty(len(labels))
    p[order] = np.maximum.accumulate(stepped)
    single = np.array([tail_p(h, rest[:, 0]) for h in top])
    signed = np.broadcast_to(np.asarray(sided), observed.shape)[best] != 0
    return FamilyWise(labels, p, single, best, top, rest[:, 0], scale, signed)


def tail_p(value: float, maxima: np.ndarray) -> float:
    """P(largest statistic >= value) from its B simulated values.

    By counting (with the observed set counted among them) up to the largest tenth; beyond, by a
    generalised Pareto distribution of the excesses (Pickands 1975; probability-weighted moments of
    Hosking and Wallis 1987). Made to err upwards: the shape is at least 0, an exponential tail,
    where normal statistics have lighter ones, and the mean excess is taken a standard error larger.
    """
    sets = len(maxima)
    ordered = np.sort(maxima)[::-1]
    n = max(FEWEST_IN_TAIL, int(TAIL * sets))
    if sets <= 2 * n or value <= ordered[n]:
        return float((1 + np.count_nonzero(maxima >= value)) / (sets + 1))
    excess = (ordered[:n] - ordered[n])[::-1]
    mean = float(excess.mean())
    if mean <= 0.0:
        return 1.0 / (sets + 1)
    weighted = float(np.mean((1.0 - (np.arange(1, n + 1) - 0.35) / n) * excess))
    shape = float(np.clip(2.0 - mean / (mean - 2.0 * weighted), 0.0, HEAVIEST))
    scale = mean * (1.0 - shape) * (1.0 + 1.0 / np.sqrt(n))
    beyond = (value - ordered[n]) / scale
    log_tail = -beyond if shape < 1e-6 else -np.log1p(shape * beyond) / shape
    return float((n + 1) / (sets + 1) * np.exp(log_tail))


def threshold(maxima: np.ndarray, alpha: float) -> float:
    """The value whose `tail_p` is alpha."""
    low, high = float(np.min(maxima)), float(np.max(maxima)) + 1.0
    while tail_p(high, maxima) > alpha:
        high += high - low
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if tail_p(middle, maxima) > alpha else (low, middle)
    return high
