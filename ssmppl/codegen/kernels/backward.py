"""Backward simulation with the exact kernel, over a model's generated functions.

Godsill, Doucet and West (2004), algorithm 1; Schön et al. (2015), section 5. Given the particles
and weights of a filter, each trajectory draws its x_T by the last weights and then, backwards in
time, the index of x_t with probability proportional to w_t^i f(x'_{t+1} | x_t^i): O(N) for each
trajectory and step.

Deterministic (Dirac) components of a trajectory are those that follow from its noisy components,
as in `conditional_smc`. Where x_{t+1}, ..., x_{t+h} change with the choice of x_t in this way, the
law of the noisy components is not Markov, and the weights take in what the choice does to the
densities of these steps: f and g of t + 1, ..., t + h and f of t + h + 1 (Lindsten and Schön 2013,
"Backward simulation methods", section 4.5). `horizon` is h - 0 where there is nothing of the
kind, and -1 where the choice changes all later steps (a position that integrates a velocity).

Notation: N particles, M trajectories, T steps, D states; history : (T, D, N); weights : (T, N);
paths : (T, D, M).
"""

from __future__ import annotations

import numpy as np

from ssmppl.codegen.kernels.flags import exact, kernel
from ssmppl.codegen.kernels.particle_filter import add, take_log
from ssmppl.codegen.kernels.random import uniform
from ssmppl.codegen.kernels.weights import OK, draw_relative, relative_weights, rule_out


@exact
def draw_last(history, weights, rng, index, paths):
    """Draw x_T of each trajectory by the last weights; index : (M,), written."""
    last, n = history.shape[0] - 1, history.shape[2]
    cumulative, first = np.empty(n), np.empty(n, dtype=np.int32)
    tabulate(weights[last], cumulative, first)
    for m in range(index.size):
        index[m] = draw_tabulated(cumulative, first, uniform(rng))
    take(history[last], index, paths[last])


@exact
def tabulate(w, cumulative, first):
    """Prepare draws in O(1) from weights w : (N,), by a guide table (Chen and Asau 1974).

    cumulative : (N,) sums of w. first : (N,) first[k] is the first j with
    cumulative[j] > (k / N) total.
    """
    n = w.size
    total = 0.0
    for j in range(n):
        total += w[j]
        cumulative[j] = total
    j = 0
    for k in range(n):
        while j < n - 1 and cumulative[j] <= (k / n) * total:
            j += 1
        first[k] = j


@exact
def draw_tabulated(cumulative, first, u):
    """The first j with cumulative[j] > u total: never one of weight zero."""
    n = cumulative.size
    point = u * cumulative[n - 1]
    j = first[min(np.int64(u * n), n - 1)]
    while j < n - 1 and cumulative[j] <= point:
        j += 1
    while j > 0 and cumulative[j - 1] > point:  # u n may be rounded up to a whole number
        j -= 1
    return j


@kernel
def take(x, index, columns):
    """columns[:, m] = x[:, index[m]] for all of index : (M,)."""
    for k in range(x.shape[0]):
        source, target = x[k], columns[k]
        for m in range(index.size):
            target[m] = source[np.uint64(index[m])]


@exact
def column(x, m, out):
    """out = x[:, m]."""
    for k in range(out.size):
        out[k] = x[k, m]


@exact
def backward_weights(
    step, connect, weigh_following, weigh_connected, weigh_observed, horizon,
    theta, c, s, s_later, y, seen, u, t, x, log_w, paths, m, reference, joined, joined_next,
    part, log_v,
):  # fmt: skip
    """log_v[i] = log of w_t^i p(what follows of trajectory m | x_t^i), up to a constant.

    s : the constants of step t + 1. x : (D, N) and log_w : (N,), the particles of step t.
    """
    n_steps = paths.shape[0]
    column(paths[t + 1], m, reference)
    weigh_following(theta, c, s, x, reference, log_v)
    add(log_v, log_w)
    if horizon != 0:
        changed = t + horizon if horizon > 0 else n_steps - 1  # the last step that t changes
        connect(theta, c, s, x, reference, joined)
        weigh_observed(theta, c, s, joined, part)
        rule_out(part)
        add(log_v, part)
        for later in range(t + 2, min(changed + 2, n_steps)):
            step(theta, c, y, seen, u, later, s_later)
            column(paths[later], m, reference)
            connect(theta, c, s_later, joined, reference, joined_next)
            weigh_connected(theta, c, s_later, joined, joined_next, part)
            rule_out(part)
            add(log_v, part)
            if later <= changed:
                weigh_observed(theta, c, s_later, joined_next, part)
                rule_out(part)
                add(log_v, part)
            joined, joined_next = joined_next, joined


@exact
def backward_exact(
    prepare, step, backward_weights, complete, sizes, horizon,
    theta, y, seen, u, rng, history, weights, paths,
):  # fmt: skip
    """Draw paths; returns (status, t), t the step at which a status other than OK arose.

    Trajectories that share x_{t+1}, as many do at first, share the weights too where these depend
    on nothing else.
    """
    n_steps, d, n = history.shape
    n_paths = paths.shape[2]
    c, s, s_later = np.empty(sizes[0]), np.empty(sizes[1]), np.empty(sizes[1])
    log_w, log_v, part, p = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    joined, joined_next, reference = np.empty((d, n)), np.empty((d, n)), np.empty(d)
    index, following = np.empty(n_paths, dtype=np.int64), np.empty(n_paths, dtype=np.int64)
    prepare(theta, c)
    draw_last(history, weights, rng, index, paths)
    for back in range(n_steps - 1):
        t = n_steps - 2 - back
        step(theta, c, y, seen, u, t + 1, s)
        take_log(weights[t], log_w)
        following[:] = index
        order = np.argsort(following)
        total = 0.0
        for r in range(n_paths):
            m = order[r]
            if r == 0 or horizon != 0 or following[m] != following[order[r - 1]]:
                backward_weights(
                    theta, c, s, s_later, y, seen, u, t, history[t], log_w, paths, m, reference,
                    joined, joined_next, part, log_v,
                )  # fmt: skip
                total, status = relative_weights(log_v, p)
                if status != OK:
                    return status, t
            index[m] = draw_relative(p, total, uniform(rng))
        take(history[t], index, paths[t])
    if horizon != 0:
        for t in range(1, n_steps):
            step(theta, c, y, seen, u, t, s)
            complete(theta, c, s, paths[t - 1], paths[t])
    return OK, n_steps
