"""Counter-based random numbers: words, uniforms and normals.

Word i of a stream is a hash of (key, i), so it does not depend on threads or on how the draws
are cut into calls.  The hash is a SplitMix64 generator (G. L. Steele, D. Lea, C. H. Flood,
*Fast splittable pseudorandom number generators*, OOPSLA 2014; the multipliers are D. Stafford's
variant 13), keyed by 128 bits: the first key is where the counter starts, the second one enters
after the first multiplication, so that two streams whose counters overlap still differ, and a
third multiplication spreads it over the word.

A state is a uint64 array of shape (4,): key 0, key 1, the counter, and one spare word.
Each drawing function advances the counter in place.  2^64 words per stream.

Normals are drawn by G. E. P. Box and M. E. Muller's method (*Ann. Math. Stat.* 29, 1958), which
has no branches and so vectorises.
"""

from __future__ import annotations

import numpy as np

from ssmppl.codegen.kernels.math.elementary import (
    bits_float,
    exp,
    log,
    log1p,
    log_normal_number,
    sin_cos_reduced,
)
from ssmppl.codegen.kernels.math.flags import exact, kernel, precise
from ssmppl.codegen.kernels.math.special import deviance_part, stirling_error

KEY0, KEY1, COUNTER = 0, 1, 2
"""Where the parts of a state are."""

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MULTIPLIER_1 = np.uint64(0xBF58476D1CE4E5B9)
_MULTIPLIER_2 = np.uint64(0x94D049BB133111EB)
_MULTIPLIER_3 = np.uint64(0x9FB21C651E98DF25)
_ONE = np.int64(0x3FF0000000000000)  # the bits of 1.0
_HALF_STEP = 1.1102230246251565e-16  # 2^-53
_TURN = np.pi / 2.0


def new_state(seed_sequence: np.random.SeedSequence) -> np.ndarray:
    """State at the start of the stream that belongs to `seed_sequence`, uint64 of shape (4,)."""
    state = np.zeros(4, dtype=np.uint64)
    state[:2] = seed_sequence.generate_state(2, dtype=np.uint64)
    return state


@precise
def word(key0, key1, index):
    """Word `index` of the stream (key0, key1); all uint64."""
    z = key0 + index * _GOLDEN
    z = (z ^ (z >> np.uint64(30))) * _MULTIPLIER_1
    z ^= key1  # before the shift: else its top bit would reach few bits of the word
    z = (z ^ (z >> np.uint64(27))) * _MULTIPLIER_2
    z = (z ^ (z >> np.uint64(31))) * _MULTIPLIER_3
    return z ^ (z >> np.uint64(28))


@precise
def word_uniform(bits):
    """The upper 52 bits of a word as a uniform (k + 1/2) 2^-52, never 0 or 1."""
    mantissa = np.int64(bits >> np.uint64(12))
    return bits_float(mantissa | _ONE) - (1.0 - _HALF_STEP)


@precise
def _box_muller(radius_word, angle_word):
    """Two independent normals from two words.

    The angle is uniform on (-pi/4, pi/4), where the polynomials are short; the two lowest
    bits of its word, which `word_uniform` does not use, turn it to one of four quadrants.
    """
    radius = np.sqrt(-2.0 * log_normal_number(word_uniform(radius_word)))
    sine, cosine = sin_cos_reduced(_TURN * (word_uniform(angle_word) - 0.5))
    sine *= radius
    cosine *= radius
    cosine = cosine if (angle_word & np.uint64(1)) != 0 else -cosine
    swap = (angle_word & np.uint64(2)) != 0
    return (sine if swap else cosine), (cosine if swap else sine)


@kernel
def fill_normal(state, out):
    """Fill `out`, shape (n,), contiguous, with standard normals."""
    key0, key1, start = state[0], state[1], state[2]
    n = out.size
    pairs = (n + 1) // 2
    angles = start + np.uint64(pairs)
    first, second = out[:pairs], out[pairs:]
    for i in range(n - pairs):
        a, b = _box_muller(
            word(key0, key1, start + np.uint64(i)), word(key0, key1, angles + np.uint64(i))
        )
        first[i] = a
        second[i] = b
    if n % 2 == 1:
        last = np.uint64(pairs - 1)
        a, b = _box_muller(word(key0, key1, start + last), word(key0, key1, angles + last))
        first[pairs - 1] = a
    state[2] = angles + np.uint64(pairs)


@kernel
def fill_uniform(state, out):
    """Fill `out`, shape (n,), contiguous, with uniforms on the open interval (0, 1)."""
    key0, key1, start = state[0], state[1], state[2]
    for i in range(out.size):
        out[i] = word_uniform(word(key0, key1, start + np.uint64(i)))
    state[2] = start + np.uint64(out.size)


@exact
def normals(state, out):
    """`fill_normal`, for those who call from Python."""
    fill_normal(state, out)


@exact
def uniforms(state, out):
    """`fill_uniform`, for those who call from Python."""
    fill_uniform(state, out)


@precise
def next_word(state):
    """The next word, uint64."""
    index = state[2]
    state[2] = index + np.uint64(1)
    return word(state[0], state[1], index)


@precise
def uniform(state):
    """A uniform on the open interval (0, 1)."""
    return word_uniform(next_word(state))


@precise
def normal(state):
    """A standard normal."""
    radius_word = next_word(state)
    a, _ = _box_muller(radius_word, next_word(state))
    return a


@precise
def exponential(state):
    """An exponential with mean 1."""
    return -log_normal_number(uniform(state))


@exact
def _gamma_from_one(state, shape):
    """Gamma(shape, 1) for 1 <= shape < inf: G. Marsaglia, W. W. Tsang, *ACM TOMS* 26 (2000)."""
    d = shape - 1.0 / 3.0
    c = 1.0 / np.sqrt(9.0 * d)
    while True:
        x = normal(state)
        v = 1.0 + c * x
        if v > 0.0:
            v = v * v * v
            u = uniform(state)
            if log_normal_number(u) < 0.5 * x * x + d * (1.0 - v + log_normal_number(v)):
                return d * v


@exact
def log_gamma_draw(state, shape):
    """The logarithm of a Gamma(shape, 1) variate.

    Below shape 1 it is log G(shape + 1) + (log U)/shape (Marsaglia and Tsang, section 6), which
    is finite where the variate itself is 0: beta and Dirichlet variates need that.
    """
    if not (0.0 < shape < np.inf):
        return np.nan
    if shape >= 1.0:
        return log(_gamma_from_one(state, shape))
    boost = log_normal_number(uniform(state)) / shape
    return log(_gamma_from_one(state, shape + 1.0)) + boost


@exact
def gamma(state, shape):
    """A Gamma(shape, 1) variate; 0 only where the variate is below the least float."""
    if not (0.0 < shape < np.inf):
        return np.nan
    if shape >= 1.0:
        return _gamma_from_one(state, shape)
    return exp(log_gamma_draw(state, shape))


@exact
def gamma_by(state, shape, x, u):
    """A Gamma(shape, 1) variate: Marsaglia and Tsang's first try by a given normal and uniform,
    with their squeeze; `gamma` where it is refused. For loops with buffers of both."""
    if 1.0 <= shape < np.inf:
        d = shape - 1.0 / 3.0
        v = 1.0 + x / np.sqrt(9.0 * d)
        if v > 0.0:
            v = v * v * v
            if u < 1.0 - 0.0331 * (x * x) * (x * x):
                return d * v
            if log_normal_number(u) < 0.5 * x * x + d * (1.0 - v + log_normal_number(v)):
                return d * v
    return gamma(state, shape)


@exact
def _poisson_log_mass(k, rate):
    if k == 0.0:
        return -rate
    return -stirling_error(k) - deviance_part(k, rate) - 0.5 * log(2.0 * np.pi * k)


@exact
def poisson(state, rate):
    """A Poisson variate, as float64: inversion below rate 10, else W. Hörmann's PTRS,
    *Insurance: Mathematics and Economics* 12 (1993), with Loader's form of the mass."""
    if not (0.0 <= rate < np.inf):
        return np.nan
    if rate < 10.0:
        left = uniform(state)
        mass = exp(-rate)
        k = 0.0
        while left > mass and mass > 0.0:
            left -= mass
            k += 1.0
            mass *= rate / k
        return k
    b = 0.931 + 2.53 * np.sqrt(rate)
    a = -0.059 + 0.02483 * b
    log_inverse_alpha = log(1.1239 + 1.1328 / (b - 3.4))
    squeeze = 0.9277 - 3.6224 / (b - 2.0)
    while True:
        u = uniform(state) - 0.5
        v = uniform(state)
        us = 0.5 - abs(u)
        k = np.floor((2.0 * a / us + b) * u + rate + 0.43)
        if us >= 0.07 and v <= squeeze:
            return k
        if k < 0.0 or (us < 0.013 and v > us):
            continue
        ratio = log(v) + log_inverse_alpha - log(a / (us * us) + b)
        if ratio <= _poisson_log_mass(k, rate):
            return k


@exact
def _binomial_log_mass(k, n, p, q):
    if k == 0.0 or k == n:
        return n * (log1p(-p) if k == 0.0 else log(p))
    error = stirling_error(n) - stirling_error(k) - stirling_error(n - k)
    deviance = deviance_part(k, n * p) + deviance_part(n - k, n * q)
    return error - deviance + 0.5 * log(n / (2.0 * np.pi * k * (n - k)))


@exact
def _binomial_half(state, n, p):
    """Binomial for p <= 1/2: inversion if n p < 10, else W. Hörmann's BTRS, *J. Statist. Comput.
    Simul.* 46 (1993)."""
    q = 1.0 - p
    if n * p < 10.0:
        left = uniform(state)
        mass = exp(n * log1p(-p))
        odds = p / q
        k = 0.0
        while left > mass and mass > 0.0 and k < n:
            left -= mass
            mass *= odds * (n - k) / (k + 1.0)
            k += 1.0
        return k
    spread = np.sqrt(n * p * q)
    b = 1.15 + 2.53 * spread
    a = -0.0873 + 0.0248 * b + 0.01 * p
    centre = n * p + 0.5
    squeeze = 0.92 - 4.2 / b
    alpha = (2.83 + 5.1 / b) * spread
    at_mode = _binomial_log_mass(np.floor((n + 1.0) * p), n, p, q)
    while True:
        u = uniform(state) - 0.5
        v = uniform(state)
        us = 0.5 - abs(u)
        k = np.floor((2.0 * a / us + b) * u + centre)
        if k < 0.0 or k > n:
            continue
        if us >= 0.07 and v <= squeeze:
            return k
        if log(v * alpha / (a / (us * us) + b)) <= _binomial_log_mass(k, n, p, q) - at_mode:
            return k


@exact
def binomial(state, n, p):
    """A binomial variate, as float64; NaN unless n is a whole number >= 0 and 0 <= p <= 1."""
    if not (0.0 <= n < np.inf and 0.0 <= p <= 1.0) or n != np.floor(n):
        return np.nan
    if p <= 0.5:
        return _binomial_half(state, float(n), p)
    return n - _binomial_half(state, float(n), 1.0 - p)


@exact
def vonmises(state, concentration):
    """A von Mises variate round 0, on [-pi, pi]: D. J. Best and N. I. Fisher, *Applied Statistics*
    28 (1979), by rejection from a wrapped Cauchy law. NaN unless 0 <= concentration < inf."""
    if not (0.0 <= concentration < np.inf):
        return np.nan
    if concentration < 1e-8:
        return np.pi * (2.0 * uniform(state) - 1.0)
    if concentration > 1e8:  # normal but for one part in the concentration
        return normal(state) / np.sqrt(concentration)
    # (1 + rho^2) / (2 rho) of their rho, in a form that keeps its digits
    tau = 1.0 + np.sqrt(1.0 + 4.0 * concentration * concentration)
    rho = 2.0 * concentration / (tau + np.sqrt(2.0 * tau))
    r = (1.0 + rho * rho) / (2.0 * rho)
    while True:
        z = np.cos(np.pi * uniform(state))
        f = (1.0 + r * z) / (r + z)
        c = concentration * (r - f)
        u = uniform(state)
        if c * (2.0 - c) > u or log(c / u) + 1.0 - c >= 0.0:
            angle = np.arccos(min(max(f, -1.0), 1.0))
            return angle if uniform(state) < 0.5 else -angle
