"""The particle filter, over the generated functions of a model; the steps that other filters share.

Algorithm 2 of Schön et al. (2015) in the auxiliary form of Pitt and Shephard (1999): with weights
w_{t-1} and look-ahead values v, resample by p ~ w v, move by q, weigh by (w / p) f g / q. With
v = 1 and q = f it is the bootstrap filter. Resampling is done at every step, or when the
effective sample size falls below `ess_threshold` N (Del Moral, Doucet and Jasra 2012).

The product over t of the mean weights is unbiased for the likelihood, for every scheme here and
every N (Del Moral 2004, proposition 7.4.1; Pitt et al. 2012 for the auxiliary form).

Notation: N particles, T steps; x, x_prev : (D, N), one contiguous row per state component; w : (N,)
normalised weights; log_v : (N,) unnormalised log weights.

Two forms are for proposals without look-ahead. `filter_rows` runs over some rows, to be gone on
with: what SMC^2 attaches to each parameter. `move_blocks` is one row of a filter in blocks of
particles, which threads share out. Resampling and normalising are what particles have to wait for
each other in; there each block moves, weighs and normalises its own particles, by random numbers of
its own, and then only a few numbers of each block meet: the weight of particle i of block b is
share[b] w[b, i]. From the shares a block knows in which blocks the ancestors of its particles lie,
and finds them there. So a row is one pass that threads need not wait for each other in, and what is
computed does not depend on who does it. Its arrays: B blocks of n = `BLOCK`, the last of them
filled up with particles of weight zero; x : (B, D, n); w : (B, n), the weights within each block;
shares : (B,).
"""

from __future__ import annotations

import math

import numpy as np

from ssmppl.codegen.kernels.math.elementary import log
from ssmppl.codegen.kernels.math.flags import exact, inlined, kernel
from ssmppl.codegen.kernels.math.random import fill_normal, fill_uniform
from ssmppl.codegen.kernels.particle.resampling import (
    PADDING,
    fill_slots,
    last_positive,
    resample,
    sweep,
    systematic,
)
from ssmppl.codegen.kernels.particle.weights import (
    ALL_ZERO,
    NAN,
    OK,
    STRETCH,
    normalise,
    rule_out,
    sum_of,
    summarise,
)

NO_LOOK_AHEAD, APPROXIMATE, EXACT, GUIDED = 0, 1, 2, 3
# Resampling by a look-ahead that is too sharp would leave unbounded weights: with this share of
# the plain weights mixed in, w / p <= 1 / share.
PLAIN_SHARE = 0.1
GUIDED_SHARE = 0.02  # where the look-ahead knows all that is to come, and steers the moves too
BITS = 13
BLOCK = 1 << BITS
"""Particles of a block: few enough for their rows to stay in a core's cache."""

_SHIFT = np.uint64(BITS)
_MASK = np.uint64(BLOCK - 1)


@kernel
def gather(x, ancestors, x_prev):
    """x_prev[:, i] = x[:, ancestors[i]]."""
    for k in range(x.shape[0]):
        source, target = x[k], x_prev[k]
        for i in range(target.size):
            target[i] = source[np.uint64(ancestors[i])]


@kernel
def copy(source, target):
    """target = source, as far as target goes (slices would drag Numba's string functions in)."""
    for i in range(target.size):
        target[i] = source[i]


@kernel
def count(ancestors):
    """ancestors[i] = i: nobody was resampled."""
    for i in range(ancestors.size):
        ancestors[i] = i


@kernel
def add(log_v, log_base):
    """log_v += log_base. What one of them rules out stays so where the other is undefined: a
    particle of weight zero may lie where the laws have no density, and is never chosen."""
    for i in range(log_v.size):
        a, b = log_v[i], log_base[i]
        log_v[i] = -np.inf if (a == -np.inf) | (b == -np.inf) else a + b


@kernel
def mix(p, w, share):
    """p = (1 - share) p + share w."""
    for i in range(p.size):
        p[i] = (1.0 - share) * p[i] + share * w[i]


@kernel
def second_stage(w, p, ancestors, log_ratio, log_base):
    """log_base[i] = log (w / (N p)) at the ancestor of i, the second-stage weight.

    log_ratio : (N,) scratch. Two loops, of which the first one vectorises.
    """
    n = log_base.size
    for j in range(n):
        log_ratio[j] = log(w[j] / (n * p[j]))
    for i in range(n):
        log_base[i] = log_ratio[np.uint64(ancestors[i])]


@kernel
def take_log(w, log_base):
    """log_base = log w."""
    for i in range(w.size):
        log_base[i] = log(w[i])


@kernel
def below(log_v, log_sum, log_w):
    """log_w = log_v - log_sum."""
    for i in range(log_v.size):
        log_w[i] = log_v[i] - log_sum


@exact
def any_finite(log_v):
    """Whether some log weight is an ordinary number."""
    for i in range(log_v.size):
        if abs(log_v[i]) < np.inf:
            return True
    return False


@exact
def look_ahead_weights(log_v, w, log_base, ahead, p):
    """p <- what to resample by: the weights w times the look-ahead values exp(log_v).

    Returns (effective size of p, status). log_v and log_base (N,) are overwritten. A look-ahead
    that is no number rules its particle out where that cannot bias anything, as a share of the
    plain weights is mixed in. Where nothing is left to go by, p = w.
    """
    take_log(w, log_base)
    add(log_v, log_base)
    _, size, status = normalise(log_v, p)
    if status == NAN:
        if ahead != EXACT:
            rule_out(log_v)
        _, size, status = normalise(log_v, p)
        if status == NAN and any_finite(log_v):
            return 0.0, status
    if status != OK:
        copy(w, p)
        squares = 0.0
        for i in range(p.size):
            squares += p[i] * p[i]
        return 1.0 / squares, OK
    if ahead == APPROXIMATE:
        mix(p, w, PLAIN_SHARE)
    elif ahead == GUIDED:
        mix(p, w, GUIDED_SHARE)
    return size, OK


@exact
def absent(*arguments):
    """Stands for a function that a model lacks; never called."""


@inlined
def resampling_weights(
    fit, look_ahead, theta, c, s, x, fits, w, ahead, log_v, log_base, p
):  # fmt: skip
    """p <- what to resample the particles x by: w, or `look_ahead_weights` where there are any; the
    status of these."""
    copy(w, p)
    status = OK
    if ahead != NO_LOOK_AHEAD:
        if fits.shape[0] > 0:
            fit(theta, c, s, x, fits)
        look_ahead(theta, c, s, x, fits, log_v)
        _, status = look_ahead_weights(log_v, w, log_base, ahead, p)
    return status


@inlined
def descend(fit, theta, c, s, x, fits, ancestors, ahead, x_prev, own_fits):
    """x_prev <- the ancestors of the particles to come, own_fits <- what is fitted to these.

    fits : of the particles x, known where they look ahead.
    """
    gather(x, ancestors, x_prev)
    if own_fits.shape[0] > 0:
        if ahead != NO_LOOK_AHEAD:
            gather(fits, ancestors, own_fits)
        else:
            fit(theta, c, s, x_prev, own_fits)


@inlined
def move(
    draw_initial, weigh_initial, draw, weigh, theta, c, s, t, x_prev, fits, x, log_v,
    normals, uniforms, rng,
):  # fmt: skip
    """x (D, N) <- the particles of row t, log_v (N,) <- what they weigh."""
    fill_normal(rng, normals)
    if uniforms.size > 0:
        fill_uniform(rng, uniforms)
    if t == 0:
        draw_initial(theta, c, s, x, normals, uniforms, rng)
        weigh_initial(theta, c, s, x, log_v)
    else:
        draw(theta, c, s, x_prev, fits, x, normals, uniforms, rng)
        weigh(theta, c, s, x_prev, fits, x, log_v)


@inlined
def weigh_row(log_v, w):
    """`normalise` the weights of a row, which is impossible where none of them is a number."""
    log_sum, ess, status = normalise(log_v, w)
    if status == NAN and not any_finite(log_v):
        status = ALL_ZERO
    return log_sum, ess, status


@exact
def particle_filter(
    prepare, step, draw_initial, weigh_initial, fit, look_ahead, draw, weigh, predict,
    sizes, ahead, theta, y, seen, u, particles, scheme, ess_threshold, rng,
    log_increment, ess, moments, kept=None,
):  # fmt: skip
    """Run the filter; returns (status, t), t the step at which a status other than OK arose.

    sizes : (theta constants, step constants, states, normals, uniforms, fits) of the generated
        code. ahead : which kind of look-ahead there is.
    scheme : code of the resampling scheme; None: systematic, and no other one is compiled.
    log_increment, ess : (T,), written.
    moments : None, or what else is written, as a tuple: probabilities (P,), mean (T, D),
        covariance (T, D, D), quantiles (T, P, D) and what `predict_step` writes.
    kept : None, or the whole particle system, written, as a tuple: particles (T, D, N), weights
        (T, N), normalised, and ancestors (T, N), row 0 without meaning.
    """
    n_steps, n = y.shape[0], particles
    c, s = np.empty(sizes[0]), np.empty(sizes[1])
    x, x_prev = np.empty((sizes[2], n)), np.empty((sizes[2], n))
    fits, fits_prev = np.empty((sizes[5], n)), np.empty((sizes[5], n))
    normals, uniforms = np.empty(sizes[3] * n), np.empty(sizes[4] * n)
    log_v, log_base, w, p = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    log_w = np.empty(n)
    ancestors = np.empty(n + PADDING, dtype=np.int32)
    log_n = math.log(n)
    log_increment[:] = -np.inf
    prepare(theta, c)
    for t in range(n_steps):
        step(theta, c, y, seen, u, t, s)
        if moments is not None:
            predict(theta, y, seen, u, t, x, w, rng, moments[4])
        uniform_base = True
        if t > 0:
            current_ess = ess[t - 1]
            if ahead != NO_LOOK_AHEAD:
                if sizes[5] > 0:
                    fit(theta, c, s, x, fits_prev)
                look_ahead(theta, c, s, x, fits_prev, log_v)
                current_ess, status = look_ahead_weights(log_v, w, log_base, ahead, p)
                if status != OK:
                    return status, t
            else:
                p, w = w, p
            if ess_threshold >= 1.0 or current_ess < ess_threshold * n:
                if scheme is None:
                    systematic(rng, p, ancestors)
                else:
                    resample(scheme, rng, p, ancestors)
                if kept is not None:
                    copy(ancestors, kept[2][t])
                gather(x, ancestors, x_prev)
                if ahead != NO_LOOK_AHEAD:
                    if sizes[5] > 0:
                        gather(fits_prev, ancestors, fits)
                    second_stage(w, p, ancestors, log_v, log_base)
                    uniform_base = False
            else:
                if kept is not None:
                    count(kept[2][t])
                x, x_prev = x_prev, x
                if ahead != NO_LOOK_AHEAD:
                    fits, fits_prev = fits_prev, fits
                copy(log_w, log_base)
                uniform_base = False
            if ahead == NO_LOOK_AHEAD and sizes[5] > 0:
                fit(theta, c, s, x_prev, fits)
        fill_normal(rng, normals)
        if sizes[4] > 0:
            fill_uniform(rng, uniforms)
        if t == 0:
            draw_initial(theta, c, s, x, normals, uniforms, rng)
            weigh_initial(theta, c, s, x, log_v)
        else:
            draw(theta, c, s, x_prev, fits, x, normals, uniforms, rng)
            weigh(theta, c, s, x_prev, fits, x, log_v)
        if not uniform_base:
            add(log_v, log_base)
        log_sum, ess[t], status = weigh_row(log_v, w)
        if status != OK:
            return status, t
        if ess_threshold < 1.0:
            # not from w, where one that is far behind is zero: later rows may bring it back
            below(log_v, log_sum, log_w)
        log_increment[t] = log_sum - log_n if uniform_base else log_sum
        if kept is not None:
            for k in range(sizes[2]):
                copy(x[k], kept[0][t, k])
            copy(w, kept[1][t])
        if moments is not None:
            summarise(x, w, moments[0], moments[1][t], moments[2][t], moments[3][t])
    return OK, n_steps


@exact
def filter_rows(
    prepare, step, draw_initial, weigh_initial, fit, draw, weigh, sizes,
    theta, y, seen, u, start, stop, rng, x, w, log_increment,
):  # fmt: skip
    """Go on from row `start` to row `stop` - 1; returns (status, t).

    x, w : the particles after row start - 1, without meaning at row 0; overwritten by those after
        the last row. log_increment : (T,), written at the rows.
    """
    n = w.size
    c, s = np.empty(sizes[0]), np.empty(sizes[1])
    x_prev, fits = np.empty((sizes[2], n)), np.empty((sizes[5], n))
    normals, uniforms = np.empty(sizes[3] * n), np.empty(sizes[4] * n)
    log_v = np.empty(n)
    ancestors = np.empty(n + PADDING, dtype=np.int32)
    log_n = math.log(n)
    prepare(theta, c)
    for t in range(start, stop):
        step(theta, c, y, seen, u, t, s)
        if t > 0:
            systematic(rng, w, ancestors)
            gather(x, ancestors, x_prev)
            if sizes[5] > 0:
                fit(theta, c, s, x_prev, fits)
        move(
            draw_initial, weigh_initial, draw, weigh, theta, c, s, t, x_prev, fits, x, log_v,
            normals, uniforms, rng,
        )  # fmt: skip
        log_sum, _, status = weigh_row(log_v, w)
        if status != OK:
            return status, t
        log_increment[t] = log_sum - log_n
    return OK, stop


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
        move(
            draw_initial, weigh_initial, draw, weigh, theta, c, s, t, x_prev, fits, x[b], log_v,
            normals, uniforms, streams[b],
        )  # fmt: skip
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
