"""Score and observed information from the genealogy of a particle filter, by fixed-lag smoothing.

Fisher's identity, grad log p(y) = E[sum_t xi_t | y] with xi_t = grad log { f(x_t | x_{t-1})
g(y_t | x_t) }, and Louis' identity, - hess log p(y) = - E[sum_t h_t | y] - Var[sum_t xi_t | y]
with h_t the second derivatives (Schön et al. 2015, section 6; Louis 1982). Expectations at a step
are taken over the ancestors there of the weighted particles at a later step: the fixed-lag smoother
(Kitagawa 1996; Kitagawa and Sato 2001; Olsson, Cappé, Douc and Moulines 2008), which needs no
transition density and so holds for deterministic components.

`path_score` weighs step s at step min(s + lag, T), as Dahlin, Lindsten and Schön (2015) do. The
variance of the sum takes pairs of steps in as far as they are `lag` apart. The weights at s + lag
are carried back along the ancestors, which costs O(N lag) a step and derivatives of 2 lag + 1 steps
at a time.

`row_scores` keeps the rows apart. Rows are done in blocks, so that all rows of a block share one
pass back along the ancestors: the lag is `lag` for the last row of a block and less than twice that
for the first; only ancestors with a weight are evaluated.

Notation: N particles, T rows, P or F derivatives; xi : (P, N) at one step, h : (P (P + 1) / 2, N),
row by row of the lower half.
"""

from __future__ import annotations

import numpy as np

from ssmppl.codegen.kernels.math.flags import exact
from ssmppl.codegen.kernels.math.random import fill_normal, fill_uniform
from ssmppl.codegen.kernels.particle.particle_filter import copy, gather
from ssmppl.codegen.kernels.particle.simulation import mix_channels


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
def path_score(
    prepare, step, gradient_initial, gradient, hessian_initial, hessian, sizes, second,
    theta, y, seen, u, history, weights, ancestry, lag, score, information,
):  # fmt: skip
    """Write the score (P,) and, if `second`, the information (P, P), from a particle system.

    history (T, D, N), weights (T, N), ancestry (T, N) : as of `filtered_path`.
    """
    n_steps, d, n = history.shape
    n_parameters = score.size
    c, s = np.empty(sizes[0]), np.empty(sizes[1])
    x_prev, back, further = np.empty((d, n)), np.empty(n), np.empty(n)
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
    prepare(theta, c)
    for t in range(n_steps):
        step(theta, c, y, seen, u, t, s)
        if t == 0:
            gradient_initial(theta, c, s, history[t], xis[0])
            if second:
                hessian_initial(theta, c, s, history[t], hs[0])
        else:
            gather(history[t - 1], ancestry[t], x_prev)
            gradient(theta, c, s, x_prev, history[t], xis[t % ring])
            if second:
                hessian(theta, c, s, x_prev, history[t], hs[t % later])
        # smooth what is `lag` steps old, at the end all that is left
        last = t == n_steps - 1
        if last or t >= lag:
            copy(weights[t], back)
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
    x, given_each = np.empty((d, n)), np.empty((4 * y.shape[1], n))
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
        moments(theta, c, s, x, given_each)
        mix_channels(given_each, w, out[t])


@exact
def row_predictions_at(prepare, step, moments, sizes, theta, y, seen, u, particles, weights, out):
    """Likewise, of particles (T, D, N) that are given y_{1:t-1} already."""
    n_steps, _, n = particles.shape
    c, s = np.empty(sizes[0]), np.empty(sizes[1])
    given_each = np.empty((4 * y.shape[1], n))
    prepare(theta, c)
    for t in range(n_steps):
        step(theta, c, y, seen, u, t, s)
        moments(theta, c, s, particles[t], given_each)
        mix_channels(given_each, weights[t], out[t])


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
