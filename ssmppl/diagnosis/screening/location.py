"""Location of the gap: equation and moment, stretch of time, region of states and inputs.

A group is the scores of one equation and moment in the strengths of D basis functions. With the
nuisance scores (and the other groups, or the catalogue) regressed out, its statistic is

    Q = S~' M^-1 S~,    M = (1 - w) V + w m I    in correlation units,

V the bootstrap's covariance, its directions of next to no variance cut, w the shrinkage of Ledoit
and Wolf (*J. Multivariate Analysis* 88, 2004): with B = 200 sets and D = 12 the small eigenvalues
of V come out too small, and their inverses would rule Q. Set b is measured by the V of the other
sets (Sherman and Morrison), as the observed one is; Q in turn is put on the normal scale by its
simulated distribution, so that groups of different size compare.

When the gap opens is the stretch of time that carries more of a statistic than its share. The
scores of a group summed over J bins of time, W_1 .. W_J, add up to S~. Projected on the estimated
strengths c = V^- S~ they are the statistic bin by bin. Under a missing term that acts all the time,
E W_w = V_w c for every window w: what a window has beyond its share,

    a_w - r_w a,    a_w = c' W_w,    r_w = cov(a_w, a) / var(a),

then has mean zero whether there is a gap or not, so that simulated sets without one calibrate its
largest value over windows. (Nyblom's argument, with a free beginning and end.)
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from ssmppl.diagnosis.screening.efficient_score import balanced, regress
from ssmppl.diagnosis.screening.familywise import familywise, tail_p
from ssmppl.errors import ArgumentError

if TYPE_CHECKING:
    import pandas as pd

RANK_CUT = 1e-3  # of the largest eigenvalue, in units in which every unprojected score has size 1
KEPT = 0.999  # share of the variance of what is projected out that its components must hold
SHARE = 4  # one component of what is projected out takes at least this many sets
BINS = 24  # of time
LEAST_VARIANCE = 1e-3  # of a window's contrast, in shares of the whole: less is all of the record


@dataclass(frozen=True)
class BasisGroupScore:
    """Efficient scores of D basis functions in one data set, beside their null distribution.

    score : (D,) S~. covariance : (D, D) V. inverse : (D, D) M^-1, in the directions kept.
    statistic : Q. z : its normal score. null : (B,) those of the simulated sets. kappa :
    share of the standard deviation that is left of the scores. rank : directions kept.
    shrinkage : w.
    """

    score: np.ndarray
    covariance: np.ndarray
    inverse: np.ndarray
    statistic: float
    z: float
    null: np.ndarray
    kappa: float
    rank: int
    shrinkage: float

    @property
    def p(self) -> float:
        """p of this group alone."""
        return tail_p(self.z, self.null)

    @property
    def estimate(self) -> np.ndarray:
        """(D,) strengths of the basis functions, V^- S~."""
        return self.inverse @ self.score


def group_score(
    columns: np.ndarray,
    observed: np.ndarray,
    nuisance: np.ndarray,
    observed_nuisance: np.ndarray,
    others: np.ndarray | None = None,
    observed_others: np.ndarray | None = None,
) -> BasisGroupScore:
    """A group's statistic with the nuisance scores and `others` projected out.

    Parameters
    ----------
    columns, observed : (B, D), (D,) scores of the basis functions.
    nuisance, observed_nuisance : (B, P), (P,).
    others, observed_others : (B, K), (K,) of the other groups, or of the catalogue. There may be
        more of them than sets: their leading principal components stand for them (at most one for
        `SHARE` sets, at least `KEPT` of their variance where that is fewer).
    """
    columns, observed = np.asarray(columns, float), np.asarray(observed, float)
    x, x0 = np.asarray(nuisance, float), np.asarray(observed_nuisance, float)
    if columns.ndim != 2 or observed.shape != columns.shape[1:] or len(x) != len(columns):
        raise ArgumentError(
            f"scores of shape {columns.shape}, observed {observed.shape}, nuisance {x.shape}",
            fix="give (B, D), (D,) and (B, P)",
        )
    if others is not None and np.shape(others)[1]:
        rest, rest0 = _components(np.asarray(others, float), np.asarray(observed_others), x, x0)
        x, x0 = np.hstack([x, rest]), np.hstack([x0, rest0])
    fit = regress(columns, x)
    sets, size = len(columns), np.sqrt(np.mean(columns**2, axis=0))
    inverse_size = np.divide(1.0, size, out=np.zeros_like(size), where=size > 0.0)
    residuals = fit.residuals * inverse_size
    score = fit.predict_error(observed, x0)
    v = residuals.T @ residuals / fit.dof
    values, vectors = np.linalg.eigh(v)
    kept = values > RANK_CUT * max(float(values[-1]), 1e-6)
    rank = int(kept.sum())
    # In the directions kept, each set as the others predict it, with one scale for all sets.
    left = fit.left_out * np.sqrt(1.0 - fit.leverage)[:, None] * inverse_size @ vectors[:, kept]
    new = score * inverse_size @ vectors[:, kept] / np.sqrt(1.0 + fit.leverage_of(x0))
    c = np.diag(values[kept])
    w = _shrinkage(left, c) if rank else 0.0
    m = (1.0 - w) * c + w * (np.trace(c) / max(rank, 1)) * np.eye(rank)
    inverse = np.linalg.inv(m)
    q = np.einsum("bi,ij,bj->b", left, inverse, left)
    # Without set b, the sums of squares and products lack exactly the square of its `left`.
    own = np.maximum(1.0 - (1.0 - w) / fit.dof * q, 1e-3)
    q_null = q * (1.0 - 1.0 / fit.dof) / own
    q_seen = float(new @ inverse @ new)
    z, null = _normal(q_seen, q_null)
    full = inverse_size[:, None] * (vectors[:, kept] @ inverse @ vectors[:, kept].T) * inverse_size
    info = float(np.trace(columns.T @ columns * np.outer(inverse_size, inverse_size))) / sets
    kappa = float(np.sqrt(min(np.trace(v) / info, 1.0))) if info > 0.0 else 0.0
    return BasisGroupScore(
        score, v * np.outer(size, size), full, q_seen, z, null, kappa, rank, w,
    )  # fmt: skip


def localise(
    groups: Mapping[Hashable, tuple[np.ndarray, np.ndarray]],
    nuisance: np.ndarray,
    observed_nuisance: np.ndarray,
    places: Mapping[Hashable, Hashable] | None = None,
) -> tuple[pd.DataFrame, dict[Hashable, BasisGroupScore]]:
    """Each group with those of all other places projected out; p family-wise over the groups.

    groups : by key, for instance (equation, moment): columns (B, D) and observed (D,). places : of
        each key; None: each is its own.

    Returns
    -------
    Table key, statistic, z, p, kappa, and z_alone, p_alone: with the nuisance scores alone
    projected out. Where those are large and the former are not, the equations cannot be told apart
    by these data. p_either is that of the larger of the two z: who looks at both looks twice. And
    the groups themselves, by key, with the others projected out.
    """
    import pandas as pd

    keys = list(groups)
    at = {k: k for k in keys} if places is None else places
    alone, given_others = [], []
    for key in keys:
        columns, observed = groups[key]
        rest = [groups[k] for k in keys if at[k] != at[key]]
        alone.append(group_score(columns, observed, nuisance, observed_nuisance))
        others = np.hstack([c for c, _ in rest]) if rest else None
        seen = np.hstack([o for _, o in rest]) if rest else None
        given_others.append(
            group_score(columns, observed, nuisance, observed_nuisance, others, seen)
        )

    def together(found: list[BasisGroupScore]) -> np.ndarray:
        z, null = np.array([g.z for g in found]), np.stack([g.null for g in found], axis=1)
        return familywise(z, null, sided=1, groups=np.arange(len(found)) % len(keys)).p

    table = pd.DataFrame({
        "key": pd.Series(keys, dtype=object), "statistic": [g.statistic for g in given_others],
        "z": [g.z for g in given_others], "p": together(given_others),
        "kappa": [g.kappa for g in given_others],
        "z_alone": [g.z for g in alone], "p_alone": together(alone),
        "p_either": together([*given_others, *alone]),
    })  # fmt: skip
    return table, dict(zip(keys, given_others, strict=True))


# --- the curve of what is missing ----------------------------------------------------------------


@dataclass(frozen=True)
class Curve:
    """Estimated values (G,) of a missing term, their standard errors and a pointwise band.

    Known up to what the parameters of the model could have absorbed: that part is left out.
    """

    estimate: np.ndarray
    error: np.ndarray
    low: np.ndarray
    high: np.ndarray

    @property
    def z(self) -> np.ndarray:
        """(G,) estimate over its error."""
        return np.divide(self.estimate, self.error, out=np.zeros_like(self.error),
                         where=self.error > 0.0)  # fmt: skip


def curve(group: BasisGroupScore, design: np.ndarray, level: float = 0.95) -> Curve:
    """sum_d coef_d b_d at points whose basis values are design (G, D), coef = V^- S~."""
    from scipy.special import ndtri

    design = np.asarray(design, float)
    spread = group.inverse @ group.covariance @ group.inverse
    error = np.sqrt(np.maximum(np.einsum("gi,ij,gj->g", design, spread, design), 0.0))
    value, q = design @ group.estimate, float(ndtri(0.5 + 0.5 * level))
    return Curve(value, error, value - q * error, value + q * error)


def regions(
    group: BasisGroupScore, functions: Any, values: np.ndarray, name: str = "x", count: int = 5
) -> pd.DataFrame:
    """Table region, low, high, estimate, se, z: the missing term's mean over parts of a variable.

    Parameters
    ----------
    functions : the D basis functions of the variable. values : what it was; the parts are its
        `count` quantile intervals.
    """
    import pandas as pd

    values = np.asarray(values, float).ravel()
    values = values[np.isfinite(values)]
    edges = np.unique(np.quantile(values, np.linspace(0.0, 1.0, count + 1)))
    where = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, max(len(edges) - 2, 0))
    shapes = np.stack([np.broadcast_to(f(values), values.shape) for f in functions], axis=1)
    parts = np.unique(where)
    found = curve(group, np.stack([shapes[where == i].mean(axis=0) for i in parts]))
    low, high = edges[parts], edges[np.minimum(parts + 1, len(edges) - 1)]
    return pd.DataFrame({
        "region": [f"{name} in {a:.3g} to {b:.3g}" for a, b in zip(low, high, strict=True)],
        "low": low, "high": high, "estimate": found.estimate, "se": found.error, "z": found.z,
    })  # fmt: skip


# --- inside --------------------------------------------------------------------------------------


def _normal(value: float, null: np.ndarray) -> tuple[float, np.ndarray]:
    """A statistic that is large when something is wrong, and its null distribution, as normal
    scores."""
    spread = null.std()
    if not spread > 0.0:
        return 0.0, np.zeros_like(null)
    centre = null.mean()
    z, out = balanced(np.array([(value - centre) / spread]), ((null - centre) / spread)[:, None],
                      np.array([True]))  # fmt: skip
    return float(z[0]), out[:, 0]


def _components(
    others: np.ndarray, seen: np.ndarray, x: np.ndarray, x0: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Principal components (B, R), (R,) of the others' efficient scores in correlation units."""
    fit = regress(others, x)
    size = np.sqrt(fit.spread)
    known = size > 1e-6 * np.sqrt(np.mean(others**2, axis=0))
    scaled = fit.residuals[:, known] / size[known]
    _, s, vt = np.linalg.svd(scaled, full_matrices=False)
    most = max(len(others) // SHARE - x.shape[1], 1)
    enough = int(np.searchsorted(np.cumsum(s**2), KEPT * np.sum(s**2))) + 1
    axes = vt[: min(most, enough)].T
    return scaled @ axes, (fit.predict_error(seen, x0)[known] / size[known]) @ axes


def _shrinkage(x: np.ndarray, c: np.ndarray) -> float:
    """Ledoit and Wolf's weight of the multiple of the identity, rows of x with covariance c."""
    size = c.shape[0]
    target = np.trace(c) / size * np.eye(size)
    distance = float(np.sum((c - target) ** 2))
    if distance <= 0.0:
        return 1.0
    spread = np.sum(np.sum(x**2, axis=1) ** 2) / len(x) - np.sum(c**2)
    return float(np.clip(spread / len(x) / distance, 0.0, 1.0))


# --- when ----------------------------------------------------------------------------------------


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
    group: BasisGroupScore,
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
    null = windows[:sets].transpose(1, 2, 0)  # (windows, D, B)
    own = null @ null.transpose(0, 2, 1) / sets
    cross = null @ total[:sets] / sets
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

    Scaled to the variance of a residual, as the totals in `Regression.studentised` are.
    """
    totals = nuisance.sum(axis=1)
    fit = regress(columns.sum(axis=1), totals)
    gram = fit.whiten @ fit.whiten.T  # inverse of the regressors' sums of squares
    without = np.einsum("bp,bd->bpd", totals @ gram, fit.left_out)
    left = columns - nuisance @ (fit.coefficients - without)
    last = (observed - seen @ fit.coefficients) / np.sqrt(1.0 + fit.leverage_of(seen.sum(axis=0)))
    return np.concatenate([left * np.sqrt(1.0 - fit.leverage)[:, None, None], last[None]])
