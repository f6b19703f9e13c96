"""A quadratic fitted to noisy values of a function round a point: its top, and its shape there.

A covariance for steps (`fitted_covariance`) is that of the Gaussian that a log density looks like,
by weighted least squares on points scattered round the mode, each value with common random numbers.
A fit over a whole region is not misled by the raggedness of single estimates, as differences over
short steps would be.

A maximum likelihood estimate (`fit_quadratic`) is the top of a quadratic, and its error that of the
coefficients (E. L. Ionides, C. Bretó, J. Park, R. A. Smith and A. A. King, "Monte Carlo profile
confidence intervals for dynamic systems", *J. R. Soc. Interface* 14 (2017)). Here it is a function
of all F parameters, and two things are different.

Estimates Z of a likelihood are unbiased; their logs are too low by half their variance, which is
not the same everywhere and would move the top. So the quadratic q is fitted to Z itself, by the
estimating equation of a distribution whose standard deviation is in proportion to its mean,

    sum_j x_j (Z_j / exp(q(u_j)) - 1) = 0,    x_j the monomials at u_j,

which has mean zero at the truth whatever the noise (P. McCullagh and J. A. Nelder, *Generalized
Linear Models*, 2nd edition 1989, chapters 8 and 9). The coefficients' covariance is the sandwich of
the same terms, in which what the quadratic misses counts as noise.

A likelihood is skew. Third derivatives bend the slope of a quadratic fitted over a region: over
points scattered evenly in all directions by s, slope i is off by s^2 / 2 times the sum over j of
the derivatives i, j, j. So q has terms u_i |u|^2 too, which take just this part.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

NEWTON_STEPS = 100  # of the estimating equation
AT_REST = 1e-12  # fall of the loss that is promised, after which there are no more
SAFE = 0.1  # share of the expected second derivatives that is added to the observed ones
LEAST_SHARE = 1e-4  # of a step that is taken, and of what it promises
SCATTER = 1.5  # standard deviations by which the points of `fitted_covariance` are scattered
INFORMATION = 1.0 / 16.0, 16.0  # between these it may be, in units of the first guess


@dataclass(frozen=True)
class LocalQuadratic:
    """q(u) = a + b'u - u'Hu/2 + (c'u) |u|^2.

    b, c : (F,). h : (F, F). covariance : of all coefficients, in the order of `monomials`.
    misfit : mean square of (Z - exp(q)) / exp(q).
    """

    b: np.ndarray
    h: np.ndarray
    c: np.ndarray
    covariance: np.ndarray
    misfit: float

    def slope(self, u: np.ndarray) -> np.ndarray:
        """(F,) of q at u (F,)."""
        return self.b - self.h @ u + self.c * (u @ u) + 2.0 * (self.c @ u) * u

    def information(self, u: np.ndarray) -> np.ndarray:
        """(F, F) minus the second derivatives at u (F,)."""
        mixed = np.outer(self.c, u)
        return self.h - 2.0 * (mixed + mixed.T + (self.c @ u) * np.eye(len(u)))

    def shape(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Eigenvalues (F,) of H, their standard errors, and eigenvectors."""
        values, vectors = np.linalg.eigh(self.h)
        d = len(values)
        i, j = np.tril_indices(d)
        rows = -(vectors[i] * vectors[j]).T * 2.0  # of v'Hv in the coefficients of u_i u_j
        part = self.covariance[1 + d : 1 + d + len(i), 1 + d : 1 + d + len(i)]
        return values, np.sqrt(np.einsum("fk,kl,fl->f", rows, part, rows)), vectors

    def error(self, u: np.ndarray) -> np.ndarray:
        """(F, F) covariance of a top at u, by the delta method."""
        skew = len(self.covariance) > count(len(u), skew=False)
        inverse = np.linalg.inv(self.information(u))
        rows = inverse @ slopes_of_monomials(u, skew)
        return rows @ self.covariance @ rows.T


def count(d: int, skew: bool) -> int:
    """How many coefficients q has in d dimensions."""
    return 1 + d + d * (d + 1) // 2 + (d if skew else 0)


def monomials(u: np.ndarray, skew: bool) -> np.ndarray:
    """(n, K) of points u (n, F): 1, u_i, u_i u_j (j <= i), and u_i |u|^2 if skew."""
    i, j = np.tril_indices(u.shape[1])
    columns = [np.ones((len(u), 1)), u, u[:, i] * u[:, j]]
    if skew:
        columns.append(u * np.sum(u**2, axis=1, keepdims=True))
    return np.hstack(columns)


def information_of(coefficients: np.ndarray, d: int) -> np.ndarray:
    """(d, d) minus the second derivatives at zero of what has these coefficients."""
    i, j = np.tril_indices(d)
    out = np.zeros((d, d))
    out[i, j] = -coefficients[1 + d : 1 + d + len(i)]
    return out + out.T


def slopes_of_monomials(u: np.ndarray, skew: bool) -> np.ndarray:
    """(F, K) derivatives of the monomials at one point u (F,)."""
    one = np.eye(len(u))
    i, j = np.tril_indices(len(u))
    parts = [np.zeros((len(u), 1)), one, one[:, i] * u[j] + one[:, j] * u[i]]
    if skew:
        parts.append((u @ u) * one + 2.0 * np.outer(u, u))
    return np.hstack(parts)


def fit_quadratic(u: np.ndarray, log_z: np.ndarray, skew: bool) -> LocalQuadratic | None:
    """The fit to log Z (n,) at points u (n, F), -inf where an estimate is zero.

    None where too few are finite, or the scoring does not come to rest.
    """
    d, x = u.shape[1], monomials(u, skew)
    finite = np.isfinite(log_z)
    if finite.sum() <= x.shape[1]:
        return None
    log_z = log_z - log_z[finite].max()  # a matter of the constant, and of rounding
    with np.errstate(all="ignore"):
        near = np.exp(0.125 * np.minimum(log_z[finite] + d, 0.0))  # far points are not quadratic
        begin = np.linalg.lstsq(x[finite] * near[:, None], log_z[finite] * near, rcond=None)[0]
        beta = _solved(x, log_z, begin)
        if beta is None:
            return None
        rest = np.exp(log_z - x @ beta) - 1.0
    inverse = np.linalg.inv(x.T @ x)
    leverage = np.einsum("nk,kl,nl->n", x, inverse, x)
    off = (x * (rest / np.maximum(1.0 - leverage, 0.1))[:, None]) @ inverse
    third = beta[count(d, skew=False) :] if skew else np.zeros(d)
    return LocalQuadratic(
        beta[1 : 1 + d], information_of(beta, d), third,
        off.T @ off, float(np.mean(rest**2)),
    )  # fmt: skip


def _solved(x: np.ndarray, log_z: np.ndarray, beta: np.ndarray) -> np.ndarray | None:
    """(K,) the root of the estimating equation: by damped Newton steps to the minimum of the convex
    sum_j Z_j / exp(x_j beta) + x_j beta, whose derivative it is."""

    def loss(beta: np.ndarray) -> float:
        return float(np.sum(np.exp(log_z - x @ beta) + x @ beta))

    value = loss(beta)
    for _ in range(NEWTON_STEPS):
        ratio = np.exp(log_z - x @ beta)
        try:
            step = np.linalg.solve((x.T * (ratio + SAFE)) @ x, x.T @ (ratio - 1.0))
        except np.linalg.LinAlgError:
            return None
        share, fall = 1.0, float(step @ (x.T @ (ratio - 1.0)))
        if not np.isfinite(fall):
            return None
        if fall < AT_REST:
            return beta
        while not (new := loss(beta + share * step)) < value - LEAST_SHARE * share * fall:
            share *= 0.5
            if share < LEAST_SHARE:
                return None
        beta, value = beta + share * step, new
    return None


def fitted_covariance(
    log_density: Callable[[np.ndarray], float], w: np.ndarray, scale: np.ndarray,
    rng: np.random.Generator, rounds: int = 2,
) -> np.ndarray:  # fmt: skip
    """Covariance (d, d) of the Gaussian that log_density looks like round w (d,).

    scale : (d,) first guess of its standard deviations. Directions in which the fit finds no fall,
    or one far off the guess, keep a bounded share of the guess.
    """
    d = len(w)
    factor = np.diag(scale)
    for _ in range(rounds if d else 0):
        information = fitted_information(log_density, w, factor, rng)
        values, vectors = np.linalg.eigh(information)
        root = vectors / np.sqrt(np.clip(values, *INFORMATION))
        # its Cholesky factor but for signs; the product itself need not be positive by rounding
        factor = np.linalg.qr((factor @ root).T)[1].T
    return factor @ factor.T


def fitted_information(
    log_density: Callable[[np.ndarray], float], w: np.ndarray, factor: np.ndarray,
    rng: np.random.Generator,
) -> np.ndarray:  # fmt: skip
    """Minus the second derivatives in u, where w + factor u is the point; NaN-free.

    The identity where too few points have a finite density to fit it.
    """
    d = len(w)
    coefficients = count(d, skew=False)
    n = max(4 * coefficients, 30)
    half = SCATTER * rng.standard_normal((n // 2, d))
    u = np.vstack([half, -half])  # antithetic, so that odd terms do not disturb the even ones
    log_p = np.array([log_density(w + factor @ v) for v in u])
    finite = np.isfinite(log_p)
    if finite.sum() < coefficients:
        return np.eye(d)
    u, log_p = u[finite], log_p[finite]
    drop = log_p.max() - log_p
    weight = np.exp(-0.25 * np.maximum(drop - d, 0.0))  # the far points are not quadratic
    root = np.sqrt(weight)[:, None]
    found, *_ = np.linalg.lstsq(monomials(u, False) * root, log_p * root[:, 0], rcond=None)
    return information_of(found, d)
