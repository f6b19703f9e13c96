"""The covariance of a posterior near its mode, from a quadratic fitted to estimates of its log.

The log likelihood is estimated with common random numbers at points scattered round the mode; a
full quadratic is fitted to log p by weighted least squares, and minus its second derivatives are
the information. A fit over a whole region is not misled by the raggedness of single estimates, as
differences over short steps would be.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

REACH = 1.5  # standard deviations by which the points are scattered
LEAST, MOST = 1.0 / 16.0, 4.0  # how far the fitted information may go from the scales' own


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
        root = vectors / np.sqrt(np.clip(values, LEAST, MOST**2))
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
    pairs = [(i, j) for i in range(d) for j in range(i + 1)]
    n = max(4 * (1 + d + len(pairs)), 30)
    half = REACH * rng.standard_normal((n // 2, d))
    u = np.vstack([half, -half])  # antithetic, so that odd terms do not disturb the even ones
    log_p = np.array([log_density(w + factor @ v) for v in u])
    finite = np.isfinite(log_p)
    if finite.sum() < 1 + d + len(pairs):
        return np.eye(d)
    u, log_p = u[finite], log_p[finite]
    drop = log_p.max() - log_p
    weight = np.exp(-0.25 * np.maximum(drop - d, 0.0))  # the far points are not quadratic
    design = np.column_stack([np.ones(len(u)), u, *(u[:, i] * u[:, j] for i, j in pairs)])
    root = np.sqrt(weight)[:, None]
    found, *_ = np.linalg.lstsq(design * root, log_p * root[:, 0], rcond=None)
    information = np.zeros((d, d))
    for (i, j), value in zip(pairs, found[1 + d :], strict=True):
        information[i, j] = information[j, i] = -value * (2.0 if i == j else 1.0)
    return information
