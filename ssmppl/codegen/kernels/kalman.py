"""The Kalman filter in square-root (array) form.

x_1 ~ N(m, P), x_t = A_t x_{t-1} + b_t + N(0, Q_t), y_t = C_t x_t + d_t + N(0, R_t).

Covariances are carried as factors, P = L L', and both steps are orthogonal transformations that
make an array lower triangular (Kailath, Sayed and Hassibi 2000, "Linear estimation", chapter 12):

    [A L   Q^1/2]      -> [L_pred  0]

    [R^1/2   C L]         [S^1/2   0 ]
    [0         L]      -> [K       L+],    gain = K S^-1/2

so no covariance is ever subtracted from another and none loses its positive semidefiniteness;
Q and P may be singular. A missing component drops its row from C and from R^1/2.

Everything that the entry point calls is in this file, because Numba's disk cache notices edits of
the entry point's own file only.

Notation: D states, K observed components, T steps; a matrix that does not depend on time is given
with a first axis of length 1 instead of T.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from ssmppl.codegen.kernels.flags import exact

OK, NOT_COVARIANCE, SINGULAR, NOT_FINITE = 0, 1, 2, 3
LOG_2PI = math.log(2.0 * math.pi)
# Of a covariance's entries: pivots below this share are zero, and what they leave may be as large
# as that one.
PIVOT, REST = 1e-14, 1e-10

entry = numba.njit(cache=True, nogil=True, error_model="numpy")


@exact
def square_root(covariance, root):
    """Write a root of a semidefinite matrix, root root' = covariance; False where there is none.

    Cholesky's factorisation in the order of the largest share of variance that is left, which is
    stable for singular matrices (Higham 2002, "Accuracy and stability of numerical algorithms",
    section 10.3); shares of the entries' own variance, so that units do not matter.
    """
    n = covariance.shape[0]
    for i in range(n):
        for j in range(n):
            root[i, j] = 0.0
        if not 0.0 <= covariance[i, i] < np.inf:
            return False
    left, done = np.empty(n), np.zeros(n)
    for i in range(n):
        left[i] = covariance[i, i]
    for step in range(n):
        chosen, largest = -1, PIVOT * n
        for i in range(n):
            if done[i] == 0.0 and left[i] > largest * covariance[i, i]:
                chosen, largest = i, left[i] / covariance[i, i]
        if chosen < 0:
            break
        pivot = math.sqrt(left[chosen])
        done[chosen] = 1.0
        root[chosen, step] = pivot
        for i in range(n):
            if done[i] == 0.0:
                entry = covariance[i, chosen]
                for k in range(step):
                    entry -= root[i, k] * root[chosen, k]
                root[i, step] = entry / pivot
                left[i] -= root[i, step] * root[i, step]
    for i in range(n):  # what is left must be rounding errors of zero
        for j in range(i + 1):
            if done[i] == 0.0 or done[j] == 0.0:
                entry = covariance[i, j]
                for k in range(n):
                    entry -= root[i, k] * root[j, k]
                if not abs(entry) <= REST * math.sqrt(covariance[i, i] * covariance[j, j]):
                    return False
    return True


@exact
def triangularise(a):
    """Make a (n, m), m >= n, lower triangular in place, a a' kept: Householder reflections."""
    reflect(a, a.shape[0])


@exact
def reflect(a, pivots):
    """Make the first rows of a (n, m), m >= pivots, lower triangular; a a' of all rows is kept.

    Rows of a unit matrix below the pivots hold the orthogonal transformation afterwards.
    """
    n, m = a.shape
    for i in range(pivots):
        norm = 0.0
        for k in range(i, m):
            norm += a[i, k] * a[i, k]
        norm = math.sqrt(norm)
        if norm == 0.0:
            continue
        diagonal = -norm if a[i, i] > 0.0 else norm
        a[i, i] -= diagonal  # row i now holds the vector v of the reflection 1 - 2 v v' / v'v
        scale = -1.0 / (diagonal * a[i, i])
        for row in range(i + 1, n):
            product = 0.0
            for k in range(i, m):
                product += a[row, k] * a[i, k]
            product *= scale
            for k in range(i, m):
                a[row, k] -= product * a[i, k]
        a[i, i] = diagonal
        for k in range(i + 1, m):
            a[i, k] = 0.0


@exact
def multiply(a, b, out):
    """out = a b."""
    for i in range(a.shape[0]):
        for j in range(b.shape[1]):
            total = 0.0
            for k in range(a.shape[1]):
                total += a[i, k] * b[k, j]
            out[i, j] = total


@exact
def square(root, out):
    """out = root root'."""
    for i in range(root.shape[0]):
        for j in range(i + 1):
            total = 0.0
            for k in range(root.shape[1]):
                total += root[i, k] * root[j, k]
            out[i, j] = total
            out[j, i] = total


@exact
def affine_map(a, x, b, out):
    """out = a x + b."""
    for i in range(a.shape[0]):
        total = b[i]
        for k in range(a.shape[1]):
            total += a[i, k] * x[k]
        out[i] = total


@exact
def at(t, n):
    """Index of step t in an array of n steps, or of one for all."""
    return t if n > 1 else 0


@exact
def predict(a, b, q_root, mean, root, array):
    """mean, root <- those of a x + b + N(0, q_root q_root')."""
    n = mean.size
    affine_map(a, mean.copy(), b, mean)
    multiply(a, root, array[:, :n])
    array[:, n:] = q_root
    triangularise(array)
    root[:] = array[:, :n]


@exact
def update(residual, seen, r_root, c_root, mean, root, z):
    """mean, root <- those given the seen components of y; (log density, smallest |S^1/2_ii|).

    residual : (K,) y less its prediction. c_root : (K, D) C L. z : (K,) scratch.
    """
    n, k_all = mean.size, residual.size
    k = 0
    array = np.zeros((k_all + n, k_all + n))
    for j in range(k_all):
        if seen[j] != 0.0:
            array[k, :k_all] = r_root[j]
            array[k, k_all:] = c_root[j]
            z[k] = residual[j]
            k += 1
    array[k : k + n, k_all:] = root
    array = array[: k + n]
    triangularise(array)
    log_density, least = -0.5 * k * LOG_2PI, np.inf
    for i in range(k):  # z = S^-1/2 residual
        for j in range(i):
            z[i] -= array[i, j] * z[j]
        z[i] /= array[i, i]
        least = min(least, abs(array[i, i]))
        log_density -= math.log(abs(array[i, i])) + 0.5 * z[i] * z[i]
    for i in range(n):
        for j in range(k):
            mean[i] += array[k + i, j] * z[j]
    root[:] = array[k:, k : k + n]
    return log_density, least


@entry
def kalman_filter(
    m, P, A, b, Q, C, d, R, y, seen,
    log_increment, mean, covariance, mean_predicted, covariance_predicted,
    observation_mean, observation_covariance,
):  # fmt: skip
    """Run the filter; returns (status, t), t the step at which a status other than OK arose.

    m (D,), P (D, D); A, Q (T or 1, D, D), b (T or 1, D): into row t, row 0 is not read; C
    (T or 1, K, D), d (T or 1, K), R (T or 1, K, K); y, seen (T, K).
    log_increment (T,): log p(y_t | y_{1:t-1}), written. The moments of x_t given y_{1:t} and given
    y_{1:t-1}, and those of all components of y_t given y_{1:t-1}: written where their first axis
    is not empty.
    """
    n_steps, n, k = y.shape[0], m.size, y.shape[1]
    moments = mean.shape[0] > 0
    x, root, q_root, r_root = m.copy(), np.empty((n, n)), np.empty((n, n)), np.empty((k, k))
    c_root, both = np.empty((k, n)), np.empty((n, 2 * n))
    predicted, residual, z = np.empty(k), np.empty(k), np.empty(k)
    log_increment[:] = -np.inf
    if not square_root(P, root):
        return NOT_COVARIANCE, 0
    for t in range(n_steps):
        if t > 0:
            if (t == 1 or Q.shape[0] > 1) and not square_root(Q[at(t, Q.shape[0])], q_root):
                return NOT_COVARIANCE, t
            predict(A[at(t, A.shape[0])], b[at(t, b.shape[0])], q_root, x, root, both)
        if (t == 0 or R.shape[0] > 1) and not square_root(R[at(t, R.shape[0])], r_root):
            return NOT_COVARIANCE, t
        multiply(C[at(t, C.shape[0])], root, c_root)
        affine_map(C[at(t, C.shape[0])], x, d[at(t, d.shape[0])], predicted)
        if moments:
            mean_predicted[t] = x
            square(root, covariance_predicted[t])
            observation_mean[t] = predicted
            square(c_root, observation_covariance[t])
            observation_covariance[t] += R[at(t, R.shape[0])]
        for j in range(k):
            residual[j] = y[t, j] - predicted[j]
        increment, least = update(residual, seen[t], r_root, c_root, x, root, z)
        if least == 0.0:
            return SINGULAR, t
        if not abs(increment) < np.inf:
            return NOT_FINITE, t
        log_increment[t] = increment
        if moments:
            mean[t] = x
            square(root, covariance[t])
    return OK, n_steps
