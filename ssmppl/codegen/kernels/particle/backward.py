"""Backward simulation: trajectories drawn through the particles of a filter.

`backward_exact`: Godsill, Doucet and West (2004), algorithm 1; Schön et al. (2015), section 5.
Given the particles and weights of a filter, each trajectory draws its x_T by the last weights and
then, backwards in time, the index of x_t with probability proportional to
w_t^i f(x'_{t+1} | x_t^i): O(N) for each trajectory and step. The others look at single pairs
(x_t^i, x'_{t+1}), and their passes go over trajectories instead of over particles.

`backward_rejection`: the index i is proposed by the filter's weights and accepted with probability
f(x'_{t+1} | x_t^i) / sup_x f(x'_{t+1} | x) (Douc, Garivier, Moulines and Olsson 2011). All
trajectories that are left propose once in each round; what is still left when a round no longer
pays draws with the exact kernel (Taghavi, Lindsten, Svensson and Schön 2013). When to stop depends
on earlier proposals only, all of which were rejected for the trajectories that are left, so the
law of their indices stays exact.

`backward_mcmc`: the index starts at the ancestor of x'_{t+1} in the filter and makes a number of
independent Metropolis-Hastings steps, proposals again by the filter's weights (Bunch and Godsill
2013): O(1) for each trajectory and step, and a path of the genealogy where no step is made.

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

import math

import numpy as np

from ssmppl.codegen.kernels.math.flags import exact, kernel
from ssmppl.codegen.kernels.math.random import uniform
from ssmppl.codegen.kernels.particle.particle_filter import add, copy, take_log
from ssmppl.codegen.kernels.particle.weights import (
    NAN,
    OK,
    draw_relative,
    relative_weights,
    rule_out,
)

ABOVE_BOUND = 4
"""A density above what was derived as its bound."""

SLACK = 1e-6
"""By how much rounding may lift the log of a density above its bound."""

PRICE = 20.0
"""Cost of a proposal, as a number of particles that the exact kernel could have weighed."""


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
        copy(index, following)
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


@exact
def continuation(
    step, complete, weigh_connected, weigh_observed, horizon,
    theta, c, s, s_later, y, seen, u, t, x, paths, joined, joined_next, part, log_v,
):  # fmt: skip
    """log_v[m] = log p(what follows of trajectory m | x[:, m]), up to a constant; x : (D, M)."""
    n_steps, d = paths.shape[0], x.shape[0]
    for k in range(d):
        copy(paths[t + 1, k], joined[k])
    if horizon != 0:
        complete(theta, c, s, x, joined)
    weigh_connected(theta, c, s, x, joined, log_v)
    if horizon != 0:
        changed = t + horizon if horizon > 0 else n_steps - 1
        weigh_observed(theta, c, s, joined, part)
        rule_out(part)
        add(log_v, part)
        for later in range(t + 2, min(changed + 2, n_steps)):
            step(theta, c, y, seen, u, later, s_later)
            for k in range(d):
                copy(paths[later, k], joined_next[k])
            complete(theta, c, s_later, joined, joined_next)
            weigh_connected(theta, c, s_later, joined, joined_next, part)
            rule_out(part)
            add(log_v, part)
            if later <= changed:
                weigh_observed(theta, c, s_later, joined_next, part)
                rule_out(part)
                add(log_v, part)
            joined, joined_next = joined_next, joined


@exact
def backward_mcmc(
    prepare, step, continuation, complete, sizes, horizon,
    theta, y, seen, u, rng, history, weights, ancestry, moves, paths,
):  # fmt: skip
    """Draw paths; returns (status, t). moves : Metropolis-Hastings steps for each index."""
    n_steps, d, n = history.shape
    n_paths = paths.shape[2]
    c, s, s_later = np.empty(sizes[0]), np.empty(sizes[1]), np.empty(sizes[1])
    cumulative, first = np.empty(n), np.empty(n, dtype=np.int32)
    x, joined, joined_next = (
        np.empty((d, n_paths)), np.empty((d, n_paths)), np.empty((d, n_paths)),
    )  # fmt: skip
    log_now, log_new, part = np.empty(n_paths), np.empty(n_paths), np.empty(n_paths)
    index, proposed = np.empty(n_paths, dtype=np.int64), np.empty(n_paths, dtype=np.int64)
    prepare(theta, c)
    draw_last(history, weights, rng, index, paths)
    for back in range(n_steps - 1):
        t = n_steps - 2 - back
        step(theta, c, y, seen, u, t + 1, s)
        tabulate(weights[t], cumulative, first)
        for m in range(n_paths):
            index[m] = ancestry[t + 1, index[m]]
        for move in range(moves + 1):
            for m in range(n_paths):
                proposed[m] = index[m]
                if move > 0:
                    proposed[m] = draw_tabulated(cumulative, first, uniform(rng))
            take(history[t], proposed, x)
            continuation(
                theta, c, s, s_later, y, seen, u, t, x, paths, joined, joined_next, part, log_new
            )
            for m in range(n_paths):
                if log_new[m] != log_new[m]:
                    return NAN, t
                if move == 0:
                    log_now[m] = log_new[m]
                elif math.log(uniform(rng)) < log_new[m] - log_now[m]:
                    index[m], log_now[m] = proposed[m], log_new[m]
        take(history[t], index, paths[t])
    if horizon != 0:
        for t in range(1, n_steps):
            step(theta, c, y, seen, u, t, s)
            complete(theta, c, s, paths[t - 1], paths[t])
    return OK, n_steps


@exact
def backward_rejection(
    prepare, step, bound, weigh_connected, weigh_following, sizes,
    theta, y, seen, u, rng, history, weights, paths, tally,
):  # fmt: skip
    """Draw paths; returns (status, t).

    tally : (2,) raised by the number of proposals, and of indices drawn by the exact kernel.
    """
    n_steps, d, n = history.shape
    n_paths = paths.shape[2]
    c, s = np.empty(sizes[0]), np.empty(sizes[1])
    cumulative, first = np.empty(n), np.empty(n, dtype=np.int32)
    x, following = np.empty((d, n_paths)), np.empty((d, n_paths))
    log_f, log_bound = np.empty(n_paths), np.empty(n_paths)
    index, waiting = np.empty(n_paths, dtype=np.int64), np.empty(n_paths, dtype=np.int64)
    proposed, later = np.empty(n_paths, dtype=np.int64), np.empty(n_paths, dtype=np.int64)
    log_w, log_v, p, reference = np.empty(n), np.empty(n), np.empty(n), np.empty(d)
    prepare(theta, c)
    draw_last(history, weights, rng, index, paths)
    for back in range(n_steps - 1):
        t = n_steps - 2 - back
        step(theta, c, y, seen, u, t + 1, s)
        tabulate(weights[t], cumulative, first)
        for k in range(d):
            copy(paths[t + 1, k], following[k])
        bound(theta, c, s, following, log_bound)
        left = n_paths
        for m in range(n_paths):
            waiting[m], later[m] = m, index[m]
        accepted, tried = 1.0, 1.0
        while left > 0 and accepted * n > PRICE * tried:
            for r in range(left):
                proposed[r] = draw_tabulated(cumulative, first, uniform(rng))
            take(history[t], proposed[:left], x)
            weigh_connected(theta, c, s, x, following, log_f[:left])
            tally[0] += left
            accepted, tried = 0.5 * accepted, 0.5 * tried + left
            still = 0
            for r in range(left):
                if log_f[r] != log_f[r]:
                    return NAN, t
                if log_f[r] > log_bound[r] + SLACK * (1.0 + abs(log_bound[r])):
                    return ABOVE_BOUND, t
                if math.log(uniform(rng)) < log_f[r] - log_bound[r]:
                    index[waiting[r]] = proposed[r]
                    accepted += 1.0
                else:
                    waiting[still], log_bound[still] = waiting[r], log_bound[r]
                    for k in range(d):
                        following[k, still] = following[k, r]
                    still += 1
            left = still
        tally[1] += left
        for r in range(left):
            proposed[r] = later[waiting[r]]
        order = np.argsort(proposed[:left])
        take_log(weights[t], log_w)
        total = 0.0
        for q in range(left):
            r = order[q]
            if q == 0 or proposed[r] != proposed[order[q - 1]]:  # else the weights are the same
                for k in range(d):
                    reference[k] = following[k, r]
                weigh_following(theta, c, s, history[t], reference, log_v)
                add(log_v, log_w)
                total, status = relative_weights(log_v, p)
                if status != OK:
                    return status, t
            index[waiting[r]] = draw_relative(p, total, uniform(rng))
        take(history[t], index, paths[t])
    return OK, n_steps
