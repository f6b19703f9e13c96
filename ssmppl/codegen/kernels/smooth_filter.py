"""A particle filter whose likelihood is a continuous function of the parameters.

S. Malik and M. K. Pitt, "Particle filters for continuous likelihood evaluation and maximisation",
*Journal of Econometrics* 165 (2011): for one scalar state, resampling inverts a piecewise linear
distribution function through the sorted particles. With fixed normals and stratified uniforms every
particle then moves continuously with the parameters. Where two particles change places they have
one weight, as they are weighed by the observation alone, so that the function stays the same there.

Notation: N particles, T steps; x : (1, N); w : (N,) normalised weights.
"""

from __future__ import annotations

import math

import numpy as np

from ssmppl.codegen.kernels.flags import exact
from ssmppl.codegen.kernels.random import fill_normal, fill_uniform
from ssmppl.codegen.kernels.weights import OK, normalise

CROWDED = 24  # particles in one bucket, from which insertion alone would be slow
GAPS = (29524, 9841, 3280, 1093, 364, 121, 40, 13, 4, 1)  # (3^k - 1) / 2, D. E. Knuth's


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
