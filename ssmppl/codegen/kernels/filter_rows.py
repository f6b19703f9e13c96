"""The particle filter over some rows, to be gone on with: what SMC^2 attaches to each parameter.

As `particle_filter.py`, for proposals without look-ahead: resample at every row, move by q, weigh
by f g / q. The product of the mean weights is unbiased for the likelihood of the rows.

Notation: N particles, D states; x : (D, N); w : (N,) normalised weights.
"""

from __future__ import annotations

import math

import numpy as np

from ssmppl.codegen.kernels.flags import exact
from ssmppl.codegen.kernels.particle_filter import any_finite, gather
from ssmppl.codegen.kernels.random import fill_normal, fill_uniform
from ssmppl.codegen.kernels.resampling import PADDING, systematic
from ssmppl.codegen.kernels.weights import ALL_ZERO, NAN, OK, normalise


@exact
def filter_rows(
    prepare, step, draw_initial, weigh_initial, fit, draw, weigh, sizes,
    theta, y, seen, u, start, stop, rng, x, w, log_increment,
):  # fmt: skip
    """Go on from row `start` to row `stop` - 1; returns (status, t).

    x, w : the particles after row start - 1, without meaning at row 0; overwritten by those after
        the last row. log_increment : (T,), written at the rows.
    """
    n = w.size
    c, s = np.empty(sizes[0]), np.empty(sizes[1])
    x_prev, fits = np.empty((sizes[2], n)), np.empty((sizes[5], n))
    normals, uniforms = np.empty(sizes[3] * n), np.empty(sizes[4] * n)
    log_v = np.empty(n)
    ancestors = np.empty(n + PADDING, dtype=np.int32)
    log_n = math.log(n)
    prepare(theta, c)
    for t in range(start, stop):
        step(theta, c, y, seen, u, t, s)
        if t > 0:
            systematic(rng, w, ancestors)
            gather(x, ancestors, x_prev)
            if sizes[5] > 0:
                fit(theta, c, s, x_prev, fits)
        fill_normal(rng, normals)
        if sizes[4] > 0:
            fill_uniform(rng, uniforms)
        if t == 0:
            draw_initial(theta, c, s, x, normals, uniforms, rng)
            weigh_initial(theta, c, s, x, log_v)
        else:
            draw(theta, c, s, x_prev, fits, x, normals, uniforms, rng)
            weigh(theta, c, s, x_prev, fits, x, log_v)
        log_sum, _, status = normalise(log_v, w)
        if status == NAN and not any_finite(log_v):
            status = ALL_ZERO
        if status != OK:
            return status, t
        log_increment[t] = log_sum - log_n
    return OK, stop
