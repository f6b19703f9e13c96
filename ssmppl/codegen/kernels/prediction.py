"""One-step predictions of the observation, from weighted particles moved by the transition."""

from __future__ import annotations

import numpy as np

from ssmppl.codegen.kernels.flags import exact
from ssmppl.codegen.kernels.random import fill_normal, fill_uniform
from ssmppl.codegen.kernels.summaries import (
    weighted_mean,
    weighted_product,
    weighted_quantiles,
)


@exact
def mix_channels(told, w, out):
    """out (4, K) : mean, variance, P(Y <= y), P(Y < y) of each channel, over particles w : (N,).

    told : (4 K, N), the same given each particle.
    """
    for k in range(out.shape[1]):
        middles = told[4 * k]
        out[0, k] = weighted_mean(middles, w)
        between = weighted_product(middles, out[0, k], middles, out[0, k], w)
        out[1, k] = weighted_mean(told[4 * k + 1], w) + between
        for row in range(2, 4):
            below = weighted_mean(told[4 * k + row], w)
            out[row, k] = 1.0 if below > 1.0 else below  # weights sum to 1 + rounding


@exact
def predict_step(
    prepare, step, draw_initial, draw, moments, observe, sizes,
    theta, y, seen, u, t, x_prev, w_prev, rng, told,
):  # fmt: skip
    """Write what is predicted of y_t, K channels, at P levels.

    told : prediction (T, 4, K), of which row t gets mean, variance, P(Y <= y_t) and P(Y < y_t) of
        each channel; levels (P,), increasing; quantiles (T, P, K), of one y drawn for each
        particle; stream, of these draws alone: `rng` goes on as if there were none.
    """
    prediction, levels, quantiles, stream = told
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
