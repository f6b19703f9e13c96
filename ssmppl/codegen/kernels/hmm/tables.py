"""A model's laws as tables over its values, row by row, and sums of derivatives over them.

The generated functions take values for particles: of `values` (D, K), and of the pairs `before`
and `after` (D, K * K), in which j of x_t runs faster than i of x_{t-1}.

Notation as in `passes.py`.
"""

from __future__ import annotations

import math

import numpy as np

from ssmppl.codegen.kernels.math.flags import exact


@exact
def write_tables(
    prepare, step, log_initial, log_transition, log_observation, sizes,
    theta, y, seen, u, first, values, before, after, log_start, log_move, move, log_g,
):  # fmt: skip
    """Fill log_start (S, K), log_move and move (R or 1, K * K), and log_g (R, K).

    The move is written once, as of the first row, where there is one row for it.
    """
    c, s = np.empty(sizes[0]), np.empty(sizes[1])
    prepare(theta, c)
    for k in range(first.size - 1):
        begin, end = first[k], first[k + 1]
        own_y, own_seen, own_u = y[begin:end], seen[begin:end], u[begin:end]
        for t in range(begin, end):
            step(theta, c, own_y, own_seen, own_u, t - begin, s)
            if t == begin:
                log_initial(theta, c, s, values, log_start[k])
            if t == 0 or log_move.shape[0] > 1:
                log_transition(theta, c, s, before, after, log_move[t])
                for i in range(move.shape[1]):
                    move[t, i] = math.exp(log_move[t, i])
            log_observation(theta, c, s, values, log_g[t])


@exact
def weighed(law, weight, slopes, gradient):
    """Add weight times the slopes (P, N) weighed by a law (N,) to the gradient (P,). What has no
    weight does not count, be it infinite."""
    for i in range(law.size):
        share = weight * law[i]
        if share > 0.0:
            for p in range(gradient.size):
                gradient[p] += share * slopes[p, i]


@exact
def expected_slopes(
    prepare, step, slopes_initial, slopes_transition, slopes_observation, sizes,
    theta, y, seen, u, first, weights, values, before, after, moving, smoothed, pairs, gradient,
):  # fmt: skip
    """Add to the gradient (P,) what the derivatives of the complete-data log density are expected
    to be, by the laws (R, K) of x_t and (R, K * K) of (x_{t-1}, x_t) given the data.

    weights (S,) : how often each sequence counts. moving : whether the law of the transition is one
    for each row; else its derivatives are taken once, weighed by the sum over all rows.
    """
    c, s = np.empty(sizes[0]), np.empty(sizes[1])
    slopes = np.zeros((gradient.size, values.shape[1]))
    slopes_first = np.zeros((gradient.size, values.shape[1]))
    slopes_pairs = np.zeros((gradient.size, before.shape[1]))
    total = np.zeros(before.shape[1])
    prepare(theta, c)
    for k in range(first.size - 1):
        begin, end = first[k], first[k + 1]
        own_y, own_seen, own_u = y[begin:end], seen[begin:end], u[begin:end]
        for t in range(begin, end):
            step(theta, c, own_y, own_seen, own_u, t - begin, s)
            if t == begin:
                slopes_initial(theta, c, s, values, slopes_first)
                weighed(smoothed[t], weights[k], slopes_first, gradient)
            elif moving:
                slopes_transition(theta, c, s, before, after, slopes_pairs)
                weighed(pairs[t], weights[k], slopes_pairs, gradient)
            else:
                for i in range(total.size):
                    total[i] += weights[k] * pairs[t, i]
            slopes_observation(theta, c, s, values, slopes)
            weighed(smoothed[t], weights[k], slopes, gradient)
    if not moving:
        slopes_transition(theta, c, s, before, after, slopes_pairs)
        weighed(total, 1.0, slopes_pairs, gradient)
