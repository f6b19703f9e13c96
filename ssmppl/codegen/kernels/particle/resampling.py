"""Resampling: M ancestors from N normalised weights.

Shapes and symbols: w : (N,), non-negative, summing to 1 up to rounding.  ancestors :
(M + PADDING,) int32; ancestors[m] = j means that j is the ancestor of m, for m < M; the last
`PADDING` entries are scratch.  Every scheme is unbiased (E #{m : A_m = j} = M w_j), writes the
ancestors in increasing order (the conditional scheme: in cyclic order), fills every slot and
never chooses a particle of weight zero, whatever the rounding errors.

Each scheme goes once over the particles, adding up the weights, and asks *how many of the M
sorted points lie below the sum*.  For the systematic and the stratified scheme that is a
formula; j is then written to the next four slots whether it has offspring or not, the next
particle overwrites what was too much, and a loop runs only for more than four copies.  There is
no branch to mispredict, and the cost does not depend on the weights.

Systematic: J. Carpenter, P. Clifford, P. Fearnhead, *IEE Proc. Radar* 146 (1999).  Stratified:
G. Kitagawa, *J. Comp. Graph. Stat.* 5 (1996).  Residual: J. S. Liu, R. Chen, *JASA* 93 (1998).
Multinomial: sorted uniforms as normalised sums of exponentials, L. Devroye, *Non-Uniform Random
Variate Generation* (1986), V.3.  Compared by R. Douc, O. Cappé, E. Moulines, *Comparison of
resampling schemes for particle filtering* (2005).  Conditional: N. Chopin, S. S. Singh, *On
particle Gibbs sampling*, Bernoulli 21 (2015), section 4.
"""

from __future__ import annotations

import numpy as np

from ssmppl.codegen.kernels.math.elementary import log_normal_number
from ssmppl.codegen.kernels.math.flags import exact, kernel, precise
from ssmppl.codegen.kernels.math.random import uniform, word, word_uniform

SYSTEMATIC, STRATIFIED, RESIDUAL, MULTINOMIAL = 0, 1, 2, 3

PADDING = 4
"""How many entries `ancestors` has beyond the M that are asked for."""

_1 = np.uint64(1)
_2 = np.uint64(2)
_3 = np.uint64(3)
_4 = np.uint64(4)


@precise
def _floor_below(x, limit):
    """min(int(x), limit) for x >= 0; a NaN, too, gives `limit`, so no write leaves the array."""
    return np.uint64(np.int64(x)) if x < limit else np.uint64(limit)


@precise
def _place(ancestors, p, q, j):
    """Make j the ancestor of the slots p, ..., q - 1; slots up to p + 3 may be overwritten."""
    ancestors[p] = j
    ancestors[p + _1] = j
    ancestors[p + _2] = j
    ancestors[p + _3] = j
    p += _4
    while p < q:
        ancestors[p] = j
        p += _1


@exact
def last_positive(w):
    """Index of the last particle with a positive weight."""
    for i in range(w.size):
        j = w.size - 1 - i
        if w[j] > 0.0:
            return j
    return w.size - 1


@exact
def fill_slots(ancestors, p, end, j):
    """Make j the ancestor of the slots p, ..., end - 1."""
    for m in range(np.int64(p), end):
        ancestors[m] = j


@exact
def sweep(w, begin, end, scale, limit, s, p, ancestors):
    """Place the particles begin, ..., end - 1: after j, int(s + scale (w_begin + .. + w_j)) slots
    are full, at most `limit` of them.  Returns the new (s, p).

    Four particles at a time: then only one addition in four waits for the one before it.  The
    sums stay monotone in j under rounding, and equal where a weight is zero.
    """
    part = w[begin:end]
    n = np.uint64(end - begin)
    offset = np.uint64(begin)
    j = np.uint64(0)
    while j + _3 < n:
        a = scale * part[j]
        b = a + scale * part[j + _1]
        c = b + scale * part[j + _2]
        d = c + scale * part[j + _3]
        q0 = _floor_below(s + a, limit)
        q1 = _floor_below(s + b, limit)
        q2 = _floor_below(s + c, limit)
        s += d
        q3 = _floor_below(s, limit)
        _place(ancestors, p, q0, offset + j)
        _place(ancestors, q0, q1, offset + j + _1)
        _place(ancestors, q1, q2, offset + j + _2)
        _place(ancestors, q2, q3, offset + j + _3)
        p = q3
        j += _4
    while j < n:
        s += scale * part[j]
        q = _floor_below(s, limit)
        _place(ancestors, p, q, offset + j)
        p = q
        j += _1
    return s, p


@exact
def systematic(state, w, ancestors):
    """The points u, 1 + u, ..., M - 1 + u on the axis of M (w_1 + ... + w_j)."""
    m = ancestors.size - PADDING
    # k + u < s exactly if k < s - u: the number of such k is int(s + 1 - u).
    _, p = sweep(w, 0, w.size, float(m), m, 1.0 - uniform(state), np.uint64(0), ancestors)
    if p < m:
        fill_slots(ancestors, p, m, last_positive(w))


@exact
def stratified(state, w, ancestors):
    """The points k + u_k, one in each of M strata.  u_k is word k, whoever asks for it."""
    m = ancestors.size - PADDING
    key0, key1, start = state[0], state[1], state[2]
    s = 0.0
    p = np.uint64(0)
    for j in range(np.uint64(w.size)):
        s += m * w[j]
        k = _floor_below(s, m)
        below = word_uniform(word(key0, key1, start + k)) < s - np.float64(k)
        q = min(k + np.uint64(below), np.uint64(m))
        _place(ancestors, p, q, j)
        p = q
    state[2] = start + np.uint64(m)
    if p < m:
        fill_slots(ancestors, p, m, last_positive(w))


@precise
def _exponential(key0, key1, index):
    return -log_normal_number(word_uniform(word(key0, key1, index)))


@kernel
def _sum_exponentials(key0, key1, start, n):
    """Sum of the n exponentials that the words from `start` on make."""
    total = 0.0
    for i in range(n):
        total += _exponential(key0, key1, start + np.uint64(i))
    return total


@exact
def multinomial(state, w, ancestors):
    """M independent draws, sorted: the residual scheme without its deterministic part."""
    m = ancestors.size - PADDING
    _merge(state, w, 0.0, m, 1.0, ancestors)


@exact
def residual(state, w, ancestors):
    """int(M w_j) copies of j, and independent draws from the fractions that remain."""
    m = ancestors.size - PADDING
    copies = 0
    fractions = 0.0
    for j in range(w.size):
        x = m * w[j]
        whole = np.floor(x)
        copies += np.int64(_floor_below(whole, m))
        fractions += x - whole
    _merge(state, w, float(m), max(m - copies, 0), fractions, ancestors)


@exact
def _merge(state, w, scale, draws, total, ancestors):
    """int(scale w_j) copies of j each, and `draws` sorted points among the sums of what is left.

    What is left is the fraction of scale w_j, or w_j itself if scale = 0; its sum is `total`.
    The points are E_1 + ... + E_i over E_1 + ... + E_{draws + 1}; the exponentials are made
    twice from the same words, because their sum is needed first and there is nowhere to keep
    them.
    """
    m = ancestors.size - PADDING
    key0, key1, index = state[0], state[1], state[2]
    state[2] = index + np.uint64(draws + 1)
    unit = total / _sum_exponentials(key0, key1, index, draws + 1)
    point = unit * _exponential(key0, key1, index)
    left = draws
    s = 0.0
    p = 0
    for j in range(w.size):
        if scale > 0.0:
            x = scale * w[j]
            whole = np.floor(x)
            q = min(p + np.int64(_floor_below(whole, m)), m)
            s += x - whole
        else:
            q = p
            s += w[j]
        while point < s and left > 0:
            index += _1
            point += unit * _exponential(key0, key1, index)
            left -= 1
            q += 1
        q = min(q, m)
        fill_slots(ancestors, p, q, j)
        p = q
    if p < m:
        fill_slots(ancestors, p, m, last_positive(w))


@exact
def conditional_systematic(state, w, keep, ancestors):
    """Systematic resampling given that the ancestor of the last slot is `keep`.  M = N.

    The unconditional law is systematic resampling followed by a rotation of the slots by a
    uniform number, under which each A_m has the law w.  Given A_{N-1} = keep the point of the
    last slot, v, is uniform on the interval of `keep`, and the others follow at v + 1, v + 2,
    ... round the circle of length N.  So the sums start with what lies between v and the end
    of that interval, go on with keep + 1, ..., N - 1, 0, ..., keep - 1, and come back to `keep`,
    which takes all slots that remain and always the last one.
    """
    n = w.size
    scale = float(n)
    limit = n - 1
    s = uniform(state) * (scale * w[keep])
    p = _floor_below(s, limit)
    fill_slots(ancestors, 0, np.int64(p), keep)
    s, p = sweep(w, keep + 1, n, scale, limit, s, p, ancestors)
    s, p = sweep(w, 0, keep, scale, limit, s, p, ancestors)
    fill_slots(ancestors, p, n, keep)


@exact
def resample(scheme, state, w, ancestors):
    """Resample by the scheme with this code; see the module for shapes."""
    if scheme == SYSTEMATIC:
        systematic(state, w, ancestors)
    elif scheme == STRATIFIED:
        stratified(state, w, ancestors)
    elif scheme == RESIDUAL:
        residual(state, w, ancestors)
    else:
        multinomial(state, w, ancestors)
