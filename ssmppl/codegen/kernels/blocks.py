"""One particle filter in blocks of particles, which threads share out.

Resampling and normalising are what particles have to wait for each other in. Here each block moves,
weighs and normalises its own particles, by random numbers of its own, and then only a few numbers
of each block meet: the weight of particle i of block b is share[b] w[b, i]. From the shares a block
knows in which blocks the ancestors of its particles lie, and finds them there. So a row is one pass
that threads need not wait for each other in, and what is computed does not depend on who does it.

Notation: N particles in B blocks of n = `BLOCK`, the last of them filled up with particles of
weight zero; x : (B, D, n); w : (B, n), the weights within each block; shares : (B,).
"""

from __future__ import annotations

import numpy as np

from ssmppl.codegen.kernels.elementary import log
from ssmppl.codegen.kernels.flags import exact, kernel
from ssmppl.codegen.kernels.particle_filter import add, any_finite, copy, take_log
from ssmppl.codegen.kernels.random import fill_normal, fill_uniform
from ssmppl.codegen.kernels.resampling import fill_slots, last_positive, sweep
from ssmppl.codegen.kernels.weights import OK, STRETCH, normalise, sum_of

BITS = 13
BLOCK = 1 << BITS
"""Particles of a block: few enough for their rows to stay in a core's cache."""

_SHIFT = np.uint64(BITS)
_MASK = np.uint64(BLOCK - 1)


@kernel
def gather_blocks(old, ancestors, x_prev):
    """x_prev[:, i] = the particle ancestors[i] of old, counted through all blocks."""
    for k in range(x_prev.shape[0]):
        target = x_prev[k]
        for i in range(target.size):
            j = np.uint64(ancestors[i])
            target[i] = old[j >> _SHIFT, k, j & _MASK]


@exact
def ancestors_of(w, ends, u, low, high, ancestors):
    """Systematic resampling: the ancestors of the slots low, ..., high - 1 among all particles.

    w : (B, n), the weights within each block. ends : (B + 1,), N times the sum of the shares before
    each block; ends[B] = N. u : uniform, one for all slots. ancestors : (high - low + PADDING,)
    int32, written, as block times n plus place.
    """
    n, count = w.shape[1], high - low
    flat = w.reshape(w.size)
    shift = (1.0 - u) - low  # after particles of sum S, int(S + shift) slots are full
    b = 0
    while ends[b + 1] + shift < 1.0:
        b += 1
    p = np.uint64(0)
    while p < count:
        s, scale = ends[b] + shift, ends[b + 1] - ends[b]
        j = 0
        while j + STRETCH < n and s < 0.0:  # by stretches, as far as they end before the slots
            own = scale * sum_of(w[b, j : j + STRETCH])
            if s + own >= 0.0:
                break
            s += own
            j += STRETCH
        while j < n and s < 0.0:
            s += scale * w[b, j]
            if s >= 1.0:
                q = min(np.int64(s), count)
                fill_slots(ancestors, p, q, b * n + j)
                p = np.uint64(q)
            j += 1
        if j < n:
            s, p = sweep(flat, b * n + j, (b + 1) * n, scale, count, s, p, ancestors)
        end = min(np.int64(ends[b + 1] + shift), count)
        if p < end:
            fill_slots(ancestors, p, end, b * n + last_positive(w[b]))
        p = np.uint64(end)
        b += 1


@exact
def move_blocks(
    prepare, step, draw_initial, weigh_initial, fit, draw, weigh,
    sizes, theta, y, seen, u, t, particles, old, old_w, ends, point, shares, streams, x, w, sums,
    scratch, ancestors, first, last,
):  # fmt: skip
    """Move the particles of the blocks first, ..., last - 1 to row t, and weigh them.

    sizes : as of the kernel `particle_filter`. old, old_w : the particles of row t - 1.
    ends, point : as of `ancestors_of`, its u. shares : (B,). Where shares[0] >= 0 nobody is
        resampled: particles move on from themselves and keep their weights.
    streams : (B, 4), state of each block's random numbers. x, w : written.
    sums : (B, 4), written: log of the sum of the weights, effective sample size, status, and
        whether some log weight is an ordinary number.
    scratch : (S, n), room for one row of each state, fit, normal and uniform, and two more: for
        memory taken and given back in each pass, threads would wait for the system.
    ancestors : (n + PADDING,) int32, scratch that holds indices of particles.
    """
    n = w.shape[1]
    c, s = np.empty(sizes[0]), np.empty(sizes[1])
    x_prev, fits = scratch[: sizes[2]], scratch[sizes[2] : sizes[2] + sizes[5]]
    at = sizes[2] + sizes[5]
    normals = scratch[at : at + sizes[3]].reshape(sizes[3] * n)
    at += sizes[3]
    uniforms = scratch[at : at + sizes[4]].reshape(sizes[4] * n)
    log_v, log_base = scratch[at + sizes[4]], scratch[at + sizes[4] + 1]
    prepare(theta, c)
    step(theta, c, y, seen, u, t, s)
    for b in range(first, last):
        keep = t > 0 and shares[0] >= 0.0
        if keep:
            for k in range(sizes[2]):
                copy(old[b, k], x_prev[k])
            take_log(old_w[b], log_base)
        elif t > 0:
            ancestors_of(old_w, ends, point, b * n, min((b + 1) * n, particles), ancestors)
            gather_blocks(old, ancestors, x_prev)
        if t > 0 and sizes[5] > 0:
            fit(theta, c, s, x_prev, fits)
        fill_normal(streams[b], normals)
        if sizes[4] > 0:
            fill_uniform(streams[b], uniforms)
        if t == 0:
            draw_initial(theta, c, s, x[b], normals, uniforms, streams[b])
            weigh_initial(theta, c, s, x[b], log_v)
        else:
            draw(theta, c, s, x_prev, fits, x[b], normals, uniforms, streams[b])
            weigh(theta, c, s, x_prev, fits, x[b], log_v)
        if keep:
            add(log_v, log_base)
        for i in range(max(particles - b * n, 0), n):
            log_v[i] = -np.inf
        log_sum, ess, status = normalise(log_v, w[b])
        if keep:
            log_sum += log(shares[b])
        sums[b, 0], sums[b, 1], sums[b, 2], sums[b, 3] = log_sum, ess, status, 1.0
        if status != OK:
            w[b, :] = 0.0
            sums[b, 3] = any_finite(log_v)
