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
K^- = K S^1/2. Only S is inverted, by its triangular root; N and D are sums of squares. A symmetric
matrix has the derivative of its entries taken one by one.

Where a part of the start is unknown, products of r, u and xs are expectations over it, that is,
sums over the columns (see `steps.py`).
"""

from __future__ import annotations

import numpy as np

from ssmppl.codegen.kernels.kalman.square_root import OK, at, multiply, square
from ssmppl.codegen.kernels.kalman.steps import copy, forward, multiply_add, root_at, update
from ssmppl.codegen.kernels.math.flags import exact


@exact
def transposed(a, out):
    """out <- a'."""
    for i in range(a.shape[0]):
        for j in range(a.shape[1]):
            out[j, i] = a[i, j]


@exact
def congruence(n, a, product, out):
    """out <- a' n a, symmetric; product: scratch of the shape of a."""
    multiply(n, a, product)
    for i in range(a.shape[1]):
        for j in range(i + 1):
            total = 0.0
            for k in range(a.shape[0]):
                total += a[k, i] * product[k, j]
            out[i, j] = total
            out[j, i] = total


@exact
def add_products(a, b, out):
    """out += sum over columns of a b'."""
    for i in range(a.shape[0]):
        for j in range(b.shape[0]):
            total = 0.0
            for f in range(a.shape[1]):
                total += a[i, f] * b[j, f]
            out[i, j] += total


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
def solve_transposed(array, b, k):
    """b, first k rows <- L^-T b, L the leading lower triangle (k, k) of array."""
    for j in range(b.shape[1]):
        for i in range(k - 1, -1, -1):
            for l in range(i + 1, k):
                b[i, j] -= array[l, i] * b[l, j]
            b[i, j] /= array[i, i]


@exact
def observation_adjoints(
    model, adjoint, t, seen, array, k, z, rho, v, smoothed, filtered_cov, u, gain, spread
):
    """Those of C, d and R at step t; u and gain = K' = S^-T/2 K^-' left behind.

    u (K, F), gain (K, D), spread (K, K): first k rows written.
    """
    n = v.shape[0]
    for i in range(k):
        for f in range(z.shape[1]):
            u[i, f] = z[i, f]
            for j in range(n):
                u[i, f] -= array[k + j, i] * rho[j, f]
        for j in range(n):
            gain[i, j] = array[k + j, i]
    # spread = S^-T/2 (I + K^-' V K^-) S^-1/2
    inner = np.empty((n, k))
    for j in range(n):
        for i in range(k):
            inner[j, i] = 0.0
            for l in range(n):
                inner[j, i] += v[j, l] * gain[i, l]
    for i in range(k):
        for j in range(k):
            total = 1.0 if i == j else 0.0
            for l in range(n):
                total += gain[i, l] * inner[l, j]
            spread[i, j] = total
    solve_transposed(array, u, k)
    solve_transposed(array, spread[:k, :k], k)
    solve_transposed(array, spread[:k, :k].T, k)
    solve_transposed(array, gain, k)
    for i in range(k):  # inner' <- K' V
        for l in range(n):
            inner[l, i] = 0.0
            for h in range(n):
                inner[l, i] += gain[i, h] * v[h, l]
    d_adjoint = adjoint.d[at(t, adjoint.d.shape[0])]
    c_adjoint = adjoint.C[at(t, adjoint.C.shape[0])]
    r_adjoint = adjoint.R[at(t, adjoint.R.shape[0])]
    i = 0
    for p in range(seen.size):
        if seen[p] == 0.0:
            continue
        d_adjoint[p] += u[i, 0]
        for a in range(n):
            total = -gain[i, a]
            for l in range(n):
                total += inner[l, i] * filtered_cov[l, a]
            for f in range(u.shape[1]):
                total += u[i, f] * smoothed[a, f]
            c_adjoint[p, a] += total
        j = 0
        for q in range(seen.size):
            if seen[q] == 0.0:
                continue
            total = -0.5 * (spread[i, j] + spread[j, i])
            for f in range(u.shape[1]):
                total += u[i, f] * u[j, f]
            r_adjoint[p, q] += 0.5 * total
            j += 1
        i += 1


@exact
def adjoints(model, start, y, seen, log_increment, adjoint):
    """Derivatives of log p(y); returns (status, t) of the forward pass.

    start (D, F): the mean of x_1, and a root of the law of its unknown part; log_increment (T,),
    written. adjoint: `Matrices` of the shapes of the model's; to each is added, summed over time
    where the matrix is one for all steps.
    """
    n_steps, n, k_all, columns = y.shape[0], start.shape[0], y.shape[1], start.shape[1]
    x, roots = np.empty((n_steps, n, columns)), np.empty((n_steps, n, n))
    status, stopped = forward(model, start, y, seen, x, roots, log_increment)
    if status != OK:
        return status, stopped
    r_root, array = np.empty((k_all, k_all)), np.empty((k_all + n, k_all + n))
    filtered, z = np.empty((n, columns)), np.empty((k_all, columns))
    r, rho, u = np.zeros((n, columns)), np.zeros((n, columns)), np.empty((k_all, columns))
    info, v, product = np.zeros((n, n)), np.zeros((n, n)), np.empty((n, n))  # N and V
    filtered_cov, turned = np.empty((n, n)), np.empty((n, n))
    gain, spread = np.empty((k_all, n)), np.empty((k_all, k_all))
    for t in range(n_steps - 1, -1, -1):
        c = model.C[at(t, model.C.shape[0])]
        root_at(model.R, t, n_steps - 1, r_root)
        k = update(model, t, y[t], seen[t], x[t], roots[t], r_root, array, z, filtered)
        square(array[k : k + n, k : k + n], filtered_cov)
        if t < n_steps - 1:
            a = model.A[at(t + 1, model.A.shape[0])]
            transposed(a, turned)
            multiply(turned, r, rho)
            congruence(info, a, product, v)
            multiply_add(filtered_cov, rho, filtered)  # the smoothed mean
            b_adjoint = adjoint.b[at(t + 1, adjoint.b.shape[0])]
            for i in range(n):
                b_adjoint[i] += r[i, 0]
            half_square_less(r, info, adjoint.Q[at(t + 1, adjoint.Q.shape[0])])
            a_adjoint = adjoint.A[at(t + 1, adjoint.A.shape[0])]
            add_products(r, filtered, a_adjoint)
            for i in range(n):  # product holds N A
                for j in range(n):
                    for l in range(n):
                        a_adjoint[i, j] -= product[i, l] * filtered_cov[l, j]
        observation_adjoints(
            model, adjoint, t, seen[t], array, k, z, rho, v, filtered, filtered_cov, u, gain, spread
        )
        back(c, seen[t], array, k, rho, v, u, gain, product, turned, r, info)
    for i in range(n):
        adjoint.m[i] += r[i, 0]
    half_square_less(r, info, adjoint.P)
    return OK, n_steps


@exact
def back(c, seen, array, k, rho, v, u, gain, product, turned, r, info):
    """r and info (N) <- those before the update; product and turned: scratch (D, D).

    gain (K, D), first k rows: K'. turned holds I - K C.
    """
    n = v.shape[0]
    copy(rho, r)
    for i in range(n):
        for j in range(n):
            turned[i, j] = 1.0 if i == j else 0.0
    i = 0
    for p in range(seen.size):
        if seen[p] != 0.0:
            for a in range(n):
                for f in range(u.shape[1]):
                    r[a, f] += c[p, a] * u[i, f]
                for b in range(n):
                    turned[a, b] -= gain[i, a] * c[p, b]
            i += 1
    congruence(v, turned, product, info)
    whitened = np.zeros((k, n))  # S^-1/2 C, row by row
    i = 0
    for p in range(seen.size):
        if seen[p] == 0.0:
            continue
        for a in range(n):
            total = c[p, a]
            for j in range(i):
                total -= array[i, j] * whitened[j, a]
            whitened[i, a] = total / array[i, i]
        i += 1
    for a in range(n):
        for b in range(n):
            for i in range(k):
                info[a, b] += whitened[i, a] * whitened[i, b]


def zeros_like(model):
    """Adjoints before any is added."""
    return type(model)(*(np.zeros(f.shape) for f in model))
