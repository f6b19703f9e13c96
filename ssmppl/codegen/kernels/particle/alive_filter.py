"""The alive particle filter: draw until enough particles are alive, and count the draws.

Where no particle can have produced a row (bounded noise, counts that a latent number must reach),
the ordinary filter ends with Z = 0. To draw once more only when all have died would make the
estimate too large. The alive filter draws particles one after another, each with an ancestor of its
own, until N + 1 have a positive weight, and leaves out the last one (LeGland and Oudjane 2006; Del
Moral, Jasra, Lee, Yau and Zhang 2015, "The alive particle filter"; with weights other than 0 and 1
Kudlicka, Murray, Ronquist and Schön 2019, algorithm 2). With P draws the increment of the
likelihood is

    (1 / (P - 1)) sum_{i <= N} w_i        where P is that of the (N + 1)-th that is alive,
    (1 / M) sum_i w_i                      where fewer were alive among the most draws M allowed,

and both together are unbiased: given how many are alive, these are independent draws from the law
of those alive, whose probability p is estimated by N / (P - 1) or K / M. For M = infinity that is
unbiased by the negative binomial law; for a finite M the chance that the N-th success comes by draw
M - 1, times p, is E[N / (P - 1); P <= M], and the chance that it does not, times p, is
E[K / M; K <= N] (the unbiased estimate of truncated inverse sampling: Girshick, Mosteller and
Savage 1946). The argument holds for every function of the new particle, so the product over t is
unbiased as of the ordinary filter; it needs independent ancestors, hence multinomial resampling.

Notation: N particles, T steps; x, x_prev : (D, N), the particles that are alive first and copies of
them behind, which have weight 0; w : (N,) normalised.
"""

from __future__ import annotations

import math

import numpy as np

from ssmppl.codegen.kernels.math.elementary import log
from ssmppl.codegen.kernels.math.flags import exact, kernel
from ssmppl.codegen.kernels.math.random import fill_normal, fill_uniform, uniform
from ssmppl.codegen.kernels.particle.particle_filter import (
    NO_LOOK_AHEAD,
    copy,
    descend,
    resampling_weights,
)
from ssmppl.codegen.kernels.particle.weights import (
    ALL_ZERO,
    INFINITE,
    NAN,
    OK,
    normalise,
    summarise,
)

BATCH = 4096  # draws made side by side at most, unless there are more particles


@exact
def independent_ancestors(rng, p, total, chosen):
    """chosen[m] = j with probability p[j], independently; never one of probability zero.

    total : (N,) scratch, the sums of p.
    """
    sum_ = 0.0
    for j in range(p.size):
        sum_ += p[j]
        total[j] = sum_
    last = p.size - 1
    while last > 0 and not p[last] > 0.0:
        last -= 1
    for m in range(chosen.size):
        point = sum_ * uniform(rng)
        low, high = 0, last
        while low < high:
            middle = (low + high) // 2
            if total[middle] > point:
                high = middle
            else:
                low = middle + 1
        chosen[m] = low


@exact
def batch_size(n, alive, tries, most):
    """How many draws to make next: all that are likely to be needed, and some more."""
    if tries == 0:
        return min(n + 1, most)
    wanted = 1.1 * (n + 1 - alive) * tries / max(alive, 1) + 8.0
    return min(int(min(wanted, max(n + 1.0, float(BATCH)))), most - tries)


@kernel
def log_ratio_of(w, p, log_ratio):
    """log_ratio = log (w / p), the second-stage weight of a draw whose ancestor it is."""
    for j in range(w.size):
        log_ratio[j] = log(w[j] / p[j])


@exact
def alive_filter(
    prepare, step, draw_initial, weigh_initial, fit, look_ahead, draw, weigh, predict,
    sizes, ahead, theta, y, seen, u, particles, most, rng,
    log_increment, ess, moments, kept=None,
):  # fmt: skip
    """Run the filter; returns (status, t), t the step at which a status other than OK arose.

    most : draws at one step at most. All else as of `particle_filter`.
    """
    n_steps, n, d = y.shape[0], particles, sizes[2]
    c, s = np.empty(sizes[0]), np.empty(sizes[1])
    x, x_prev = np.empty((d, n)), np.empty((d, n))
    fits_prev = np.empty((sizes[5], n))
    log_v, part, w, p = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    log_ratio, ancestors = np.zeros(n), np.zeros(n, dtype=np.int32)
    log_increment[:] = -np.inf
    prepare(theta, c)
    for t in range(n_steps):
        step(theta, c, y, seen, u, t, s)
        if moments is not None:
            predict(theta, y, seen, u, t, x, w, rng, moments[4])
        if t > 0:
            status = resampling_weights(
                fit, look_ahead, theta, c, s, x, fits_prev, w, ahead, log_v, part, p
            )
            if status != OK:
                return status, t
            if ahead != NO_LOOK_AHEAD:
                log_ratio_of(w, p, log_ratio)
            x, x_prev = x_prev, x
        alive, tries, undefined = 0, 0, 0
        while alive <= n and tries < most:
            m = batch_size(n, alive, tries, most)
            normals, uniforms = np.empty(sizes[3] * m), np.empty(sizes[4] * m)
            tried, log_tried = np.empty((d, m)), np.empty(m)
            chosen = np.zeros(m, dtype=np.int32)
            fill_normal(rng, normals)
            if sizes[4] > 0:
                fill_uniform(rng, uniforms)
            if t == 0:
                draw_initial(theta, c, s, tried, normals, uniforms, rng)
                weigh_initial(theta, c, s, tried, log_tried)
            else:
                tried_prev, fits = np.empty((d, m)), np.empty((sizes[5], m))
                independent_ancestors(rng, p, part, chosen)
                descend(fit, theta, c, s, x_prev, fits_prev, chosen, ahead, tried_prev, fits)
                draw(theta, c, s, tried_prev, fits, tried, normals, uniforms, rng)
                weigh(theta, c, s, tried_prev, fits, tried, log_tried)
                if ahead != NO_LOOK_AHEAD:
                    for i in range(m):
                        log_tried[i] += log_ratio[chosen[i]]
            for i in range(m):
                if alive > n:
                    break
                tries += 1
                if log_tried[i] != log_tried[i]:
                    undefined += 1
                elif log_tried[i] == np.inf:
                    return INFINITE, t
                elif log_tried[i] > -np.inf:
                    if alive < n:
                        log_v[alive] = log_tried[i]
                        ancestors[alive] = chosen[i]
                        for k in range(d):
                            x[k, alive] = tried[k, i]
                    alive += 1
            if undefined == tries:  # nothing is defined here, as in the ordinary filter
                return ALL_ZERO, t
            if undefined > 0 and alive > 0:
                return NAN, t
        if alive == 0:
            return ALL_ZERO, t
        for i in range(alive, n):
            log_v[i] = -np.inf
            ancestors[i] = ancestors[0]
            for k in range(d):
                x[k, i] = x[k, 0]
        log_sum, ess[t], status = normalise(log_v, w)
        if status != OK:
            return status, t
        log_increment[t] = log_sum - math.log(tries - 1 if alive > n else tries)
        if kept is not None:
            for k in range(d):
                copy(x[k], kept[0][t, k])
            copy(w, kept[1][t])
            copy(ancestors, kept[2][t])
        if moments is not None:
            summarise(x, w, moments[0], moments[1][t], moments[2][t], moments[3][t])
    return OK, n_steps
