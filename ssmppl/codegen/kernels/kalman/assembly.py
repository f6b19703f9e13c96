"""A linear Gaussian model's matrices put together from the values of their entries, and the
gradient from the adjoints of these.

The matrices of all rows stand in one array, one field of `Matrices` after the other. An entry is
described by whole numbers: where its value is (`FIXED`: a number, whatever theta is; `BY_THETA`:
in c, what depends on theta alone; `BY_ROW`: in s, what depends on the row too), the slot there, its
offset in row 0, and the distance between rows, 0 for a matrix that is one for all of them.
"""

from __future__ import annotations

import numpy as np

from ssmppl.codegen.kernels.math.flags import exact

FIXED, BY_THETA, BY_ROW = 0, 1, 2


@exact
def assemble(prepare, step, sizes, theta, y, seen, u, entries, flat):
    """Write the entries of every row into flat.

    entries (E, 4): place, slot, offset, distance; those of x_1 alone have distance 0, and are read
    in row 0.
    """
    n_steps = y.shape[0]
    c, s = np.empty(sizes[0]), np.empty(sizes[1])
    prepare(theta, c)
    varies = False
    for e in range(entries.shape[0]):
        place, slot, offset, distance = entries[e]
        if place == BY_THETA:
            for t in range(n_steps if distance > 0 else 1):
                flat[offset + t * distance] = c[slot]
        else:
            varies = varies or place == BY_ROW
    if not varies:
        return
    for t in range(n_steps):
        step(theta, c, y, seen, u, t, s)
        for e in range(entries.shape[0]):
            place, slot, offset, distance = entries[e]
            if place == BY_ROW and (t == 0 or distance > 0):
                flat[offset + t * distance] = s[slot]


@exact
def contract(prepare, step, sizes, theta, y, seen, u, slopes, values, adjoint, gradient):
    """Add to gradient (P,) the derivatives of the entries times the adjoints of these.

    slopes (E, 6): place, slot, offset, distance, the first row that counts, the parameter; values
    (E,): of those that are fixed. adjoint : as flat, of `assemble`.
    """
    n_steps = y.shape[0]
    c, s = np.empty(sizes[0]), np.empty(sizes[1])
    prepare(theta, c)
    varies = False
    for e in range(slopes.shape[0]):
        place, slot, offset, distance, first, parameter = slopes[e]
        if place == BY_ROW:
            varies = True
            continue
        if first >= n_steps:
            continue
        total = adjoint[offset]
        if distance > 0:
            total = 0.0
            for t in range(first, n_steps):
                total += adjoint[offset + t * distance]
        gradient[parameter] += total * (c[slot] if place == BY_THETA else values[e])
    if not varies:
        return
    for t in range(n_steps):
        step(theta, c, y, seen, u, t, s)
        for e in range(slopes.shape[0]):
            place, slot, offset, distance, first, parameter = slopes[e]
            if place == BY_ROW and t >= first and (t == 0 or distance > 0):
                gradient[parameter] += s[slot] * adjoint[offset + t * distance]
