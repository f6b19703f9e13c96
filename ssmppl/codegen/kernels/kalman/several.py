"""Filters and draws over several data sets of one model, whose matrices are the same in all rows.

What is not known of the states depends on which rows are measured, not on what was measured in
them: data sets that miss what the longest one does take its arrays, and go on with their means
alone. Most panels miss nothing, and so pay for one filter and many means.

Data sets stand end to end, as in `inference.run.problem.EndToEnd`: that of number e has the rows
first[e], ..., first[e + 1] - 1 of R.
"""

from __future__ import annotations

import numpy as np

from ssmppl.codegen.kernels.kalman.adjoint import filter_forward, means_forward
from ssmppl.codegen.kernels.kalman.correction import draw_by_correction
from ssmppl.codegen.kernels.kalman.square_root import OK, same
from ssmppl.codegen.kernels.math.flags import exact


@exact
def misses_alike(seen, other):
    """Whether a record (T, K) misses what another one of at least as many rows does."""
    for t in range(seen.shape[0]):
        if not same(seen[t], other[t]):
            return False
    return True


@exact
def longest_of(first):
    """The data set of the most rows, and how many these are."""
    chosen, most = 0, 0
    for e in range(first.size - 1):
        if first[e + 1] - first[e] > most:
            chosen, most = e, first[e + 1] - first[e]
    return chosen, most


@exact
def draws_by_correction(model, start, y, seen, first, stream, out):
    """One draw of the states of each data set; returns (status, e), of the first whose status is
    other than OK. start, stream : as of `draw_by_correction`. out (R, D), written."""
    n, k_all, (chosen, most) = start.shape[0], y.shape[1], longest_of(first)
    kept, roots = np.empty((most, k_all, k_all + n)), np.empty((most, n, n))
    own, own_roots = np.empty((most, k_all, k_all + n)), np.empty((most, n, n))
    pattern = seen[first[chosen] : first[chosen + 1]]
    for step in range(-1, first.size - 1):
        e = chosen if step < 0 else step
        if step == chosen:
            continue
        a, b = first[e], first[e + 1]
        if step < 0 or misses_alike(seen[a:b], pattern):
            status, _ = draw_by_correction(
                model, start, y[a:b], seen[a:b], stream, step >= 0, kept, roots, out[a:b]
            )  # fmt: skip
        else:
            status, _ = draw_by_correction(
                model, start, y[a:b], seen[a:b], stream, False, own, own_roots, out[a:b]
            )  # fmt: skip
        if status != OK:
            return status, e
    return OK, first.size - 1


@exact
def log_likelihoods(model, start, y, seen, first, log_increment):
    """The filter over each data set; log_increment (R,), written, -inf from where one stops."""
    (n, columns), k_all, (chosen, most) = start.shape, y.shape[1], longest_of(first)
    x, z, nothing = (
        np.empty((most, n, columns)), np.empty((most, k_all, columns)), np.empty((0, n, n))
    )  # fmt: skip
    kept, own = np.empty((most, k_all, k_all + n)), np.empty((most, k_all, k_all + n))
    pattern = seen[first[chosen] : first[chosen + 1]]
    sound = False
    for step in range(-1, first.size - 1):
        e = chosen if step < 0 else step
        if step == chosen:
            continue
        a, b = first[e], first[e + 1]
        if step < 0:
            status, _ = filter_forward(
                model, start, y[a:b], seen[a:b], x, kept, z, nothing, log_increment[a:b]
            )  # fmt: skip
            sound = status == OK
        elif sound and misses_alike(seen[a:b], pattern):
            means_forward(model, start, y[a:b], seen[a:b], x, kept, z, log_increment[a:b])
        else:
            filter_forward(
                model, start, y[a:b], seen[a:b], x, own, z, nothing, log_increment[a:b]
            )  # fmt: skip
