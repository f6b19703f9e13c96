"""Particle filters that are continuous, or nearly so, in the parameters and the random numbers.

`smooth_filter`: S. Malik and M. K. Pitt, "Particle filters for continuous likelihood evaluation and
maximisation", *Journal of Econometrics* 165 (2011): for one scalar state, resampling inverts a
piecewise linear distribution function through the sorted particles. With fixed normals and
stratified uniforms every particle then moves continuously with the parameters. Where two particles
change places they have one weight, as they are weighed by the observation alone, so that the
function stays the same there.

`correlated_path`, for the correlated pseudo-marginal method (Deligiannidis, Doucet and Pitt 2018,
section 4.2): all randomness comes in as numbers, and before they are resampled the particles are
put in order, so that a small change of the numbers or of theta moves the resampled particles a
little only. One state component is ordered by its value, several along a Hilbert curve (Gerber and
Chopin 2015), which keeps neighbours together where an order by one coordinate would not see the
others. The points of the curve are computed by J. Skilling's method (*AIP Conf. Proc.* 707, 2004).

Notation: N particles, T steps; x : (D, N); w : (N,) normalised weights.
"""

from __future__ import annotations

import math

import numpy as np

from ssmppl.codegen.kernels.math.flags import exact
from ssmppl.codegen.kernels.math.random import fill_normal, fill_uniform
from ssmppl.codegen.kernels.math.special import ndtr
from ssmppl.codegen.kernels.particle.conditional_smc import ancestral_path, draw_index
from ssmppl.codegen.kernels.particle.particle_filter import (
    NO_LOOK_AHEAD,
    add,
    copy,
    descend,
    resampling_weights,
    second_stage,
    weigh_row,
)
from ssmppl.codegen.kernels.particle.resampling import PADDING
from ssmppl.codegen.kernels.particle.weights import OK, normalise

CROWDED = 24  # particles in one bucket, from which insertion alone would be slow
GAPS = (29524, 9841, 3280, 1093, 364, 121, 40, 13, 4, 1)  # (3^k - 1) / 2, D. E. Knuth's
_LOWEST, _HIGHEST = 1e-16, 1.0 - 1e-16  # of uniforms, which are never 0 or 1


@exact
def sort_order(x, buckets, ends, order):
    """Write the order that sorts x (N,): buckets of equal width, then insertion.

    Particles that moved by a smooth law spread over the buckets, where a comparison sort would
    mispredict every other branch. Where an outlier crowds them into few, insertion goes by
    diminishing steps (D. L. Shell). buckets (N,), ends (N + 1,) : scratch, integers.
    """
    n = x.size
    low, high = x[0], x[0]
    for i in range(n):
        low, high = min(low, x[i]), max(high, x[i])
    width = (n - 1) / (high - low) if high > low else 0.0
    if not width < np.inf:
        width = 0.0
    ends[:] = 0
    most = 0
    for i in range(n):
        place = (x[i] - low) * width
        b = np.int64(place) if 0.0 <= place < n else 0  # what is not finite has no place
        buckets[i] = b
        ends[b + 1] += 1
        most = max(most, ends[b + 1])
    for b in range(n):
        ends[b + 1] += ends[b]
    for i in range(n):
        order[ends[buckets[i]]] = i
        ends[buckets[i]] += 1
    for gap in GAPS:
        if gap > 1 and (most <= CROWDED or gap >= n):
            continue
        for m in range(gap, n):
            i = order[m]
            k = m
            while k >= gap and x[order[k - gap]] > x[i]:
                order[k] = order[k - gap]
                k -= gap
            order[k] = i


@exact
def invert(x, w, order, points, out):
    """Quantiles of the piecewise linear distribution of weighted particles.

    x, w : (N,) particles and normalised weights; order : (N,) sorts x. points : (N,) uniforms, the
    m-th within its stratum: the level is (m + points[m]) / N. out : (N,), written, increasing.

    Half of a particle's weight lies evenly on the way to each neighbour; the outer halves of the
    first and the last one lie on these themselves.
    """
    n = x.size
    left = 0
    below = 0.5 * w[order[0]]  # mass up to the particle `left`, half of its own included
    for m in range(n):
        level = (m + points[m]) / n
        mass = 0.0
        while left + 1 < n:
            mass = 0.5 * (w[order[left]] + w[order[left + 1]])
            if level < below + mass:
                break
            below += mass
            left += 1
        low = x[order[left]]
        if left + 1 < n and level > below:
            out[m] = low + (x[order[left + 1]] - low) * (level - below) / mass
        else:
            out[m] = low


@exact
def smooth_filter(
    prepare, step, draw_initial, weigh_initial, draw, weigh, sizes,
    theta, y, seen, u, particles, rng, log_increment,
):  # fmt: skip
    """Run the filter; returns (status, t), t the step at which a status other than OK arose.

    sizes : (theta constants, step constants, states, normals, uniforms, fits) of the generated
        code, with one state. log_increment : (T,), written. The same rng gives the same normals and
        uniforms, whatever theta is.
    """
    n_steps, n = y.shape[0], particles
    c, s = np.empty(sizes[0]), np.empty(sizes[1])
    x, x_prev, fits = np.empty((1, n)), np.empty((1, n)), np.empty((0, n))
    normals, uniforms = np.empty(sizes[3] * n), np.empty(sizes[4] * n)
    log_v, w, points = np.empty(n), np.empty(n), np.empty(n)
    buckets, ends = np.empty(n, dtype=np.int64), np.empty(n + 1, dtype=np.int64)
    order = np.empty(n, dtype=np.int64)
    log_increment[:] = -np.inf
    prepare(theta, c)
    for t in range(n_steps):
        step(theta, c, y, seen, u, t, s)
        fill_normal(rng, normals)
        fill_uniform(rng, uniforms)
        fill_uniform(rng, points)
        if t == 0:
            draw_initial(theta, c, s, x, normals, uniforms, rng)
            weigh_initial(theta, c, s, x, log_v)
        else:
            sort_order(x[0], buckets, ends, order)
            invert(x[0], w, order, points, x_prev[0])
            draw(theta, c, s, x_prev, fits, x, normals, uniforms, rng)
            weigh(theta, c, s, x_prev, fits, x, log_v)
        log_sum, _, status = normalise(log_v, w)
        if status != OK:
            return status, t
        log_increment[t] = log_sum - math.log(n)
    return OK, n_steps


@exact
def to_uniform(normal):
    """Phi(normal), inside of the open unit interval."""
    return min(max(ndtr(normal), _LOWEST), _HIGHEST)


@exact
def hilbert_index(cells, bits):
    """Place on the Hilbert curve of a cell (D,) of a grid with 2^bits cells a side; cells is
    changed. D bits < 63."""
    d = cells.size
    top = np.int64(1) << np.int64(bits - 1)
    q = top
    while q > 1:  # undo the rotations, from the largest cube down
        mask = q - 1
        for i in range(d):
            if cells[i] & q:
                cells[0] ^= mask
            else:
                swap = (cells[0] ^ cells[i]) & mask
                cells[0] ^= swap
                cells[i] ^= swap
        q >>= 1
    for i in range(1, d):  # Gray code
        cells[i] ^= cells[i - 1]
    flip = np.int64(0)
    q = top
    while q > 1:
        if cells[d - 1] & q:
            flip ^= q - 1
        q >>= 1
    index = np.int64(0)
    for b in range(bits):
        for i in range(d):
            bit = ((cells[i] ^ flip) >> np.int64(bits - 1 - b)) & 1
            index = (index << 1) | bit
    return index


@exact
def order_of(x, order):
    """Positions of the particles x (D, N) in their order, (N,).

    Several components: on a grid between 3 standard deviations below and above the mean of each,
    with as many cells as 62 bits allow; of more than 31 components the first 31 count.
    """
    d, n = min(x.shape[0], 31), x.shape[1]
    if d == 1:
        order[:] = np.argsort(x[0], kind="mergesort")
        return
    bits = min(62 // d, 16)
    side = float(1 << bits)
    low, scale = np.empty(d), np.empty(d)
    for k in range(d):
        mean, square = 0.0, 0.0
        for i in range(n):
            mean += x[k, i] / n
        for i in range(n):
            square += (x[k, i] - mean) ** 2 / n
        sd = math.sqrt(square)
        low[k] = mean - 3.0 * sd
        scale[k] = side / (6.0 * sd) if sd > 0.0 else 0.0
    keys, cells = np.empty(n, dtype=np.int64), np.empty(d, dtype=np.int64)
    for i in range(n):
        for k in range(d):
            cell = (x[k, i] - low[k]) * scale[k]
            cells[k] = np.int64(min(max(cell, 0.0), side - 1.0)) if cell == cell else 0
        keys[i] = hilbert_index(cells, bits)
    order[:] = np.argsort(keys, kind="mergesort")


@exact
def ordered_systematic(point, w, order, ancestors):
    """Systematic resampling at the points point, 1 + point, ... of N times the weights summed in
    this order; `ancestors`, as everywhere, has padding that is not used."""
    n = w.size
    total, m = 0.0, 0
    for i in range(n):
        j = order[i]
        total += n * w[j]
        while m < n and point + m < total:
            ancestors[m] = j
            m += 1
    last = n - 1
    while last > 0 and not w[order[last]] > 0.0:
        last -= 1
    while m < n:  # what rounding left
        ancestors[m] = order[last]
        m += 1


@exact
def correlated_path(
    prepare, step, draw_initial, weigh_initial, fit, look_ahead, draw, weigh, sizes, ahead,
    theta, y, seen, u, particles, normals, uniforms, points, trajectory, log_increment,
):  # fmt: skip
    """`filtered_path` on given numbers, all standard normal; returns (status, t, log Z).

    normals (T, a N), uniforms (T, b N) : what the particles' normals and uniforms are made of.
    points (T + 1,) : what the uniforms of resampling are made of, and of the path's choice.
    """
    n_steps, n, d = y.shape[0], particles, trajectory.shape[1]
    c, s = np.empty(sizes[0]), np.empty(sizes[1])
    history, ancestry = np.empty((n_steps, d, n)), np.empty((n_steps, n), dtype=np.int32)
    x_prev = np.empty((d, n))
    fits, fits_prev = np.empty((sizes[5], n)), np.empty((sizes[5], n))
    own_uniforms, rng = np.empty(sizes[4] * n), np.zeros(4, dtype=np.uint64)
    log_v, log_base, part = np.empty(n), np.empty(n), np.empty(n)
    w, p = np.empty(n), np.empty(n)
    ancestors, order = np.empty(n + PADDING, dtype=np.int32), np.empty(n, dtype=np.int64)
    log_increment[:] = 0.0
    prepare(theta, c)
    for t in range(n_steps):
        step(theta, c, y, seen, u, t, s)
        x = history[t]
        if t > 0:
            status = resampling_weights(
                fit,
                look_ahead,
                theta,
                c,
                s,
                history[t - 1],
                fits_prev,
                w,
                ahead,
                log_v,
                log_base,
                p,
            )
            if status != OK:
                return status, t, -np.inf
            order_of(history[t - 1], order)
            ordered_systematic(to_uniform(points[t]), p, order, ancestors)
            descend(fit, theta, c, s, history[t - 1], fits_prev, ancestors, ahead, x_prev, fits)
            copy(ancestors, ancestry[t])
        for i in range(own_uniforms.size):
            own_uniforms[i] = to_uniform(uniforms[t, i])
        if t == 0:
            draw_initial(theta, c, s, x, normals[t], own_uniforms, rng)
            weigh_initial(theta, c, s, x, log_v)
        else:
            draw(theta, c, s, x_prev, fits, x, normals[t], own_uniforms, rng)
            weigh(theta, c, s, x_prev, fits, x, log_v)
        if ahead != NO_LOOK_AHEAD:
            if t > 0:
                second_stage(w, p, ancestors, part, log_base)
                add(log_v, log_base)
                log_increment[t] = math.log(n)  # the second-stage weights hold 1 / N already
        log_sum, _, status = weigh_row(log_v, w)
        if status != OK:
            return status, t, -np.inf
        log_increment[t] += log_sum - math.log(n)
    ancestral_path(history, ancestry, draw_index(w, to_uniform(points[n_steps])), trajectory)
    return OK, n_steps, log_increment.sum()
