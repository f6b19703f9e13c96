"""Special functions of probability, scalar, for kernels.

Sources: M. Abramowitz and I. A. Stegun, *Handbook of Mathematical Functions* (A&S);
M. J. Wichura's AS 241, *Applied Statistics* 37 (1988), for the normal quantile; C. Loader, *Fast
and accurate computation of binomial probabilities* (2000), for powers over factorials without
cancellation.  Relative errors are below 1e-12 (near a zero of the function: absolute errors);
`tests/kernels/test_special.py` has the ranges.  Outside their domain the functions return NaN.
The incomplete gamma and beta functions are in `incomplete`.
"""

from __future__ import annotations

import math

import numpy as np

from ssmppl.codegen.kernels.elementary import exp, log, log1p
from ssmppl.codegen.kernels.flags import exact

_INF = np.inf
_SQRT_HALF = 0.7071067811865476
_LOG_SQRT_2PI = 0.9189385332046727


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
