"""Efficient scores: what is left of a candidate's score once the nuisance scores are projected out.

B data sets simulated at the fitted parameters give the joint distribution of the candidates'
statistics S (K,) and of the nuisance scores S_theta (P,). The efficient statistic is the residual
of the regression of S on S_theta over the sets (C. R. Rao; here by parametric bootstrap, without
refits):

    S~ = S - I_k,theta I_theta,theta^-1 S_theta,    V = var S~,    z = S~ / sqrt(V),
    predicted gain z^2 / 2 nats,    first estimate of the strength S~ / V.

The score at the fitted parameters need not be zero (a mode under a prior, a fit that stopped
early): it is subtracted like that of any simulated set. First-order scores have mean zero and are
regressed without intercept; quadratic statistics (the scores in strength^2 of a latent process)
have their mean taken off, and their strength is that of strength^2.

A set that is part of the regression lies closer to it than one that is not, as the observed one.
Null statistics are therefore externally studentised residuals (Cook and Weisberg 1982, section
2.2.1): set b is predicted and scaled by the other sets; the observed one has the extra variance of
its own prediction. Both are Student's t with about B - P degrees of freedom.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.special import gammaincc, gammaln, ndtri_exp

from ssmppl.errors import ArgumentError

EIGENVALUE_CUT = 1e-10  # of I_theta,theta in correlation units: below it is rounding, not knowledge
# Candidates that keep a smaller share of their information are absorbed: with the parameters known
# to order T^-1/2, second-order terms of order 1 stand against S~ of order kappa sqrt(T).
ABSORBED = 0.03
LARGEST_SKEWNESS = float(np.sqrt(8.0))  # of a quadratic form in normals: one squared normal's
CONSTANT = "constant across simulated data sets"
SELDOM = "zero in almost all simulated data sets"
FEWEST_TELLING = 8  # sets in which a column is not zero, without which it says nothing
TAKEN = "not identifiable (collinear with the parameters)"
DROWNED = "smaller than the smoother's Monte Carlo error"
SPARE_SETS = 20  # degrees of freedom without which a residual variance says nothing


@dataclass(frozen=True)
class Regression:
    """Least squares of y (B, K) on x (B, P) over sets, rank-revealing.

    left_out : (B, K) prediction errors of each set from the others. spread : (K,) residual
    variance. dof : its degrees of freedom. leverage : (B,).
    """

    coefficients: np.ndarray
    mean: np.ndarray
    shift: np.ndarray
    left_out: np.ndarray
    residuals: np.ndarray
    spread: np.ndarray
    leverage: np.ndarray
    dof: int
    whiten: np.ndarray  # (P, r): x @ whiten has orthonormal columns over the sets
    base: float  # leverage of the intercept

    def predict_error(self, y: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Residuals of new statistics y (..., K) at x (..., P)."""
        return y - self.mean - (x - self.shift) @ self.coefficients

    def leverage_of(self, x: np.ndarray) -> float:
        """Variance of the prediction at x (P,), in units of the residual variance."""
        return self.base + float(np.sum(((x - self.shift) @ self.whiten) ** 2))

    @property
    def studentised(self) -> np.ndarray:
        """(B, K) `left_out` over its standard deviation, as the other sets give it."""
        free = 1.0 - self.leverage[:, None]
        rest = (self.dof * self.spread - self.left_out**2 * free) / (self.dof - 1)
        scale = np.sqrt(np.maximum(rest, 0.0) / free)
        return np.divide(self.left_out, scale, out=np.zeros_like(scale), where=scale > 0.0)


def regress(y: np.ndarray, x: np.ndarray, *, intercept: bool = False) -> Regression:
    """Regression of y (B, K) on x (B, P); directions of x that are linear combinations are cut.

    Raises
    ------
    ArgumentError : not `SPARE_SETS` more sets than regressors.
    """
    sets = len(y)
    mean = y.mean(axis=0) if intercept else np.zeros(y.shape[1])
    shift = x.mean(axis=0) if intercept else np.zeros(x.shape[1])
    centred = x - shift
    size = np.sqrt(np.mean(centred**2, axis=0))
    inverse = np.divide(1.0, size, out=np.zeros_like(size), where=size > 0.0)
    u, s, vt = np.linalg.svd(centred * inverse, full_matrices=False)
    kept = s**2 > EIGENVALUE_CUT * (s[0] ** 2 if s.size else 1.0)
    u, s, vt = u[:, kept], s[kept], vt[kept]
    dof = sets - int(kept.sum()) - int(intercept)
    if dof < SPARE_SETS:
        raise ArgumentError(
            f"{sets} bootstrap sets for {int(kept.sum())} nuisance scores",
            fix=f"simulate at least {sets - dof + SPARE_SETS} sets, or fix some parameters",
        )
    whiten = (vt.T / s) * inverse[:, None]
    coefficients = whiten @ (u.T @ (y - mean))
    residuals = y - mean - u @ (u.T @ (y - mean))
    base = 1.0 / sets if intercept else 0.0
    leverage = np.minimum(base + np.sum(u**2, axis=1), 1.0 - 1e-9)
    return Regression(
        coefficients, mean, shift, residuals / (1.0 - leverage)[:, None], residuals,
        np.sum(residuals**2, axis=0) / dof, leverage, dof, whiten, base,
    )  # fmt: skip


@dataclass(frozen=True)
class Null:
    """Statistics of B data sets simulated at the fitted parameters.

    columns : (B, K) of the candidates. nuisance : (B, P) scores in the parameters.
    quadratic : (K,) which columns are quadratic forms. sided : (K,) sign that the strength must
    have, 0 for both. noise : (K,) Monte Carlo variance of one set's column, from the smoother.
    """

    columns: np.ndarray
    nuisance: np.ndarray
    quadratic: np.ndarray
    sided: np.ndarray
    noise: np.ndarray

    @classmethod
    def of(
        cls, columns: Any, nuisance: Any, *, quadratic: Any = False, sided: Any = 0,
        noise: Any = 0.0,
    ) -> Null:  # fmt: skip
        """The null distribution, its shapes checked and scalars spread over the columns.

        Raises
        ------
        ArgumentError : a shape that does not fit, or a number that is not finite.
        """
        columns, nuisance = np.asarray(columns, float), np.asarray(nuisance, float)
        if columns.ndim != 2 or nuisance.ndim != 2 or len(columns) != len(nuisance):
            raise ArgumentError(
                f"columns of shape {columns.shape} and nuisance scores of shape {nuisance.shape}",
                fix="give (B, K) and (B, P): one row for each simulated data set",
            )
        for name, values in (("columns", columns), ("nuisance", nuisance)):
            if not np.all(np.isfinite(values)):
                row, k = np.argwhere(~np.isfinite(values))[0]
                raise ArgumentError(
                    f"{name}[{row}, {k}] is {values[row, k]}",
                    fix="leave out simulated sets, or candidates, without a finite score",
                )
        width = columns.shape[1]
        spread = [np.broadcast_to(np.asarray(v), (width,)) for v in (quadratic, sided, noise)]
        return cls(columns, nuisance, spread[0].astype(bool), np.sign(spread[1]).astype(int),
                   spread[2].astype(float))  # fmt: skip


@dataclass(frozen=True)
class Efficient:
    """Efficient statistics of one data set, beside their null distribution.

    score : (K,) S~. variance : (K,) V, Monte Carlo variance taken off. z, gain, strength : (K,);
    a quadratic column's z is the normal score of its studentised statistic (see `normal_score`),
    and its strength is that of strength^2. The gain is zero where the sign is not allowed.
    kappa : (K,) share sqrt(V / I_kk) that the parameters do not absorb. rho : (K, K) correlations
    of S~ (those between candidates that carry independent Monte Carlo noise come out too small by
    `noise_share`). statistic, null : (K,), (B, K) studentised, for `familywise`; zero where status
    is not "". noise_share : (K,) of the variance that is the smoother's.
    status : "" or why a column says nothing: `CONSTANT`, `SELDOM`, `TAKEN` or `DROWNED`.
    """

    score: np.ndarray
    variance: np.ndarray
    z: np.ndarray
    gain: np.ndarray
    strength: np.ndarray
    kappa: np.ndarray
    rho: np.ndarray
    statistic: np.ndarray
    null: np.ndarray
    noise_share: np.ndarray
    sided: np.ndarray
    status: tuple[str, ...]

    @cached_property
    def covariance(self) -> np.ndarray:
        """(K, K) of S~: rho scaled to the variances V."""
        size = np.sqrt(self.variance)
        return self.rho * size[:, None] * size


def efficient(null: Null, columns: np.ndarray, nuisance: np.ndarray) -> Efficient:
    """Efficient statistics of observed columns (K,) with nuisance score (P,) under `null`.

    V is the residual variance less the smoother's, yet at least two standard errors of the
    residual variance itself (a relative 2 sqrt(2 / dof)): less than that, these sets cannot tell
    from zero, and dividing by it would make strengths out of noise.

    A column that is zero in a set says nothing there: what acts where a state seldom goes. V is
    that of the sets in which it says something, or one of few would lie as far out as there are
    others; of fewer than `FEWEST_TELLING` of these there is none.
    """
    columns, nuisance = np.asarray(columns, float), np.asarray(nuisance, float)
    sets, width = null.columns.shape
    score, total, info = np.zeros(width), np.zeros(width), np.zeros(width)
    t, null_t, residuals = np.zeros(width), np.zeros((sets, width)), np.zeros((sets, width))
    dof = sets
    for intercept in (False, True):
        which = null.quadratic == intercept
        if not which.any():
            continue
        y = null.columns[:, which]
        fit = regress(y, null.nuisance, intercept=intercept)
        dof = min(dof, fit.dof)
        score[which] = fit.predict_error(columns[which], nuisance)
        total[which], residuals[:, which] = fit.spread, fit.residuals
        info[which] = np.sum((y - fit.mean) ** 2, axis=0) / (sets - int(intercept))
        size = np.sqrt(fit.spread * (1.0 + fit.leverage_of(nuisance)))
        t[which] = np.divide(score[which], size, out=np.zeros_like(size), where=size > 0.0)
        null_t[:, which] = fit.studentised
    telling = np.mean(null.columns != 0.0, axis=0)
    by = np.where(telling > 0.0, np.sqrt(telling), 1.0)
    total, info, t, null_t = total / by**2, info / by**2, t * by, null_t * by
    floor = 2.0 * np.sqrt(2.0 / dof)
    variance = np.maximum(total - null.noise, floor * total)
    info_left = np.maximum(info - null.noise, floor * info)
    kappa = np.sqrt(np.minimum(_ratio(variance, info_left), 1.0))
    # Residual variance that is either none of the column's own or cannot be told from the noise's.
    left = total - null.noise
    constant = info <= (1e-12 * np.max(np.abs(null.columns), axis=0, initial=0.0)) ** 2
    silent = constant | (left <= ABSORBED**2 * info_left + floor * np.minimum(null.noise, total))
    seldom = ~constant & (telling * sets < FEWEST_TELLING)
    silent |= seldom
    drowned = silent & ~constant & (null.noise > 0.5 * info)
    kappa[silent] = np.sqrt(np.clip(_ratio(left, info_left), 0.0, 1.0))[silent]
    t[silent], null_t[:, silent] = 0.0, 0.0
    t, null_t = balanced(t, null_t, null.quadratic)
    z = np.where(null.quadratic, t, _ratio(score, np.sqrt(variance)))
    z[silent] = 0.0
    allowed = (null.sided == 0) | (null.sided * z > 0)
    return Efficient(
        score, np.where(silent, 0.0, variance), z, np.where(allowed, 0.5 * z**2, 0.0),
        np.where(silent, 0.0, _ratio(score, variance)), kappa, _correlation(residuals, silent),
        t, null_t, np.minimum(_ratio(null.noise, total), 1.0),
        np.where(null.quadratic, 1, null.sided),
        tuple(np.select([constant, seldom, drowned, silent],
                        [CONSTANT, SELDOM, DROWNED, TAKEN], "").tolist()),
    )  # fmt: skip


def balanced(
    t: np.ndarray, null: np.ndarray, quadratic: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Studentised statistics (K,), (B, K), with the quadratic columns turned into normal scores.

    A random walk's statistic is nearly one squared normal: left as it is, its tail alone would set
    the distribution of the largest of all candidates, and nothing else could ever be found.
    """
    t, null = t.copy(), null.copy()
    for k in np.flatnonzero(quadratic):
        of_all, of_others = _skewness(null[:, k])
        t[k] = normal_score(t[k], of_all)
        null[:, k] = normal_score(null[:, k], of_others)
    return t, null


def normal_score(t: np.ndarray | float, skewness: np.ndarray | float) -> np.ndarray:
    """z with Phi(z) = F(t), F the standardised gamma distribution with this skewness.

    Three moments matched, exact for sums of equally weighted squared normals (P. Hall, *Statistics*
    14, 1983; M. Buckley and G. Eagleson 1988). Bounded below by -8.
    """
    t, skewness = np.asarray(t, float), np.maximum(skewness, 0.01)
    shape = 4.0 / skewness**2
    x = shape + t * np.sqrt(shape)
    inside = np.maximum(x, 1e-300)
    with np.errstate(divide="ignore"):
        tail = np.log(gammaincc(shape, inside))
    far = (shape - 1.0) * np.log(inside) - inside - gammaln(shape)  # leading term of Q(a, x)
    log_tail = np.where(tail > -600.0, tail, far)
    z = -ndtri_exp(np.minimum(log_tail, -1e-15))
    return np.where(x > 0.0, np.maximum(z, -8.0), -8.0)


def _skewness(values: np.ndarray) -> tuple[float, np.ndarray]:
    """Skewness of values (B,), and (B,) of all but each one: its own extreme must not excuse it."""
    x = (values - values.mean()) / (values.std() or 1.0)
    sums = np.array([np.sum(x**k) for k in (1, 2, 3)])
    powers, count = np.stack([x, x**2, x**3]), len(x)

    def of(sums: np.ndarray, n: int) -> np.ndarray:
        m1, m2, m3 = sums / n
        spread = np.maximum(m2 - m1**2, 1e-12)
        found = (m3 - 3.0 * m1 * m2 + 2.0 * m1**3) / spread**1.5
        return np.clip(found, 0.0, LARGEST_SKEWNESS)

    return float(of(sums, count)), of(sums[:, None] - powers, count - 1)


def _ratio(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.divide(a, b, out=np.zeros(np.shape(b)), where=b > 0.0)


def _correlation(residuals: np.ndarray, silent: np.ndarray) -> np.ndarray:
    size = np.sqrt(np.sum(residuals**2, axis=0))
    scaled = residuals * np.where(silent, 0.0, _ratio(np.ones_like(size), size))
    rho = np.clip(scaled.T @ scaled, -1.0, 1.0)
    np.fill_diagonal(rho, 1.0)
    return rho
