"""Distribution functions that have no closed form, scalar, for kernels.

The beta-binomial law's is a sum over its values, each from the last by their ratio (Johnson, Kemp
and Kotz 2005, "Univariate discrete distributions", section 6.2.2), in logarithms, which neither
over- nor underflow. Von Mises' is an integral, by the double exponential rule of Takahasi and Mori
(1974), *Publ. RIMS* 9. Outside their domain the functions return NaN.
"""

from __future__ import annotations

import math

import numpy as np

from ssmppl.codegen.kernels.elementary import exp, log
from ssmppl.codegen.kernels.flags import exact
from ssmppl.codegen.kernels.special import gammaln_rise, i0e, lgamma

FARTHEST = 42.0  # exp(-42) of the density at the end of the integral is below rounding
STEP, NODES = 0.0625, 52  # of the rule, on each side of its middle


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
        # of log F, which is nearly straight in the tail
        following = x - below / slope * log(below / p) if below > 0.0 and p > 0.0 else low
        if not low < following < high:
            following = 0.5 * (low + high)
        if abs(following - x) <= 1e-15 * abs(x) or high - low <= 1e-15 * abs(x):
            x = following
            break
        x = following
    return x if q <= 0.5 else -x
