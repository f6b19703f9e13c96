"""Simulation of states and observations, many draws side by side, and one-step predictions of y_t.

A prediction moves the weighted particles of the row before by the transition.
"""

from __future__ import annotations

import numpy as np

from ssmppl.codegen.kernels.math.flags import exact
from ssmppl.codegen.kernels.math.random import fill_normal, fill_uniform
from ssmppl.codegen.kernels.particle.weights import (
    weighted_mean,
    weighted_product,
    weighted_quantiles,
)


@exact
def simulate(
    prepare, step, draw_initial, draw, observe, sizes,
    theta, y, seen, u, rng, states, observations, feedback,
):  # fmt: skip
    """Fill states (T, D, n) and observations (T, K, n) by the model's laws.

    feedback : the transition names observations, so y_t must be in place when x_{t+1} is drawn;
        then n = 1 and y : (T, K) is written as it is drawn.
    """
    n_steps, n = states.shape[0], states.shape[2]
    c, s = np.empty(sizes[0]), np.empty(sizes[1])
    normals, uniforms = np.empty(sizes[3] * n), np.empty(sizes[4] * n)
    prepare(theta, c)
    for t in range(n_steps):
        step(theta, c, y, seen, u, t, s)
        fill_normal(rng, normals)
        fill_uniform(rng, uniforms)
        if t == 0:
            draw_initial(theta, c, s, states[0], normals, uniforms, rng)
        else:
            draw(theta, c, s, states[t - 1], states[t], normals, uniforms, rng)
        fill_normal(rng, normals)
        fill_uniform(rng, uniforms)
        observe(theta, c, s, states[t], observations[t], normals, uniforms, rng)
        if feedback:
            for k in range(y.shape[1]):
                y[t, k] = observations[t, k, 0]


@exact
def simulate_on(
    prepare, step, draw, observe, sizes,
    theta, y, seen, u, first, x, rng, states, observations, feedback,
):  # fmt: skip
    """Fill states (H, D, n) and observations (H, K, n) of rows first, ..., first + H - 1 from x
    (D, n), the states of the row before.

    feedback : as in `simulate`; the draws are then made one after the other, and rows of y from
        `first` on are overwritten.
    """
    n_steps, d, n = states.shape
    width = 1 if feedback else n
    c, s = np.empty(sizes[0]), np.empty(sizes[1])
    normals, uniforms = np.empty(sizes[3] * width), np.empty(sizes[4] * width)
    before, after = np.empty((d, width)), np.empty((d, width))
    seen_at = np.empty((y.shape[1], width))
    prepare(theta, c)
    for a in range(0, n, width):
        for j in range(d):
            for i in range(width):
                before[j, i] = x[j, a + i]
        for h in range(n_steps):
            step(theta, c, y, seen, u, first + h, s)
            fill_normal(rng, normals)
            fill_uniform(rng, uniforms)
            draw(theta, c, s, before, after, normals, uniforms, rng)
            fill_normal(rng, normals)
            fill_uniform(rng, uniforms)
            observe(theta, c, s, after, seen_at, normals, uniforms, rng)
            for i in range(width):
                for j in range(d):
                    before[j, i] = states[h, j, a + i] = after[j, i]
                for k in range(y.shape[1]):
                    observations[h, k, a + i] = seen_at[k, i]
                    if feedback:
                        y[first + h, k] = seen_at[k, i]


@exact
def observe_states(prepare, step, observe, sizes, theta, y, seen, u, rng, states, observations):
    """Fill observations (T, K, n) by their laws given states (T, D, n)."""
    n_steps, n = states.shape[0], states.shape[2]
    c, s = np.empty(sizes[0]), np.empty(sizes[1])
    normals, uniforms = np.empty(sizes[3] * n), np.empty(sizes[4] * n)
    prepare(theta, c)
    for t in range(n_steps):
        step(theta, c, y, seen, u, t, s)
        fill_normal(rng, normals)
        fill_uniform(rng, uniforms)
        observe(theta, c, s, states[t], observations[t], normals, uniforms, rng)


@exact
def mix_channels(given_each, w, out):
    """out (4, K) : mean, variance, P(Y <= y), P(Y < y) of each channel, over particles w : (N,).

    given_each : (4 K, N), the same given each particle.
    """
    for k in range(out.shape[1]):
        middles = given_each[4 * k]
        out[0, k] = weighted_mean(middles, w)
        between = weighted_product(middles, out[0, k], middles, out[0, k], w)
        out[1, k] = weighted_mean(given_each[4 * k + 1], w) + between
        for row in range(2, 4):
            below = weighted_mean(given_each[4 * k + row], w)
            out[row, k] = 1.0 if below > 1.0 else below  # weights sum to 1 + rounding


@exact
def predict_step(
    prepare, step, draw_initial, draw, moments, observe, sizes,
    theta, y, seen, u, t, x_prev, w_prev, rng, predicted,
):  # fmt: skip
    """Write what is predicted of y_t, K channels, at P levels.

    predicted : prediction (T, 4, K), of which row t gets mean, variance, P(Y <= y_t) and
        P(Y < y_t) of each channel; levels (P,), increasing; quantiles (T, P, K), of one y drawn
        for each particle; stream, of these draws alone: `rng` goes on as if there were none.
    """
    prediction, levels, quantiles, stream = predicted
    n, n_channels = w_prev.size, y.shape[1]
    c, s = np.empty(sizes[0]), np.empty(sizes[1])
    x, out = np.empty((sizes[2], n)), np.empty((4 * n_channels, n))
    normals, uniforms = np.empty(sizes[3] * n), np.empty(sizes[4] * n)
    prepare(theta, c)
    step(theta, c, y, seen, u, t, s)
    fill_normal(rng, normals)
    fill_uniform(rng, uniforms)
    if t == 0:
        draw_initial(theta, c, s, x, normals, uniforms, rng)
        w = np.full(n, 1.0 / n)
    else:
        draw(theta, c, s, x_prev, x, normals, uniforms, rng)
        w = w_prev
    moments(theta, c, s, x, out)
    mix_channels(out, w, prediction[t])
    if levels.size > 0:
        normals, uniforms = np.empty(sizes[6] * n), np.empty(sizes[7] * n)
        fill_normal(stream, normals)
        fill_uniform(stream, uniforms)
        observe(theta, c, s, x, out, normals, uniforms, stream)
        for k in range(n_channels):
            weighted_quantiles(out[k], w, levels, quantiles[t, :, k])
            for i in range(n):
                if w[i] > 0.0 and out[k, i] != out[k, i]:  # a law whose parameter left its range
                    quantiles[t, :, k] = np.nan
                    break
