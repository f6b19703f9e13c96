"""The Kalman filter in square-root (array) form.

x_1 ~ N(m, P), x_t = A_t x_{t-1} + b_t + N(0, Q_t), y_t = C_t x_t + d_t + N(0, R_t).

Covariances are carried as factors, P = L L', and both steps are orthogonal transformations that
make an array lower triangular (Kailath, Sayed and Hassibi 2000, "Linear estimation", chapter 12):

    [A L   Q^1/2]      -> [L_pred  0]

    [R^1/2   C L]         [S^1/2   0 ]
    [0         L]      -> [K       L+],    gain = K S^-1/2

so no covariance is ever subtracted from another and none loses its positive semidefiniteness;
Q and P may be singular. A missing component drops its row from C and from R^1/2.

Where A, Q, C and R do not depend on time, covariances settle (Anderson and Moore 1979, "Optimal
filtering", chapter 4). From the step on at which the root moves by rounding errors only, the arrays
are kept and the means go on alone, until a row misses other components than the one before.

Notation: D states, K observed components, T steps; a matrix that does not depend on time is given
with a first axis of length 1 instead of T.
"""

from __future__ import annotations

import math

import numpy as np

from ssmppl.codegen.kernels.math.flags import exact

OK, NOT_COVARIANCE, SINGULAR, NOT_FINITE = 0, 1, 2, 3
LOG_2PI = math.log(2.0 * math.pi)
# Of a covariance's entries: pivots below this share are zero, and what they leave may be as large
# as that one.
PIVOT, REST = 1e-14, 1e-10
# A root that moved by no more, as a share of its rows and of its columns, rests: rounding alone
# moves it so, and what falls as 1 / t moves its columns by more in any series.
SETTLED, LEARNT = 16 * 2.0**-52, 1e-11


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
def product(x, y):
    """x'y in four sums that need not wait for each other, always in the same order."""
    a, b, c, d = 0.0, 0.0, 0.0, 0.0
    quarters = x.size // 4
    for q in range(quarters):
        a += x[4 * q] * y[4 * q]
        b += x[4 * q + 1] * y[4 * q + 1]
        c += x[4 * q + 2] * y[4 * q + 2]
        d += x[4 * q + 3] * y[4 * q + 3]
    for k in range(4 * quarters, x.size):
        a += x[k] * y[k]
    return (a + b) + (c + d)


@exact
def triangularise(a):
    """Make a (n, m), m >= n, lower triangular in place, a a' kept: Householder reflections."""
    reflect(a, a.shape[0])


@exact
def reflect(a, pivots):
    """Make the first rows of a (n, m), m >= pivots, lower triangular; a a' of all rows is kept.

    Rows of a unit matrix below the pivots hold the orthogonal transformation afterwards.
    """
    n = a.shape[0]
    for i in range(pivots):
        v = a[i, i:]
        norm = math.sqrt(product(v, v))
        if norm == 0.0:
            continue
        diagonal = -norm if v[0] > 0.0 else norm
        v[0] -= diagonal  # row i now holds the vector v of the reflection 1 - 2 v v' / v'v
        scale = -1.0 / (diagonal * v[0])
        for j in range(i + 1, n):
            row = a[j, i:]
            factor = scale * product(row, v)
            for k in range(row.size):
                row[k] -= factor * v[k]
        v[0] = diagonal
        for k in range(1, v.size):
            v[k] = 0.0


@exact
def multiply(a, b, out):
    """out = a b."""
    for i in range(a.shape[0]):
        row = out[i]
        for j in range(b.shape[1]):
            row[j] = 0.0
        for k in range(a.shape[1]):
            factor, other = a[i, k], b[k]
            for j in range(b.shape[1]):
                row[j] += factor * other[j]


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
def predict(a, q_root, root, array):
    """root <- that of a x + N(0, q_root q_root'); array (D, 2 D) is scratch."""
    n = root.shape[0]
    multiply(a, root, array[:, :n])
    array[:, n:] = q_root
    triangularise(array)
    root[:] = array[:, :n]


@exact
def join(seen, r_root, c_root, root, array):
    """Fill and transform the array of an update; returns k, how many components were measured.

    array (K + D, K + D): rows 0 to k hold S^1/2, rows k to k + D the gain's K and the new root,
    in columns 0 to k and k to k + D.
    """
    n, k_all = root.shape[0], r_root.shape[0]
    array[:] = 0.0
    k = 0
    for j in range(k_all):
        if seen[j] != 0.0:
            array[k, :k_all] = r_root[j]
            array[k, k_all:] = c_root[j]
            k += 1
    array[k : k + n, k_all:] = root
    triangularise(array[: k + n])
    return k


@exact
def learn(array, k, residual, seen, mean, z):
    """mean <- that given the seen components of y; (log density, smallest |S^1/2_ii|).

    array, k : of `join`. residual : (K,) y less its prediction. z : (K,) scratch.
    """
    log_density, least = -0.5 * k * LOG_2PI, np.inf
    i = 0
    for row in range(seen.size):  # z = S^-1/2 residual
        if seen[row] != 0.0:
            z[i] = residual[row]
            for j in range(i):
                z[i] -= array[i, j] * z[j]
            z[i] /= array[i, i]
            least = min(least, abs(array[i, i]))
            log_density -= math.log(abs(array[i, i])) + 0.5 * z[i] * z[i]
            i += 1
    for i in range(mean.size):
        for j in range(k):
            mean[i] += array[k + i, j] * z[j]
    return log_density, least


@exact
def rests(root, last):
    """Whether a triangular root is the last one but for rounding; last <- root.

    What rounding moves is small in units of the rows. That alone does not tell: beside a part that
    no data tell of, what is being learned may be as small, and shrink as slowly as 1 / t. It is
    in columns of its own, which have to rest in their own units, unless they are rounding as a
    whole. The signs of columns do not matter: last holds the root with a diagonal that is not
    negative.
    """
    n, still = root.shape[0], True
    for i in range(n):
        squares, change = 0.0, 0.0
        for j in range(i + 1):
            entry = root[i, j] if root[j, j] >= 0.0 else -root[i, j]
            squares += entry * entry
            change = max(change, abs(entry - last[i, j]))
        still = still and change <= SETTLED * math.sqrt(squares)
    for j in range(n):
        size, change, noise = 0.0, 0.0, 0.0
        for i in range(j, n):
            entry = root[i, j] if root[j, j] >= 0.0 else -root[i, j]
            size, change = max(size, abs(entry)), max(change, abs(entry - last[i, j]))
            for k in range(i + 1 if still else 0):
                noise = max(noise, SETTLED * abs(root[i, k]))
            last[i, j] = entry
        still = still and (change <= LEARNT * size or size <= noise)
    return still


@exact
def same(a, b):
    """Whether two vectors are equal."""
    for i in range(a.size):
        if a[i] != b[i]:
            return False
    return True


@exact
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
    n_steps, n, k_all = y.shape[0], m.size, y.shape[1]
    moments = mean.shape[0] > 0
    constant = A.shape[0] == 1 and Q.shape[0] == 1 and C.shape[0] == 1 and R.shape[0] == 1
    settled, k = False, 0
    x, root, q_root, r_root = m.copy(), np.empty((n, n)), np.empty((n, n)), np.empty((k_all, k_all))
    c_root, both, array = (
        np.empty((k_all, n)),
        np.empty((n, 2 * n)),
        np.empty((k_all + n, k_all + n)),
    )
    last, before, predicted = np.zeros((n, n)), np.empty(n), np.empty(k_all)
    residual, z = np.empty(k_all), np.empty(k_all)
    log_increment[:] = -np.inf
    if not square_root(P, root):
        return NOT_COVARIANCE, 0
    for t in range(n_steps):
        alike = constant and t > 1 and same(seen[t], seen[t - 1])
        settled = settled and alike
        if t > 0:
            before[:] = x
            affine_map(A[at(t, A.shape[0])], before, b[at(t, b.shape[0])], x)
        if not settled:
            if t > 0:
                if (t == 1 or Q.shape[0] > 1) and not square_root(Q[at(t, Q.shape[0])], q_root):
                    return NOT_COVARIANCE, t
                predict(A[at(t, A.shape[0])], q_root, root, both)
            if (t == 0 or R.shape[0] > 1) and not square_root(R[at(t, R.shape[0])], r_root):
                return NOT_COVARIANCE, t
            multiply(C[at(t, C.shape[0])], root, c_root)
        affine_map(C[at(t, C.shape[0])], x, d[at(t, d.shape[0])], predicted)
        if moments:
            mean_predicted[t], observation_mean[t] = x, predicted
            if settled:
                covariance_predicted[t] = covariance_predicted[t - 1]
                observation_covariance[t] = observation_covariance[t - 1]
            else:
                square(root, covariance_predicted[t])
                square(c_root, observation_covariance[t])
                observation_covariance[t] += R[at(t, R.shape[0])]
        for j in range(k_all):
            residual[j] = y[t, j] - predicted[j]
        if not settled:
            k = join(seen[t], r_root, c_root, root, array)
        increment, least = learn(array, k, residual, seen[t], x, z)
        if least == 0.0:
            return SINGULAR, t
        if not abs(increment) < np.inf:
            return NOT_FINITE, t
        log_increment[t] = increment
        if moments:
            mean[t] = x
        if settled:
            if moments:
                covariance[t] = covariance[t - 1]
            continue
        root[:] = array[k : k + n, k : k + n]
        if moments:
            square(root, covariance[t])
        if constant:
            settled = rests(root, last) and alike
    return OK, n_steps
