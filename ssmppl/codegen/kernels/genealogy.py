"""What is kept of the particles of earlier steps, so that a path can be read off at the end.

Either everything, (T, D, N) values with (T, N) ancestors; or the tree of those particles that have
descendants: Jacob, Murray and Rubenthaler (2015), "Path storage in the particle filter",
*Statistics and Computing* 25, algorithms 1 to 3. Paths coalesce: the tree has T + O(N log N) nodes
on average, against T N. Writing a step down whole costs less than pruning the tree as long as all
of it is small, so the tree is taken where it is not (`DENSE`). Both give the same paths.
"""

from __future__ import annotations

import numpy as np

from ssmppl.codegen.kernels.flags import exact
from ssmppl.codegen.kernels.particle_filter import copy

# Numbers, of the particles of all steps, up to which everything is kept: 256 MiB, and half as much
# again for ancestors where there is one state.
DENSE = 1 << 25
FIRST = 4  # times N: nodes that a tree has room for at the beginning
UNUSED = -1  # a node's number of children where the node is free

FREE, CURSOR, ROW = 0, 1, 2  # in `counters`


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
