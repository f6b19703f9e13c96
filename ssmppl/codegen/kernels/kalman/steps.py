"""Steps of the exact filter for several columns of means, with the transformations kept.

x_1 = start + N(0, P), x_t = A_t x_{t-1} + b_t + N(0, Q_t), y_t = C_t x_t + d_t + N(0, R_t).

What is known at a step is written as x = mean + root e, e ~ N(0, I). Both steps of the filter are
orthogonal changes of these standard normal variables (`square_root.py` has the same arrays):

    (e; w) = Theta (e_pred; rest)      from  [A L  Q^1/2]   Theta = [L_pred  0]

    (nu; e) = Theta (z; e_filt; rest)  from  [R^1/2  C L]   Theta = [S^1/2  0   0]
                                             [0        L]           [K      L+  0]

z is what the measurement tells. The rows of Theta are found by carrying the unit matrix below the
array. A smoother that goes back by them needs no inverse but that of S^1/2, whose pivots are
not zero: Q, P and the predicted covariance may be singular (the idea of Paige and Saunders 1977,
"Least squares estimation of discrete linear dynamic systems using orthogonal transformations",
SIAM J. Numer. Anal. 14).

Columns: column 0 of the means is the model's own; column c > 0 is the response to a unit of the
c-th unknown of a start that is not given (de Jong 1991, "The diffuse Kalman filter", Annals of
Statistics 19): no data, no offsets, the same gains. F columns in all.

The pivots' arithmetic does not depend on the rows below them, and the compiler may reorder nothing
here, so that a backward pass which repeats a step finds the very numbers of the forward one.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ssmppl.codegen.kernels.kalman.square_root import (
    LOG_2PI,
    NOT_COVARIANCE,
    NOT_FINITE,
    OK,
    SINGULAR,
    at,
    reflect,
    square_root,
)
from ssmppl.codegen.kernels.math.flags import exact


class Matrices(NamedTuple):
    """A linear Gaussian model in numbers, in the order of the kernel's arguments.

    m (D,), P (D, D): law of x_1. A, Q (T or 1, D, D), b (T or 1, D): into row t, row 0 without
    meaning. C (T or 1, K, D), d (T or 1, K), R (T or 1, K, K): at row t.
    """

    m: np.ndarray
    P: np.ndarray
    A: np.ndarray
    b: np.ndarray
    Q: np.ndarray
    C: np.ndarray
    d: np.ndarray
    R: np.ndarray


@exact
def multiply_add(a, b, out):
    """out += a b."""
    for i in range(a.shape[0]):
        for k in range(a.shape[1]):
            factor = a[i, k]
            for j in range(b.shape[1]):
                out[i, j] += factor * b[k, j]


@exact
def copy(a, out):
    """out <- a: loops, because assignments to slices take much longer to compile."""
    for i in range(a.shape[0]):
        for j in range(a.shape[1]):
            out[i, j] = a[i, j]


@exact
def fill(out, value):
    """Every entry of out (n, m) <- value."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j] = value


@exact
def add_square(a, out):
    """out += a a', both halves from the same sums."""
    for i in range(a.shape[0]):
        for j in range(i + 1):
            total = 0.0
            for k in range(a.shape[1]):
                total += a[i, k] * a[j, k]
            out[i, j] += total
            if i != j:
                out[j, i] += total


@exact
def root_at(covariances, t, first, root):
    """root <- that of step t, found anew where it changes; False where there is none."""
    if t == first or covariances.shape[0] > 1:
        return square_root(covariances[at(t, covariances.shape[0])], root)
    return True


@exact
def predict_columns(a, b, x, out):
    """out (D, F) = a x, and b more in column 0."""
    fill(out, 0.0)
    for i in range(b.size):
        out[i, 0] = b[i]
    multiply_add(a, x, out)


@exact
def predict_array(a, root, q_root, array):
    """Fill and transform [A L, Q^1/2; I, 0; 0, I] (D to 3 D, 2 D): as many rows as it has."""
    n = root.shape[0]
    fill(array, 0.0)
    multiply_add(a, root, array[:n, :n])
    copy(q_root, array[:n, n:])
    for i in range(n, array.shape[0]):
        array[i, i - n] = 1.0
    reflect(array, n)


@exact
def update_array(c, root, r_root, seen, array):
    """Fill and transform the array of an update; returns k, how many components were measured.

    Rows of array (2 K + 2 D or less, K + D): k for y, D for x, then the unit matrix: D rows for
    e and K rows for the noise, as many as there is room for.
    """
    n, k_all = root.shape[0], r_root.shape[0]
    fill(array, 0.0)
    k = 0
    for j in range(k_all):
        if seen[j] != 0.0:
            copy(r_root[j : j + 1], array[k : k + 1, :k_all])
            multiply_add(c[j : j + 1], root, array[k : k + 1, k_all:])
            k += 1
    copy(root, array[k : k + n, k_all:])
    for i in range(min(n, array.shape[0] - k - n)):
        array[k + n + i, k_all + i] = 1.0
    for j in range(min(k_all, array.shape[0] - k - 2 * n)):
        array[k + 2 * n + j, j] = 1.0
    reflect(array, k + n)
    return k


@exact
def innovations(c, d, y, seen, x, array, z):
    """z (K, F), first k rows <- S^-1/2 (y - C x - d), and -S^-1/2 C x in the further columns."""
    k = 0
    for j in range(y.size):
        if seen[j] == 0.0:
            continue
        for f in range(x.shape[1]):
            value = y[j] - d[j] if f == 0 else 0.0
            for i in range(x.shape[0]):
                value -= c[j, i] * x[i, f]
            for i in range(k):
                value -= array[k, i] * z[i, f]
            z[k, f] = value / array[k, k]
        k += 1


@exact
def add_known(a, where, count, x, b, out):
    """out (n, F) <- a x, and b more in column 0, from the nonzero entries of a."""
    fill(out, 0.0)
    for i in range(b.size):
        out[i, 0] = b[i]
    for e in range(count):
        factor, row, into = a[where[e, 0], where[e, 1]], x[where[e, 1]], out[where[e, 0]]
        for f in range(row.size):
            into[f] += factor * row[f]


@exact
def innovate(c, where, count, d, y, place, k, x, array, z, filtered):
    """z (K, F), first k rows <- S^-1/2 (y - C x - d), -S^-1/2 C x in the further columns; filtered
    <- the mean given these.

    array, place, k : of `update_root`; where, count : of the entries of c that are not zero.
    """
    columns = x.shape[1]
    for p in range(y.size):
        if place[p] >= 0:
            z[place[p], 0] = y[p] - d[p]
            for f in range(1, columns):
                z[place[p], f] = 0.0
    for e in range(count):
        row = place[where[e, 0]]
        if row >= 0:
            factor = c[where[e, 0], where[e, 1]]
            for f in range(columns):
                z[row, f] -= factor * x[where[e, 1], f]
    copy(x, filtered)
    for i in range(k):
        for f in range(columns):
            for j in range(i):
                z[i, f] -= array[j, i] * z[j, f]
            z[i, f] /= array[i, i]
        for a in range(filtered.shape[0]):
            for f in range(columns):
                filtered[a, f] += array[i, k + a] * z[i, f]


@exact
def forward(model, start, y, seen, x, roots, log_increment):
    """Run the filter; returns (status, t) as `kalman_filter` does.

    start (D, F). Written: x (T, D, F), roots (T, D, D): what is known of x_t from y_{1:t-1};
    log_increment (T,): log p(y_t | y_{1:t-1}) of column 0.
    """
    n_steps, n, k_all = y.shape[0], start.shape[0], y.shape[1]
    q_root, r_root = np.empty((n, n)), np.empty((k_all, k_all))
    both, array = np.empty((n, 2 * n)), np.empty((k_all + n, k_all + n))
    root, filtered, z = np.empty((n, n)), np.empty(start.shape), np.empty((k_all, start.shape[1]))
    log_increment[:] = -np.inf
    for t in range(n_steps):
        if t == 0:
            copy(start, x[0])
            if not square_root(model.P, roots[0]):
                return NOT_COVARIANCE, 0
        else:
            if not root_at(model.Q, t, 1, q_root):
                return NOT_COVARIANCE, t
            a = model.A[at(t, model.A.shape[0])]
            predict_columns(a, model.b[at(t, model.b.shape[0])], filtered, x[t])
            predict_array(a, root, q_root, both)
            copy(both[:, :n], roots[t])
        if not root_at(model.R, t, 0, r_root):
            return NOT_COVARIANCE, t
        k = update(model, t, y[t], seen[t], x[t], roots[t], r_root, array, z, filtered)
        copy(array[k : k + n, k : k + n], root)
        increment = log_density(array, z, k)
        status = status_of(increment)
        if status != OK:
            return status, t
        log_increment[t] = increment
    return OK, n_steps


@exact
def update(model, t, y, seen, x, root, r_root, array, z, filtered):
    """The update of step t: array transformed, z and filtered (D, F) written; returns k."""
    n = root.shape[0]
    c = model.C[at(t, model.C.shape[0])]
    k = update_array(c, root, r_root, seen, array)
    innovations(c, model.d[at(t, model.d.shape[0])], y, seen, x, array, z)
    copy(x, filtered)
    multiply_add(array[k : k + n, :k], z[:k], filtered)
    return k


@exact
def status_of(increment):
    """What a step's `log_density` says of it."""
    if increment == np.inf:
        return SINGULAR
    return OK if abs(increment) < np.inf else NOT_FINITE


@exact
def log_density(array, z, k):
    """log N(y; prediction, S) from S^1/2 and column 0 of z; inf where S is singular."""
    total = -0.5 * k * LOG_2PI
    for i in range(k):
        if array[i, i] == 0.0:
            return np.inf
        total -= math.log(abs(array[i, i])) + 0.5 * z[i, 0] * z[i, 0]
    return total
