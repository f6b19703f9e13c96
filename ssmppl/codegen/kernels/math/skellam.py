"""The difference of two Poisson counts: its mass, distribution function and quantile, for kernels.

J. G. Skellam, *J. R. Stat. Soc.* 109 (1946): P(k) = e^-(a + b) (a / b)^(k / 2) I_|k|(2 sqrt(a b)).
The Bessel function is its power series where order and argument are small, else the uniform
expansion DLMF 10.41.3. Of that the leading term is the saddle point approximation: counts A and
B = A - k with A B = a b are the likeliest ones, and its exponent is that of their two Poisson
masses, which C. Loader's deviances have without cancellation.

Tails are sums outwards from k: their terms' ratios r(i) = P(i + 1) / P(i) follow from
i P(i) = a P(i - 1) - b P(i + 1), r(i - 1) = a / (i + b r(i)), which is stable inwards and has
positive terms only (W. Gautschi, *SIAM Review* 9 (1967)). Of spreads beyond 1e4 they have too many
terms, and the approximation of R. Lugannani and S. Rice, *Adv. Appl. Prob.* 12 (1980), is good to
1e-10.
"""

from __future__ import annotations

import math

import numpy as np

from ssmppl.codegen.kernels.math.elementary import exp, log
from ssmppl.codegen.kernels.math.flags import exact
from ssmppl.codegen.kernels.math.special import deviance_part, ndtr, ndtri, stirling_error

_INF = np.inf
_LOG_2PI = 1.8378770664093453
FEW = 100.0  # sqrt(k^2 + 4 a b) from which on the uniform expansion is good to rounding
MANY = 1e8  # and from which on tails are not summed
NEAR = 1e-5  # of the mean, where errors of that difference and of its limit are alike
FARTHEST = 42.0  # exp(-42) of the first term is below rounding


@exact
def _sound(k, a, b):
    return k == k and 0.0 <= a < _INF and 0.0 <= b < _INF


@exact
def _total(k, a, b):
    """A + B of the likeliest counts of difference k: the variance at the saddle point."""
    return math.hypot(k, 2.0 * math.sqrt(a) * math.sqrt(b))


@exact
def _saddle_point(k, a, b):
    """(log(A / a), the exponent) for k >= 0 and A > 0."""
    up = 0.5 * (k + _total(k, a, b))
    down = b * (a / up)
    tilt = log(up / a)
    # what rounding of A and B makes of their difference, to first order
    gap = (up - k) - down if up <= 2.0 * k else (up - down) - k
    rest = deviance_part(down, b) if down > 0.0 else b
    return tilt, tilt * gap - deviance_part(up, a) - rest


@exact
def _series(k, product):
    """1 + x / (k + 1) + x^2 / (2 (k + 1) (k + 2)) + ..."""
    term = total = 1.0
    for j in range(1, 1000):
        term *= product / (j * (k + j))
        total += term
        if term < 1e-17 * total:
            break
    return total


@exact
def _expansion(p, m):
    """1 + U_1(p) / nu + ... of DLMF 10.41.3, with nu = p m, x = p^2."""
    x = p * p
    u1 = (3.0 - 5.0 * x) / 24.0
    u2 = (81.0 - x * (462.0 - 385.0 * x)) / 1152.0
    u3 = (30375.0 - x * (369603.0 - x * (765765.0 - 425425.0 * x))) / 414720.0
    u4 = 349922430.0 - x * (446185740.0 - 185910725.0 * x)
    u4 = (4465125.0 - x * (94121676.0 - x * u4)) / 39813120.0
    u5 = 614135872350.0 - x * (566098157625.0 - 188699385875.0 * x)
    u5 = (1519035525.0 - x * (49286948607.0 - x * (284499769554.0 - x * u5))) / 6688604160.0
    u6 = 5104696716244125.0 - x * (3685299006138750.0 - 1023694168371875.0 * x)
    u6 = 127577298354750.0 - x * (1050760774457901.0 - x * (3369032068261860.0 - x * u6))
    u6 = (2757049477875.0 - x * u6) / 4815794995200.0
    return 1.0 + (u1 + (u2 + (u3 + (u4 + (u5 + u6 / m) / m) / m) / m) / m) / m


@exact
def skellam_log_mass(k, a, b):
    """log P(N1 - N2 = k) for counts of rates a and b."""
    if not _sound(k, a, b):
        return math.nan
    if k < 0.0:
        k, a, b = -k, b, a
    if k == _INF or (a == 0.0 and k > 0.0):
        return -_INF
    m = _total(k, a, b)
    if m < FEW:
        of_up = -a
        if k > 0.0:
            of_up = -stirling_error(k) - deviance_part(k, a) - 0.5 * (_LOG_2PI + log(k))
        return of_up - b + log(_series(k, a * b))
    return _saddle_point(k, a, b)[1] - 0.5 * (_LOG_2PI + log(m)) + log(_expansion(k / m, m))


@exact
def _outwards(k, a, b):
    """P(N1 - N2 >= k) over P(N1 - N2 = k), k >= max(0, a - b).

    The exponent falls by w^2 / (2 (m + w)) at least up to k + w.
    """
    m = _total(k, a, b)
    i = k + np.ceil(FARTHEST + math.sqrt(FARTHEST * FARTHEST + 2.0 * FARTHEST * m))
    ratio = 2.0 * a / (i + 1.0 + math.hypot(i + 1.0, 2.0 * math.sqrt(a) * math.sqrt(b)))
    total = 1.0
    while i > k:
        ratio = a / (i + b * ratio)
        total = 1.0 + ratio * total
        i -= 1.0
    return total


@exact
def _approximate_upper(k, a, b):
    """P(N1 - N2 >= k) by Lugannani and Rice's formula for whole numbers (Daniels 1987, *Int. Stat.
    Rev.* 55, equation 4.6)."""
    m = _total(k, a, b)
    tilt, exponent = _saddle_point(abs(k), a, b) if k >= 0.0 else _saddle_point(-k, b, a)
    tilt = tilt if k >= 0.0 else -tilt
    w = math.copysign(math.sqrt(max(-2.0 * exponent, 0.0)), tilt)
    if abs(w) < NEAR * math.sqrt(m):  # the difference of two reciprocals has fewer digits
        correction = 0.5 / math.sqrt(m) - k / (6.0 * m * math.sqrt(m))
    else:
        correction = 1.0 / (-math.expm1(-tilt) * math.sqrt(m)) - 1.0 / w
    return min(ndtr(-w) + correction * exp(exponent - 0.5 * _LOG_2PI), 1.0)


@exact
def _lower(k, a, b):
    """P(N1 - N2 <= k) for k < a - b, to full relative accuracy."""
    if _total(k, a, b) > MANY:
        return max(_approximate_upper(-k, b, a), 0.0)
    mass = exp(skellam_log_mass(k, a, b))
    if mass == 0.0:
        return 0.0
    if k <= 0.0:
        return min(mass * _outwards(-k, b, a), 1.0)
    # down to 0 by the ratios the other way round, then on from there
    ratio = exp(skellam_log_mass(k + 1.0, a, b) - skellam_log_mass(k, a, b))
    term = total = 1.0
    while k > 0.0 and term > 1e-18 * total:
        back = (k + b * ratio) / a
        term *= back
        total += term
        ratio = 1.0 / back
        k -= 1.0
    if k == 0.0:
        total += term * (_outwards(0.0, b, a) - 1.0)
    return min(mass * total, 1.0)


@exact
def skellam_cdf(k, a, b):
    """P(N1 - N2 <= k): below the mean to full relative accuracy, above it one less the rest."""
    if not _sound(k, a, b):
        return math.nan
    k = np.floor(k)
    if abs(k) == _INF:
        return 0.0 if k < 0.0 else 1.0
    return _lower(k, a, b) if k < a - b else 1.0 - _lower(-k - 1.0, b, a)


@exact
def skellam_quantile(a, b, q):
    """The smallest k with P(N1 - N2 <= k) >= q; -inf for q = 0 unless b is 0."""
    if not _sound(q, a, b) or not 0.0 <= q <= 1.0:
        return math.nan
    if q == 0.0:
        return -_INF if b > 0.0 else 0.0
    if q == 1.0:
        return _INF if a > 0.0 else 0.0
    guess = np.floor(a - b + math.sqrt(a + b) * ndtri(q))
    step = 1.0
    if skellam_cdf(guess, a, b) >= q:
        low, high = guess - step, guess
        while skellam_cdf(low, a, b) >= q:
            step *= 2.0
            low, high = low - step, low
    else:
        low, high = guess, guess + step
        while skellam_cdf(high, a, b) < q:
            step *= 2.0
            low, high = high, high + step
    while high - low > 1.0:
        middle = np.floor(0.5 * (low + high))
        if not low < middle < high:  # of numbers so large that not all whole ones exist
            break
        if skellam_cdf(middle, a, b) >= q:
            high = middle
        else:
            low = middle
    return high
