"""The unscented Kalman filter, and predictions of observations by the same points.

S. J. Julier and J. K. Uhlmann, "A new extension of the Kalman filter to nonlinear systems", 1997: a
Gaussian of n components is stood for by 2 n + 1 points, the mean and the columns of a root of its
covariance either way, at sqrt(n + kappa) of them, kappa = max(3 - n, 0), so that no weight is
negative. The transition takes points of (x_{t-1}, e_t), so that noise may enter it in any way. The
update takes the mean and the covariance of y_t given x_t at the points of the prediction; laws of
observations that are not Gaussian count by these two moments.

Notation: D states, K components of y, R noises of a transition and R_1 of the initial law, T rows.
"""

from __future__ import annotations

import math

import numpy as np

from ssmppl.codegen.kernels.math.flags import exact
from ssmppl.codegen.kernels.twisted.lookahead_backward import factorise

NOTHING_LEFT = 1e-14  # of a variance, once what other components tell of it is taken off


@exact
def root_of(p, root):
    """Lower root (D, D) of p, positive semidefinite: a column of zeros where nothing is left."""
    d = p.shape[0]
    root[:] = 0.0
    for j in range(d):
        total = p[j, j]
        for k in range(j):
            total -= root[j, k] ** 2
        if not total > NOTHING_LEFT * p[j, j]:
            continue
        root[j, j] = math.sqrt(total)
        for i in range(j + 1, d):
            total = p[i, j]
            for k in range(j):
                total -= root[i, k] * root[j, k]
            root[i, j] = total / root[j, j]


@exact
def predicted_row(tell, theta, c, s, m, p, y_mean, y_covariance, cross):
    """Moments of y_t where x_t is Gaussian with mean m (D,) and covariance p (D, D).

    y_mean (K,), y_covariance (K, K), cross (D, K) of x_t and y_t : written.
    """
    d, k = m.size, y_mean.size
    kappa = max(3.0 - d, 0.0)
    reach = math.sqrt(d + kappa)
    root, now = np.empty((d, d)), np.empty((d, 1))
    root_of(p, root)
    points, values = np.zeros((2 * d + 1, k)), np.zeros((k + k * (k + 1) // 2, 1))
    y_mean[:] = 0.0
    y_covariance[:] = 0.0
    cross[:] = 0.0
    for i in range(2 * d + 1):
        weight = 0.5 / (d + kappa) if i else kappa / (d + kappa)
        sign = reach if i % 2 else -reach
        for a in range(d):
            now[a, 0] = m[a] + (sign * root[a, (i - 1) // 2] if i else 0.0)
        if weight == 0.0:
            continue
        tell(theta, c, s, now, values)
        at = k
        for a in range(k):
            points[i, a] = values[a, 0]
            y_mean[a] += weight * values[a, 0]
            for b in range(a + 1):
                y_covariance[a, b] += weight * values[at, 0]
                at += 1
    for i in range(2 * d + 1):
        weight = 0.5 / (d + kappa) if i else kappa / (d + kappa)
        if weight == 0.0:
            continue
        sign = reach if i % 2 else -reach
        for a in range(k):
            off = weight * (points[i, a] - y_mean[a])
            for b in range(a + 1):
                y_covariance[a, b] += off * (points[i, b] - y_mean[b])
            if i:
                for j in range(d):
                    cross[j, a] += sign * root[j, (i - 1) // 2] * off
    for a in range(k):
        for b in range(a):
            y_covariance[b, a] = y_covariance[a, b]


@exact
def predicted_rows(
    prepare, step, predicted_row, sizes, theta, y, seen, u, mean, covariance, y_mean, y_covariance,
):  # fmt: skip
    """y_mean (T, K), y_covariance (T, K, K) <- moments of the observations where the states are
    Gaussian with these means (T, D) and covariances (T, D, D)."""
    n_steps, d = mean.shape
    c, s, cross = np.empty(sizes[0]), np.empty(sizes[1]), np.empty((d, y.shape[1]))
    prepare(theta, c)
    for t in range(n_steps):
        step(theta, c, y, seen, u, t, s)
        predicted_row(theta, c, s, mean[t], covariance[t], y_mean[t], y_covariance[t], cross)


@exact
def unscented_filter(
    prepare, step, begin, follow, predicted_row, sizes, theta, y, seen, u, r,
    predicted, predicted_covariance, cross, mean, covariance, y_mean, y_covariance, increments,
):  # fmt: skip
    """The log-likelihood by the Gaussian laws of the predictions; -inf where it comes to no number.

    r : numbers (R_1, R) of noises. predicted (T, D) and predicted_covariance (T, D, D), cross (T,
    D, D) of x_{t-1} and x_t, mean (T, D) and covariance (T, D, D), y_mean (T, K) and y_covariance
    (T, K, K) of the prediction, increments (T,) of the log-likelihood : written.
    """
    n_steps, d = mean.shape
    k_all = y.shape[1]
    c, s = np.empty(sizes[0]), np.empty(sizes[1])
    widest = max(r[0], r[1])
    points, e = np.empty((2 * (d + widest) + 1, d)), np.zeros(widest)
    before, now, root = np.zeros((d, 1)), np.zeros((d, 1)), np.zeros((d, d))
    told = np.empty((d, k_all))
    total = 0.0
    prepare(theta, c)
    for t in range(n_steps):
        step(theta, c, y, seen, u, t, s)
        own = d if t > 0 else 0  # components of x_{t-1} among those of the points
        n = own + (r[0] if t == 0 else r[1])
        kappa = max(3.0 - n, 0.0)
        reach = math.sqrt(n + kappa)
        if t > 0:
            root_of(covariance[t - 1], root)
        predicted[t] = 0.0
        predicted_covariance[t] = 0.0
        cross[t] = 0.0
        for i in range(2 * n + 1):
            weight = 0.5 / (n + kappa) if i else kappa / (n + kappa)
            if weight == 0.0:
                continue
            sign = reach if i % 2 else -reach
            column = (i - 1) // 2 if i else -1
            e[:] = 0.0
            if column >= own:
                e[column - own] = sign
            if t == 0:
                begin(theta, c, s, e, now)
            else:
                for a in range(d):
                    off = sign * root[a, column] if 0 <= column < own else 0.0
                    before[a, 0] = mean[t - 1, a] + off
                follow(theta, c, s, before, e, now)
            for a in range(d):
                points[i, a] = now[a, 0]
                predicted[t, a] += weight * now[a, 0]
        for i in range(2 * n + 1):
            weight = 0.5 / (n + kappa) if i else kappa / (n + kappa)
            if weight == 0.0:
                continue
            sign = reach if i % 2 else -reach
            column = (i - 1) // 2 if i else -1
            for a in range(d):
                off = weight * (points[i, a] - predicted[t, a])
                for b in range(a + 1):
                    predicted_covariance[t, a, b] += off * (points[i, b] - predicted[t, b])
                if 0 <= column < own:
                    for b in range(d):
                        cross[t, b, a] += sign * root[b, column] * off
        for a in range(d):
            for b in range(a):
                predicted_covariance[t, b, a] = predicted_covariance[t, a, b]
        predicted_row(
            theta, c, s, predicted[t], predicted_covariance[t], y_mean[t], y_covariance[t], told
        )
        n_seen = 0
        for a in range(k_all):
            n_seen += 1 if seen[t, a] != 0.0 else 0
        part, gain, off_y = np.empty((n_seen, n_seen)), np.empty((n_seen, d)), np.empty(n_seen)
        a_seen = 0
        for a in range(k_all):
            if seen[t, a] == 0.0:
                continue
            off_y[a_seen] = y[t, a] - y_mean[t, a]
            for j in range(d):
                gain[a_seen, j] = told[j, a]
            b_seen = 0
            for b in range(k_all):
                if seen[t, b] != 0.0:
                    part[a_seen, b_seen] = y_covariance[t, a, b]
                    b_seen += 1
            a_seen += 1
        if not factorise(part):
            return -np.inf
        # with S = C C': off <- C^-1 off, gain <- C^-1 (x, y)', so that updates are squares
        increments[t] = -0.5 * n_seen * math.log(2.0 * math.pi)
        for a in range(n_seen):
            for b in range(a):
                off_y[a] -= part[a, b] * off_y[b]
                for j in range(d):
                    gain[a, j] -= part[a, b] * gain[b, j]
            off_y[a] /= part[a, a]
            for j in range(d):
                gain[a, j] /= part[a, a]
            increments[t] -= 0.5 * off_y[a] ** 2 + math.log(part[a, a])
        for i in range(d):
            mean[t, i] = predicted[t, i]
            for a in range(n_seen):
                mean[t, i] += gain[a, i] * off_y[a]
            for j in range(i + 1):
                covariance[t, i, j] = predicted_covariance[t, i, j]
                for a in range(n_seen):
                    covariance[t, i, j] -= gain[a, i] * gain[a, j]
                covariance[t, j, i] = covariance[t, i, j]
            if not abs(mean[t, i]) < np.inf or not covariance[t, i, i] < np.inf:
                return -np.inf
        total += increments[t]
        if not abs(total) < np.inf:
            return -np.inf
    return total
