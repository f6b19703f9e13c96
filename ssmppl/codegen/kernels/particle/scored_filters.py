"""A particle filter that estimates the score and the observed information as it runs.

Fisher's identity, grad log p(y) = E[sum_t xi_t | y] with xi_t = grad log { f(x_t | x_{t-1})
g(y_t | x_t) }, and Louis' identity, - hess log p(y) = - E[sum_t h_t | y] - Var[sum_t xi_t | y]
with h_t the second derivatives (Schön et al. 2015, section 6; Louis 1982). Expectations at step s
are taken over the particles' ancestors at s, weighed at step min(s + lag, T): the fixed-lag
smoother of Kitagawa and Sato (2001), as Dahlin, Lindsten and Schön (2015) use it. The variance of
the sum takes pairs of steps in as far as they are `lag` apart. The weights at s + lag are carried
back along the ancestors, which costs O(N lag) a step and no memory beyond 2 lag + 1 steps.

Notation as in `conditional_smc.py`; xi : (P, N) at one step, h : (P (P + 1) / 2, N), row by row of
the lower half.

Smoothed complete-data scores, row by row, from the genealogy of a particle filter.

Fisher's identity: d log p(y_{1:T}) / d theta = sum_t E[xi_t | y_{1:T}], with xi_t the derivative of
log { f(x_t | x_{t-1}) g(y_t | x_t) }. Expectations at row t are taken over the ancestors at t - 1
and t of the weighted particles at a later row: the fixed-lag smoother (Kitagawa 1996; Olsson,
Cappé, Douc and Moulines 2008), which needs no transition density and so holds for deterministic
components. Rows are done in blocks, so that all rows of a block share one pass back along the
ancestors: the lag is `lag` for the last row of a block and less than twice that for the first.

Notation: F derivatives, N particles, T rows; only ancestors with a weight are evaluated.
"""

from __future__ import annotations

import math

import numpy as np

from ssmppl.codegen.kernels.math.flags import exact
from ssmppl.codegen.kernels.math.random import fill_normal, fill_uniform, uniform
from ssmppl.codegen.kernels.particle.conditional_smc import draw_index
from ssmppl.codegen.kernels.particle.particle_filter import (
    NO_LOOK_AHEAD,
    add,
    any_finite,
    copy,
    gather,
    look_ahead_weights,
    second_stage,
)
from ssmppl.codegen.kernels.particle.resampling import PADDING, systematic
from ssmppl.codegen.kernels.particle.simulation import mix_channels
from ssmppl.codegen.kernels.particle.weights import ALL_ZERO, NAN, OK, normalise


@exact
def carry_back(w, ancestors, w_before):
    """w_before[j] = sum of w[i] over the offspring i of j."""
    for j in range(w_before.size):
        w_before[j] = 0.0
    for i in range(w.size):
        w_before[ancestors[i]] += w[i]


@exact
def add_score(w, xi, mean, score):
    """score += mean = sum_j w_j xi_j."""
    for p in range(xi.shape[0]):
        total = 0.0
        for j in range(w.size):
            if w[j] > 0.0:
                total += w[j] * xi[p, j]
        mean[p] = total
        score[p] += total


@exact
def add_information(w, s, lag, xis, hs, ancestry, mean, before, information):
    """information += - E[h_s] - Var[xi_s] - Cov[xi_s, B] - Cov[B, xi_s], B = sum of xi_r over
    the `lag` steps r before s along the ancestors.

    xis (2 lag + 1, P, N), hs (lag + 1, P (P + 1) / 2, N) : rings of steps. mean : (P,) of xi_s.
    before : (P,) scratch.
    """
    n_parameters, ring, later = mean.size, xis.shape[0], hs.shape[0]
    xi, h = xis[s % ring], hs[s % later]
    for j in range(w.size):
        if not w[j] > 0.0:
            continue
        for p in range(n_parameters):
            before[p] = 0.0
        k = j
        for r in range(s - 1, max(s - lag, 0) - 1, -1):
            k = ancestry[r + 1, k]
            for p in range(n_parameters):
                before[p] += xis[r % ring, p, k]
        m = 0
        for p in range(n_parameters):
            own = w[j] * (xi[p, j] - mean[p])
            for q in range(p + 1):
                other = xi[q, j] - mean[q]
                half = own * before[q] + w[j] * other * before[p]
                information[p, q] -= w[j] * h[m, j] + own * other + half
                m += 1


@exact
def filter_with_score(
    prepare, step, draw_initial, weigh_initial, fit, look_ahead, draw, weigh,
    gradient_initial, gradient, hessian_initial, hessian, sizes, ahead, second,
    theta, y, seen, u, particles, rng, trajectory, log_increment, lag, score, information,
):  # fmt: skip
    """`filtered_path` with score (P,) and, if `second`, information (P, P); returns (status, t,
    log Z)."""
    n_steps, n, d, n_parameters = y.shape[0], particles, trajectory.shape[1], score.size
    c, s = np.empty(sizes[0]), np.empty(sizes[1])
    history, ancestry = np.empty((n_steps, d, n)), np.empty((n_steps, n), dtype=np.int32)
    x_prev = np.empty((d, n))
    fits, fits_prev = np.empty((sizes[5], n)), np.empty((sizes[5], n))
    normals, uniforms = np.empty(sizes[3] * n), np.empty(sizes[4] * n)
    log_v, log_base, part = np.empty(n), np.empty(n), np.empty(n)
    w, p, back, further = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    ancestors = np.empty(n + PADDING, dtype=np.int32)
    ring = 2 * lag + 1
    xis = np.empty((ring, n_parameters, n))
    mean, before = np.empty(n_parameters), np.empty(n_parameters)
    if second:
        later = lag + 1
        hs = np.empty((later, n_parameters * (n_parameters + 1) // 2, n))
        for i in range(n_parameters):
            for j in range(n_parameters):
                information[i, j] = 0.0
    score[:] = 0.0
    log_increment[:] = 0.0
    prepare(theta, c)
    for t in range(n_steps):
        step(theta, c, y, seen, u, t, s)
        x = history[t]
        if t > 0:
            copy(w, p)
            if ahead != NO_LOOK_AHEAD:
                if sizes[5] > 0:
                    fit(theta, c, s, history[t - 1], fits_prev)
                look_ahead(theta, c, s, history[t - 1], fits_prev, log_v)
                _, status = look_ahead_weights(log_v, w, log_base, ahead, p)
                if status != OK:
                    return status, t, -np.inf
            systematic(rng, p, ancestors)
            gather(history[t - 1], ancestors, x_prev)
            if sizes[5] > 0:
                if ahead != NO_LOOK_AHEAD:
                    gather(fits_prev, ancestors, fits)
                else:
                    fit(theta, c, s, x_prev, fits)
            copy(ancestors, ancestry[t])
        fill_normal(rng, normals)
        if sizes[4] > 0:
            fill_uniform(rng, uniforms)
        if t == 0:
            draw_initial(theta, c, s, x, normals, uniforms, rng)
            weigh_initial(theta, c, s, x, log_v)
            gradient_initial(theta, c, s, x, xis[0])
            if second:
                hessian_initial(theta, c, s, x, hs[0])
        else:
            draw(theta, c, s, x_prev, fits, x, normals, uniforms, rng)
            weigh(theta, c, s, x_prev, fits, x, log_v)
            gradient(theta, c, s, x_prev, x, xis[t % ring])
            if second:
                hessian(theta, c, s, x_prev, x, hs[t % later])
        if ahead != NO_LOOK_AHEAD:
            if t > 0:
                second_stage(w, p, ancestors, part, log_base)
                add(log_v, log_base)
                log_increment[t] = math.log(n)  # the second-stage weights hold 1 / N already
        log_sum, _, status = normalise(log_v, w)
        if status == NAN and not any_finite(log_v):
            status = ALL_ZERO
        if status != OK:
            return status, t, -np.inf
        log_increment[t] += log_sum - math.log(n)
        # smooth what is `lag` steps old, at the end all that is left
        last = t == n_steps - 1
        if last or t >= lag:
            copy(w, back)
            for r in range(t, max(t - lag, 0) - 1, -1):
                if last or r == t - lag:
                    add_score(back, xis[r % ring], mean, score)
                    if second:
                        add_information(back, r, lag, xis, hs, ancestry, mean, before, information)
                if r > max(t - lag, 0):
                    carry_back(back, ancestry[r], further)
                    back, further = further, back
    if second:
        for i in range(n_parameters):
            for j in range(i):
                information[j, i] = information[i, j]
    k = draw_index(w, uniform(rng))
    for back_by in range(n_steps):
        t = n_steps - 1 - back_by
        for m in range(d):
            trajectory[t, m] = history[t, m, k]
        if t > 0:
            k = ancestry[t, k]
    return OK, n_steps, log_increment.sum()


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
