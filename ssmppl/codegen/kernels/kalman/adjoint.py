"""Derivatives of log p(y) in the matrices of a linear Gaussian model, all in one backward pass.

With v_t and S_t the innovations and their covariance, K_t = P_t C' S^-1 the filter's gain and
P_t the predicted covariance, the pass goes back over

    u_t = S^-1 v_t - K' rho_t                r_t = rho_t + C' u_t               rho_t = A' r_{t+1}
    D_t = S^-1 + K' V_t K                    N_t = C' S^-1 C + (I - K C)' V_t (I - K C)
                                                                                V_t = A' N_{t+1} A

and the derivatives are (Koopman and Shephard 1992, "Exact score for time series models in state
space form", Biometrika 79; Durbin and Koopman 2012, "Time series analysis by state space methods",
section 7.3.3; those in A and C by Fisher's identity from the same smoothed disturbances)

    b: r        Q: (r r' - N) / 2        A: r_{t+1} xs_t' - N_{t+1} A F_t
    d: u        R: (u u' - D) / 2        C: u xs_t' - K' (I - V_t F_t)
    m: r_1      P: (r_1 r_1' - N_1) / 2

with F_t the filtered covariance and xs_t the smoothed mean; the array of the update gives K by
K^- = K S^1/2. Only S is inverted, by its triangular root. N is found from one side, then from the
other, V (I - K C) and (I - K C)' times that: what the data tell is small, and is so before it is
subtracted from. A symmetric matrix has the derivative of its entries taken one by one.

The forward pass keeps the arrays of each update; zeros of A and C are passed over, and of the
adjoints only those are found that are asked for. Steps of a filter that has settled share one
array.

Where a part of the start is unknown, products of r, u and xs are expectations over it, that is,
sums over the columns (see `steps.py`).
"""

from __future__ import annotations

import numpy as np

from ssmppl.codegen.kernels.kalman.square_root import (
    NOT_COVARIANCE,
    OK,
    at,
    begin_roots,
    measure_step,
    nonzeros,
    predict_step,
    rests,
    roots_of,
    same,
    square_columns,
    update_step,
)
from ssmppl.codegen.kernels.kalman.steps import (
    add_known,
    copy,
    fill,
    innovate,
    log_density,
    status_of,
)
from ssmppl.codegen.kernels.math.flags import exact

# Which adjoints are asked for, in the order of `Matrices`.
M_, P_, A_, B_, Q_, C_, D_, R_ = 0, 1, 2, 3, 4, 5, 6, 7


@exact
def half_square_less(a, b, out):
    """out += (a a' - b) / 2."""
    for i in range(a.shape[0]):
        for j in range(a.shape[0]):
            total = -b[i, j]
            for f in range(a.shape[1]):
                total += a[i, f] * a[j, f]
            out[i, j] += 0.5 * total


@exact
def filter_forward(model, start, y, seen, x, kept, z, roots, log_increment):
    """Run the filter; returns (status, t) as `kalman_filter` does.

    start (D, F). Written: x (T, D, F), filtered means; kept (T, K, K + D), the first k rows of the
    array of each update, and z (T, K, F), the whitened innovations; log_increment (T,), of column
    0; and where its first axis is not empty roots (T, D, D), transposed, of the filtered
    covariances.
    """
    n_steps, n, k_all, columns = y.shape[0], start.shape[0], y.shape[1], start.shape[1]
    constant = (
        model.A.shape[0] == 1
        and model.Q.shape[0] == 1
        and model.C.shape[0] == 1
        and model.R.shape[0] == 1
    )
    settled, s = False, roots_of(n, k_all)
    before, last = np.empty((n, columns)), np.zeros((n, n))
    log_increment[:] = -np.inf
    if not begin_roots(model.P, s):
        return NOT_COVARIANCE, 0
    copy(start, before)
    for t in range(n_steps):
        c, d = model.C[at(t, model.C.shape[0])], model.d[at(t, model.d.shape[0])]
        alike = t > 0 and same(seen[t], seen[t - 1])
        settled = settled and alike
        if not settled:
            if t > 0 and not predict_step(model.A, model.Q, t, s):
                return NOT_COVARIANCE, t
            if not measure_step(model.C, model.R, t, seen[t], alike, s):
                return NOT_COVARIANCE, t
            update_step(c, s)
            if constant:
                settled = rests(s.root, last) and alike
        if t > 0:
            a, b = model.A[at(t, model.A.shape[0])], model.b[at(t, model.b.shape[0])]
            add_known(a, s.a, s.counts[0], x[t - 1], b, before)
        k = s.counts[3]
        for i in range(k):
            for j in range(k + n):
                kept[t, i, j] = s.array[i, j]
        if roots.shape[0] > 0:
            copy(s.root, roots[t])
        innovate(c, s.c, s.counts[1], d, y[t], s.place, k, before, s.array, z[t], x[t])
        increment = log_density(s.array, z[t], k)
        status = status_of(increment)
        if status != OK:
            return status, t
        log_increment[t] = increment
    return OK, n_steps


@exact
def means_forward(model, start, y, seen, x, kept, z, log_increment):
    """`filter_forward` of a record whose arrays are known, from another one that misses the same:
    what is not known of the states does not depend on what was measured."""
    n_steps, n, k_all, columns = y.shape[0], start.shape[0], y.shape[1], start.shape[1]
    where_a, where_c = np.empty((n * n, 2), np.int64), np.empty((k_all * n, 2), np.int64)
    count_a, count_c, place = 0, 0, np.empty(k_all, np.int64)
    before = np.empty((n, columns))
    log_increment[:] = -np.inf
    copy(start, before)
    for t in range(n_steps):
        c, d = model.C[at(t, model.C.shape[0])], model.d[at(t, model.d.shape[0])]
        if t == 0 or model.C.shape[0] > 1:
            count_c = nonzeros(c, where_c)
        k = 0
        for p in range(k_all):
            place[p] = -1
            if seen[t, p] != 0.0:
                place[p] = k
                k += 1
        if t > 0:
            a, b = model.A[at(t, model.A.shape[0])], model.b[at(t, model.b.shape[0])]
            if t == 1 or model.A.shape[0] > 1:
                count_a = nonzeros(a, where_a)
            add_known(a, where_a, count_a, x[t - 1], b, before)
        innovate(c, where_c, count_c, d, y[t], place, k, before, kept[t], z[t], x[t])
        increment = log_density(kept[t], z[t], k)
        status = status_of(increment)
        if status != OK:
            return status, t
        log_increment[t] = increment
    return OK, n_steps


@exact
def adjoints(model, start, y, seen, wanted, log_increment, adjoint):
    """Derivatives of log p(y); returns (status, t) of the forward pass.

    start (D, F): the mean of x_1, and a root of the law of its unknown part; wanted (8,): not 0 for
    the fields of `Matrices` whose derivatives are asked for; log_increment (T,), written. adjoint:
    `Matrices` of the shapes of the model's; to each that is wanted is added, summed over time where
    the matrix is one for all steps.
    """
    n_steps, n, k_all, columns = y.shape[0], start.shape[0], y.shape[1], start.shape[1]
    told = wanted[A_] != 0 or wanted[C_] != 0  # those for which the smoothed states are needed
    x, kept = np.empty((n_steps, n, columns)), np.empty((n_steps, k_all, k_all + n))
    z, roots = np.empty((n_steps, k_all, columns)), np.empty((n_steps if told else 0, n, n))
    status, stopped = filter_forward(model, start, y, seen, x, kept, z, roots, log_increment)
    if status != OK:
        return status, stopped
    r, rho, u = np.zeros((n, columns)), np.zeros((n, columns)), np.empty((k_all, columns))
    info, v, product = np.zeros((n, n)), np.zeros((n, n)), np.empty((n, n))  # N, V and N A
    covariance, smoothed = np.empty((n, n)), np.empty((n, columns))
    gain, by_v = np.empty((k_all, n)), np.empty((k_all, n))
    inverse, spread = np.empty((k_all, k_all)), np.empty((k_all, k_all))
    where_a, where_c = np.empty((n * n, 2), np.int64), np.empty((k_all * n, 2), np.int64)
    count_a, count_c, place = 0, 0, np.empty(k_all, np.int64)
    for t in range(n_steps - 1, -1, -1):
        c = model.C[at(t, model.C.shape[0])]
        if t == n_steps - 1 or model.C.shape[0] > 1:
            count_c = nonzeros(c, where_c)
        k = 0
        for p in range(k_all):
            place[p] = -1
            if seen[t, p] != 0.0:
                place[p] = k
                k += 1
        if told:
            square_columns(roots[t], covariance)
        if t < n_steps - 1:
            a = model.A[at(t + 1, model.A.shape[0])]
            if t == n_steps - 2 or model.A.shape[0] > 1:
                count_a = nonzeros(a, where_a)
            if wanted[B_] != 0:
                b_adjoint = adjoint.b[at(t + 1, adjoint.b.shape[0])]
                for i in range(n):
                    b_adjoint[i] += r[i, 0]
            if wanted[Q_] != 0:
                half_square_less(r, info, adjoint.Q[at(t + 1, adjoint.Q.shape[0])])
            go_back(a, where_a, count_a, r, info, rho, product, v)
        if told:
            copy(x[t], smoothed)
            for i in range(n):
                for l in range(n):
                    for f in range(columns):
                        smoothed[i, f] += covariance[i, l] * rho[l, f]
        if wanted[A_] != 0 and t < n_steps - 1:
            a_adjoint = adjoint.A[at(t + 1, adjoint.A.shape[0])]
            for i in range(n):
                for j in range(n):
                    for f in range(columns):
                        a_adjoint[i, j] += r[i, f] * smoothed[j, f]
                for l in range(n):
                    for j in range(n):
                        a_adjoint[i, j] -= product[i, l] * covariance[l, j]
        look_back(kept[t], k, z[t], rho, v, inverse, u, gain, by_v, spread)
        observation_adjoints(
            adjoint, wanted, t, place, k, u, spread, gain, by_v, smoothed, covariance
        )
        learn_back(c, where_c, count_c, place, k, rho, v, u, gain, by_v, inverse, r, info)
    if wanted[M_] != 0:
        for i in range(n):
            adjoint.m[i] += r[i, 0]
    if wanted[P_] != 0:
        half_square_less(r, info, adjoint.P)
    return OK, n_steps


@exact
def go_back(a, where, count, r, info, rho, product, v):
    """rho <- a' r, product <- info a, v <- a' info a, from the nonzero entries of a."""
    n = info.shape[0]
    fill(rho, 0.0)
    fill(product, 0.0)
    fill(v, 0.0)
    for e in range(count):
        factor, row, into = a[where[e, 0], where[e, 1]], r[where[e, 0]], rho[where[e, 1]]
        for f in range(row.size):
            into[f] += factor * row[f]
    for i in range(n):
        row, into = info[i], product[i]
        for e in range(count):
            into[where[e, 1]] += row[where[e, 0]] * a[where[e, 0], where[e, 1]]
    for e in range(count):
        factor, row, into = a[where[e, 0], where[e, 1]], product[where[e, 0]], v[where[e, 1]]
        for j in range(n):
            into[j] += factor * row[j]


@exact
def look_back(array, k, z, rho, v, inverse, u, gain, by_v, spread):
    """What an update adds: u, gain = K', by_v = K' V, spread = D and inverse = S^-1.

    array : the rows that `filter_forward` keeps. u (K, F), gain and by_v (K, D), inverse and spread
    (K, K): first k rows written.
    """
    n, columns = v.shape[0], rho.shape[1]
    for i in range(k):  # S^-1/2, lower triangular
        for j in range(k):
            spread[i, j] = 0.0
        spread[i, i] = 1.0 / array[i, i]
        for j in range(i):
            total = 0.0
            for l in range(j, i):
                total -= array[l, i] * spread[l, j]
            spread[i, j] = total / array[i, i]
    for i in range(k):  # S^-T/2 times z - K^-' rho and K^-'
        for j in range(n):
            gain[i, j] = 0.0
        for l in range(i, k):
            factor = spread[l, i]
            for j in range(n):
                gain[i, j] += factor * array[l, k + j]
        for j in range(k):
            total = 0.0
            for l in range(max(i, j), k):
                total += spread[l, i] * spread[l, j]
            inverse[i, j] = total
        for f in range(columns):
            total = 0.0
            for l in range(i, k):
                total += spread[l, i] * z[l, f]
            for j in range(n):
                total -= gain[i, j] * rho[j, f]
            u[i, f] = total
    for i in range(k):
        row = by_v[i]
        for j in range(n):
            row[j] = 0.0
        for l in range(n):
            factor, other = gain[i, l], v[l]
            for j in range(n):
                row[j] += factor * other[j]
        for j in range(i + 1):
            total = inverse[i, j]
            for l in range(n):
                total += row[l] * gain[j, l]
            spread[i, j] = total
            spread[j, i] = total


@exact
def observation_adjoints(adjoint, wanted, t, place, k, u, spread, gain, by_v, smoothed, covariance):
    """Those of C, d and R at step t, as far as they are wanted."""
    k_all, n = place.size, gain.shape[1]
    d_adjoint = adjoint.d[at(t, adjoint.d.shape[0])]
    c_adjoint = adjoint.C[at(t, adjoint.C.shape[0])]
    r_adjoint = adjoint.R[at(t, adjoint.R.shape[0])]
    for p in range(k_all):
        i = place[p]
        if i < 0:
            continue
        if wanted[D_] != 0:
            d_adjoint[p] += u[i, 0]
        if wanted[C_] != 0:
            row = c_adjoint[p]
            for a in range(n):
                total = -gain[i, a]
                for f in range(u.shape[1]):
                    total += u[i, f] * smoothed[a, f]
                row[a] += total
            for l in range(n):
                factor, other = by_v[i, l], covariance[l]
                for a in range(n):
                    row[a] += factor * other[a]
        if wanted[R_] != 0:
            for q in range(k_all):
                j = place[q]
                if j >= 0:
                    total = -spread[i, j]
                    for f in range(u.shape[1]):
                        total += u[i, f] * u[j, f]
                    r_adjoint[p, q] += 0.5 * total


@exact
def learn_back(c, where, count, place, k, rho, v, u, gain, by_v, inverse, r, info):
    """r and info (N) <- those before the update; v is destroyed, and by_v."""
    n = v.shape[0]
    copy(rho, r)
    for e in range(count):
        i = place[where[e, 0]]
        if i < 0:
            continue
        p, b = where[e, 0], where[e, 1]
        for f in range(u.shape[1]):
            r[b, f] += c[p, b] * u[i, f]
        for l in range(n):
            v[l, b] -= by_v[i, l] * c[p, b]  # V (I - K C)
    for i in range(k):  # by_v <- K' V (I - K C) - S^-1 C
        row = by_v[i]
        for j in range(n):
            row[j] = 0.0
        for l in range(n):
            factor, other = gain[i, l], v[l]
            for j in range(n):
                row[j] += factor * other[j]
        for e in range(count):
            j = place[where[e, 0]]
            if j >= 0:
                row[where[e, 1]] -= inverse[i, j] * c[where[e, 0], where[e, 1]]
    for e in range(count):
        i = place[where[e, 0]]
        if i < 0:
            continue
        factor, row, into = c[where[e, 0], where[e, 1]], by_v[i], v[where[e, 1]]
        for j in range(n):
            into[j] -= factor * row[j]
    for i in range(n):
        for j in range(i + 1):
            entry = 0.5 * (v[i, j] + v[j, i])
            info[i, j] = entry
            info[j, i] = entry


def zeros_like(model):
    """Adjoints before any is added."""
    return type(model)(*(np.zeros(f.shape) for f in model))
