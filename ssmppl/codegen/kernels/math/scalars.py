"""Scalar functions that generated code calls and the other kernels do not need.

`power`, `maximum` and `minimum` have NumPy's meaning, NaN included. The quantiles of discrete
distributions are the smallest k at which the distribution function reaches q, found by doubling
and bisection. The factorisations of small matrices take their entries as a tuple, row by row.
"""

from __future__ import annotations

import math

import numpy as np

from ssmppl.codegen.kernels.math.elementary import exp, log1p
from ssmppl.codegen.kernels.math.flags import exact, precise
from ssmppl.codegen.kernels.math.special import beta_tails, betainc, gammainc, gammaincc

LARGEST_COUNT = 2.0**53
PIVOT = 1e-13  # of a variance, below which what is left of it is taken for rounding


@precise
def maximum(a, b):
    return a if (a >= b) | (a != a) else b


@precise
def minimum(a, b):
    return a if (a <= b) | (a != a) else b


@precise
def logaddexp(a, b):
    """log(exp a + exp b), in a form that vectorises."""
    top = a if (a >= b) | (a != a) else b
    return top if (top == -np.inf) | (top == np.inf) else top + log1p(exp(-abs(a - b)))


@precise
def sign(a):
    return 1.0 if a > 0.0 else (-1.0 if a < 0.0 else a)


@precise
def floor(a):
    return np.floor(a)


@precise
def ceil(a):
    return np.ceil(a)


@precise
def whole(a):
    """A number of times: 0 for what is negative or no number."""
    return int(a) if a > 0.0 else 0


@exact
def power(a, b):
    """a ** b as NumPy has it: nan for a negative base with a fractional exponent."""
    return np.power(a, b)


@exact
def tan(a):
    return math.tan(a)


@exact
def arcsin(a):
    return math.asin(a) if abs(a) <= 1.0 else math.nan


@exact
def arccos(a):
    return math.acos(a) if abs(a) <= 1.0 else math.nan


@exact
def arctan2(a, b):
    return math.atan2(a, b)


@exact
def arcsinh(a):
    return math.asinh(a)


@exact
def arccosh(a):
    return math.acosh(a) if a >= 1.0 else math.nan


@exact
def arctanh(a):
    if abs(a) == 1.0:
        return math.copysign(math.inf, a)
    return math.atanh(a) if abs(a) < 1.0 else math.nan


@exact
def _poisson_cdf(k, a, b, c):
    return gammaincc(k + 1.0, a)


@exact
def _binomial_cdf(k, n, p, c):
    return 1.0 if k >= n else betainc(n - k, k + 1.0, 1.0 - p)


@exact
def _negbinomial_tails(k, r, mean):
    """P(X <= k) and P(X > k)."""
    if not (r > 0.0 and mean >= 0.0) or r + mean == math.inf:
        return math.nan, math.nan
    above, below = beta_tails(k + 1.0, r, mean / (r + mean), r / (r + mean))
    return below, above


@exact
def _negbinomial_cdf(k, r, mean, c):
    return _negbinomial_tails(k, r, mean)[0]


@exact
def _smallest(cdf, q, a, b, c):
    """The smallest whole k >= 0 with cdf(k) >= q."""
    if not 0.0 <= q <= 1.0:
        return math.nan
    if cdf(0.0, a, b, c) >= q:
        return 0.0
    low, high = 0.0, 1.0
    while cdf(high, a, b, c) < q:
        low, high = high, 2.0 * high
        if high > LARGEST_COUNT:
            return math.inf
    while high - low > 1.0:
        middle = np.floor(0.5 * (low + high))
        if cdf(middle, a, b, c) >= q:
            high = middle
        else:
            low = middle
    return high


@exact
def _poisson_survival(k, a, b, c):
    return gammainc(k + 1.0, a)


@exact
def _negbinomial_survival(k, r, mean, c):
    return _negbinomial_tails(k, r, mean)[1]


@exact
def _smallest_below(survival, q, a, b):
    """The smallest whole k >= 0 with survival(k) <= q: `_smallest` for the upper tail."""
    if not 0.0 <= q <= 1.0:
        return math.nan
    low, high = -1.0, 0.0
    while survival(high, a, b, 0.0) > q:
        low, high = high, 2.0 * high + 1.0
        if high > LARGEST_COUNT:
            return math.inf
    if math.isnan(survival(high, a, b, 0.0)):
        return math.nan
    while high - low > 1.0:
        middle = np.floor(0.5 * (low + high))
        if survival(middle, a, b, 0.0) <= q:
            high = middle
        else:
            low = middle
    return high


@exact
def poisson_survival_quantile(rate, q):
    return _smallest_below(_poisson_survival, q, rate, 0.0)


@exact
def negbinomial_survival_quantile(r, mean, q):
    return _smallest_below(_negbinomial_survival, q, r, mean)


@exact
def poisson_quantile(rate, q):
    return _smallest(_poisson_cdf, q, rate, 0.0, 0.0)


@exact
def binomial_quantile(n, p, q):
    return _smallest(_binomial_cdf, q, n, p, 0.0)


@exact
def negbinomial_quantile(r, mean, q):
    return _smallest(_negbinomial_cdf, q, r, mean, 0.0)


@exact
def _matrix(entries, n):
    out = np.empty((n, n))
    for i in range(n):
        for j in range(n):
            out[i, j] = entries[i * n + j]
    return out


@exact
def cholesky(entries, n):
    """Lower Cholesky factor of a matrix that may be singular.

    A pivot of zero, but for rounding, leaves a column of zeros (Higham 2002, "Accuracy and
    stability of numerical algorithms", section 10.3); nan from the first pivot on that is negative,
    or zero beside an entry that is not.
    """
    a = _matrix(entries, n)
    for j in range(n):
        least = PIVOT * a[j, j]
        for k in range(j):
            a[j, j] -= a[j, k] * a[j, k]
        gone = (a[j, j] <= 0.0) & (a[j, j] >= -least)
        for i in range(j + 1, n):
            for k in range(j):
                a[i, j] -= a[i, k] * a[j, k]
            gone = gone & (a[i, j] * a[i, j] <= least * a[i, i])
        a[j, j] = math.sqrt(a[j, j]) if a[j, j] > 0.0 else math.nan
        for i in range(j + 1, n):
            a[i, j] = 0.0 if gone else a[i, j] / a[j, j]
        a[j, j] = 0.0 if gone else a[j, j]
    return a


@exact
def _eliminate(a, b):
    """Gauss-Jordan with partial pivoting on (a | b) in place; returns (sign, log |det a|).

    Where a is singular: (0, -inf), and elimination stops there.
    """
    n, sign, log_size = a.shape[0], 1.0, 0.0
    for j in range(n):
        pivot = j
        for i in range(j + 1, n):
            if abs(a[i, j]) > abs(a[pivot, j]):
                pivot = i
        if not abs(a[pivot, j]) > 0.0:
            return 0.0 * a[pivot, j], -math.inf + a[pivot, j]
        if pivot != j:
            sign = -sign
            for k in range(n):
                a[j, k], a[pivot, k] = a[pivot, k], a[j, k]
            for k in range(b.shape[1]):
                b[j, k], b[pivot, k] = b[pivot, k], b[j, k]
        if a[j, j] < 0.0:
            sign = -sign
        log_size += math.log(abs(a[j, j]))
        scale = 1.0 / a[j, j]
        for i in range(n):
            if i != j and a[i, j] != 0.0:
                factor = a[i, j] * scale
                for k in range(j, n):
                    a[i, k] -= factor * a[j, k]
                for k in range(b.shape[1]):
                    b[i, k] -= factor * b[j, k]
    return sign, log_size


@exact
def inverse(entries, n):
    """Inverse; nan where the matrix is singular."""
    a, b = _matrix(entries, n), np.eye(n)
    sign, _ = _eliminate(a, b)
    for i in range(n):
        for j in range(n):
            b[i, j] = b[i, j] / a[i, i] if abs(sign) == 1.0 else math.nan
    return b


@exact
def det(entries, n):
    """Determinant: the product of the pivots, with the sign of their permutation."""
    a = _matrix(entries, n)
    sign, _ = _eliminate(a, np.empty((n, 0)))
    size = abs(sign)
    for j in range(n):
        size *= abs(a[j, j])
    return math.copysign(size, sign)


@exact
def logdet(entries, n):
    """log |det|, a sum over the pivots, so that no product can underflow; -inf where singular."""
    return _eliminate(_matrix(entries, n), np.empty((n, 0)))[1]
