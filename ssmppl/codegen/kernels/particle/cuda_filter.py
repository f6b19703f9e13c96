"""The particle filter on a CUDA device: two kernels for each row, over blocks of threads.

`move_blocks` has a thread for each particle. It finds the particle's ancestor, moves and weighs it
by the model's functions, those that also run on the processor, over arrays of a single particle;
then the threads of a block add their weights up. `join_blocks`, on one block of threads, makes one
filter of the blocks. Nothing is brought back to the host before the last row.

Weights are added up as whole numbers, in units of 2^-52 of the largest weight of a block, and
blocks in units that leave room for all of them. Sums of whole numbers do not depend on their order,
so that every run gives the same numbers, and never fall, so that a search among them cannot find a
particle of weight zero.

These are texts: `codegen/modules/device.py` puts a model's functions and sizes in, and compiles.

Notation: N particles, one to a thread, in blocks of THREADS threads; D states; x : (D, N).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from ssmppl.codegen.kernels.math.elementary import exp, log
from ssmppl.codegen.kernels.math.random import fill_normal, fill_uniform
from ssmppl.codegen.kernels.particle.weights import ALL_ZERO, INFINITE, NAN, OK

if TYPE_CHECKING:
    from numba import cuda

UNIT = 4503599627370496.0  # 2^52
STREAM_BITS = np.uint64(20)  # words of a particle's own stream at each row
HAS_NAN, HAS_INFINITE, HAS_FINITE = 1, 2, 4


def largest_of(values, lane, own):
    """The largest of what the threads of a block have; values : shared, one for each thread."""
    values[lane] = own
    cuda.syncthreads()
    step = values.size // 2
    while step > 0:
        if lane < step:
            values[lane] = max(values[lane], values[lane + step])
        cuda.syncthreads()
        step //= 2
    found = values[0]
    cuda.syncthreads()
    return found


def total_of(values, lane, own):
    """The sum of what the threads of a block have, always in the same order."""
    values[lane] = own
    cuda.syncthreads()
    step = values.size // 2
    while step > 0:
        if lane < step:
            values[lane] += values[lane + step]
        cuda.syncthreads()
        step //= 2
    found = values[0]
    cuda.syncthreads()
    return found


def running_sum(values, lane, own):
    """The sum of what the threads up to this one have; whole numbers."""
    values[lane] = own
    cuda.syncthreads()
    step = 1
    while step < values.size:
        more = values[lane - step] if lane >= step else 0
        cuda.syncthreads()
        values[lane] += more
        cuda.syncthreads()
        step *= 2
    found = values[lane]
    cuda.syncthreads()
    return found


def move_blocks(
    draw_initial, weigh_initial, fit, draw, weigh,
    block_size, states, fits, has_fit, normals, uniforms,
    theta, c, s, t, particles, keys, points, old, old_sums, old_ends, x, sums, tops, squares,
    flags,
):  # fmt: skip
    """Resample, move and weigh one particle; the block's sums.

    block_size, states, fits, normals, uniforms : whole numbers in the text, of at least 1, as is
        has_fit, 0 or 1.
    s : (T, S), the constants of each step. keys : (3,) uint64, the state that the particles'
        streams count from. points : (T,), where the systematic points of a row begin, in (0, 1).
    old, old_sums, old_ends : the particles of row t - 1, their sums within each block, and
        (blocks,) the sums of all blocks up to each one.
    x, sums, tops, squares, flags : written, of row t. tops : (blocks,) the largest log weights.
    """
    i = cuda.grid(1)
    lane, block = cuda.threadIdx.x, cuda.blockIdx.x
    real = cuda.shared.array(block_size, np.float64)
    whole = cuda.shared.array(block_size, np.int64)
    log_w = cuda.local.array(1, np.float64)
    log_w[0] = -np.inf
    if i < particles:
        stream = cuda.local.array(4, np.uint64)
        normal_draws = cuda.local.array(normals, np.float64)
        uniform_draws = cuda.local.array(uniforms, np.float64)
        one = cuda.local.array((states, 1), np.float64)
        before = cuda.local.array((states, 1), np.float64)
        fitted = cuda.local.array((fits, 1), np.float64)
        stream[0], stream[1] = keys[0], keys[1]
        index = np.uint64(t) * np.uint64(particles) + np.uint64(i)
        stream[2] = keys[2] + (index << STREAM_BITS)
        fill_normal(stream, normal_draws)
        fill_uniform(stream, uniform_draws)
        if t == 0:
            draw_initial(theta, c, s[t], one, normal_draws, uniform_draws, stream)
            weigh_initial(theta, c, s[t], one, log_w)
        else:
            blocks = old_ends.size
            total = old_ends[blocks - 1]
            point = np.int64((i + points[t]) * (np.float64(total) / particles))
            point = max(min(point, total - 1), 0)
            low, high = 0, blocks - 1  # the first block whose end lies beyond the point
            while low < high:
                middle = (low + high) // 2
                if old_ends[middle] > point:
                    high = middle
                else:
                    low = middle + 1
            begin = old_ends[low - 1] if low > 0 else 0
            first = low * block_size
            last = min(first + block_size, particles) - 1
            share = np.float64(point - begin) / max(np.float64(old_ends[low] - begin), 1.0)
            rest = min(np.int64(share * np.float64(old_sums[last])), old_sums[last] - 1)
            low, high = first, last  # the first particle whose sum lies beyond the rest
            while low < high:
                middle = (low + high) // 2
                if old_sums[middle] > rest:
                    high = middle
                else:
                    low = middle + 1
            for k in range(states):
                before[k, 0] = old[k, low]
            if has_fit > 0:
                fit(theta, c, s[t], before, fitted)
            draw(theta, c, s[t], before, fitted, one, normal_draws, uniform_draws, stream)
            weigh(theta, c, s[t], before, fitted, one, log_w)
        for k in range(states):
            x[k, i] = one[k, 0]
    # what is no ordinary number is noted and left out
    value = log_w[0]
    is_finite = abs(value) < np.inf
    any_nan = cuda.syncthreads_or(np.int32(value != value))
    any_infinite = cuda.syncthreads_or(np.int32(value == np.inf))
    any_finite = cuda.syncthreads_or(np.int32(is_finite))
    top = largest_of(real, lane, value if is_finite else -np.inf)
    weight = 0.0
    if is_finite:
        weight = exp(value - top)
    square = total_of(whole, lane, np.int64(weight * weight * UNIT))
    own = running_sum(whole, lane, np.int64(weight * UNIT))
    if i < particles:
        sums[i] = own
    if lane == 0:
        tops[block] = top
        squares[block] = np.float64(square) / UNIT
        flags[block] = (
            (HAS_NAN if any_nan else 0)
            + (HAS_INFINITE if any_infinite else 0)
            + (HAS_FINITE if any_finite else 0)
        )


def join_blocks(
    block_size, particles, t, sums, tops, squares, flags, ends, log_increment, ess, status
):  # fmt: skip
    """One filter of all blocks: their sums up to each one, and the row's likelihood.

    block_size : whole number in the text, here of the threads, too. ends : (blocks,), written.
    log_increment, ess, status : (T,), written at t.
    """
    lane = cuda.threadIdx.x
    real = cuda.shared.array(block_size, np.float64)
    whole = cuda.shared.array(block_size, np.int64)
    blocks = ends.size
    each = (blocks + block_size - 1) // block_size
    first, last = min(lane * each, blocks), min((lane + 1) * each, blocks)
    has = 0
    top = -np.inf
    for b in range(first, last):
        has |= flags[b]
        top = max(top, tops[b])
    any_nan = cuda.syncthreads_or(np.int32(has & HAS_NAN))
    any_infinite = cuda.syncthreads_or(np.int32(has & HAS_INFINITE))
    any_finite = cuda.syncthreads_or(np.int32(has & HAS_FINITE))
    top = largest_of(real, lane, top)
    room = 1.0  # the sum of all blocks is to stay below 2^62
    while room < blocks * (block_size / 512.0):
        room *= 2.0
    own, total, square = np.int64(0), 0.0, 0.0
    for b in range(first, last):
        scale = 0.0
        if tops[b] > -np.inf:
            scale = exp(tops[b] - top)
        weight = np.float64(sums[min((b + 1) * block_size, particles) - 1])
        total += weight / UNIT * scale
        square += squares[b] * scale * scale
        own += np.int64(weight * scale / room)
        ends[b] = own
    before = running_sum(whole, lane, own) - own
    for b in range(first, last):
        ends[b] += before
    total = total_of(real, lane, total)
    square = total_of(real, lane, square)
    if lane == 0:
        code = OK
        if any_nan:
            code = NAN if any_finite else ALL_ZERO
        elif any_infinite:
            code = INFINITE
        elif not any_finite:
            code = ALL_ZERO
        status[t] = code
        log_increment[t] = top + log(total) - math.log(particles)
        ess[t] = total * total / square
