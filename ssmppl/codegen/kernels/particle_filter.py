"""The particle filter, over the generated functions of a model.

Algorithm 2 of Schön et al. (2015) in the auxiliary form of Pitt and Shephard (1999): with weights
w_{t-1} and look-ahead values v, resample by p ~ w v, move by q, weigh by (w / p) f g / q. With
v = 1 and q = f it is the bootstrap filter. Resampling is done at every step, or when the
effective sample size falls below `ess_threshold` N (Del Moral, Doucet and Jasra 2012).

The product over t of the mean weights is unbiased for the likelihood, for every scheme here and
every N (Del Moral 2004, proposition 7.4.1; Pitt et al. 2012 for the auxiliary form).

Notation: N particles, T steps; x, x_prev : (D, N), one contiguous row per state component; w : (N,)
normalised weights; log_v : (N,) unnormalised log weights.
"""

from __future__ import annotations

import math

import numpy as np

from ssmppl.codegen.kernels.elementary import log
from ssmppl.codegen.kernels.flags import exact, kernel
from ssmppl.codegen.kernels.random import fill_normal, fill_uniform
from ssmppl.codegen.kernels.resampling import PADDING, resample
from ssmppl.codegen.kernels.summaries import summarise
from ssmppl.codegen.kernels.weights import ALL_ZERO, NAN, OK, normalise

NO_LOOK_AHEAD, APPROXIMATE, EXACT = 0, 1, 2
# Resampling by a look-ahead that is too sharp would leave unbounded weights: with this share of
# the plain weights mixed in, w / p <= 1 / share.
PLAIN_SHARE = 0.1


@kernel
def gather(x, ancestors, x_prev):
    """x_prev[:, i] = x[:, ancestors[i]]."""
    for k in range(x.shape[0]):
        source, target = x[k], x_prev[k]
        for i in range(target.size):
            target[i] = source[np.uint64(ancestors[i])]


@kernel
def add(log_v, log_base):
    """log_v += log_base."""
    for i in range(log_v.size):
        log_v[i] += log_base[i]


@kernel
def mix(p, w):
    """p = (1 - share) p + share w."""
    for i in range(p.size):
        p[i] = (1.0 - PLAIN_SHARE) * p[i] + PLAIN_SHARE * w[i]


@kernel
def second_stage(w, p, ancestors, log_base):
    """log_base[i] = log (w / (N p)) at the ancestor of i, the second-stage weight."""
    n = log_base.size
    for i in range(n):
        j = np.uint64(ancestors[i])
        log_base[i] = log(w[j] / (n * p[j]))


@kernel
def take_log(w, log_base):
    """log_base = log w."""
    for i in range(w.size):
        log_base[i] = log(w[i])


@exact
def any_finite(log_v):
    """Whether some log weight is an ordinary number."""
    for i in range(log_v.size):
        if abs(log_v[i]) < np.inf:
            return True
    return False


@exact
def particle_filter(
    prepare, step, draw_initial, weigh_initial, draw, weigh, look_ahead, predict,
    sizes, ahead, theta, y, seen, u, particles, scheme, ess_threshold, rng,
    log_increment, ess, probabilities, mean, covariance, quantiles, prediction,
):  # fmt: skip
    """Run the filter; returns (status, t), t the step at which a status other than OK arose.

    sizes : (theta constants, step constants, states, normals, uniforms) of the generated code.
    log_increment, ess : (T,), written. mean (T, D), covariance (T, D, D), quantiles
    (T, P, D) and prediction (T, 3, K): written where their first axis is not empty.
    prediction: mean, variance, and distribution function at y_t, of the one-step prediction.
    """
    n_steps, n = y.shape[0], particles
    c, s = np.empty(sizes[0]), np.empty(sizes[1])
    x, x_prev = np.empty((sizes[2], n)), np.empty((sizes[2], n))
    normals, uniforms = np.empty(sizes[3] * n), np.empty(sizes[4] * n)
    log_v, log_base, w, p = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    ancestors = np.empty(n + PADDING, dtype=np.int32)
    log_n = math.log(n)
    log_increment[:] = -np.inf
    prepare(theta, c)
    for t in range(n_steps):
        step(theta, c, y, seen, u, t, s)
        if prediction.shape[0] > 0:
            predict(theta, y, seen, u, t, x, w, rng, prediction)
        uniform_base = True
        if t > 0:
            current_ess = ess[t - 1]
            if ahead != NO_LOOK_AHEAD:
                look_ahead(theta, c, s, x, log_v)
                take_log(w, log_base)
                add(log_v, log_base)
                _, current_ess, status = normalise(log_v, p)
                if status == NAN and any_finite(log_v):
                    return status, t
                if status != OK:  # nowhere to go by the look-ahead: go by the weights
                    p[:] = w
                    current_ess = ess[t - 1]
                elif ahead == APPROXIMATE:
                    mix(p, w)
            else:
                p, w = w, p
            if ess_threshold >= 1.0 or current_ess < ess_threshold * n:
                resample(scheme, rng, p, ancestors)
                gather(x, ancestors, x_prev)
                if ahead != NO_LOOK_AHEAD:
                    second_stage(w, p, ancestors, log_base)
                    uniform_base = False
            else:
                take_log(w if ahead != NO_LOOK_AHEAD else p, log_base)
                uniform_base = False
                x, x_prev = x_prev, x
        fill_normal(rng, normals)
        fill_uniform(rng, uniforms)
        if t == 0:
            draw_initial(theta, c, s, x, normals, uniforms, rng)
            weigh_initial(theta, c, s, x, log_v)
        else:
            draw(theta, c, s, x_prev, x, normals, uniforms, rng)
            weigh(theta, c, s, x_prev, x, log_v)
        if not uniform_base:
            add(log_v, log_base)
        log_sum, ess[t], status = normalise(log_v, w)
        if status == NAN and not any_finite(log_v):
            status = ALL_ZERO
        if status != OK:
            return status, t
        log_increment[t] = log_sum - log_n if uniform_base else log_sum
        if mean.shape[0] > 0:
            summarise(x, w, probabilities, mean[t], covariance[t], quantiles[t], log_v)
    return OK, n_steps


@exact
def no_look_ahead(theta, c, s, states_prev, log_w):
    """Stands in for the look-ahead of a filter that has none."""


@exact
def no_prediction(theta, y, seen, u, t, x, w, rng, prediction):
    """Stands in for the predictions where none are asked for."""
