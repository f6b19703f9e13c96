"""Incomplete gamma and beta functions, regularised, and their inverses in x.

Series and continued fractions of A&S 6.5.29, 6.5.31 and 26.5.8; the factors x^a e^-x / Gamma
and x^a (1-x)^b / B by C. Loader's saddle-point form, which keeps its accuracy for large a.
The choice between them follows A. R. DiDonato and A. H. Morris, *ACM TOMS* 12 (1986).  The
inverses are Newton's method kept inside a shrinking bracket.  Outside their domain: NaN.
"""

from __future__ import annotations

import math

import numpy as np

from ssmppl.codegen.kernels.elementary import exp, expm1, log
from ssmppl.codegen.kernels.flags import exact
from ssmppl.codegen.kernels.special import (
    deviance_part,
    lgamma,
    ndtri,
    poisson_density,
    stirling_error,
)

_INF = np.inf
_EPS = 2.220446049250313e-16
_TINY = 1e-300
_STEPS = 1_000_000  # of a series or fraction; some 8 sqrt(max(a, b)) of them are needed


@exact
def _gamma_series(a, x):
    """1 + x/(a+1) + x^2/((a+1)(a+2)) + ...: P(a, x) over x^a e^-x / Gamma(a+1)."""
    total = 1.0
    term = 1.0
    for k in range(1, _STEPS):
        term *= x / (a + k)
        total += term
        if term < total * (0.25 * _EPS):
            break
    return total


@exact
def _gamma_fraction(a, x):
    """Q(a, x) over x^a e^-x / Gamma(a), by Lentz's method."""
    b = x + 1.0 - a
    c = 1.0 / _TINY
    d = 1.0 / b
    h = d
    for k in range(1, _STEPS):
        an = -k * (k - a)
        b += 2.0
        d = an * d + b
        d = 1.0 / (d if abs(d) > _TINY else _TINY)
        c = b + an / c
        c = c if abs(c) > _TINY else _TINY
        step = d * c
        h *= step
        if abs(step - 1.0) < _EPS:
            break
    return h


@exact
def _lgamma_1p(a):
    """log Gamma(1 + a), with all digits for small a: A&S 6.1.33."""
    if a > 0.02:
        return lgamma(1.0 + a)
    q = 0.16955717699740818 - a * (0.1440498967688461 - a * 0.12550966952474304)
    q = 0.40068563438653143 - a * (0.27058080842778454 - a * (0.20738555102867398 - a * q))
    return -a * (0.5772156649015329 - a * (0.8224670334241132 - a * q))


@exact
def _gamma_small(a, x):
    """Q(a, x) for a < 1 and x <= 1.5, where 1 - P would cancel.

    With P = x^a (1 + s)/Gamma(a+1), s = a sum (-x)^k / (k! (a+k)):
    Q = -(e^t - 1) - e^t s, t = a log x - log Gamma(a+1).
    """
    term = 1.0
    s = 0.0
    for k in range(1, 60):
        term *= -x / k
        s += term / (a + k)
    s *= a
    t = a * log(x) - _lgamma_1p(a)
    return -expm1(t) - exp(t) * s


@exact
def _gamma_uniform(a, x):
    """`gamma_tails` for large a: N. M. Temme's uniform expansion, *SIAM J. Math. Anal.* 10 (1979),
    whose second term is below rounding from a = 1e8 on.

    With a eta^2 / 2 = x - a - a log(x/a): Q = erfc(eta sqrt(a/2)) / 2 + R.
    """
    deviance = deviance_part(a, x)
    eta = math.copysign(math.sqrt(2.0 * deviance / a), x - a)
    if abs(eta) < 1e-3:
        first = -1.0 / 3.0 + eta * (1.0 / 12.0 - eta * (2.0 / 135.0 - eta / 864.0))
    else:
        first = a / (x - a) - 1.0 / eta
    rest = first * exp(-deviance) / math.sqrt(2.0 * np.pi * a)
    root = math.copysign(math.sqrt(deviance), eta)
    return 0.5 * math.erfc(-root) - rest, 0.5 * math.erfc(root) + rest


@exact
def gamma_tails(a, x):
    """(P, Q): lower and upper regularised incomplete gamma function, each to full accuracy."""
    if not (a > 0.0 and x >= 0.0) or (a == _INF and x == _INF):
        return np.nan, np.nan
    if x == 0.0 or a == _INF:
        return 0.0, 1.0
    if x == _INF:
        return 1.0, 0.0
    if a < 1.0 and x <= 1.5:
        upper = _gamma_small(a, x)
        # e^t (1 + s) directly, in case it is the small one.
        lower = exp(a * log(x) - x - lgamma(a + 1.0)) * _gamma_series(a, x)
        return lower, upper
    if a > 1e8:
        return _gamma_uniform(a, x)
    factor = poisson_density(a, x)
    if x < a + 1.0:
        lower = factor * _gamma_series(a, x)
        return min(lower, 1.0), max(1.0 - lower, 0.0)
    upper = factor * a * _gamma_fraction(a, x)
    return max(1.0 - upper, 0.0), min(upper, 1.0)


@exact
def gammainc(a, x):
    """P(a, x), the distribution function of Gamma(a, 1) at x."""
    return gamma_tails(a, x)[0]


@exact
def gammaincc(a, x):
    """Q(a, x) = 1 - P(a, x)."""
    return gamma_tails(a, x)[1]


@exact
def gammaincinv(a, p):
    """x with P(a, x) = p."""
    return _gamma_quantile(a, p, 1.0 - p)


@exact
def gammainccinv(a, q):
    """x with Q(a, x) = q."""
    return _gamma_quantile(a, 1.0 - q, q)


@exact
def _gamma_quantile(a, p, q):
    """x with P(a, x) = p = 1 - q: Newton's method for log P (or log Q) in log x."""
    if not (a > 0.0 and p >= 0.0 and q >= 0.0) or a == _INF:
        return np.nan
    if p == 0.0 or q == 0.0:
        return 0.0 if p == 0.0 else _INF
    # P(a, x) <= x^a / Gamma(a+1): where the bound is p, x is too small, but hardly so if small.
    low = (log(p) + lgamma(a + 1.0)) / a
    if low < -745.0:
        return 0.0
    high = 709.0
    # Wilson and Hilferty's cube, unless the other guess is the right one.
    use_lower = p <= 0.5
    z = ndtri(p) if use_lower else -ndtri(q)
    root = 1.0 - 1.0 / (9.0 * a) + z / (3.0 * math.sqrt(a))
    y = low
    if root > 0.0:
        y = max(low, math.log(a) + 3.0 * math.log(root))
    target = log(p) if use_lower else log(q)
    for _ in range(200):
        x = exp(y)
        lower, upper = gamma_tails(a, x)
        too_large = lower > p if use_lower else upper < q
        if too_large:
            high = y
        else:
            low = y
        tail = lower if use_lower else upper
        # d log P / d log x = x^a e^-x / (Gamma(a) P).
        slope = (poisson_density(a, x) * a if a > 1e-3 else exp(a * y - x - lgamma(a))) / tail
        step = (log(tail) - target) / (slope if use_lower else -slope)
        following = y - step
        if not (low < following < high):
            following = 0.5 * (low + high)
        if abs(following - y) <= 1e-15 * max(1.0, abs(y)):
            return exp(following)
        y = following
    return exp(y)


@exact
def _beta_factor(a, b, x, y):
    """x^a y^b Gamma(a+b) / (Gamma(a) Gamma(b)), y = 1 - x."""
    n = a + b
    if min(a, b) < 1e-2:
        return exp(a * log(x) + b * log(y) + lgamma(n) - lgamma(a) - lgamma(b))
    error = stirling_error(n) - stirling_error(a) - stirling_error(b)
    deviance = deviance_part(a, n * x) + deviance_part(b, n * y)
    return exp(error - deviance) * math.sqrt(a / n * b / (2.0 * np.pi))


@exact
def _beta_fraction(a, b, x, y):
    """I_x(a, b) over x^a y^b / B(a, b): every other convergent of the continued fraction A&S
    26.5.8, as DiDonato and Morris, *ACM TOMS* 18 (1992), equation 9, have it, by Lentz's method.

    Nothing cancels in it where y is small and known to its last digit.
    """
    away = a * y - b * x
    c = h = a / (a + 1.0) * (1.0 + away)
    d = 0.0
    for m in range(1, _STEPS):
        step = (a + m - 1.0) * x / (a + 2 * m - 1.0)
        above = step * ((a + b + m - 1.0) * x / (a + 2 * m - 1.0)) * (m * (b - m))
        below = m * (b - m) * x / (a + 2 * m - 1.0) + m
        below += (a + m) / (a + 2 * m + 1.0) * (1.0 + away + m * (1.0 + y))
        d = below + above * d
        d = 1.0 / (d if abs(d) > _TINY else _TINY)
        c = below + above / c
        c = c if abs(c) > _TINY else _TINY
        h *= d * c
        if abs(d * c - 1.0) < _EPS:
            break
    return 1.0 / h


@exact
def beta_tails(a, b, x, y):
    """(I_x(a, b), 1 - I_x(a, b)) with y = 1 - x given, so that neither end loses digits."""
    if x <= 0.0 or y <= 0.0:
        return (0.0, 1.0) if x <= 0.0 else (1.0, 0.0)
    factor = _beta_factor(a, b, x, y)
    if x * (a + b + 2.0) < a + 1.0:
        lower = min(factor * _beta_fraction(a, b, x, y), 1.0)
        return lower, 1.0 - lower
    upper = min(factor * _beta_fraction(b, a, y, x), 1.0)
    return 1.0 - upper, upper


@exact
def betainc(a, b, x):
    """I_x(a, b), the distribution function of Beta(a, b) at x."""
    if not (a > 0.0 and b > 0.0 and 0.0 <= x <= 1.0) or a + b == _INF:
        return np.nan
    return beta_tails(a, b, x, 1.0 - x)[0]


@exact
def betaincc(a, b, x):
    """1 - I_x(a, b)."""
    if not (a > 0.0 and b > 0.0 and 0.0 <= x <= 1.0) or a + b == _INF:
        return np.nan
    return beta_tails(a, b, x, 1.0 - x)[1]


@exact
def betaincinv(a, b, p):
    """x with I_x(a, b) = p."""
    return _beta_quantile(a, b, p, 1.0 - p)


@exact
def betainccinv(a, b, q):
    """x with 1 - I_x(a, b) = q."""
    return _beta_quantile(a, b, 1.0 - q, q)


@exact
def _beta_quantile(a, b, p, q):
    """x with I_x(a, b) = p = 1 - q: bracketed Newton in the log-odds of x."""
    if not (a > 0.0 and b > 0.0 and p >= 0.0 and q >= 0.0) or a + b == _INF:
        return np.nan
    if p == 0.0 or q == 0.0:
        return 0.0 if p == 0.0 else 1.0
    low = -745.0
    high = 745.0
    use_lower = p <= 0.5
    target = log(p) if use_lower else log(q)
    t = log(a / b)
    for _ in range(300):
        # x and y = 1 - x, both exact to rounding, from the log-odds t.
        x = 1.0 / (1.0 + exp(-t))
        y = 1.0 / (1.0 + exp(t))
        lower, upper = beta_tails(a, b, x, y)
        too_large = lower > p if use_lower else upper < q
        if too_large:
            high = t
        else:
            low = t
        tail = lower if use_lower else upper
        # d I / d t = x^a y^b / B(a, b), since dx/dt = x y.
        slope = _beta_factor(a, b, x, y) / tail
        step = (log(tail) - target) / (slope if use_lower else -slope)
        following = t - step
        if not (low < following < high):
            following = 0.5 * (low + high)
        if abs(following - t) <= 1e-15 * max(1.0, abs(t)):
            t = following
            break
        t = following
    return 1.0 / (1.0 + exp(-t))
