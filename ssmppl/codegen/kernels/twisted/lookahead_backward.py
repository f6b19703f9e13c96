"""The guide of the twisted particle filter, backward in time: about log p(y_{t:T} | x_t).

A backward pass over a model made linear along a reference trajectory, in information form. It
inverts I + L' A L only, so that states without noise and singular covariances are no trouble; each
step is a sum of squares, so that the information stays positive semidefinite. It knows no model,
and is compiled once for all. Notation as in `lookahead.py`.
"""

from __future__ import annotations

import math

import numpy as np

from ssmppl.codegen.kernels.math.flags import exact


@exact
def factorise(m):
    """Lower Cholesky factor in place of m, positive definite; False where it is not."""
    r = m.shape[0]
    for j in range(r):
        total = m[j, j]
        for k in range(j):
            total -= m[j, k] ** 2
        if not total > 0.0:
            return False
        m[j, j] = math.sqrt(total)
        for i in range(j + 1, r):
            total = m[i, j]
            for k in range(j):
                total -= m[i, k] * m[j, k]
            m[i, j] = total / m[j, j]
    return True


@exact
def solve(root, b, column):
    """b[:, column] <- (root root')^-1 b[:, column]."""
    r = root.shape[0]
    for i in range(r):
        total = b[i, column]
        for k in range(i):
            total -= root[i, k] * b[k, column]
        b[i, column] = total / root[i, i]
    for i in range(r - 1, -1, -1):
        total = b[i, column]
        for k in range(i + 1, r):
            total -= root[k, i] * b[k, column]
        b[i, column] = total / root[i, i]


@exact
def carry_information(
    a, g, away, jacobian, spread, aim, gain, a_before, g_before, la, m, left, al, bar, pull
):  # fmt: skip
    """One step back: from psi_t to what x_{t-1} can expect of it; False where it is no number.

    a (D, D), g (D,) : of psi_t about its centre. away (D,) : rest less that centre. aim (R',), gain
    (R', D) : e at the old x_{t-1}, and for each unit away from it; R of the rows are written, as
    are a_before and g_before. la (R, D), m (R, R), left, al, bar (D, D), pull (D,) : room to work
    in, which would cost more to find anew at every step than the step itself.
    """
    d, r = spread.shape
    # la: L' A
    for k in range(r):
        for j in range(d):
            total = 0.0
            for i in range(d):
                total += spread[i, k] * a[i, j]
            la[k, j] = total
    for k in range(r):
        for n in range(r):
            total = 1.0 if k == n else 0.0
            for j in range(d):
                total += la[k, j] * spread[j, n]
            m[k, n] = total
    if not factorise(m):
        return False
    for k in range(r):
        total = 0.0
        for i in range(d):
            total += spread[i, k] * g[i]
        for j in range(d):
            total -= la[k, j] * away[j]
        gain[k, 0] = total
    solve(m, gain, 0)
    for k in range(r):
        aim[k] = gain[k, 0]
    for j in range(d):
        solve(m, la, j)  # la <- (I + L'AL)^-1 L' A, the noise that takes a unit of `away` back
    # left = I - L la; the information of both the rest and the noise, each a square
    for i in range(d):
        for j in range(d):
            total = 1.0 if i == j else 0.0
            for k in range(r):
                total -= spread[i, k] * la[k, j]
            left[i, j] = total
    for i in range(d):
        for j in range(d):
            total = 0.0
            for k in range(d):
                total += a[i, k] * left[k, j]
            al[i, j] = total
    for i in range(d):
        for j in range(i + 1):
            total = 0.0
            for k in range(d):
                total += left[k, i] * al[k, j]
            for k in range(r):
                total += la[k, i] * la[k, j]
            bar[i, j] = total
            bar[j, i] = total
    for i in range(d):
        total = 0.0
        for k in range(d):
            total += left[k, i] * g[k]
        for j in range(d):
            total -= bar[i, j] * away[j]
        pull[i] = total
    for i in range(d):
        for j in range(d):
            total = 0.0
            for k in range(d):
                total += bar[i, k] * jacobian[k, j]
            al[i, j] = total
    for k in range(r):
        for j in range(d):
            total = 0.0
            for i in range(d):
                total -= la[k, i] * jacobian[i, j]
            gain[k, j] = total
    for i in range(d):
        for j in range(i + 1):
            total = 0.0
            for k in range(d):
                total += jacobian[k, i] * al[k, j]
            a_before[i, j] = total
            a_before[j, i] = total
        total = 0.0
        for k in range(d):
            total += jacobian[k, i] * pull[k]
        g_before[i] = total
    return True


@exact
def look_back(x, rest, jacobian, spread, spread_initial, g, h, horizon, a, pull, aim, gain):
    """The guide and the gains along a reference x; False where it comes to no number.

    horizon : rows after which the guide starts anew, blind to what comes later; 0: never.
    a (T, D, D), pull (T, D) : of psi_t about x_t, written, as are aim (T, R') and gain (T, R', D).
    """
    n_steps, d = x.shape
    away, nowhere = np.empty(d), np.zeros((d, d))
    a_next, g_next = np.zeros((d, d)), np.zeros(d)
    r, r_initial = spread.shape[2], spread_initial.shape[1]
    la, m = np.empty((r, d)), np.empty((r, r))
    la_initial, m_initial = np.empty((r_initial, d)), np.empty((r_initial, r_initial))
    left, al, bar, room = np.empty((d, d)), np.empty((d, d)), np.empty((d, d)), np.empty(d)
    for t in range(n_steps - 1, -1, -1):
        blind = t == n_steps - 1 or (horizon > 0 and (t + 1) % horizon == 0)
        for i in range(d):
            pull[t, i] = g[t, i] + (0.0 if blind else g_next[i])
            away[i] = rest[t, i] - x[t, i]
            for j in range(d):
                a[t, i, j] = h[t, i, j] + (0.0 if blind else a_next[i, j])
        if t > 0:
            fine = carry_information(
                a[t], pull[t], away, jacobian[t], spread[t], aim[t], gain[t], a_next, g_next,
                la, m, left, al, bar, room,
            )  # fmt: skip
        else:
            fine = carry_information(
                a[t], pull[t], away, nowhere, spread_initial, aim[t], gain[t], a_next, g_next,
                la_initial, m_initial, left, al, bar, room,
            )  # fmt: skip
        if not fine:
            return False
    return True


@exact
def look_back_scalar(x, rest, jacobian, spread, spread_initial, g, h, a, pull):
    """`look_back` for one state with one noise, where its matrices are numbers."""
    a_next, g_next = 0.0, 0.0
    for t in range(x.shape[0] - 1, -1, -1):
        a[t, 0, 0] = h[t, 0, 0] + a_next
        pull[t, 0] = g[t, 0] + g_next
        size = spread[t, 0, 0] if t > 0 else spread_initial[0, 0]
        left = 1.0 / (1.0 + size * size * a[t, 0, 0])
        bar = left * a[t, 0, 0]
        g_next = jacobian[t, 0, 0] * (left * pull[t, 0] - bar * (rest[t, 0] - x[t, 0]))
        a_next = jacobian[t, 0, 0] * jacobian[t, 0, 0] * bar
    return abs(a[0, 0, 0]) < np.inf and abs(pull[0, 0]) < np.inf


@exact
def look_back_each(first, x, rest, jacobian, spread, spread_initial, g, h, a, pull, aim, gain):
    """`look_back` over E data sets end to end, that of number e in the rows first[e], ...,
    first[e + 1] - 1; spread_initial : (E, D, R_1)."""
    for e in range(first.size - 1):
        i, j = first[e], first[e + 1]
        if not look_back(
            x[i:j], rest[i:j], jacobian[i:j], spread[i:j], spread_initial[e], g[i:j], h[i:j], 0,
            a[i:j], pull[i:j], aim[i:j], gain[i:j],
        ):  # fmt: skip
            return False
    return True


@exact
def look_back_scalar_each(first, x, rest, jacobian, spread, spread_initial, g, h, a, pull):
    """`look_back_scalar` likewise."""
    for e in range(first.size - 1):
        i, j = first[e], first[e + 1]
        if not look_back_scalar(
            x[i:j], rest[i:j], jacobian[i:j], spread[i:j], spread_initial[e], g[i:j], h[i:j],
            a[i:j], pull[i:j],
        ):  # fmt: skip
            return False
    return True


@exact
def write_guide(a, pull, x, u, aim, spread_initial, out):
    """out (T, U + G): the inputs, then each row's guide; False where its start is no number.

    The lower half of A, g and the centre in every row; in the first also the mean `aim` of the
    noise of x_1 and the lower factor of its precision.
    """
    n_steps, d = x.shape
    r = spread_initial.shape[1]
    m = np.empty((r, r))
    for k in range(r):
        for n in range(r):
            total = 1.0 if k == n else 0.0
            for i in range(d):
                for j in range(d):
                    total += spread_initial[i, k] * a[0, i, j] * spread_initial[j, n]
            m[k, n] = total
    if not factorise(m):
        return False
    at = u.shape[1] + d * (d + 1) // 2 + 2 * d
    for k in range(r):
        out[0, at + k] = aim[k]
    at += r
    for k in range(r):
        for n in range(k + 1):
            out[0, at] = m[k, n]
            at += 1
    for t in range(n_steps):
        for i in range(u.shape[1]):
            out[t, i] = u[t, i]
        at = u.shape[1]
        for i in range(d):
            for j in range(i + 1):
                out[t, at] = a[t, i, j]
                at += 1
        for i in range(d):
            out[t, at + i] = pull[t, i]
            out[t, at + d + i] = x[t, i]
    return True
