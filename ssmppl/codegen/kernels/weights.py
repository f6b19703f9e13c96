"""Normalised importance weights, their sum and their effective size.

The sum is taken after subtracting the maximum (log-sum-exp); the effective sample size is
(sum W)^2 / sum W^2, A. Kong, J. S. Liu and W. H. Wong, *JASA* 89 (1994).  Two passes, both of
which vectorise, and one to scale; nothing is allocated.
"""

from __future__ import annotations

import numpy as np

from ssmppl.codegen.kernels.elementary import bits_float, exp, float_bits
from ssmppl.codegen.kernels.elementary import log as _log
from ssmppl.codegen.kernels.flags import kernel, precise

OK = 0
ALL_ZERO = 1
"""Every log-weight is -inf: no particle can have produced the observation."""
NAN = 2
"""Some log-weight is NaN, whatever the others are."""
INFINITE = 3
"""Some log-weight is +inf, and none is NaN."""

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
    total = 0.0
    squares = 0.0
    for i in range(n):
        value = exp(log_w[i] - top)
        w[i] = value
        total += value
        squares += value * value
    # A NaN that the maximum passed over shows in the sum.
    if total != total:
        return np.nan, np.nan, NAN
    scale = 1.0 / total
    for i in range(n):
        w[i] *= scale
    return top + _log(total), total * total / squares, OK
