"""Filters that keep paths: conditional SMC with ancestor sampling, and a filter with one path.

`conditional_smc`, the kernel of PGAS: algorithm 3 of Lindsten, Jordan and Schön (2014), "Particle
Gibbs with ancestor sampling" (in Schön et al. 2015, algorithm 7): particle N follows the reference
trajectory; its ancestor is drawn anew at every step with probability proportional to
w_{t-1} f(x'_t | x_{t-1}). The other ancestors are drawn given that one by conditional systematic
resampling (Chopin and Singh 2015), which has the same marginals as independent draws, so the kernel
leaves p(x_{1:T} | y_{1:T}, theta) invariant for every N >= 2. It draws the new trajectory among the
N ancestral paths by their final weights; so under the invariant law the weighted mean of a function
over all N paths has the expectation of the function of the one that was drawn, with less variance.
Particle SAEM averages so (Lindsten 2013; Schön et al. 2015, equation for its approximation of Q).

Deterministic (Dirac) components of the reference are those that follow from its noisy components
and the new ancestor. Where they forget the ancestor within `horizon` steps, the weights take the
densities of these steps in (section 7.1 there); where they never do, `horizon` is -1 and no
ancestor is sampled: particle Gibbs as in Andrieu, Doucet and Holenstein (2010).

Where parameters are `eliminated` (`analysis/elimination/elimination.py`; Wigren, Risuleo, Murray
and Lindsten 2019), particles carry their running statistics as further deterministic components,
which `statistics_by_row` tells of a trajectory. These never forget the ancestor, but add up: what
all later rows of the reference are worth given an ancestor's statistics is one number,
`weigh_future`.

A genealogy is what is kept of the particles of earlier steps, so that a path can be read off at the
end: either everything, (T, D, N) values with (T, N) ancestors; or the tree of those particles that
have descendants: Jacob, Murray and Rubenthaler (2015), "Path storage in the particle filter",
*Statistics and Computing* 25, algorithms 1 to 3. Paths coalesce: the tree has T + O(N log N) nodes
on average, against T N. Writing a step down whole costs less than pruning the tree as long as all
of it is small, so the tree is taken where it is not (`DENSE`). Both give the same paths.

Notation: N particles, T steps; x : (D, N); reference, trajectory : (T, D); w : (N,).
"""

from __future__ import annotations

import math

import numpy as np

from ssmppl.codegen.kernels.math.flags import exact
from ssmppl.codegen.kernels.math.random import fill_normal, fill_uniform, uniform
from ssmppl.codegen.kernels.particle.particle_filter import (
    NO_LOOK_AHEAD,
    add,
    copy,
    descend,
    gather,
    look_ahead_weights,
    move,
    resampling_weights,
    second_stage,
    weigh_row,
)
from ssmppl.codegen.kernels.particle.resampling import PADDING, conditional_systematic, systematic
from ssmppl.codegen.kernels.particle.weights import OK, draw_relative, relative_weights, rule_out

# Numbers, of the particles of all steps, up to which everything is kept: 256 MiB, and half as much
# again for ancestors where there is one state.
DENSE = 1 << 25
FIRST = 4  # times N: nodes that a tree has room for at the beginning
UNUSED = -1  # a node's number of children where the node is free

FREE, CURSOR, ROW = 0, 1, 2  # in `counters`
JOINING = 8
"""Added to a status of the weights by which the reference's ancestor into row t is drawn."""


@exact
def statistics_by_row(
    prepare, step, initial_statistics, transition_statistics, observed_statistics, sizes,
    theta, y, seen, u, trajectory, moved, measured,
):  # fmt: skip
    """moved[t] (K,) : of x_t given x_{t-1}, at row 0 of x_1; measured[t] (K,) : of y_t given x_t.

    trajectory : (T, D).
    """
    n_steps, d = trajectory.shape
    c, s = np.empty(sizes[0]), np.empty(sizes[1])
    x_prev, x, row = np.empty((d, 1)), np.empty((d, 1)), np.empty((moved.shape[1], 1))
    prepare(theta, c)
    for t in range(n_steps):
        step(theta, c, y, seen, u, t, s)
        for i in range(d):
            x_prev[i, 0] = x[i, 0]
            x[i, 0] = trajectory[t, i]
        if t == 0:
            initial_statistics(theta, c, s, x, row)
        else:
            transition_statistics(theta, c, s, x_prev, x, row)
        copy(row[:, 0], moved[t])
        observed_statistics(theta, c, s, x, row)
        copy(row[:, 0], measured[t])


@exact
def open_genealogy(n_steps, d, n, dense):
    """(values (T, D, N), ancestors (T, N), tree) with room for what is to come.

    dense : numbers up to which everything is kept; beyond, the first two are empty.
    tree : values (nodes, D), parents and numbers of children (nodes,), leaves (2, N), and counters
    (3,): how many nodes are free, where the next one is looked for, which row of `leaves` holds.
    """
    kept = n_steps if n_steps * d * n <= dense else 0
    room = FIRST * n if kept == 0 else 0
    children = np.empty(room, dtype=np.int32)
    for k in range(room):
        children[k] = UNUSED
    counters = np.zeros(3, dtype=np.int64)
    counters[FREE] = room
    tree = (
        np.empty((room, d)), np.empty(room, dtype=np.int32), children,
        np.empty((2, n if kept == 0 else 0), dtype=np.int32), counters,
    )  # fmt: skip
    return np.empty((kept, d, n)), np.empty((kept, n), dtype=np.int32), tree


@exact
def remember(genealogy, t, x, ancestors):
    """The genealogy with step t, to be used from here on: x (D, N), whose particle i descends from
    `ancestors[i]` of step t - 1."""
    values, ancestry, tree = genealogy
    if values.shape[0] > 0:
        for m in range(x.shape[0]):
            copy(x[m], values[t, m])
        if t > 0:
            copy(ancestors, ancestry[t])
        return genealogy
    leaves, counters = tree[3], tree[4]
    n, d = leaves.shape[1], x.shape[0]
    if t > 0:
        _prune(tree, ancestors)
    # a quarter free, so that the search below looks at four nodes for one, on average
    while counters[FREE] < n + tree[1].size // 4:
        tree = _with_twice_the_room(tree)
    nodes, parents, children = tree[0], tree[1], tree[2]
    old, new = leaves[counters[ROW]], leaves[1 - counters[ROW]]
    at = counters[CURSOR]
    for i in range(n):  # in the order of memory, and so are the steps that follow
        while children[at] != UNUSED:
            at = at + 1 if at + 1 < children.size else 0
        new[i] = at
        parents[at] = old[ancestors[i]] if t > 0 else -1
        children[at] = 0
        for m in range(d):
            nodes[at, m] = x[m, i]
    counters[FREE] -= n
    counters[CURSOR] = at
    counters[ROW] = 1 - counters[ROW]
    return values, ancestry, tree


@exact
def recall(genealogy, k, path):
    """Write the path (T, D) that ends in particle k of the last step."""
    values, ancestry, tree = genealogy
    if values.shape[0] > 0:
        ancestral_path(values, ancestry, k, path)
        return
    n_steps, d = path.shape
    nodes, parents, leaves, counters = tree[0], tree[1], tree[3], tree[4]
    at = leaves[counters[ROW], k]
    for back in range(n_steps):
        for m in range(d):
            path[n_steps - 1 - back, m] = nodes[at, m]
        at = parents[at]


@exact
def ancestral_path(values, ancestry, k, path):
    """Write the path (T, D) that ends in particle k of the last step, where everything was kept."""
    n_steps, d = path.shape
    for back in range(n_steps):
        t = n_steps - 1 - back
        for m in range(d):
            path[t, m] = values[t, m, k]
        if t > 0:
            k = ancestry[t, k]


@exact
def _prune(tree, ancestors):
    """Free the leaves without children, and all whose descendants have died with them."""
    parents, children, leaves, counters = tree[1], tree[2], tree[3], tree[4]
    row = leaves[counters[ROW]]
    for i in range(row.size):
        children[row[ancestors[i]]] += 1
    for i in range(row.size):
        k = row[i]
        while k >= 0 and children[k] == 0:
            children[k] = UNUSED
            counters[FREE] += 1
            k = parents[k]
            if k >= 0:
                children[k] -= 1


@exact
def _with_twice_the_room(tree):
    nodes, parents, children, leaves, counters = tree
    room, d = nodes.shape
    more_nodes = np.empty((2 * room, d))
    more_parents = np.empty(2 * room, dtype=np.int32)
    more_children = np.empty(2 * room, dtype=np.int32)
    for k in range(room):
        more_parents[k], more_children[k] = parents[k], children[k]
        more_children[room + k] = UNUSED
        for m in range(d):
            more_nodes[k, m] = nodes[k, m]
    counters[FREE] += room
    counters[CURSOR] = room
    return more_nodes, more_parents, more_children, leaves, counters


@exact
def draw_index(w, u):
    """Index j with probability w[j], from one uniform; never one of weight zero."""
    total, last = 0.0, -1
    for j in range(w.size):
        if w[j] > 0.0:
            total += w[j]
            last = j
            if u < total:
                return j
    return last


@exact
def conditional_smc(
    prepare, step, draw_initial, weigh_initial, fit, look_ahead, draw, weigh,
    connect, weigh_connected, weigh_observed, weigh_future, sizes, ahead, horizon, eliminated,
    theta, y, seen, u, particles, rng, reference, trajectory, statistics, paths=None, weights=None,
):  # fmt: skip
    """One sweep from `reference` to `trajectory`; returns (status, t), the status also raised by
    `JOINING`.

    statistics : (2,), written: the share of steps at which the trajectory changed, and the mean
    effective sample size as a share of N. paths, weights : (N, T, D) and (N,), written where given:
    all ancestral paths and their weights, by which the trajectory is drawn.
    """
    n_steps, n, d = y.shape[0], particles, reference.shape[1]
    c, s, s_later = np.empty(sizes[0]), np.empty(sizes[1]), np.empty(sizes[1])
    genealogy = open_genealogy(n_steps, d, n, DENSE)
    x, x_before, x_prev = np.empty((d, n)), np.empty((d, n)), np.empty((d, n))
    joined, joined_next = np.empty((d, n)), np.empty((d, n))
    before, own = np.empty((d, 1)), np.empty((d, 1))
    fits, fits_prev = np.empty((sizes[5], n)), np.empty((sizes[5], n))
    normals, uniforms = np.empty(sizes[3] * n), np.empty(sizes[4] * n)
    log_v, log_base, part = np.empty(n), np.empty(n), np.empty(n)
    w, p = np.empty(n), np.empty(n)
    ancestors = np.empty(n + PADDING, dtype=np.int32)
    last, ess_total = n - 1, 0.0
    prepare(theta, c)
    for t in range(n_steps):
        step(theta, c, y, seen, u, t, s)
        x, x_before = x_before, x
        if t == 0:
            fill_normal(rng, normals)
            if sizes[4] > 0:
                fill_uniform(rng, uniforms)
            draw_initial(theta, c, s, x, normals, uniforms, rng)
            for k in range(d):
                x[k, last] = reference[0, k]
            weigh_initial(theta, c, s, x, log_v)
        else:
            # the ancestor of the reference
            keep = last
            if horizon >= 0:
                log_base, log_v = log_v, log_base
                connect(theta, c, s, x_before, reference[t], joined)
                weigh_connected(theta, c, s, x_before, joined, log_v)
                add(log_v, log_base)
                if horizon > 0:
                    weigh_observed(theta, c, s, joined, part)
                    rule_out(part)
                    add(log_v, part)
                for ahead_by in range(1, min(horizon, n_steps - 1 - t) + 1):
                    step(theta, c, y, seen, u, t + ahead_by, s_later)
                    connect(theta, c, s_later, joined, reference[t + ahead_by], joined_next)
                    weigh_connected(theta, c, s_later, joined, joined_next, part)
                    rule_out(part)
                    add(log_v, part)
                    weigh_observed(theta, c, s_later, joined_next, part)
                    rule_out(part)
                    add(log_v, part)
                    joined, joined_next = joined_next, joined
                if eliminated:
                    weigh_future(theta, c, s, x_before, joined, part)
                    add(log_v, part)
                total, status = relative_weights(log_v, p)
                if status != OK:
                    return JOINING + status, t
                keep = draw_relative(p, total, uniform(rng))
            # all others, given that one
            if ahead != NO_LOOK_AHEAD:
                if sizes[5] > 0:
                    fit(theta, c, s, x_before, fits_prev)
                look_ahead(theta, c, s, x_before, fits_prev, log_v)
                _, status = look_ahead_weights(log_v, w, log_base, ahead, p)
                if status != OK:
                    return status, t
            else:
                copy(w, p)
            conditional_systematic(rng, p, keep, ancestors)
            gather(x_before, ancestors, x_prev)
            if sizes[5] > 0:
                if ahead != NO_LOOK_AHEAD:
                    gather(fits_prev, ancestors, fits)
                else:
                    fit(theta, c, s, x_prev, fits)
            fill_normal(rng, normals)
            if sizes[4] > 0:
                fill_uniform(rng, uniforms)
            draw(theta, c, s, x_prev, fits, x, normals, uniforms, rng)
            for k in range(d):
                before[k, 0] = x_prev[k, last]
            connect(theta, c, s, before, reference[t], own)
            for k in range(d):
                x[k, last] = own[k, 0]
            weigh(theta, c, s, x_prev, fits, x, log_v)
            if ahead != NO_LOOK_AHEAD:
                second_stage(w, p, ancestors, part, log_base)
                add(log_v, log_base)
        genealogy = remember(genealogy, t, x, ancestors)
        _, ess, status = weigh_row(log_v, w)
        if status != OK:
            return status, t
        ess_total += ess
    if paths is not None:
        copy(w, weights)
        for i in range(n):
            recall(genealogy, i, paths[i])
    recall(genealogy, draw_index(w, uniform(rng)), trajectory)
    changed = 0
    for t in range(n_steps):
        different = False
        for m in range(d):
            different = different or trajectory[t, m] != reference[t, m]
        changed += 1 if different else 0
    statistics[0] = changed / n_steps
    statistics[1] = ess_total / (n_steps * n)
    return OK, n_steps


@exact
def filtered_path(
    prepare, step, draw_initial, weigh_initial, fit, look_ahead, draw, weigh, sizes, ahead,
    theta, y, seen, u, particles, rng, trajectory, log_increment, kept=None,
):  # fmt: skip
    """A particle filter that keeps one ancestral path; returns (status, t, log Z).

    What PMMH needs (Andrieu, Doucet and Holenstein 2010, section 2.4.2): the likelihood estimate
    and, drawn by the final weights, a path of the same run. Systematic resampling at every step.
    kept : None, or the whole particle system, written, as of `particle_filter`.
    """
    n_steps, n, d = y.shape[0], particles, trajectory.shape[1]
    c, s = np.empty(sizes[0]), np.empty(sizes[1])
    if kept is None:
        genealogy = open_genealogy(n_steps, d, n, DENSE)
    else:
        genealogy = (kept[0], kept[2], open_genealogy(0, d, 0, 0)[2])
    x, x_before, x_prev = np.empty((d, n)), np.empty((d, n)), np.empty((d, n))
    fits, fits_prev = np.empty((sizes[5], n)), np.empty((sizes[5], n))
    normals, uniforms = np.empty(sizes[3] * n), np.empty(sizes[4] * n)
    log_v, log_base, part = np.empty(n), np.empty(n), np.empty(n)
    w, p = np.empty(n), np.empty(n)
    ancestors = np.empty(n + PADDING, dtype=np.int32)
    log_increment[:] = 0.0
    prepare(theta, c)
    for t in range(n_steps):
        step(theta, c, y, seen, u, t, s)
        x, x_before = x_before, x
        if t > 0:
            status = resampling_weights(
                fit, look_ahead, theta, c, s, x_before, fits_prev, w, ahead, log_v, log_base, p
            )
            if status != OK:
                return status, t, -np.inf
            systematic(rng, p, ancestors)
            descend(fit, theta, c, s, x_before, fits_prev, ancestors, ahead, x_prev, fits)
        move(
            draw_initial, weigh_initial, draw, weigh, theta, c, s, t, x_prev, fits, x, log_v,
            normals, uniforms, rng,
        )  # fmt: skip
        if ahead != NO_LOOK_AHEAD:
            if t > 0:
                second_stage(w, p, ancestors, part, log_base)
                add(log_v, log_base)
                log_increment[t] = math.log(n)  # the second-stage weights hold 1 / N already
        genealogy = remember(genealogy, t, x, ancestors)
        log_sum, _, status = weigh_row(log_v, w)
        if status != OK:
            return status, t, -np.inf
        log_increment[t] += log_sum - math.log(n)
        if kept is not None:
            copy(w, kept[1][t])
    recall(genealogy, draw_index(w, uniform(rng)), trajectory)
    return OK, n_steps, log_increment.sum()
