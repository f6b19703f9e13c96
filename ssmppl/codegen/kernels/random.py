"""Counter-based random numbers: words, uniforms and normals.

Word i of a stream is a hash of (key, i), so it does not depend on threads or on how the draws
are cut into calls.  The hash is a SplitMix64 generator (G. L. Steele, D. Lea, C. H. Flood,
*Fast splittable pseudorandom number generators*, OOPSLA 2014; the multipliers are D. Stafford's
variant 13), keyed by 128 bits: the first key is where the counter starts, the second one enters
after the first multiplication, so that two streams whose counters overlap still differ, and a
third multiplication (that of `rrmxmx`-like mixers) follows to spread it over the word.

A state is a uint64 array of shape (4,): key 0, key 1, the counter, and one spare word.
Each drawing function advances the counter in place.  2^64 words per stream.

Normals are drawn by G. E. P. Box and M. E. Muller's method (*Ann. Math. Stat.* 29, 1958), which
has no branches and so vectorises.
"""

from __future__ import annotations

import numpy as np

from ssmppl.codegen.kernels.elementary import _sin_cos_reduced, bits_float, log_normal_number
from ssmppl.codegen.kernels.flags import kernel, precise

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
    z = (z ^ key1 ^ (z >> np.uint64(27))) * _MULTIPLIER_2
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
    sine, cosine = _sin_cos_reduced(_TURN * (word_uniform(angle_word) - 0.5))
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
