"""Special functions of probability, and laws' functions without a closed form: scalar, for kernels.

Sources: M. Abramowitz and I. A. Stegun, *Handbook of Mathematical Functions* (A&S);
M. J. Wichura's AS 241, *Applied Statistics* 37 (1988), for the normal quantile; C. Loader, *Fast
and accurate computation of binomial probabilities* (2000), for powers over factorials without
cancellation.  Relative errors are below 1e-12 (near a zero of the function: absolute errors);
`tests/codegen/kernels/test_special.py` has the ranges.  Outside their domain the functions
return NaN.

Incomplete gamma and beta functions, regularised: series and continued fractions of A&S 6.5.29,
6.5.31 and 26.5.8; the factors x^a e^-x / Gamma and x^a (1-x)^b / B by Loader's saddle-point form,
which keeps its accuracy for large a.  The choice between them follows A. R. DiDonato and
A. H. Morris, *ACM TOMS* 12 (1986).  Their inverses in x are Newton's method kept inside a
shrinking bracket.

The beta-binomial distribution function is a sum over the law's values, each from the last by their
ratio (Johnson, Kemp and Kotz 2005, "Univariate discrete distributions", section 6.2.2), in
logarithms, which neither over- nor underflow.  Von Mises' is an integral, by the double exponential
rule of Takahasi and Mori (1974), *Publ. RIMS* 9; so is that of the skew normal, the part beyond an
angle of D. B. Owen's function, *Ann. Math. Stat.* 27 (1956).
"""

from __future__ import annotations

import math

import numpy as np

from ssmppl.codegen.kernels.math.elementary import exp, expm1, log, log1p
from ssmppl.codegen.kernels.math.flags import exact

_INF = np.inf
_SQRT_HALF = 0.7071067811865476
_LOG_SQRT_2PI = 0.9189385332046727
_EPS = 2.220446049250313e-16
_TINY = 1e-300
_STEPS = 1_000_000  # of a series or fraction; some 8 sqrt(max(a, b)) of them are needed
FARTHEST = 42.0  # exp(-42) of the density at the end of the integral is below rounding
STEP, NODES = 0.0625, 52  # of the rule, on each side of its middle
FINE_STEP, FINE_NODES = 1.0 / 24.0, 80  # likewise, of the skew normal's integral


@exact
def erf(x):
    """Error function."""
    return math.erf(x)


@exact
def erfc(x):
    """Complementary error function."""
    return math.erfc(x)


@exact
def lgamma(x):
    """log |Gamma(x)|; inf at the poles 0, -1, -2, ..."""
    if x <= 0.0 and x == np.floor(x):
        return _INF
    return x if x != x else math.lgamma(x)


@exact
def digamma(x):
    """Derivative of log Gamma: recurrence up to x >= 10, then A&S 6.3.18; reflection below 0."""
    if x <= 0.0 and x == np.floor(x):
        return np.nan
    value = 0.0
    if x < 0.0:
        value = -np.pi / math.tan(np.pi * (x - np.floor(x)))
        x = 1.0 - x
    while x < 10.0:
        value -= 1.0 / x
        x += 1.0
    return value + log(x) + _digamma_error(x)


@exact
def _digamma_error(x):
    """digamma(x) - log(x) for x >= 10."""
    z = 1.0 / (x * x)
    q = 1.0 / 252.0 - z * (1.0 / 240.0 - z * (1.0 / 132.0 - z * (691.0 / 32760.0 - z / 12.0)))
    return -0.5 / x - z * (1.0 / 12.0 - z * (1.0 / 120.0 - z * q))


@exact
def trigamma(x):
    """Second derivative of log Gamma: recurrence up to x >= 10, then A&S 6.4.12; reflection."""
    if x <= 0.0 and x == np.floor(x):
        return np.nan
    if x < 0.0:
        sine = math.sin(np.pi * (x - np.floor(x)))
        return np.pi * np.pi / (sine * sine) - trigamma_positive(1.0 - x)
    return trigamma_positive(x)


@exact
def trigamma_positive(x):
    """`trigamma` for x > 0."""
    value = 0.0
    while x < 10.0:
        value += 1.0 / (x * x)
        x += 1.0
    z = 1.0 / (x * x)
    q = 1.0 / 42.0 - z * (1.0 / 30.0 - z * (5.0 / 66.0 - z * (691.0 / 2730.0 - z * 7.0 / 6.0)))
    return value + 1.0 / x + 0.5 * z + z / x * (1.0 / 6.0 - z * (1.0 / 30.0 - z * q))


@exact
def _bessel_i(order, x):
    """exp(-x) I_order(x) for x >= 0 and order 0 or 1: the power series A&S 9.6.10, whose terms are
    all positive, up to 25; above it the asymptotic series A&S 9.7.1 to its rounding."""
    if not x >= 0.0:
        return np.nan
    if x <= 25.0:
        half = 0.5 * x
        term = total = 1.0 if order == 0 else half
        for k in range(1, 200):
            term *= half * half / (k * (k + order))
            total += term
            if term < 1e-17 * total:
                break
        return exp(-x) * total
    if x == _INF:
        return 0.0
    term = total = 1.0
    for k in range(1, 40):
        term *= -(4.0 * order * order - (2.0 * k - 1.0) ** 2) / (8.0 * k * x)
        total += term
        if abs(term) < 1e-17:
            break
    return total / math.sqrt(2.0 * np.pi * x)


@exact
def i0e(x):
    """exp(-|x|) I_0(x), the modified Bessel function."""
    return _bessel_i(0, abs(x))


@exact
def i1e(x):
    """exp(-|x|) I_1(x)."""
    return math.copysign(_bessel_i(1, abs(x)), x)


@exact
def ndtr(x):
    """Standard normal distribution function."""
    return 0.5 * math.erfc(-x * _SQRT_HALF)


@exact
def log_ndtr(x):
    """log of `ndtr`; below -20 by the asymptotic series A&S 7.1.23 for the tail."""
    if x >= -1.0:
        return log1p(-0.5 * math.erfc(x * _SQRT_HALF))
    if x >= -20.0:
        return log(0.5 * math.erfc(-x * _SQRT_HALF))
    z = 1.0 / (x * x)
    term = 1.0
    total = 0.0
    for k in range(1, 12):
        term *= -(2 * k - 1) * z
        total += term
    return -0.5 * x * x - log(-x) - _LOG_SQRT_2PI + log1p(total)


@exact
def _ratio(x, p0, p1, p2, p3, p4, p5, p6, p7, q1, q2, q3, q4, q5, q6, q7):
    above = ((((((p7 * x + p6) * x + p5) * x + p4) * x + p3) * x + p2) * x + p1) * x + p0
    below = ((((((q7 * x + q6) * x + q5) * x + q4) * x + q3) * x + q2) * x + q1) * x + 1.0
    return above / below


@exact
def ndtri(p):
    """Standard normal quantile, AS 241 (routine PPND16)."""
    if not (0.0 <= p <= 1.0):
        return np.nan
    if p == 0.0 or p == 1.0:
        return -_INF if p == 0.0 else _INF
    q = p - 0.5
    # fmt: off
    if abs(q) <= 0.425:
        return q * _ratio(
            0.180625 - q * q,
            3.3871328727963666080, 133.14166789178437745, 1971.5909503065514427,
            13731.693765509461125, 45921.953931549871457, 67265.770927008700853,
            33430.575583588128105, 2509.0809287301226727,
            42.313330701600911252, 687.18700749205790830, 5394.1960214247511077,
            21213.794301586595867, 39307.895800092710610, 28729.085735721942674,
            5226.4952788528545610,
        )
    r = math.sqrt(-log(p if q < 0.0 else 1.0 - p))
    if r <= 5.0:
        x = _ratio(
            r - 1.6,
            1.42343711074968357734, 4.63033784615654529590, 5.76949722146069140550,
            3.64784832476320460504, 1.27045825245236838258, 0.241780725177450611770,
            0.0227238449892691845833, 7.74545014278341407640e-4,
            2.05319162663775882187, 1.67638483018380384940, 0.689767334985100004550,
            0.148103976427480074590, 0.0151986665636164571966, 5.47593808499534494600e-4,
            1.05075007164441684324e-9,
        )
    else:
        x = _ratio(
            r - 5.0,
            6.65790464350110377720, 5.46378491116411436990, 1.78482653991729133580,
            0.296560571828504891230, 0.0265321895265761230930, 1.24266094738807843860e-3,
            2.71155556874348757815e-5, 2.01033439929228813265e-7,
            0.599832206555887937690, 0.136929880922735805310, 0.0148753612908506148525,
            7.86869131145613259100e-4, 1.84631831751005468180e-5, 1.42151175831644588870e-7,
            2.04426310338993978564e-15,
        )
    # fmt: on
    return -x if q < 0.0 else x


@exact
def stirling_error(x):
    """log Gamma(x + 1) - log(sqrt(2 pi x) (x/e)^x) for x > 0 (Loader, section 2)."""
    if x < 15.0:
        return lgamma(x + 1.0) - (x + 0.5) * math.log(x) + x - _LOG_SQRT_2PI
    z = 1.0 / (x * x)
    q = 1.0 / 1680.0 - z * (1.0 / 1188.0 - z * (691.0 / 360360.0 - z / 156.0))
    return (1.0 / 12.0 - z * (1.0 / 360.0 - z * (1.0 / 1260.0 - z * q))) / x


@exact
def gammaln_rise(a, b):
    """log Gamma(a + b) - log Gamma(a) for a, a + b >= 0, by Stirling's formula where they are
    large: the error is one of the result's size, not of the two functions'."""
    end = a + b
    if not (a >= 0.0 and end >= 0.0):
        return np.nan
    if min(a, end) < 15.0:
        return lgamma(end) - lgamma(a)
    leading = (a - 0.5) * log1p(b / a) + b * (log(end) - 1.0)
    return leading + (stirling_error(end) - stirling_error(a))


@exact
def digamma_rise(a, b):
    """digamma(a + b) - digamma(a), likewise."""
    end = a + b
    if not (a >= 0.0 and end >= 0.0):
        return np.nan
    if min(a, end) < 10.0:
        return digamma(end) - digamma(a)
    return log1p(b / a) + (_digamma_error(end) - _digamma_error(a))


@exact
def betaln(a, b):
    """log of the beta function of a, b >= 0."""
    small = min(a, b)
    return lgamma(small) - gammaln_rise(max(a, b), small) if small >= 0.0 else np.nan


@exact
def deviance_part(x, mean):
    """x log(x/mean) + mean - x without cancellation near x = mean (Loader, section 3)."""
    difference = x - mean
    if abs(difference) < 0.1 * (x + mean):
        v = difference / (x + mean)
        total = difference * v
        term = 2.0 * x * v
        for j in range(1, 1000):
            term *= v * v
            following = total + term / (2 * j + 1)
            if following == total:
                break
            total = following
        return total
    return x * math.log(x / mean) + mean - x


@exact
def poisson_density(x, mean):
    """mean^x e^-mean / Gamma(x + 1) for real x > 0, mean > 0 (Loader, equation 4)."""
    return exp(-stirling_error(x) - deviance_part(x, mean)) / math.sqrt(2.0 * np.pi * x)


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


@exact
def _betabinomial_sound(n, a, b):
    whole = 0.0 <= n < np.inf and n == np.floor(n)
    return whole and 0.0 < a < np.inf and 0.0 < b < np.inf


@exact
def _betabinomial_log_mass(k, n, a, b):
    choose = lgamma(n + 1.0) - lgamma(k + 1.0) - lgamma(n - k + 1.0)
    return choose + gammaln_rise(a, k) + gammaln_rise(b, n - k) - gammaln_rise(a + b, n)


@exact
def betabinomial_cdf(k, n, a, b):
    """P(X <= k) for X successes of n whose probability is Beta(a, b)."""
    if not _betabinomial_sound(n, a, b) or k != k:
        return math.nan
    k = np.floor(k)
    if k < 0.0 or k >= n:
        return 0.0 if k < 0.0 else 1.0
    log_mass = _betabinomial_log_mass(k, n, a, b)
    total = exp(log_mass)
    while k > 0.0:  # from k down
        log_mass += log(k * (n - k + b)) - log((n - k + 1.0) * (k - 1.0 + a))
        k -= 1.0
        total += exp(log_mass)
    return min(total, 1.0)


@exact
def betabinomial_quantile(n, a, b, q):
    """The smallest k with P(X <= k) >= q."""
    if not _betabinomial_sound(n, a, b) or not 0.0 <= q <= 1.0:
        return math.nan
    k = 0.0
    log_mass = _betabinomial_log_mass(k, n, a, b)
    total = exp(log_mass)
    while total < q and k < n:
        log_mass += log((n - k) * (k + a)) - log((k + 1.0) * (n - k - 1.0 + b))
        k += 1.0
        total += exp(log_mass)
    return k


@exact
def _vonmises_lower(concentration, x):
    """The integral of the density from -pi to x <= 0, to full relative accuracy.

    The density grows towards x: the integral begins where it is exp(-FARTHEST) of that at x.
    """
    # 1 - cos of both ends, by sines of halves, which keep their digits
    most = 2.0 * math.sin(0.5 * x) ** 2
    first = most + FARTHEST / concentration if concentration > 0.0 else 2.0
    start = -math.pi if first >= 2.0 else -2.0 * math.asin(math.sqrt(0.5 * first))
    half = 0.5 * (x - start)
    total = 0.0
    for j in range(-NODES, NODES + 1):
        s = 0.5 * math.pi * math.sinh(j * STEP)
        from_end = half * exp(-s) / math.cosh(s)  # x - t
        # cos t - cos x
        less = -2.0 * math.sin(x - 0.5 * from_end) * math.sin(-0.5 * from_end)
        weight = math.cosh(j * STEP) / math.cosh(s) ** 2
        total += weight * exp(concentration * less)
    total *= STEP * 0.5 * math.pi * half
    return total * exp(-concentration * most) / (2.0 * math.pi * i0e(concentration))


@exact
def vonmises_cdf(concentration, x):
    """P(X <= x), -pi <= x <= pi, for a von Mises law round 0."""
    if not (0.0 <= concentration < np.inf) or not abs(x) <= 3.141592653589794:
        return math.nan
    if x <= 0.0:
        return _vonmises_lower(concentration, max(x, -math.pi))
    return 1.0 - _vonmises_lower(concentration, max(-x, -math.pi))


@exact
def _towards(x, below, slope, p, low, high):
    """The next point in search of P = p from x, where P is `below`: Newton's for log P, which is
    nearly straight in the tail, or the middle of the interval where that leads out of it."""
    known = below > 0.0 and slope > 0.0 and p > 0.0
    following = x - below / slope * log(below / p) if known else low
    return following if low < following < high else 0.5 * (low + high)


@exact
def vonmises_quantile(concentration, q):
    """x with P(X <= x) = q: Newton's method, kept inside of an interval that shrinks."""
    if not (0.0 <= concentration < np.inf and 0.0 <= q <= 1.0):
        return math.nan
    p = min(q, 1.0 - q)
    low, high = -math.pi, 0.0
    x = math.pi * (p - 0.5) if concentration < 1.0 else -1.0 / math.sqrt(concentration)
    for _ in range(200):
        below = _vonmises_lower(concentration, x)
        if below < p:
            low = x
        else:
            high = x
        slope = exp(-2.0 * concentration * math.sin(0.5 * x) ** 2)
        slope /= 2.0 * math.pi * i0e(concentration)
        following = _towards(x, below, slope, p, low, high)
        if abs(following - x) <= 1e-15 * abs(x) or high - low <= 1e-15 * abs(x):
            x = following
            break
        x = following
    return x if q <= 0.5 else -x


@exact
def _beyond_angle(h, a):
    """The integral of exp(-h^2 / (2 cos^2 t)) / pi from arctan(a) to pi / 2, h and a >= 0, to full
    relative accuracy; up to where the integrand is exp(-FARTHEST) of that at its beginning."""
    if h <= 1e-100:
        return math.atan2(1.0, a) / math.pi
    last = math.sqrt(a * a + 2.0 * FARTHEST / (h * h))
    width = math.atan2(2.0 * FARTHEST / (h * h * (last + a)), 1.0 + last * a)
    total = 0.0
    for j in range(-FINE_NODES, FINE_NODES + 1):
        s = 0.5 * math.pi * math.sinh(j * FINE_STEP)
        t = math.tan(0.5 * width * exp(s) / math.cosh(s))
        further = t * (1.0 + a * a) / (1.0 - a * t)  # tan of the angle, less a
        part = exp(-0.5 * h * h * further * (further + 2.0 * a)) if further >= 0.0 else 0.0
        total += math.cosh(j * FINE_STEP) / math.cosh(s) ** 2 * part
    total *= FINE_STEP * 0.5 * math.pi * 0.5 * width / math.pi
    return total * exp(-0.5 * h * h * (1.0 + a * a))


@exact
def _skewnormal_lower(shape, z):
    """P(Z <= z), z <= 0."""
    if not z > -_INF:
        return 0.0
    beyond = _beyond_angle(-z, abs(shape))
    return beyond if shape >= 0.0 else 2.0 * ndtr(z) - beyond


@exact
def skewnormal_cdf(shape, z):
    """P(Z <= z) of the density 2 phi(z) Phi(shape z)."""
    if not abs(shape) < _INF or math.isnan(z):
        return math.nan
    return _skewnormal_lower(shape, z) if z <= 0.0 else 1.0 - _skewnormal_lower(-shape, -z)


@exact
def skewnormal_quantile(shape, q):
    """z with P(Z <= z) = q: Newton's method for log P, kept inside of an interval that shrinks."""
    if not abs(shape) < _INF or not 0.0 <= q <= 1.0:
        return math.nan
    if q == 0.0 or q == 1.0:
        return -_INF if q == 0.0 else _INF
    negative = q <= skewnormal_cdf(shape, 0.0)
    turned, p = (shape, q) if negative else (-shape, 1.0 - q)
    low, high, x = -40.0, 0.0, -0.5
    for _ in range(200):
        below = _skewnormal_lower(turned, x)
        if below < p:
            low = x
        else:
            high = x
        slope = 2.0 * exp(-0.5 * x * x - _LOG_SQRT_2PI) * ndtr(turned * x)
        following = _towards(x, below, slope, p, low, high)
        if abs(following - x) <= 1e-15 * abs(x) or high - low <= 1e-15 * abs(x):
            x = following
            break
        x = following
    return x if negative else -x
