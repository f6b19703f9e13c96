"""Elementary functions as branch-free polynomials, which LLVM inlines and vectorises.

libm's functions are calls, and a loop with a call in it does not vectorise.  Each function
here is: reduce the argument to a short interval, evaluate a polynomial there, put the result
together with selects only.  The methods are those of W. J. Cody and W. Waite, *Software
Manual for the Elementary Functions* (1980), and J.-M. Muller, *Elementary Functions*
(3rd ed., 2016), chapters 3 and 11; the coefficients are interpolants at Chebyshev nodes,
computed with 60 digits (`tests/codegen/kernels/coefficients.py` recomputes them).

Errors against mpmath, in units in the last place, are in
`tests/codegen/kernels/test_elementary.py`: exp, log, sin, cos below 2, the others below 4.  NaN
stays NaN, infinities are honoured, exp(-inf) is exactly 0; the sign of zero is not kept.
"""

from __future__ import annotations

import numpy as np

from ssmppl.codegen.kernels.math.flags import precise

# Adding 1.5 * 2^52 rounds to an integer and leaves that integer in the low bits.
_ROUND = 6755399441055744.0
_ROUND_BITS = np.int64(0x4338000000000000)
_BIAS = np.int64(1023)

_LOG2_E = 1.4426950408889634
_LN2_HI = 0.6931471806019545  # 32 bits: k * _LN2_HI is exact for |k| < 2^21
_LN2_LO = -4.2009150726810846e-11

_TWO_OVER_PI = 0.6366197723675814
_PIO2_1 = 1.5707963267341256  # 33 bits each: k * part is exact for k < 2^20
_PIO2_2 = 6.077100506303966e-11
_PIO2_3 = 2.0222662487959506e-21
_FAR = 1048576.0  # 2^20, a multiple of 4: shifts by 2^20 pi/2 leave sine and cosine alone
_TRIG_LIMIT = 1e12  # beyond it the multiple of 2^20 pi/2 has too many bits

_SQRT_HALF_BITS = np.int64(0x3FE6A09E667F3BCD)
_INF = np.inf


@precise
def float_bits(x):
    """The 64 bits of a float64, as int64."""
    return np.float64(x).view(np.int64)


@precise
def bits_float(i):
    """The float64 with the bits of an int64."""
    return np.int64(i).view(np.float64)


@precise
def _power_of_two(k):
    """2^k for -1023 < k < 1024, from the low 12 bits of k."""
    return bits_float((k + _BIAS) << np.int64(52))


@precise
def _exp_reduce(x):
    """(k, p) with exp(x) = 2^k (1 + p) and |p| < 0.42.  Beyond the range of exp x is clamped.

    The two comparisons are false for NaN, which therefore passes through into p.  Only the
    low 12 bits of k count: `_power_of_two` shifts the others out.
    """
    if x > 711.0:
        x = 711.0
    if x < -746.0:
        x = -746.0
    t = x * _LOG2_E + _ROUND
    n = t - _ROUND
    r = (x - n * _LN2_HI) - n * _LN2_LO
    q = 2.5100375832561234e-08
    q = q * r + 2.7620075879983367e-07
    q = q * r + 2.7557268480310024e-06
    q = q * r + 2.4801521322368692e-05
    q = q * r + 0.00019841269863040545
    q = q * r + 0.0013888888917196719
    q = q * r + 0.008333333333330065
    q = q * r + 0.041666666666624164
    q = q * r + 0.16666666666666669
    q = q * r + 0.5000000000000001
    return float_bits(t), r + r * r * q


@precise
def exp(x):
    """e^x; 0 from -745.2 down, inf from 709.8 up."""
    k, p = _exp_reduce(x)
    # Two factors, because 2^k alone would overflow or be subnormal at the ends.
    half = k >> np.int64(1)
    return (_power_of_two(half) * (1.0 + p)) * _power_of_two(k - half)


@precise
def expm1(x):
    """e^x - 1 without cancellation near 0."""
    k, p = _exp_reduce(x)
    half = k >> np.int64(1)
    rest = k - half
    up = _power_of_two(half)
    return (up * p + (up - _power_of_two(-rest))) * _power_of_two(rest)


@precise
def _half_expm1(x):
    """(e^x - 1) / 2, which overflows later than e^x does."""
    k, p = _exp_reduce(x)
    half = k >> np.int64(1)
    rest = k - half - np.int64(1)
    up = _power_of_two(half)
    return (up * p + (up - _power_of_two(-rest - np.int64(1)))) * _power_of_two(rest)


@precise
def sinh(x):
    """Hyperbolic sine, from h = (e^|x| - 1)/2 as h + h/(2h + 1)."""
    h = _half_expm1(abs(x))
    tail = h / (2.0 * h + 1.0)
    value = h + (tail if h < _INF else 0.0)
    value = -value if x < 0.0 else value
    return x if x != x else value


@precise
def cosh(x):
    """Hyperbolic cosine, from h = (e^|x| - 1)/2 as 1 + h - h/(2h + 1)."""
    h = _half_expm1(abs(x))
    # h - h/(2h+1) = 2h^2/(2h+1) is free of cancellation.
    tail = h * (2.0 * h / (2.0 * h + 1.0))
    value = 1.0 + (tail if h < 1e150 else h)
    return x if x != x else value


@precise
def tanh(x):
    """Hyperbolic tangent, -t/(t + 2) with t = e^(-2|x|) - 1."""
    t = expm1(-2.0 * abs(x))
    value = -t / (t + 2.0)
    return -value if x < 0.0 else value


@precise
def _log_bits(bits):
    """(n, f, g): the positive normal number with these bits has the logarithm n log 2 + f - g.

    x = 2^n m with m in [sqrt(1/2), sqrt(2)); with f = m - 1 and s = f/(2 + f),
    log m = 2 atanh(s) = f - f^2/2 + s (f^2/2 + R(s^2)), R(z) = 2z/3 + 2z^2/5 + ...
    """
    k = (bits - _SQRT_HALF_BITS) >> np.int64(52)
    m = bits_float(bits - (k << np.int64(52)))
    # int64 -> float64 through the low bits: exact, and vectorises without AVX-512 too.
    n = bits_float(k + _ROUND_BITS) - _ROUND
    f = m - 1.0
    s = f / (2.0 + f)
    z = s * s
    q = 0.14616449685043406
    q = q * z + 0.15331721600556042
    q = q * z + 0.18182889125261723
    q = q * z + 0.2222221113479508
    q = q * z + 0.28571428625975487
    q = q * z + 0.39999999999899505
    q = q * z + 0.666666666666667
    half_square = 0.5 * f * f
    return n, f, half_square - s * (half_square + q * z)


@precise
def log_normal_number(x):
    """Natural logarithm of a positive, finite number that is not subnormal."""
    n, f, g = _log_bits(float_bits(x))
    return n * _LN2_HI - ((g - n * _LN2_LO) - f)


@precise
def log(x):
    """Natural logarithm; -inf at 0, NaN below."""
    tiny = x < 2.2250738585072014e-308
    n, f, g = _log_bits(float_bits(x * 18014398509481984.0 if tiny else x))  # 2^54
    n = n - (54.0 if tiny else 0.0)
    value = n * _LN2_HI - ((g - n * _LN2_LO) - f)
    value = value if x < _INF else x  # inf and NaN
    value = -_INF if x == 0.0 else value
    return np.nan if x < 0.0 else value


@precise
def log1p(x):
    """log(1 + x): the rounding error of u = 1 + x is put back as (x - (u - 1))/u."""
    u = 1.0 + x
    lost = (x - (u - 1.0)) / u
    usable = (u > 0.0) & (u < _INF)
    return log(u) + (lost if usable else 0.0)


@precise
def _trig_reduce(x):
    """(k, r): x = k pi/2 + r modulo 2 pi, |r| <= pi/4, for |x| <= 10^12.

    Cody and Waite's reduction by three parts of pi/2, twice: first by multiples of
    2^20 pi/2, whose remainder needs a second word (`low`), then by multiples of pi/2.
    A product of a multiple (20 bits) and a part (33 bits) is exact.
    """
    n = (x * (_TWO_OVER_PI / _FAR) + _ROUND) - _ROUND
    a = x - n * (_FAR * _PIO2_1)
    b = n * (_FAR * _PIO2_2)
    high = a - b
    c = a - high
    low = ((a - (high + c)) + (c - b)) - n * (_FAR * _PIO2_3)
    t = high * _TWO_OVER_PI + _ROUND
    n = t - _ROUND
    r = ((high - n * _PIO2_1) - n * _PIO2_2) + (low - n * _PIO2_3)
    return float_bits(t), r


@precise
def sin_cos_reduced(r):
    """sin r and cos r for |r| <= pi/4."""
    z = r * r
    q = 1.5917988979397435e-10
    q = q * z - 2.5051129896450185e-08
    q = q * z + 2.7557316093198404e-06
    q = q * z - 0.00019841269836740532
    q = q * z + 0.008333333333330936
    q = q * z - 0.16666666666666666
    sine = r + r * z * q
    q = -1.138254464534925e-11
    q = q * z + 2.087614504941318e-09
    q = q * z - 2.755731726587808e-07
    q = q * z + 2.48015872987544e-05
    q = q * z - 0.0013888888888887389
    q = q * z + 0.041666666666666664
    # 1 - z/2 rounds; what it loses is put back with the small terms.
    half = 0.5 * z
    main = 1.0 - half
    cosine = main + (((1.0 - main) - half) + z * z * q)
    return sine, cosine


@precise
def _quadrant(k, r):
    """sin(k pi/2 + r): sine or cosine by the lowest bit of k, sign by the next one."""
    sine, cosine = sin_cos_reduced(r)
    value = cosine if (k & np.int64(1)) != 0 else sine
    return bits_float(float_bits(value) ^ ((k & np.int64(2)) << np.int64(62)))


@precise
def sin(x):
    """Sine for |x| <= 10^12; NaN beyond.

    An exact reduction of larger numbers needs a table or a call, either of which makes the
    whole loop 5 to 10 times slower; a wrong phase would go unnoticed, a NaN does not.
    """
    k, r = _trig_reduce(x)
    value = _quadrant(k, r)
    return value if abs(x) <= _TRIG_LIMIT else np.nan


@precise
def cos(x):
    """Cosine for |x| <= 10^12; NaN beyond (see `sin`)."""
    k, r = _trig_reduce(x)
    value = _quadrant(k + np.int64(1), r)
    return value if abs(x) <= _TRIG_LIMIT else np.nan


@precise
def arctan(x):
    """Inverse tangent, reduced to [-tan(pi/8), tan(pi/8)] by atan x = c + atan((x-a)/(1+ax))."""
    a = abs(x)
    middle = a > 0.4142135623730950
    large = a > 2.414213562373095
    numerator = -1.0 if large else (a - 1.0 if middle else a)
    denominator = a if large else (a + 1.0 if middle else 1.0)
    t = numerator / denominator
    z = t * t
    q = -0.019162068915902573
    q = q * z + 0.03921955253255129
    q = q * z - 0.05085030492810941
    q = q * z + 0.058580687568615106
    q = q * z - 0.06664502215671447
    q = q * z + 0.07692182535116648
    q = q * z - 0.09090904549884611
    q = q * z + 0.11111111014561013
    q = q * z - 0.14285714284657894
    q = q * z + 0.1999999999999548
    q = q * z - 0.3333333333333333
    high = 1.5707963267948966 if large else (0.7853981633974483 if middle else 0.0)
    low = 6.123233995736766e-17 if large else (3.061616997868383e-17 if middle else 0.0)
    value = high + (t + (t * z * q + low))
    return -value if x < 0.0 else value


@precise
def sqrt(x):
    """Square root (an instruction, which vectorises)."""
    return np.sqrt(x)
