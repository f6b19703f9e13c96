"""Functions of probability that SciPy has not as ufuncs, and the Cholesky factor of a singular
matrix, which NumPy has not, for the interpreter: arrays in, array out.

The compiled kernels (`codegen/kernels/math/special.py`) compute the same by other ways.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.special as sp

BISECTIONS = 80
LARGEST_COUNT = 2.0**53
NODES, WEIGHTS = np.polynomial.legendre.leggauss(40)
PIECES = 6
# Points and weights of the double exponential rule on the unit interval.
_AT = np.arange(-80, 81) / 24.0
RULE = 0.5 * np.exp(0.5 * np.pi * np.sinh(_AT)) / np.cosh(0.5 * np.pi * np.sinh(_AT))
RULE_WEIGHTS = np.cosh(_AT) / np.cosh(0.5 * np.pi * np.sinh(_AT)) ** 2 * np.pi / 96.0
PIVOT = 1e-13  # of a variance, below which what is left of it is taken for rounding
FARTHEST = 42.0  # exp(-42) of the density at the end of the integral is below rounding
UNIFORM, SUMMED = 100.0, 1e8  # sizes of Bessel functions, where their expansion begins and sums end


def _wide(*values: Any) -> list[np.ndarray]:
    return [np.array(v, dtype=float) for v in np.broadcast_arrays(*values)]


def _stirling_error(x: np.ndarray) -> np.ndarray:
    """log Gamma(x) - ((x - 1/2) log x - x + log(2 pi) / 2) for x >= 15."""
    z = x**-2
    q = 1.0 / 1680.0 - z * (1.0 / 1188.0 - z * (691.0 / 360360.0 - z / 156.0))
    error: np.ndarray = (1.0 / 12.0 - z * (1.0 / 360.0 - z * (1.0 / 1260.0 - z * q))) / x
    return error


def _digamma_error(x: np.ndarray) -> np.ndarray:
    """digamma(x) - log(x) for x >= 10."""
    z = x**-2
    q = 1.0 / 252.0 - z * (1.0 / 240.0 - z * (1.0 / 132.0 - z * (691.0 / 32760.0 - z / 12.0)))
    error: np.ndarray = -0.5 / x - z * (1.0 / 12.0 - z * (1.0 / 120.0 - z * q))
    return error


def trigamma(a: Any) -> Any:
    """The second derivative of log Gamma."""
    return sp.polygamma(1, a)


def gammaln_rise(a: Any, b: Any) -> np.ndarray:
    """log Gamma(a + b) - log Gamma(a) for a, a + b >= 0, by Stirling's formula where they are
    large: the error is one of the result's size, not of the two functions'."""
    a, b = _wide(a, b)
    end = a + b
    with np.errstate(all="ignore"):
        leading = (a - 0.5) * np.log1p(b / a) + b * (np.log(end) - 1.0)
        large = leading + (_stirling_error(end) - _stirling_error(a))
        found = np.where(np.minimum(a, end) < 15.0, sp.gammaln(end) - sp.gammaln(a), large)
    return np.where((a >= 0) & (end >= 0), found, np.nan)


def digamma_rise(a: Any, b: Any) -> np.ndarray:
    """digamma(a + b) - digamma(a), likewise."""
    a, b = _wide(a, b)
    end = a + b
    with np.errstate(all="ignore"):
        large = np.log1p(b / a) + (_digamma_error(end) - _digamma_error(a))
        found = np.where(np.minimum(a, end) < 10.0, sp.digamma(end) - sp.digamma(a), large)
    return np.where((a >= 0) & (end >= 0), found, np.nan)


def betaln(a: Any, b: Any) -> np.ndarray:
    """log of the beta function of a, b >= 0."""
    small, large = np.minimum(a, b), np.maximum(a, b)
    return np.where(small >= 0, sp.gammaln(small) - gammaln_rise(large, small), np.nan)


def _log_mass(k: int, n: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    choose = sp.gammaln(n + 1.0) - sp.gammaln(k + 1.0) - sp.gammaln(n - k + 1.0)
    mass: np.ndarray = choose + gammaln_rise(a, k) + gammaln_rise(b, n - k) - gammaln_rise(a + b, n)
    return mass


def _trials(n: np.ndarray, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, int]:
    """Where the distribution exists, and the most trials there."""
    sound = (n >= 0) & (n < np.inf) & (n == np.floor(n))
    sound &= (a > 0) & (a < np.inf) & (b > 0) & (b < np.inf)
    return sound, int(np.max(n[sound], initial=0.0))


def betabinomial_cdf(k: Any, n: Any, a: Any, b: Any) -> np.ndarray:
    """P(X <= k) for X successes of n whose probability is Beta(a, b): the sum."""
    k, n, a, b = _wide(k, n, a, b)
    sound, most = _trials(n, a, b)
    total = np.zeros(k.shape)
    for j in range(most + 1):
        total += np.where((j <= k) & (j <= n), np.exp(_log_mass(j, n, a, b)), 0.0)
    total = np.where(k >= n, 1.0, np.minimum(total, 1.0))
    return np.where(sound & ~np.isnan(k), total, np.nan)


def betabinomial_quantile(n: Any, a: Any, b: Any, q: Any) -> np.ndarray:
    """The smallest k with P(X <= k) >= q: how many sums before the last are below q."""
    n, a, b, q = _wide(n, a, b, q)
    sound, most = _trials(n, a, b)
    total, k = np.zeros(n.shape), np.zeros(n.shape)
    for j in range(most):
        total += np.exp(_log_mass(j, n, a, b))
        k += (j < n) & (total < q)
    return np.where(sound & (q >= 0) & (q <= 1), k, np.nan)


def _negbinomial_tail(k: Any, r: Any, mean: Any, side: str) -> Any:
    """P(X <= k), "lower", or P(X > k), "upper", of counts of dispersion r."""
    r, mean = np.asarray(r, dtype=float), np.asarray(mean, dtype=float)
    of_k, of_r = (sp.betaincc, sp.betainc) if side == "lower" else (sp.betainc, sp.betaincc)
    near = of_k(k + 1.0, r, mean / (r + mean))
    return np.where(mean < r, near, of_r(r, k + 1.0, r / (r + mean)))


def poisson_quantile(rate: Any, q: Any) -> Any:
    """The smallest k with P(X <= k) >= q; SciPy's inverse is continuous in k."""
    return _round_up(sp.pdtrik(q, rate), lambda k: sp.pdtr(k, rate), q)


def binomial_quantile(n: Any, p: Any, q: Any) -> Any:
    """The quantile of a binomial distribution."""

    def cdf(k: Any) -> Any:
        return np.where(k >= n, 1.0, sp.betainc(np.maximum(n - k, 0.5), k + 1.0, 1.0 - p))

    return _round_up(sp.bdtrik(q, n, p), cdf, q)


def _round_up(k: Any, cdf: Callable[[Any], Any], q: Any) -> Any:
    k = np.maximum(np.ceil(k), 0.0)
    below = np.maximum(k - 1.0, 0.0)
    return np.where(np.asarray(q) == 1.0, np.inf, np.where(cdf(below) >= q, below, k))


def negbinomial_quantile(r: Any, mean: Any, q: Any) -> Any:
    """The smallest k with P(X <= k) >= q, for counts of dispersion r."""
    found = _smallest(lambda k: _negbinomial_tail(k, r, mean, "lower"), q, np.greater_equal)
    return np.where(np.asarray(q) == 1.0, np.inf, found)


def poisson_survival_quantile(rate: Any, q: Any) -> Any:
    """The smallest k with P(X > k) <= q."""
    return _smallest(lambda k: sp.gammainc(k + 1.0, rate), q, np.less_equal)


def negbinomial_survival_quantile(r: Any, mean: Any, q: Any) -> Any:
    """Likewise, for counts of dispersion r."""
    return _smallest(lambda k: _negbinomial_tail(k, r, mean, "upper"), q, np.less_equal)


def _smallest(tail: Callable[[np.ndarray], Any], q: Any, reached: np.ufunc) -> np.ndarray:
    """The smallest whole k >= 0 where tail(k) has reached q, elementwise.

    By a k that is doubled and an interval that is halved.
    """
    (q,) = _wide(q)
    high = np.zeros(np.broadcast_shapes(q.shape, np.shape(tail(np.zeros(())))))
    known = ~np.isnan(tail(high) + q)
    while np.any(short := known & ~reached(tail(high), q) & (high < LARGEST_COUNT)):
        high = np.where(short, 2.0 * high + 1.0, high)
    low, fits = np.full(high.shape, -1.0), reached(tail(high), q)
    while np.any(high - low > 1.0):
        middle = np.maximum(np.floor(0.5 * (low + high)), 0.0)
        inside = reached(tail(middle), q)
        low, high = np.where(inside, low, middle), np.where(inside, middle, high)
    high = np.where(fits, high, np.where(np.isnan(tail(high)), np.nan, np.inf))
    return np.where((q >= 0) & (q <= 1), high, np.nan)


def vonmises_cdf(concentration: Any, x: Any) -> np.ndarray:
    """P(X <= x), -pi <= x <= pi, for a von Mises distribution round 0, by Gauss-Legendre."""
    kappa, x = _wide(concentration, x)
    edge = -np.abs(x)
    most = 2.0 * np.sin(0.5 * edge) ** 2  # 1 - cos
    first = np.minimum(2.0, most + FARTHEST / np.where(kappa > 0, kappa, 1e-300))
    start = -2.0 * np.arcsin(np.sqrt(0.5 * first))
    total = np.zeros(x.shape)
    for piece in range(PIECES):
        width = (edge - start) / PIECES
        for node, weight in zip(NODES, WEIGHTS, strict=True):
            back = (edge - start) - width * (piece + 0.5 * (1.0 + node))  # from the edge
            less = 2.0 * np.sin(edge - 0.5 * back) * np.sin(0.5 * back)
            total += 0.5 * width * weight * np.exp(kappa * less)
    total *= np.exp(-kappa * most) / (2.0 * np.pi * sp.i0e(kappa))
    sound = (kappa >= 0) & (kappa < np.inf) & (np.abs(x) <= 3.141592653589794)
    return np.where(sound, np.where(x <= 0, total, 1.0 - total), np.nan)


def vonmises_quantile(concentration: Any, q: Any) -> np.ndarray:
    """x with P(X <= x) = q, by bisection."""
    kappa, q = _wide(concentration, q)
    p = np.minimum(q, 1.0 - q)
    low, high = np.full(q.shape, -np.pi), np.zeros(q.shape)
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        below = vonmises_cdf(kappa, middle) < p
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    sound = (kappa >= 0) & (kappa < np.inf) & (q >= 0) & (q <= 1)
    return np.where(sound, np.where(q <= 0.5, high, -high), np.nan)


def _skewnormal_lower(shape: np.ndarray, z: np.ndarray) -> np.ndarray:
    """P(Z <= z), z <= 0: the part of Owen's function beyond the angle arctan(|shape|), by the rule
    that the kernels have."""
    a, h = np.abs(shape)[..., None], -z[..., None]
    with np.errstate(all="ignore"):
        last = np.sqrt(a**2 + 2.0 * FARTHEST / h**2)
        bounded = np.arctan2(2.0 * FARTHEST / (h**2 * (last + a)), 1.0 + last * a)
        flat = h <= 1e-100  # the integrand is one
        width = np.where(flat, np.arctan2(1.0, a), bounded)
        t = np.tan(width * RULE)
        further = t * (1.0 + a**2) / (1.0 - a * t)  # tan of the angle, less a
        part = np.exp(-0.5 * h**2 * further * (further + 2.0 * a))
        part = np.where(flat, 1.0, np.where(further >= 0, part, 0.0))
        total = np.sum(RULE_WEIGHTS * part, axis=-1)
        total *= width[..., 0] / np.pi * np.exp(-0.5 * z**2 * (1.0 + shape**2))
    beyond = np.where(np.isfinite(z), total, 0.0)
    return np.where(shape >= 0, beyond, 2.0 * sp.ndtr(z) - beyond)


def skewnormal_cdf(shape: Any, z: Any) -> np.ndarray:
    """P(Z <= z) of the density 2 phi(z) Phi(shape z)."""
    shape, z = _wide(shape, z)
    tail = _skewnormal_lower(np.where(z <= 0, shape, -shape), -np.abs(z))
    sound = np.isfinite(shape) & ~np.isnan(z)
    return np.where(sound, np.where(z <= 0, tail, 1.0 - tail), np.nan)


def skewnormal_quantile(shape: Any, q: Any) -> np.ndarray:
    """z with P(Z <= z) = q, by bisection."""
    shape, q = _wide(shape, q)
    negative = q <= skewnormal_cdf(shape, np.zeros(q.shape))
    turned, p = np.where(negative, shape, -shape), np.where(negative, q, 1.0 - q)
    low, high = np.full(q.shape, -40.0), np.zeros(q.shape)
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        below = _skewnormal_lower(turned, middle) < p
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    found = np.where(q == 0, -np.inf, np.where(q == 1, np.inf, np.where(negative, high, -high)))
    sound = np.isfinite(shape) & (q >= 0) & (q <= 1)
    return np.where(sound, found, np.nan)


def _deviance_part(x: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """x log(x / mean) + mean - x for x >= 0, mean > 0, without cancellation near x = mean (C.
    Loader, *Fast and accurate computation of binomial probabilities*, 2000)."""
    v = (x - mean) / (x + mean)
    near = (x - mean) * v
    for j in range(1, 11):
        near = near + 2.0 * x * v ** (2 * j + 1) / (2 * j + 1)
    return np.where(np.abs(v) < 0.1, near, sp.xlogy(x, x / mean) + mean - x)


# Numerators, from the highest power of p^2 on, and denominators of U_k(p) / p^k, DLMF 10.41.9.
DEBYE = [
    ([-5.0, 3.0], 24.0),
    ([385.0, -462.0, 81.0], 1152.0),
    ([-425425.0, 765765.0, -369603.0, 30375.0], 414720.0),
    ([185910725.0, -446185740.0, 349922430.0, -94121676.0, 4465125.0], 39813120.0),
    (
        [-188699385875.0, 566098157625.0, -614135872350.0, 284499769554.0, -49286948607.0,
         1519035525.0],
        6688604160.0,
    ),
    (
        [1023694168371875.0, -3685299006138750.0, 5104696716244125.0, -3369032068261860.0,
         1050760774457901.0, -127577298354750.0, 2757049477875.0],
        4815794995200.0,
    ),
]  # fmt: skip


def _skellam_total(k: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """A + B of the counts A - B = k, A B = a b, the likeliest ones where N1 - N2 = k."""
    return np.hypot(k, 2.0 * np.sqrt(a) * np.sqrt(b))


def _skellam_exponent(k: np.ndarray, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(log(A / a), the exponent of the masses of A and B), for k >= 0."""
    up = 0.5 * (k + _skellam_total(k, a, b))
    down = b * (a / up)
    tilt = np.log(up / a)
    # what rounding of A and B makes of their difference, to first order
    gap = np.where(up <= 2.0 * k, (up - k) - down, (up - down) - k)
    rest = np.where(down > 0, _deviance_part(down, b), b)
    return tilt, tilt * gap - _deviance_part(up, a) - rest


def skellam_log_mass(k: Any, a: Any, b: Any) -> np.ndarray:
    """log P(N1 - N2 = k) for Poisson counts of rates a and b: the power series of the Bessel
    function in it, or DLMF 10.41.3."""
    k, a, b = _wide(k, a, b)
    sound = (a >= 0) & (a < np.inf) & (b >= 0) & (b < np.inf) & ~np.isnan(k)
    a, b, k = np.where(k < 0, b, a), np.where(k < 0, a, b), np.abs(k)
    with np.errstate(all="ignore"):
        m = _skellam_total(k, a, b)
        few, product = m < UNIFORM, np.where(m < UNIFORM, a * b, 0.0)
        term, total, j = np.ones(m.shape), np.ones(m.shape), 0
        while np.any(term > 1e-17 * total):
            j += 1
            term = term * product / (j * (k + j))
            total = total + term
        series = sp.xlogy(k, a) - sp.gammaln(k + 1.0) - a - b + np.log(total)
        factor, x = np.ones(m.shape), (k / m) ** 2
        for power, (top, below) in enumerate(DEBYE, start=1):
            factor = factor + np.polyval(top, x) / below / m**power
        exponent = _skellam_exponent(k, a, b)[1]
        uniform = exponent - 0.5 * np.log(2.0 * np.pi * m) + np.log(factor)
        found = np.where(few, series, uniform)
    found = np.where((k == np.inf) | ((a == 0) & (k > 0)), -np.inf, found)
    return np.where(sound, found, np.nan)


def _skellam_outwards(k: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """P(N1 - N2 >= k) over P(N1 - N2 = k), k >= max(0, a - b): the sum, by the ratios of its terms
    from the far end on."""
    most = float(np.max(_skellam_total(k, a, b), initial=0.0))
    total, ratio = np.ones(k.shape), np.zeros(k.shape)
    for j in range(math.ceil(FARTHEST + math.sqrt(FARTHEST**2 + 2.0 * FARTHEST * most)), 0, -1):
        ratio = a / (k + j + b * ratio)
        total = 1.0 + ratio * total
    return total


def _skellam_approximate(k: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """P(N1 - N2 <= k) of large rates: Lugannani and Rice's formula (*Adv. Appl. Prob.* 12, 1980)
    for whole numbers."""
    m, turned = _skellam_total(k, a, b), k > 0
    a, b = np.where(turned, a, b), np.where(turned, b, a)
    tilt, exponent = _skellam_exponent(np.abs(k), a, b)
    tilt = np.where(turned, -tilt, tilt)  # of -(N1 - N2) >= -k
    w = np.copysign(np.sqrt(np.maximum(-2.0 * exponent, 0.0)), tilt)
    limit = 0.5 / np.sqrt(m) + k / (6.0 * m * np.sqrt(m))
    away = -1.0 / (np.expm1(-tilt) * np.sqrt(m)) - 1.0 / w
    # near the mean the difference of two reciprocals has fewer digits than its limit
    correction = np.where(np.abs(w) < 1e-5 * np.sqrt(m), limit, away)
    density = np.exp(exponent) / math.sqrt(2.0 * math.pi)
    return np.clip(sp.ndtr(-w) + correction * density, 0.0, 1.0)


def _skellam_lower(k: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """P(N1 - N2 <= k) for k < a - b."""
    large = _skellam_total(k, a, b) > SUMMED
    out = np.where(large, _skellam_approximate(k, a, b), 0.0)
    mass = np.exp(skellam_log_mass(k, a, b))
    here = ~large & (mass > 0)
    k, a, b, mass = k[here], a[here], b[here], mass[here]
    i = np.maximum(k, 0.0)  # down to 0 by the ratios the other way round
    ratio = np.exp(skellam_log_mass(i + 1.0, a, b) - skellam_log_mass(i, a, b))
    term, total = np.ones(k.shape), np.zeros(k.shape)
    while np.any(going := (i > 0) & (term > 1e-18 * total)):
        total = np.where(going, total + term, total)
        back = np.where(going, (i + b * ratio) / a, 1.0)
        term, ratio, i = term * back, 1.0 / back, i - going
    rest = np.where(i > 0, 0.0, term * _skellam_outwards(np.maximum(-k, 0.0), b, a))
    out[here] = np.minimum(mass * (total + rest), 1.0)
    return out


def skellam_cdf(k: Any, a: Any, b: Any) -> np.ndarray:
    """P(N1 - N2 <= k): below the mean to full relative accuracy, above it one less the rest."""
    k, a, b = _wide(k, a, b)
    sound = (a >= 0) & (a < np.inf) & (b >= 0) & (b < np.inf) & ~np.isnan(k)
    k, a, b = np.where(sound, np.floor(k), 0.0), np.where(sound, a, 0.0), np.where(sound, b, 0.0)
    below, finite = k < a - b, np.isfinite(k)
    at = np.where(finite, np.where(below, k, -k - 1.0), -1.0)
    with np.errstate(all="ignore"):
        tail = _skellam_lower(at, np.where(below, a, b), np.where(below, b, a))
    found = np.where(finite, np.where(below, tail, 1.0 - tail), k > 0)
    return np.where(sound, found, np.nan)


def skellam_quantile(a: Any, b: Any, q: Any) -> np.ndarray:
    """The smallest k with P(N1 - N2 <= k) >= q; -inf for q = 0 unless b is 0."""
    a, b, q = _wide(a, b, q)
    sound = (a >= 0) & (a < np.inf) & (b >= 0) & (b < np.inf) & (q >= 0) & (q <= 1)
    inner = sound & (q > 0) & (q < 1)
    a_in, b_in, p = np.where(inner, a, 0.0), np.where(inner, b, 0.0), np.where(inner, q, 0.5)

    def reached(k: np.ndarray) -> np.ndarray:
        return skellam_cdf(k, a_in, b_in) >= p

    high = np.floor(a_in - b_in + np.sqrt(a_in + b_in) * sp.ndtri(p))
    low, step = high - 1.0, 1.0
    while np.any(short := ~reached(high)):
        low, high = np.where(short, high, low), np.where(short, high + step, high)
        step *= 2.0
    step = 1.0
    while np.any(beyond := reached(low)):
        low, high = np.where(beyond, low - step, low), np.where(beyond, low, high)
        step *= 2.0
    while True:
        middle = np.floor(0.5 * (low + high))
        between = (low < middle) & (middle < high)
        if not np.any(between):
            break
        inside = reached(middle)
        low = np.where(between & ~inside, middle, low)
        high = np.where(between & inside, middle, high)
    least, most = np.where(b > 0, -np.inf, 0.0), np.where(a > 0, np.inf, 0.0)
    return np.where(sound, np.where(q == 0, least, np.where(q == 1, most, high)), np.nan)


def factor_of_semidefinite(matrices: np.ndarray) -> np.ndarray:
    """Lower factors L (..., n, n) of symmetric positive semidefinite matrices, L L' = the matrix.

    A pivot of zero, but for rounding, leaves a column of zeros (Higham 2002, "Accuracy and
    stability of numerical algorithms", section 10.3), as in the kernel `cholesky`.

    Raises
    ------
    numpy.linalg.LinAlgError : one of the matrices is not positive semidefinite.
    """
    try:
        return np.linalg.cholesky(matrices)
    except np.linalg.LinAlgError:
        left = np.array(matrices, dtype=float)
    n = left.shape[-1]
    scale, root = np.diagonal(left, axis1=-2, axis2=-1).copy(), np.zeros_like(left)
    for j in range(n):
        pivot, column = left[..., j, j].copy(), left[..., j + 1 :, j].copy()
        least = PIVOT * scale[..., j]
        gone = (pivot <= 0.0) & (pivot >= -least)
        gone &= (column**2 <= least[..., None] * scale[..., j + 1 :]).all(axis=-1)
        if not np.all(gone | (pivot > 0.0)):
            raise np.linalg.LinAlgError("Matrix is not positive semidefinite")
        own = np.sqrt(np.where(gone, 1.0, pivot))
        root[..., j, j] = np.where(gone, 0.0, own)
        root[..., j + 1 :, j] = np.where(gone[..., None], 0.0, column / own[..., None])
        part = root[..., j + 1 :, j]
        left[..., j + 1 :, j + 1 :] -= part[..., :, None] * part[..., None, :]
    return root
