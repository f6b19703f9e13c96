"""The tempered particle filter: an informative row taken in by degrees.

Particles that the transition has drawn are weighed by g(y_t | x_t) to a small power first,
resampled, moved, weighed up to a larger power, and so on up to 1 (Herbst and Schorfheide 2019,
"Tempered particle filtering", algorithm 2; Johansen 2015, "On blocks, tempering and particle MCMC
for systems identification"). The moves are Metropolis steps in x_t given x_{t-1}, reversible with
respect to f(x_t | x_{t-1}) g(y_t | x_t)^temperature: each temperature is one more step of a
particle filter on pairs (x_{t-1}, x_t), so that the product of all mean weights is unbiased for the
likelihood, for temperatures and steps of the walk that are fixed beforehand (Del Moral 2004).
Chosen by the very particles they would leave a bias: so a pilot run on random numbers of its own
chooses them (`choose`), and the run that counts takes them as they are.

Notation: N particles, T steps, L temperatures of a step at most; x, x_prev : (D, N).
"""

from __future__ import annotations

import math

import numpy as np

from ssmppl.codegen.kernels.math.elementary import exp, log
from ssmppl.codegen.kernels.math.flags import exact, kernel
from ssmppl.codegen.kernels.math.random import fill_normal, fill_uniform, uniform
from ssmppl.codegen.kernels.particle.particle_filter import copy, gather, weigh_row
from ssmppl.codegen.kernels.particle.resampling import PADDING, systematic
from ssmppl.codegen.kernels.particle.weights import (
    OK,
    normalise,
    summarise,
    weighted_mean,
    weighted_product,
)

KEPT = (
    0.5  # of the particles that are alive, as effective sample size, from one temperature to next
)
HALVINGS = 16  # of the interval, in logarithms, in which the next temperature is looked for
SMALLEST = -100.0  # log of the smallest step in temperature
ACCEPTANCE = 0.3  # that the walk adapts to in the pilot run
GAIN = 1.0  # of the log scale, for an acceptance rate that is off by 1


@kernel
def power(log_g, step, log_v):
    """log_v = step log_g."""
    for i in range(log_g.size):
        log_v[i] = step * log_g[i]


@exact
def next_temperature(log_g, at, log_v, w):
    """The temperature up to which the weights g^(next - at) keep the effective sample size.

    log_v, w : (N,) scratch.
    """
    power(log_g, 1.0 - at, log_v)
    _, ess, status = normalise(log_v, w)
    alive = 0
    for i in range(log_g.size):
        alive += 1 if log_g[i] > -np.inf else 0
    if status != OK or ess >= KEPT * alive:
        return 1.0
    low, high = SMALLEST, math.log(1.0 - at)
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        power(log_g, exp(middle), log_v)
        _, ess, status = normalise(log_v, w)
        if ess >= KEPT * alive:
            low = middle
        else:
            high = middle
    return min(at + exp(low), 1.0)


@exact
def spread_of(x, moved, w, factor):
    """A lower factor (D, D) of the covariance of the moved components of x, equal weights; of the
    variances alone where it is not definite, zero for what does not move.

    w : (N,) scratch.
    """
    d, n = x.shape
    for i in range(n):
        w[i] = 1.0 / n
    mean = np.zeros(d)
    for k in range(d):
        mean[k] = weighted_mean(x[k], w)
    definite = True
    for k in range(d):
        for m in range(k + 1):
            factor[k, m] = 0.0
            if moved[k] and moved[m]:
                factor[k, m] = weighted_product(x[k], mean[k], x[m], mean[m], w)
    variance = np.diag(factor).copy()
    for k in range(d):  # Cholesky, in place
        for m in range(k + 1):
            if moved[k] and moved[m] and definite:
                value = factor[k, m]
                for j in range(m):
                    value -= factor[k, j] * factor[m, j]
                if k == m:
                    definite = value > 1e-10 * variance[k]
                    factor[k, k] = math.sqrt(max(value, 0.0))
                else:
                    factor[k, m] = value / factor[m, m]
    if not definite:
        for k in range(d):
            for m in range(k + 1):
                factor[k, m] = math.sqrt(variance[k]) if k == m else 0.0


@exact
def walk(x, factor, scale, normals, x_new):
    """x_new = x + scale factor z, z : normals (D N,)."""
    d, n = x.shape
    for k in range(d):
        copy(x[k], x_new[k])
        for m in range(k + 1):
            part = scale * factor[k, m]
            if part != 0.0:
                for i in range(n):
                    x_new[k, i] += part * normals[m * n + i]


@exact
def accept(rng, at, x, log_f, log_g, x_new, log_f_new, log_g_new):
    """Take over what the Metropolis rule accepts, in place; returns the mean acceptance."""
    d, n = x.shape
    total = 0.0
    for i in range(n):
        change = log_f_new[i] - log_f[i] + at * (log_g_new[i] - log_g[i])
        here = log_f_new[i] + at * log_g_new[i]
        # a density that is infinite would never be left; also where it is undefined
        if not (change > -np.inf and here < np.inf):
            continue
        chance = 1.0 if change >= 0.0 else exp(change)
        total += chance
        if uniform(rng) < chance:
            log_f[i], log_g[i] = log_f_new[i], log_g_new[i]
            for k in range(d):
                x[k, i] = x_new[k, i]
    return total / n


@exact
def tempered_filter(
    prepare, step, draw_initial, draw, log_initial, log_transition, weigh_observed, predict, sizes,
    theta, y, seen, u, particles, moves, moved_initial, moved,
    choose, counts, temperatures, factors, rng, log_increment, ess, moments, kept=None,
):  # fmt: skip
    """Run the filter; returns (status, t), t the step at which a status other than OK arose.

    moves : Metropolis steps at each temperature below 1. moved_initial, moved : (D,), 1 for the
        components that move, at the first row and later.
    choose : whether to choose the schedule and write it: counts (T,), how many temperatures each
        row has, temperatures (T, L), factors (T, L, D, D) of the walk's steps.
    ess : (T,), written: the effective sample size at the last temperature, and so on as of
        `particle_filter`.
    """
    n_steps, n, d, most = y.shape[0], particles, sizes[2], temperatures.shape[1]
    c, s = np.empty(sizes[0]), np.empty(sizes[1])
    x, x_prev = np.empty((d, n)), np.empty((d, n))
    x_new, x_prev_new = np.empty((d, n)), np.empty((d, n))
    normals, uniforms = np.empty(sizes[3] * n), np.empty(sizes[4] * n)
    steps, w, log_v = np.empty(d * n), np.empty(n), np.empty(n)
    log_f, log_g = np.empty(n), np.empty(n)
    log_f_new, log_g_new = np.empty(n), np.empty(n)
    ancestors, chosen = np.empty(n + PADDING, dtype=np.int32), np.empty(n + PADDING, dtype=np.int32)
    lines = np.empty(n, dtype=np.int32)
    log_n, log_scale = math.log(n), math.log(2.38)
    log_increment[:] = -np.inf
    prepare(theta, c)
    for t in range(n_steps):
        step(theta, c, y, seen, u, t, s)
        if moments is not None:
            predict(theta, y, seen, u, t, x, w, rng, moments[4])
        fill_normal(rng, normals)
        if sizes[4] > 0:
            fill_uniform(rng, uniforms)
        if t == 0:
            for i in range(n):
                ancestors[i] = i
            draw_initial(theta, c, s, x, normals, uniforms, rng)
        else:
            systematic(rng, w, ancestors)
            gather(x, ancestors, x_prev)
            draw(theta, c, s, x_prev, x, normals, uniforms, rng)
        weigh_observed(theta, c, s, x, log_g)
        at, total, level = 0.0, 0.0, 0
        while at < 1.0:
            if choose:
                up_to = 1.0 if level == most - 1 else next_temperature(log_g, at, log_v, w)
                temperatures[t, level] = up_to
            up_to = temperatures[t, level]
            power(log_g, up_to - at, log_v)
            log_sum, ess[t], status = weigh_row(log_v, w)
            if status != OK:
                return status, t
            total += log_sum - log_n
            at = up_to
            level += 1
            if at >= 1.0:
                break
            if level == 1:
                if t == 0:
                    log_initial(theta, c, s, x, log_f)
                else:
                    log_transition(theta, c, s, x_prev, x, log_f)
            # resample pairs (x_{t-1}, x_t)
            systematic(rng, w, chosen)
            gather(x, chosen, x_new)
            x, x_new = x_new, x
            gather(x_prev, chosen, x_prev_new)
            x_prev, x_prev_new = x_prev_new, x_prev
            for i in range(n):
                j = chosen[i]
                log_f_new[i], log_g_new[i], lines[i] = log_f[j], log_g[j], ancestors[j]
            copy(log_f_new, log_f)
            copy(log_g_new, log_g)
            for i in range(n):
                ancestors[i] = lines[i]
            # move x_t
            factor = factors[t, level - 1]
            if choose:
                spread_of(x, moved_initial if t == 0 else moved, w, factor)
            for _ in range(moves):
                fill_normal(rng, steps)
                walk(x, factor, exp(log_scale) if choose else 1.0, steps, x_new)
                if t == 0:
                    log_initial(theta, c, s, x_new, log_f_new)
                else:
                    log_transition(theta, c, s, x_prev, x_new, log_f_new)
                weigh_observed(theta, c, s, x_new, log_g_new)
                rate = accept(rng, at, x, log_f, log_g, x_new, log_f_new, log_g_new)
                if choose:
                    log_scale += GAIN * (rate - ACCEPTANCE)
                    log_scale = min(max(log_scale, log(1e-6)), log(10.0))
            if choose:
                for k in range(d):
                    for m in range(d):
                        factor[k, m] *= exp(log_scale)
        counts[t] = level
        log_increment[t] = total
        if kept is not None:
            for k in range(d):
                copy(x[k], kept[0][t, k])
            copy(w, kept[1][t])
            copy(ancestors, kept[2][t])
        if moments is not None:
            summarise(x, w, moments[0], moments[1][t], moments[2][t], moments[3][t])
    return OK, n_steps
