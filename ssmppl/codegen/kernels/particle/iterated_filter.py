"""One pass of iterated filtering over a series: a particle filter whose parameters walk.

The inner loop of algorithm IF2 of Ionides, Nguyen, Atchadé, Stoev and King (2015): each particle
carries its own parameters z, which take a step of the row's standard deviation before the particle
moves; particles and parameters are resampled together. What is left of the parameters at the end
is the swarm that the next pass begins with.

A row that no particle can have produced leaves all with the same weight, as an unlucky swarm is
not the end of a search; a particle whose parameters lead outside the domain of an operation counts
as impossible.

Notation: N particles, T rows, D states, F parameters; x, x_prev : (D + F, N), parameters last.
"""

from __future__ import annotations

import math

import numpy as np

from ssmppl.codegen.kernels.math.flags import exact
from ssmppl.codegen.kernels.math.random import fill_normal, fill_uniform
from ssmppl.codegen.kernels.particle.particle_filter import copy, gather
from ssmppl.codegen.kernels.particle.resampling import PADDING, systematic
from ssmppl.codegen.kernels.particle.weights import ALL_ZERO, OK, normalise, rule_out, weighted_mean


@exact
def iterated_filter(
    prepare, step, draw_initial, weigh_initial, draw, weigh, sizes,
    theta, y, seen, u, rng, swarm, log_increment, means,
):  # fmt: skip
    """Move the swarm (F, N) through the series; returns (status, t).

    u : (T, inputs), with the standard deviations of the parameters' steps behind the model's own.
    log_increment : (T,), written: log of the mean weight, -inf at rows that no particle can have
        produced. means : (T, F), written: the swarm's weighted mean after each row.
    status : OK, or INFINITE at row t.
    """
    n_steps, first, n = y.shape[0], sizes[2] - swarm.shape[0], swarm.shape[1]
    c, s = np.empty(sizes[0]), np.empty(sizes[1])
    x, x_prev = np.empty((sizes[2], n)), np.empty((sizes[2], n))
    fits = np.empty((sizes[5], n))
    normals, uniforms = np.empty(sizes[3] * n), np.empty(sizes[4] * n)
    log_v, w = np.empty(n), np.empty(n)
    ancestors = np.empty(n + PADDING, dtype=np.int32)
    log_n = math.log(n)
    prepare(theta, c)
    for k in range(first, sizes[2]):
        copy(swarm[k - first], x_prev[k])
    for t in range(n_steps):
        step(theta, c, y, seen, u, t, s)
        if t > 0:
            systematic(rng, w, ancestors)
            gather(x, ancestors, x_prev)
        fill_normal(rng, normals)
        if sizes[4] > 0:
            fill_uniform(rng, uniforms)
        if t == 0:
            draw_initial(theta, c, s, x_prev, x, normals, uniforms, rng)
            weigh_initial(theta, c, s, x, log_v)
        else:
            draw(theta, c, s, x_prev, fits, x, normals, uniforms, rng)
            weigh(theta, c, s, x_prev, fits, x, log_v)
        rule_out(log_v)
        log_sum, _, status = normalise(log_v, w)
        if status == ALL_ZERO:
            for i in range(n):
                w[i] = 1.0 / n
        elif status != OK:
            return status, t
        log_increment[t] = log_sum - log_n
        for k in range(first, sizes[2]):
            means[t, k - first] = weighted_mean(x[k], w)
    systematic(rng, w, ancestors)
    gather(x, ancestors, x_prev)
    for k in range(first, sizes[2]):
        copy(x_prev[k], swarm[k - first])
    return OK, n_steps
