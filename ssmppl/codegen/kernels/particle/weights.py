"""Weights of particles and of trajectories: normalised, drawn by, and what is summed and ranked by
them.

Sums of weights are taken after subtracting the maximum (log-sum-exp); the effective sample size is
(sum W)^2 / sum W^2, A. Kong, J. S. Liu and W. H. Wong, *JASA* 89 (1994).  Passes that vectorise;
nothing is allocated.

A loop that adds up stores nothing.  Before a loop that does both the compiler compares the
addresses of its arrays, and takes the scalar one if they are close: the order of the sum, and with
it the last digit, would depend on where short arrays happen to lie.

In means, covariances and quantiles a particle without weight counts for nothing, be its values
infinite or undefined.
"""

from __future__ import annotations

import numpy as np

from ssmppl.codegen.kernels.math.elementary import bits_float, exp, float_bits
from ssmppl.codegen.kernels.math.elementary import log as _log
from ssmppl.codegen.kernels.math.flags import exact, kernel, precise

OK = 0
ALL_ZERO = 1
"""Every log-weight is -inf: no particle can have produced the observation."""
NAN = 2
"""Some log-weight is NaN, whatever the others are."""
INFINITE = 3
"""Some log-weight is +inf, and none is NaN."""

NO_POINT = (ALL_ZERO, INFINITE)
"""Statuses of a likelihood at parameters that are none: impossible, or with an infinite density."""

STRETCH = 32
_INF = np.inf
_NON_SIGN = np.int64(0x7FFFFFFFFFFFFFFF)


@precise
def _ordered(bits):
    """Map the bits of floats to integers in the same order, and back (an involution).

    The largest integer vectorises as a reduction; the largest float does not, unless the
    compiler may assume that there is no NaN.
    """
    return bits ^ ((bits >> np.int64(63)) & _NON_SIGN)


@kernel
def largest(values):
    """Largest of `values`, shape (n,) with n >= 1; a NaN among them may be passed over."""
    top = _ordered(float_bits(-_INF))
    for i in range(values.size):
        top = max(top, _ordered(float_bits(values[i])))
    return bits_float(_ordered(top))


@exact
def rule_out(log_v):
    """-inf in place of NaN and +inf: for states that no filter has drawn, but a path recomputed
    from another ancestor leads to, and for parameters that walk. What leads a law out of its range
    there, or to where its density is infinite, is impossible."""
    for i in range(log_v.size):
        if not log_v[i] < _INF:
            log_v[i] = -_INF


@kernel
def _fault(log_w):
    """Why the largest log-weight is not finite, or the sum is NaN."""
    status = ALL_ZERO
    for i in range(log_w.size):
        if log_w[i] != log_w[i]:
            return NAN
        if log_w[i] == _INF:
            status = INFINITE
    return status


@kernel
def normalise(log_w, w):
    """Write the normalised exp(log_w) to `w`; return (log of the sum, ESS, status).

    log_w : (N,) log-weights.  w : (N,), another array.
    The log of the *sum*: subtract log N for the mean.  With a status other than `OK` the two
    numbers are (-inf, 0) for `ALL_ZERO` and NaN otherwise, and `w` is not to be used.
    """
    n = log_w.size
    top = largest(log_w)
    if not (-_INF < top < _INF):
        status = _fault(log_w)
        if status == ALL_ZERO:
            return -_INF, 0.0, status
        return np.nan, np.nan, status
    for i in range(n):
        w[i] = exp(log_w[i] - top)
    total = 0.0
    squares = 0.0
    for i in range(n):
        total += w[i]
        squares += w[i] * w[i]
    # A NaN that the maximum passed over shows in the sum.
    if total != total:
        return np.nan, np.nan, NAN
    scale = 1.0 / total
    for i in range(n):
        w[i] *= scale
    return top + _log(total), total * total / squares, OK


@kernel
def sum_of(w):
    """w_1 + ... + w_n."""
    total = 0.0
    for i in range(w.size):
        total += w[i]
    return total


@kernel
def _exponentials(log_w, top, w):
    """w = exp(log_w - top); their sum."""
    for i in range(log_w.size):
        w[i] = exp(log_w[i] - top)
    return sum_of(w)


@exact
def relative_weights(log_w, w):
    """w = exp(log_w - max); (their sum, status)."""
    top = largest(log_w)
    if not (-_INF < top < _INF):
        return np.nan, _fault(log_w)
    total = _exponentials(log_w, top, w)
    return total, OK if total == total else NAN


@exact
def draw_relative(w, total, u):
    """Index j with probability w[j] / total, from one uniform; never one of weight zero.

    w : (N,), total : their sum, in whatever order it was taken. The weights are passed through by
    stretches first, because adding them up one by one is what takes longest.
    """
    n, begin, point = w.size, 0, u * total
    while begin + STRETCH < n:
        own = sum_of(w[begin : begin + STRETCH])
        if own > point:
            break
        point -= own
        begin += STRETCH
    part = w[begin : min(begin + STRETCH, n)]
    last = -1
    for j in range(part.size):
        if part[j] > 0.0:
            last = j
            point -= part[j]
            if point < 0.0:
                return begin + j
    if last < 0:  # rounding has passed all weights
        while w[begin] == 0.0:
            begin -= 1
        return begin
    return begin + last


@kernel
def weighted_mean(values, w):
    """sum_i w_i values_i, weights normalised."""
    total = 0.0
    for i in range(w.size):
        share, value = w[i], values[i]
        total += share * value if share > 0.0 else 0.0
    return total


@kernel
def weighted_product(a, mean_a, b, mean_b, w):
    """sum_i w_i (a_i - mean_a) (b_i - mean_b)."""
    total = 0.0
    for i in range(w.size):
        share, product = w[i], (a[i] - mean_a) * (b[i] - mean_b)
        total += share * product if share > 0.0 else 0.0
    return total


@exact
def weighted_quantiles(values, w, probabilities, out):
    """The smallest value at which the cumulative weight reaches each probability (increasing)."""
    order = np.argsort(values)
    total, j = 0.0, 0
    for i in range(w.size):
        total += w[order[i]]
        while j < probabilities.size and (total >= probabilities[j] or i == w.size - 1):
            out[j] = values[order[i]]
            j += 1


@exact
def summarise(x, w, probabilities, mean, covariance, quantiles):
    """Moments and quantiles of x : (D, N) under w : (N,) into (D,), (D, D), (P, D)."""
    for k in range(x.shape[0]):
        mean[k] = weighted_mean(x[k], w)
        for m in range(k + 1):
            covariance[k, m] = weighted_product(x[k], mean[k], x[m], mean[m], w)
            covariance[m, k] = covariance[k, m]
        if probabilities.size > 0:
            weighted_quantiles(x[k], w, probabilities, quantiles[:, k])
