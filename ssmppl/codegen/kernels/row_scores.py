"""Smoothed complete-data scores, row by row, from the genealogy of a particle filter.

Fisher's identity: d log p(y_{1:T}) / d theta = sum_t E[xi_t | y_{1:T}], with xi_t the derivative of
log { f(x_t | x_{t-1}) g(y_t | x_t) }. Expectations at row t are taken over the ancestors at t - 1
and t of the weighted particles at a later row: the fixed-lag smoother (Kitagawa 1996; Olsson,
Cappé, Douc and Moulines 2008), which needs no transition density and so holds for deterministic
components. Rows are done in blocks, so that all rows of a block share one pass back along the
ancestors: the lag is `lag` for the last row of a block and less than twice that for the first.

Notation: F derivatives, N particles, T rows; only ancestors with a weight are evaluated.
"""

from __future__ import annotations

import numpy as np

from ssmppl.codegen.kernels.filter_with_score import carry_back
from ssmppl.codegen.kernels.flags import exact
from ssmppl.codegen.kernels.particle_filter import copy, gather
from ssmppl.codegen.kernels.prediction import mix_channels
from ssmppl.codegen.kernels.random import fill_normal, fill_uniform


@exact
def row_scores(
    prepare, step, gradient_initial, gradient, sizes,
    theta, y, seen, u, particles, weights, ancestors, lag, out,
):  # fmt: skip
    """out[t] (F,) = E[xi_t | y_{1:s}] with t + lag <= s < t + 2 lag, or s = T.

    particles (T, D, N), weights (T, N), ancestors (T, N) : a particle system, row 0 of the
        ancestors without meaning; trajectories with weights are one whose ancestors are 0, 1, ...
    """
    n_steps, d, n = particles.shape
    c, s = np.empty(sizes[0]), np.empty(sizes[1])
    back, further = np.empty(n), np.empty(n)
    index, share = np.empty(n, dtype=np.int64), np.empty(n)
    prepare(theta, c)
    first = 0
    while first < n_steps:
        last = min(first + 2 * lag, n_steps) - 1
        stop = n_steps if last == n_steps - 1 else first + lag
        copy(weights[last], back)
        for t in range(last, first - 1, -1):
            if t < stop:
                m = 0
                for j in range(n):
                    if back[j] > 0.0:
                        index[m], share[m] = j, back[j]
                        m += 1
                x, x_prev = np.empty((d, m)), np.empty((d, m))
                for k in range(d):
                    for i in range(m):
                        x[k, i] = particles[t, k, index[i]]
                        x_prev[k, i] = particles[t - 1, k, ancestors[t, index[i]]] if t else 0.0
                xi = np.empty((out.shape[1], m))
                step(theta, c, y, seen, u, t, s)
                if t == 0:
                    gradient_initial(theta, c, s, x, xi)
                else:
                    gradient(theta, c, s, x_prev, x, xi)
                for f in range(out.shape[1]):
                    total = 0.0
                    for i in range(m):
                        total += share[i] * xi[f, i]
                    out[t, f] = total
            if t > first:
                carry_back(back, ancestors[t], further)
                back, further = further, back
        first = stop


@exact
def row_predictions(
    prepare, step, draw_initial, draw, moments, sizes,
    theta, y, seen, u, particles, weights, rng, out,
):  # fmt: skip
    """out[t] (4, K) : mean, variance, P(Y <= y_t), P(Y < y_t) of each channel given y_{1:t-1}.

    One move of the weighted particles of row t - 1 by the transition; particles (T, D, N).
    """
    n_steps, d, n = particles.shape
    c, s = np.empty(sizes[0]), np.empty(sizes[1])
    x, told = np.empty((d, n)), np.empty((4 * y.shape[1], n))
    normals, uniforms = np.empty(sizes[3] * n), np.empty(sizes[4] * n)
    w = np.full(n, 1.0 / n)
    prepare(theta, c)
    for t in range(n_steps):
        step(theta, c, y, seen, u, t, s)
        fill_normal(rng, normals)
        fill_uniform(rng, uniforms)
        if t == 0:
            draw_initial(theta, c, s, x, normals, uniforms, rng)
        else:
            draw(theta, c, s, particles[t - 1], x, normals, uniforms, rng)
            copy(weights[t - 1], w)
        moments(theta, c, s, x, told)
        mix_channels(told, w, out[t])


@exact
def complete_rows(begin, follow, prepare, step, sizes, theta, y, seen, u, particles, ancestors):
    """Set the components that follow from the others, along the ancestors (T, N).

    particles (T, D, N) : all components of a particle system.
    """
    n_steps, d, n = particles.shape
    c, s = np.empty(sizes[0]), np.empty(sizes[1])
    x_prev = np.empty((d, n))
    prepare(theta, c)
    for t in range(n_steps):
        step(theta, c, y, seen, u, t, s)
        if t == 0:
            begin(theta, c, s, particles[0])
        else:
            gather(particles[t - 1], ancestors[t], x_prev)
            follow(theta, c, s, x_prev, particles[t])
