"""The mode of the noise of a whole trajectory, and Laplace's approximation of the likelihood there.

With x_1 = F_1(e_1), x_t = F_t(x_{t-1}, e_t) and e_t ~ N(0, I), the log density of noise and data is

    J(e) = sum_t log g(y_t | x_t) - e_t' e_t / 2        (+ constants),

and log p(y) is about J(e*) - log det(-J''(e*)) / 2 at its maximum e* (Tierney and Kadane 1986;
Skaug and Fournier 2006 for time series). Newton's method on e is differential dynamic programming
(Mayne 1966; Jacobson and Mayne 1970): a backward pass that eliminates e_T, e_{T-1}, ... from the
quadratic, with the second derivatives of F weighted by the costate, and a forward pass through the
exact model with the gains of the backward pass. The pivots of the elimination, M_t, are the blocks
of a factorisation of -J'', so that log det(-J'') is the sum of theirs. Where some M_t is not
positive definite the second derivatives of F, and the part of minus those of log g that is not
positive semidefinite, are left out of that step: Gauss and Newton's method.

Notation: D states, R noises of a transition and R_1 of the initial law, R' the larger, T rows.
"""

from __future__ import annotations

import math

import numpy as np

from ssmppl.codegen.kernels.math.copies import copy_rows
from ssmppl.codegen.kernels.math.flags import exact
from ssmppl.codegen.kernels.twisted.lookahead import lift
from ssmppl.codegen.kernels.twisted.lookahead_backward import factorise

PASSES = 60  # at most
# Nats that Newton's step would gain, from which it is the last: what is left after it is of the
# order of the square, so that the determinant, which moves with its root, is settled too.
ARRIVED = 1e-8
ROUNDING = 1e-13  # of J, relative
HALVINGS = 12  # of a step
ENOUGH = 1e-4  # share of the gain that the slope promises, for a step to be taken


@exact
def take_out(values, jacobian, spread, second):
    """dF / dx (D, D), dF / de (D, R) and the weighted second derivatives (D + R, D + R) out of a
    pass's values; those of the initial law have no dF / dx and are (R, R)."""
    d, r = spread.shape
    n, m = second.shape[0], 0
    if n > r:
        for i in range(d):
            for j in range(d):
                jacobian[i, j] = values[m, 0]
                m += 1
    for i in range(d):
        for j in range(r):
            spread[i, j] = values[m, 0]
            m += 1
    for i in range(n):
        for j in range(i + 1):
            second[i, j] = values[m, 0]
            second[j, i] = second[i, j]
            m += 1


@exact
def eliminate(a, g, e, jacobian, spread, second, curved, aim, gain, root, a_before, g_before, fa):
    """Take e_t out of the quadratic: (log det M, nats gained), inf and nan where M is no pivot.

    a (D, D), g (D,) : minus curvature and slope of what follows from x_t on. e (R,) : the noise.
    aim (R,), gain (R, D) : the step of e, and per unit of x_{t-1}; root (R, R) the lower factor of
    M; a_before, g_before : of what follows from x_{t-1} on, without row t - 1 itself; written.
    jacobian : (0, 0) for the initial law. fa (R + D, D) : room.
    """
    d, r = spread.shape
    before = jacobian.shape[0]
    at = before if curved else 0
    for k in range(r):
        for j in range(d):
            total = 0.0
            for i in range(d):
                total += spread[i, k] * a[i, j]
            fa[k, j] = total
    for k in range(r):
        for n in range(k + 1):
            total = 1.0 if k == n else 0.0
            for j in range(d):
                total += fa[k, j] * spread[j, n]
            if curved:
                total -= second[at + k, at + n]
            root[k, n] = total
            root[n, k] = total
        total = -e[k]
        for i in range(d):
            total += spread[i, k] * g[i]
        aim[k] = total
        for j in range(before):
            total = 0.0
            for i in range(d):
                total += fa[k, i] * jacobian[i, j]
            if curved:
                total -= second[at + k, j]
            gain[k, j] = total
    if not factorise(root):
        return np.inf, np.nan
    log_det = 0.0
    for k in range(r):
        log_det += 2.0 * math.log(root[k, k])
    for j in range(before):
        for i in range(d):
            total = 0.0
            for k in range(d):
                total += a[i, k] * jacobian[k, j]
            fa[r + j, i] = total
    for i in range(before):
        for j in range(i + 1):
            total = 0.0
            for k in range(d):
                total += jacobian[k, i] * fa[r + j, k]
            if curved:
                total -= second[i, j]
            a_before[i, j] = total
        total = 0.0
        for k in range(d):
            total += jacobian[k, i] * g[k]
        g_before[i] = total
    # Forward substitution only: with C C' = M, all that is needed are squares of C^-1 (q, N).
    gained = 0.0
    for k in range(r):
        for n in range(k):
            aim[k] -= root[k, n] * aim[n]
        aim[k] /= root[k, k]
        gained += 0.5 * aim[k] ** 2
    for j in range(before):
        for k in range(r):
            for n in range(k):
                gain[k, j] -= root[k, n] * gain[n, j]
            gain[k, j] /= root[k, k]
    for i in range(before):
        for k in range(r):
            g_before[i] -= gain[k, i] * aim[k]
        for j in range(i + 1):
            for k in range(r):
                a_before[i, j] -= gain[k, i] * gain[k, j]
            a_before[j, i] = a_before[i, j]
    for k in range(r - 1, -1, -1):  # back substitution: e's step is aim - gain dx
        for n in range(k + 1, r):
            aim[k] -= root[n, k] * aim[n]
            for j in range(before):
                gain[k, j] -= root[n, k] * gain[n, j]
        aim[k] /= root[k, k]
        for j in range(before):
            gain[k, j] /= root[k, k]
    return log_det, gained


@exact
def follow_step(begin, follow, look, theta, c, s, share, x_old, e_old, aim, gain, r, x, e, slopes):
    """The model with noise e = e_old + share aim - gain (x - x_old); returns J, -inf where it is
    no number.

    s (T, S) : what was computed once for each row. slopes (T, 1 + D + D (D + 1) / 2) : log g(y_t |
    x_t), its slope and minus its curvature, written beside x (T, D) and e (T, R').
    """
    n_steps, d = x.shape
    before, now = np.empty((d, 1)), np.empty((d, 1))
    values = np.zeros((slopes.shape[1], 1))
    total = 0.0
    for t in range(n_steps):
        for k in range(r[0] if t == 0 else r[1]):
            new = e_old[t, k] + share * aim[t, k]
            if t > 0:
                for j in range(d):
                    new -= gain[t, k, j] * (before[j, 0] - x_old[t - 1, j])
            e[t, k] = new
            total -= 0.5 * new**2
        if t == 0:
            begin(theta, c, s[t], e[t], now)
        else:
            follow(theta, c, s[t], before, e[t], now)
        look(theta, c, s[t], now, values)
        total += values[0, 0]
        if not abs(total) < np.inf:
            return -np.inf
        for i in range(d):
            x[t, i] = now[i, 0]
            before[i, 0] = now[i, 0]
        for m in range(slopes.shape[1]):
            slopes[t, m] = values[m, 0]
    return total


@exact
def eliminate_all(
    bend_initial, bend, theta, c, s, curved, r, x, e, slopes, aim, gain, root, jacobian, spread,
    information, costate,
):  # fmt: skip
    """The backward pass along a trajectory that follows the model: (log det, nats that the step
    gains), inf and nan where it comes to no number.

    curved : with all second derivatives; else those of Gauss and Newton's method. information (T,
    D, D), costate (T, D) : minus curvature and slope in x_t of row t and all that follows, written.
    """
    n_steps, d = x.shape
    widest = e.shape[1]
    values = np.zeros((d * d + d * widest + (d + widest) * (d + widest + 1) // 2, 1))
    values_first = np.zeros((d * widest + widest * (widest + 1) // 2, 1))
    both = np.empty(widest + d)
    before, now = np.empty((d, 1)), np.empty((d, 1))
    a, g, h = np.zeros((d, d)), np.zeros(d), np.empty((d, d))
    a_before, g_before = np.zeros((d, d)), np.zeros(d)
    fa = np.empty((widest + d, d))
    second = np.empty((d + r[1], d + r[1]))
    root_later, root_first = np.empty((r[1], r[1])), np.empty((r[0], r[0]))
    later, first = np.empty((d, r[1])), np.empty((d, r[0]))
    second_first, nowhere = np.empty((r[0], r[0])), np.empty((0, 0))
    log_det, gained = 0.0, 0.0
    for t in range(n_steps - 1, -1, -1):
        m = 1 + d
        for i in range(d):
            for j in range(i + 1):
                h[i, j] = slopes[t, m]
                h[j, i] = h[i, j]
                m += 1
        if not curved:
            lift(h)
        for i in range(d):
            g[i] = g_before[i] + slopes[t, 1 + i]
            costate[t, i] = g[i]
            now[i, 0] = x[t, i]
            for j in range(d):
                a[i, j] = a_before[i, j] + h[i, j]
                information[t, i, j] = a[i, j]
        n = r[0] if t == 0 else r[1]
        for k in range(n):
            both[k] = e[t, k]
        for i in range(d):
            both[n + i] = g[i]
        if t > 0:
            for i in range(d):
                before[i, 0] = x[t - 1, i]
            bend(theta, c, s[t], before, both, now, values)
            take_out(values, jacobian[t], later, second)
            part = eliminate(
                a, g, e[t], jacobian[t], later, second, curved, aim[t], gain[t], root_later,
                a_before, g_before, fa,
            )  # fmt: skip
            for k in range(n):
                for j in range(k + 1):
                    root[t, k, j] = root_later[k, j]
                for i in range(d):
                    spread[t, i, k] = later[i, k]
        else:
            bend_initial(theta, c, s[t], both, now, values_first)
            take_out(values_first, nowhere, first, second_first)
            part = eliminate(
                a, g, e[t], nowhere, first, second_first, curved, aim[t], gain[t], root_first,
                a_before, g_before, fa,
            )  # fmt: skip
            for k in range(n):
                for j in range(k + 1):
                    root[t, k, j] = root_first[k, j]
                for i in range(d):
                    spread[t, i, k] = first[i, k]
        if not abs(part[0]) < np.inf:
            return np.inf, np.nan
        log_det += part[0]
        gained += part[1]
    return log_det, gained


@exact
def gaussian_mode(
    prepare, step, follow_step, eliminate_all, sizes, theta, y, seen, u, r,
    x, e, aim, gain, root, jacobian, spread, information, costate,
):  # fmt: skip
    """(Laplace's log-likelihood less its constant, nats left to gain), by Newton's method from e.

    follow_step, eliminate_all : those above, of the model. r : numbers (R_1, R) of noises. e (T,
    R') : where it starts, and then the mode; x (T, D), aim (T, R'), gain (T, R', D), root (T, R',
    R'), jacobian (T, D, D), spread (T, D, R'), information (T, D, D) and costate (T, D) : there,
    written. -inf where the model or its curvature comes to no number; nan where the last trajectory
    is no maximum. The constant is none: g and the law of e are whole densities, and what e's lacks
    is what the integral gives.
    """
    n_steps, d = x.shape
    c, s = np.empty(sizes[0]), np.empty((n_steps, sizes[1]))
    x_new, e_new = np.empty_like(x), np.zeros_like(e)
    slopes = np.zeros((n_steps, 1 + d + d * (d + 1) // 2))
    slopes_new = np.zeros_like(slopes)
    prepare(theta, c)
    for t in range(n_steps):
        step(theta, c, y, seen, u, t, s[t])
    aim[:] = 0.0
    gain[:] = 0.0
    value = follow_step(theta, c, s, 0.0, x, e, aim, gain, r, x_new, e_new, slopes)
    if not value > -np.inf:
        return -np.inf, np.nan
    copy_rows(x_new, x)
    log_det, left, curved, last = np.inf, np.nan, True, False
    for _ in range(PASSES):
        curved = True
        log_det, left = eliminate_all(
            theta, c, s, True, r, x, e, slopes, aim, gain, root, jacobian, spread, information,
            costate,
        )  # fmt: skip
        if not left >= 0.0:
            curved = False
            log_det, left = eliminate_all(
                theta, c, s, False, r, x, e, slopes, aim, gain, root, jacobian, spread,
                information, costate,
            )  # fmt: skip
        if not left >= 0.0:
            return -np.inf, np.nan
        if last and curved:
            break
        last = left < ARRIVED
        share, moved = 1.0, False
        for _ in range(HALVINGS):
            new = follow_step(
                theta, c, s, share, x, e, aim, gain, r, x_new, e_new, slopes_new
            )  # fmt: skip
            if new >= value + ENOUGH * share * left - ROUNDING * abs(value):
                moved = True
                break
            share *= 0.5
        if not moved:
            break
        value = new
        copy_rows(x_new, x)
        copy_rows(e_new, e)
        copy_rows(slopes_new, slopes)
    if not curved:
        return np.nan, left
    return value - 0.5 * log_det, left
