"""The exact filter where components of x_1 are unknown altogether: a flat law, of density 1.

The unknown delta (G components) is a regression coefficient (Rosenberg 1973; de Jong 1991, "The
diffuse Kalman filter", Annals of Statistics 19): given it, the model is an ordinary one, and every
innovation is z_t + Z_t delta with Z_t the response of the filter to a unit of delta. So

    p(y) = integral p(y | delta) d delta,      delta | y ~ N(factor^-1 right, (factor' factor)^-1)

with factor and right from the QR factorisation of the whitened rows [Z_t, -z_t], updated by Givens
rotations (Golub and Van Loan 2013, "Matrix computations", section 6.5) as rows come in. A sum of
squares is never subtracted from another, so a level far from zero costs no digits, and a model
with no diffuse phase at all, with gaps in it, or with rows that determine one delta twice is no
special case. What is flat at t without data on it has an infinite variance.
"""

from __future__ import annotations

import math

import numpy as np

from ssmppl.codegen.kernels.kalman.square_root import (
    LOG_2PI,
    NOT_COVARIANCE,
    NOT_FINITE,
    OK,
    SINGULAR,
    at,
    begin_roots,
    measure_step,
    predict_step,
    roots_of,
    same,
    turn,
    update_step,
)
from ssmppl.codegen.kernels.kalman.steps import (
    add_known,
    add_square,
    copy,
    fill,
    innovate,
    multiply_add,
    predict_columns,
)
from ssmppl.codegen.kernels.math.flags import exact

# Of the numbers that it is the difference of: what is less is a rounding error of zero.
NOTHING = 1e-11


@exact
def absorb(row, target, factor, right):
    """Add the equation row . delta = target to the factorisation; row is destroyed.

    Returns (whether it determines a new direction, residual, change of log |det factor|), the last
    two in the directions known before and now.
    """
    n = row.size
    sizes = np.abs(row)
    change = 0.0
    for j in range(n):
        if factor[j, j] == 0.0:
            if abs(row[j]) > NOTHING * sizes[j]:
                for l in range(j, n):
                    factor[j, l] = row[l]
                right[j] = target
                return True, 0.0, change + math.log(abs(row[j]))
            row[j] = 0.0
        elif row[j] != 0.0:
            radius = math.hypot(factor[j, j], row[j])
            c, s = factor[j, j] / radius, row[j] / radius
            change -= math.log(abs(c))
            for l in range(j, n):
                above, below = factor[j, l], row[l]
                factor[j, l] = c * above + s * below
                row[l] = c * below - s * above
                sizes[l] = max(sizes[l], abs(s * above))
            above = right[j]
            right[j] = c * above + s * target
            target = c * target - s * above
    return False, target, change


@exact
def known_rows(rows, factor, right, mean, extra, known):
    """What the equations so far say of rows (p, F), value and slopes in delta.

    Written: mean (p,); extra (p, G), a root of the part of their covariance that stems from delta;
    known (p,), 0 where they hold a direction of delta that no row has determined.
    """
    for i in range(rows.shape[0]):
        mean[i], known[i] = rows[i, 0], 1.0
        for j in range(right.size):
            value, size = rows[i, 1 + j], abs(rows[i, 1 + j])
            for l in range(j):
                value -= extra[i, l] * factor[l, j]
                size = max(size, abs(extra[i, l] * factor[l, j]))
            extra[i, j] = 0.0
            if factor[j, j] != 0.0:
                extra[i, j] = value / factor[j, j]
                mean[i] += extra[i, j] * right[j]
            elif abs(value) > NOTHING * size:
                known[i] = 0.0


@exact
def report(rows, root, factor, right, extra, known, mean, covariance):
    """Moments of rows + root e + (rows' slopes) delta; NaN and infinite where delta is unknown."""
    known_rows(rows, factor, right, mean, extra, known)
    fill(covariance, 0.0)
    add_square(root, covariance)
    add_square(extra[: rows.shape[0]], covariance)
    for i in range(rows.shape[0]):
        if known[i] == 0.0:
            mean[i] = np.nan
            for j in range(rows.shape[0]):
                covariance[i, j] = np.nan
                covariance[j, i] = np.nan
    for i in range(rows.shape[0]):
        if known[i] == 0.0:
            covariance[i, i] = np.inf


@exact
def diffuse_filter(
    model, flat, y, seen, factor, right, log_increment, mean, covariance, mean_predicted,
    covariance_predicted, observation_mean, observation_covariance,
):  # fmt: skip
    """Run the filter; returns (status, t) as `kalman_filter` does.

    flat (G,): the components of x_1 that are unknown; their m and P are zero. Written: factor
    (G, G) and right (G,), whose diagonal has a zero for each direction that the data leave open;
    log_increment (T,), whose sum is log p(y) where there is none; and unless they are None the
    moments of `kalman_filter`, NaN and infinite where they do not exist yet.
    """
    n_steps, n, k_all, g = y.shape[0], model.m.size, y.shape[1], flat.size
    s, root = roots_of(n, k_all), np.empty((n, n))
    x, filtered, z = np.zeros((n, 1 + g)), np.empty((n, 1 + g)), np.empty((k_all, 1 + g))
    for i in range(n):
        x[i, 0] = model.m[i]
    for j in range(g):
        x[flat[j], 1 + j] = 1.0
        right[j] = 0.0
    fill(factor, 0.0)
    log_increment[:] = -np.inf
    row = np.empty(g)
    extra, known = np.empty((max(n, k_all), g)), np.empty(max(n, k_all))
    rows, seen_root = np.empty((k_all, 1 + g)), np.empty((k_all, n + k_all))
    if not begin_roots(model.P, s):
        return NOT_COVARIANCE, 0
    for t in range(n_steps):
        c, d = model.C[at(t, model.C.shape[0])], model.d[at(t, model.d.shape[0])]
        alike = t > 0 and same(seen[t], seen[t - 1])
        if t > 0:
            if not predict_step(model.A, model.Q, t, s):
                return NOT_COVARIANCE, t
            a, b = model.A[at(t, model.A.shape[0])], model.b[at(t, model.b.shape[0])]
            add_known(a, s.a, s.counts[0], filtered, b, x)
        if not measure_step(model.C, model.R, t, seen[t], alike, s):
            return NOT_COVARIANCE, t
        if mean is not None:
            turn(s.root, root)
            report(x, root, factor, right, extra, known, mean_predicted[t], covariance_predicted[t])
            predict_columns(c, d, x, rows)
            fill(seen_root, 0.0)
            multiply_add(c, root, seen_root[:, :n])
            copy(s.r_root, seen_root[:, n:])
            report(
                rows, seen_root, factor, right, extra, known,
                observation_mean[t], observation_covariance[t],
            )  # fmt: skip
        update_step(c, s)
        k = s.counts[3]
        innovate(c, s.c, s.counts[1], d, y[t], s.place, k, x, s.array, z, filtered)
        increment = -0.5 * k * LOG_2PI
        for i in range(k):
            if s.array[i, i] == 0.0:
                return SINGULAR, t
            increment -= math.log(abs(s.array[i, i]))
            for j in range(g):
                row[j] = z[i, 1 + j]
            new, residual, change = absorb(row, -z[i, 0], factor, right)
            increment -= 0.5 * residual * residual + change
            if new:
                increment += 0.5 * LOG_2PI
        if not abs(increment) < np.inf:
            return NOT_FINITE, t
        log_increment[t] = increment
        if mean is not None:
            turn(s.root, root)
            report(filtered, root, factor, right, extra, known, mean[t], covariance[t])
    return OK, n_steps
