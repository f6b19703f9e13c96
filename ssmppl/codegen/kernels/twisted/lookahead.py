"""The guide of the twisted particle filter, forward in time: trajectories to linearise along.

The mode of the noise of a whole trajectory is found as in differential dynamic programming: a
reference trajectory, first that of an extended Kalman filter; a backward pass over the model made
linear along it (`lookahead_backward.py`); a forward pass that follows the exact model with the
gains of the backward pass; and so on until the density stops growing. (B. M. Bell, "The iterated
Kalman smoother as a Gauss-Newton method", *SIAM J. Optimization* 4, 1994, for the equivalence; W.
Li and E. Todorov, "Iterative linear quadratic regulator design", 2004, for the forward pass with
gains.)

The part of minus the second derivatives of log g that is not positive semidefinite is left out.

Notation: D states, R noises, T rows; x_t = F(x_{t-1}, e_t), e_t ~ N(0, I); `rest` F at e = 0, J and
L its derivatives there in x_{t-1} and e; g, H slope of log g(y_t | .) and minus its curvature.
"""

from __future__ import annotations

import math

import numpy as np

from ssmppl.codegen.kernels.math.flags import exact

NEWTON_STEPS = 10  # at most, of the filter's update where the curvature varies
HALVINGS = 40  # of one of them, until the density grows: a slope can lead a thousand sds astray
CLOSE = 0.05  # nats of improvement with which they end
RESOLVED = 1e-13  # of a predicted variance, below which the variance after is mostly rounding
SWEEPS = 12  # of Jacobi's method; a handful suffice
ROUND = 1e-14


@exact
def lift(h):
    """h (D, D) <- its positive semidefinite part, by Jacobi's method; h is symmetric."""
    d = h.shape[0]
    if d == 1:
        h[0, 0] = max(h[0, 0], 0.0)
        return
    v = np.eye(d)
    a = h.copy()
    for _ in range(SWEEPS):
        off, size = 0.0, 0.0
        for i in range(d):
            size += a[i, i] ** 2
            for j in range(i):
                off += a[i, j] ** 2
        if off <= ROUND**2 * (size + off):
            break
        for p in range(d):
            for q in range(p + 1, d):
                if a[p, q] == 0.0:
                    continue
                ratio = (a[q, q] - a[p, p]) / (2.0 * a[p, q])
                t = 1.0 / (abs(ratio) + math.sqrt(1.0 + ratio * ratio))
                t = t if ratio >= 0.0 else -t
                c = 1.0 / math.sqrt(1.0 + t * t)
                s = t * c
                for k in range(d):
                    akp, akq = a[k, p], a[k, q]
                    a[k, p], a[k, q] = c * akp - s * akq, s * akp + c * akq
                for k in range(d):
                    apk, aqk = a[p, k], a[q, k]
                    a[p, k], a[q, k] = c * apk - s * aqk, s * apk + c * aqk
                    vkp, vkq = v[k, p], v[k, q]
                    v[k, p], v[k, q] = c * vkp - s * vkq, s * vkp + c * vkq
    negative = False
    for i in range(d):
        negative = negative or a[i, i] < 0.0
    if not negative:
        return
    for i in range(d):
        for j in range(i + 1):
            total = 0.0
            for k in range(d):
                if a[k, k] > 0.0:
                    total += v[i, k] * a[k, k] * v[j, k]
            h[i, j] = total
            h[j, i] = total


@exact
def update(p, h, g, toward, z, step):
    """One step of an extended Kalman update in information form.

    p (D, D) : covariance predicted. h, g : minus curvature and slope of log g at a point x.
    toward (D,) : x less the predicted mean. Writes z (D, D) = (I + P H)^-1 P, the covariance after,
    and step (D,) = z (g + H toward), from the predicted mean; returns log det(I + P H), infinite
    where that is singular.
    """
    d, log_det = g.size, 0.0
    s = np.empty((d, d))
    for i in range(d):
        for j in range(d):
            total = 1.0 if i == j else 0.0
            for k in range(d):
                total += p[i, k] * h[k, j]
            s[i, j] = total
            z[i, j] = p[i, j]
    for i in range(d):  # elimination with pivots
        best = i
        for k in range(i + 1, d):
            if abs(s[k, i]) > abs(s[best, i]):
                best = k
        if not abs(s[best, i]) > 0.0:
            return np.inf
        log_det += math.log(abs(s[best, i]))
        for j in range(d):
            s[i, j], s[best, j] = s[best, j], s[i, j]
            z[i, j], z[best, j] = z[best, j], z[i, j]
        for k in range(d):
            if k == i:
                continue
            factor = s[k, i] / s[i, i]
            if factor != 0.0:
                for j in range(d):
                    s[k, j] -= factor * s[i, j]
                    z[k, j] -= factor * z[i, j]
    for i in range(d):
        for j in range(d):
            z[i, j] /= s[i, i]
    for i in range(d):
        for j in range(i):
            z[i, j] = z[j, i] = 0.5 * (z[i, j] + z[j, i])
    for i in range(d):
        total = 0.0
        for k in range(d):
            pull = g[k]
            for j in range(d):
                pull += h[k, j] * toward[j]
            total += z[i, k] * pull
        step[i] = total
    return log_det


@exact
def look_at(look, flat, theta, c, s, x, values, g, h):
    """log g(y_t | x), with its slope and minus its curvature, positive semidefinite."""
    d = g.size
    look(theta, c, s, x, values)
    m = 1 + d
    for i in range(d):
        g[i] = values[1 + i, 0]
        for j in range(i + 1):
            h[i, j] = values[m, 0]
            h[j, i] = h[i, j]
            m += 1
    if not flat:
        lift(h)
    return values[0, 0]


@exact
def spread_out(values, rest, jacobian, spread):
    """Take f (D,), J (D, D) and L (D, R) out of a pass's values; J only where there is one."""
    d, m = rest.size, 0
    for i in range(d):
        rest[i] = values[m, 0]
        m += 1
    if values.shape[0] > d + spread.size:
        for i in range(d):
            for j in range(d):
                jacobian[i, j] = values[m, 0]
                m += 1
    for i in range(d):
        for j in range(spread.shape[1]):
            spread[i, j] = values[m, 0]
            m += 1


@exact
def most_likely(
    look_at, flat, theta, c, s, rest, p, seen_so, now, g, h, after, toward, move, lead, target
):  # fmt: skip
    """x_t after the filter's update: the mode of N(x; rest, P) g(y_t | x), by Newton's method.

    now (D, 1), g (D,), h (D, D), after (D, D) : the mode, slope and curvature of log g there, and
    the covariance, written. The rest is room to work in. P may be singular: x - rest is P times
    `lead`, so that the density of x is known without P's inverse. Returns Laplace's approximation
    of log p(y_t | y_1, ..., y_{t-1}), exact where log g is quadratic; -inf where it comes to no
    number.
    """
    d = g.size
    for i in range(d):
        now[i, 0], lead[i], toward[i] = rest[i], 0.0, 0.0
    value = look_at(theta, c, s, now, seen_so, g, h)
    height = value
    log_det = update(p, h, g, toward, after, move)
    if not log_det < np.inf:
        return -np.inf
    for _ in range(1 if flat else NEWTON_STEPS):
        for i in range(d):
            target[i] = g[i]
            for j in range(d):
                target[i] += h[i, j] * (toward[j] - move[j])
        share = 1.0
        for _ in range(HALVINGS):
            new = 0.0
            for i in range(d):
                gone = toward[i] + share * (move[i] - toward[i])
                now[i, 0] = rest[i] + gone
                new -= 0.5 * (lead[i] + share * (target[i] - lead[i])) * gone
            value = look_at(theta, c, s, now, seen_so, g, h)
            new += value
            if flat or new >= height or (abs(new) < np.inf and not abs(height) < np.inf):
                break
            share *= 0.5
        else:  # as high as it gets
            for i in range(d):
                now[i, 0] = rest[i] + toward[i]
            value = look_at(theta, c, s, now, seen_so, g, h)
            break
        gained, height = new - height, new
        for i in range(d):
            lead[i] += share * (target[i] - lead[i])
            toward[i] = now[i, 0] - rest[i]
        if flat:
            break
        log_det = update(p, h, g, toward, after, move)
        if not log_det < np.inf:
            return -np.inf
        if gained < CLOSE:
            break
    if not abs(value) < np.inf:
        return -np.inf
    return height - 0.5 * log_det


@exact
def filter_pass(
    prepare, step, linear_initial, linear, look_at, most_likely, flat, theta, y, seen, u, c, s,
    x, covariance, increments, rest, jacobian, spread, spread_initial, g, h,
):  # fmt: skip
    """`follow_filter`, with room for what is computed once (c) and at a row (s)."""
    n_steps, d = x.shape
    r, r_initial = spread.shape[2], spread_initial.shape[1]
    before, now = np.empty((d, 1)), np.empty((d, 1))
    values = np.zeros((d + d * d + d * r, 1))
    told_initial = np.zeros((d + d * r_initial, 1))
    seen_so = np.zeros((1 + d + d * (d + 1) // 2, 1))
    p, after, jp = np.zeros((d, d)), np.empty((d, d)), np.empty((d, d))
    toward, move, target, lead = np.empty(d), np.empty(d), np.empty(d), np.empty(d)
    log_likelihood, resolved = 0.0, True
    prepare(theta, c)
    for t in range(n_steps):
        step(theta, c, y, seen, u, t, s)
        if t == 0:
            linear_initial(theta, c, s, now, told_initial)
            spread_out(told_initial, rest[0], jacobian[0], spread_initial)
            for i in range(d):
                for j in range(d):
                    total = 0.0
                    for k in range(r_initial):
                        total += spread_initial[i, k] * spread_initial[j, k]
                    p[i, j] = total
        else:
            linear(theta, c, s, before, now, values)
            spread_out(values, rest[t], jacobian[t], spread[t])
            for i in range(d):
                for j in range(d):
                    total = 0.0
                    for k in range(d):
                        total += jacobian[t, i, k] * after[k, j]
                    jp[i, j] = total
            for i in range(d):
                for j in range(d):
                    total = 0.0
                    for k in range(d):
                        total += jp[i, k] * jacobian[t, j, k]
                    for k in range(r):
                        total += spread[t, i, k] * spread[t, j, k]
                    p[i, j] = total
        increments[t] = most_likely(
            theta, c, s, rest[t], p, seen_so, now, g[t], h[t], after, toward, move, lead, target
        )
        log_likelihood += increments[t]
        if not abs(log_likelihood) < np.inf:
            return -np.inf
        for i in range(d):
            resolved = resolved and after[i, i] >= RESOLVED * p[i, i]
            if not abs(now[i, 0]) < np.inf:
                return -np.inf
            x[t, i] = now[i, 0]
            before[i, 0] = now[i, 0]
            for j in range(d):
                covariance[t, i, j] = after[i, j]
    return log_likelihood if resolved else np.inf


@exact
def follow_filter(
    filter_pass, sizes, theta, y, seen, u, x, covariance, increments, rest, jacobian, spread,
    spread_initial, g, h,
):  # fmt: skip
    """The first reference: an extended Kalman filter; returns its log-likelihood, -inf where it
    comes to no number, +inf where its covariances do and rounding has eaten the log-likelihood: an
    observation determines a state better than `RESOLVED`.

    x (T, D) its means, covariance (T, D, D), increments (T,) of the log-likelihood, rest (T, D),
    jacobian (T, D, D), spread (T, D, R), spread_initial (D, R_1), g (T, D), h (T, D, D) : written.
    """
    return filter_pass(
        theta, y, seen, u, np.empty(sizes[0]), np.empty(sizes[1]), x, covariance, increments, rest,
        jacobian, spread, spread_initial, g, h,
    )  # fmt: skip


@exact
def gains_pass(
    prepare, step, begin, follow, linear_initial, linear, look_at, theta, y, seen, u, c, s, share,
    x_old, e_old, aim, gain, x, e, rest, jacobian, spread, spread_initial, g, h,
):  # fmt: skip
    """The model itself, steered by gains; returns log p(e, y) up to a constant, -inf if none.

    e_t = e_old_t + share (aim_t - e_old_t) + gain_t (x_{t-1} - x_old_{t-1}).
    aim, e_old, e (T, R'), gain (T, R', D), R' the larger of both laws' noises; x, e and the
    derivatives along x are written. c, s : room for what is computed once and at a row.
    """
    n_steps, d = x.shape
    r, r_initial = spread.shape[2], spread_initial.shape[1]
    before, now = np.empty((d, 1)), np.empty((d, 1))
    values = np.zeros((d + d * d + d * r, 1))
    told_initial = np.zeros((d + d * r_initial, 1))
    seen_so = np.zeros((1 + d + d * (d + 1) // 2, 1))
    total = 0.0
    prepare(theta, c)
    for t in range(n_steps):
        step(theta, c, y, seen, u, t, s)
        for k in range(r_initial if t == 0 else r):
            e[t, k] = e_old[t, k] + share * (aim[t, k] - e_old[t, k])
            if t > 0:
                for j in range(d):
                    e[t, k] += gain[t, k, j] * (before[j, 0] - x_old[t - 1, j])
            total -= 0.5 * e[t, k] ** 2
        if t == 0:
            linear_initial(theta, c, s, now, told_initial)
            spread_out(told_initial, rest[0], jacobian[0], spread_initial)
            begin(theta, c, s, e[0], now)
        else:
            linear(theta, c, s, before, now, values)
            spread_out(values, rest[t], jacobian[t], spread[t])
            follow(theta, c, s, before, e[t], now)
        total += look_at(theta, c, s, now, seen_so, g[t], h[t])
        if not abs(total) < np.inf:
            return -np.inf
        for i in range(d):
            x[t, i] = now[i, 0]
            before[i, 0] = now[i, 0]
    return total
