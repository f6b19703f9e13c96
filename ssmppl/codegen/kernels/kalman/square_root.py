"""The Kalman filter in square-root (array) form.

x_1 ~ N(m, P), x_t = A_t x_{t-1} + b_t + N(0, Q_t), y_t = C_t x_t + d_t + N(0, R_t).

Covariances are carried as factors, P = L L', and both steps are orthogonal transformations that
make an array lower triangular (Kailath, Sayed and Hassibi 2000, "Linear estimation", chapter 12):

    [A L   Q^1/2]      -> [L_pred  0]

    [R^1/2   C L]         [S^1/2   0 ]
    [0         L]      -> [K       L+],    gain = K S^-1/2

so no covariance is ever subtracted from another and none loses its positive semidefiniteness;
Q and P may be singular. A missing component drops its row from C and from R^1/2.

Arrays stand transposed, a column in a row of memory, so that a transformation works on whole rows;
zeros are passed over: those of A and C (the shift registers of seasons and lags), the columns that
a Q of low rank does not have, and in the update the half of L that is zero, for which rotations
take a column of L after the other into that of a measurement.

Where A, Q, C and R do not depend on time, covariances settle (Anderson and Moore 1979, "Optimal
filtering", chapter 4). From the step on at which the root moves by rounding errors only, the arrays
are kept and the means go on alone, until a row misses other components than the one before.

Notation: D states, K observed components, T steps; a matrix that does not depend on time is given
with a first axis of length 1 instead of T. Nonzero entries of a matrix (n, m) are listed as `where`
(n m, 2), of which the first `count` rows are in use.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ssmppl.codegen.kernels.math.copies import copy_row, copy_rows
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
def square_columns(root, out):
    """out = root' root: the covariance of a transposed root."""
    for i in range(root.shape[1]):
        for j in range(root.shape[1]):
            out[i, j] = 0.0
    for c in range(root.shape[0]):
        column = root[c]
        for i in range(column.size):
            factor, row = column[i], out[i]
            if factor != 0.0:
                for j in range(column.size):
                    row[j] += factor * column[j]


@exact
def add_spread(c, root, out):
    """out += c root' root c'."""
    told = np.zeros((root.shape[0], c.shape[0]))
    for l in range(root.shape[0]):
        for i in range(c.shape[0]):
            for j in range(root.shape[1]):
                told[l, i] += c[i, j] * root[l, j]
    for l in range(root.shape[0]):
        for i in range(c.shape[0]):
            for j in range(c.shape[0]):
                out[i, j] += told[l, i] * told[l, j]


@exact
def at(t, n):
    """Index of step t in an array of n steps, or of one for all."""
    return t if n > 1 else 0


@exact
def nonzeros(a, where):
    """Write (row, column) of the entries of a that are not zero into where; returns how many."""
    count = 0
    for i in range(a.shape[0]):
        for j in range(a.shape[1]):
            if a[i, j] != 0.0:
                where[count, 0] = i
                where[count, 1] = j
                count += 1
    return count


@exact
def affine_known(a, where, count, x, b, out):
    """out = a x + b, from the nonzero entries of a."""
    for i in range(b.size):
        out[i] = b[i]
    for e in range(count):
        i, k = where[e, 0], where[e, 1]
        out[i] += a[i, k] * x[k]


@exact
def turn(a, out):
    """out <- a'."""
    for i in range(a.shape[0]):
        for j in range(a.shape[1]):
            out[j, i] = a[i, j]


@exact
def reflect_columns(a, width, pivots, dots):
    """Make a' lower triangular, its columns being rows 0 to width of a: Householder reflections.

    Only pivots rows of a' are looked at, and those below carried along. dots : scratch.
    """
    n = a.shape[1]
    for i in range(min(pivots, width)):
        others = 0.0
        for c in range(i + 1, width):
            others += a[c, i] * a[c, i]
        if others == 0.0:
            continue
        norm = math.sqrt(a[i, i] * a[i, i] + others)
        diagonal = -norm if a[i, i] > 0.0 else norm
        a[i, i] -= diagonal  # column i now holds the vector v of the reflection 1 - 2 v v' / v'v
        scale = -1.0 / (diagonal * a[i, i])
        for j in range(i + 1, n):
            dots[j] = 0.0
        for c in range(i, width):
            factor, column = a[c, i], a[c]
            if factor != 0.0:
                for j in range(i + 1, n):
                    dots[j] += factor * column[j]
        for c in range(i, width):
            factor, column = scale * a[c, i], a[c]
            if factor != 0.0:
                for j in range(i + 1, n):
                    column[j] -= factor * dots[j]
            a[c, i] = 0.0
        a[i, i] = diagonal


@exact
def columns_of(root, out):
    """out <- root'; returns how many columns there are before those that are zero, as of
    `square_root`."""
    turn(root, out)
    for c in range(out.shape[0]):
        empty = True
        for i in range(out.shape[1]):
            empty = empty and out[c, i] == 0.0
        if empty:
            return c
    return out.shape[0]


@exact
def predict_root(a, where, count, noise, rank, root, array, dots):
    """root <- the transposed root of A L L' A' + Q; array (2 D, D), dots (D,): scratch.

    root : of L lower triangular, as it is after. noise : the transposed root of Q, of which rank
    rows are not zero.
    """
    n = root.shape[0]
    for c in range(n):
        column, into = root[c], array[c]
        for i in range(n):
            into[i] = 0.0
        for e in range(count):
            k = where[e, 1]
            if k >= c:  # the column is zero before
                into[where[e, 0]] += a[where[e, 0], k] * column[k]
    for c in range(rank):
        for i in range(n):
            array[n + c, i] = noise[c, i]
    reflect_columns(array, n + rank, n, dots)
    for c in range(n):
        for i in range(n):
            root[c, i] = array[c, i]


@exact
def noise_columns(r_root, seen, place, noise, dots):
    """Write the transposed lower triangular root of the measured part of R; returns its size k.

    r_root (K, K): a root of R. noise (K, K): its first k columns are written. place (K,) integers:
    where each component of y is among those that were measured, -1 where it was not.
    """
    k, k_all = 0, r_root.shape[0]
    for p in range(k_all):
        place[p] = -1
        if seen[p] != 0.0:
            for q in range(k_all):
                noise[q, k] = r_root[p, q]
            place[p] = k
            k += 1
    reflect_columns(noise, k_all, k, dots)
    return k


@exact
def update_root(c, where, count, place, noise, k, root, array):
    """Fill and transform the array of an update.

    root : transposed root of the predicted covariance, lower triangular before it was transposed.
    noise, place, k : of `noise_columns`. array (K + D, K + D): its first k rows then hold S^1/2 and
    the gain's K, transposed, in columns 0 to k and k to k + D; the next D rows the transposed root
    of the filtered covariance, in the latter.
    """
    n = root.shape[0]
    for i in range(k + n):
        for j in range(k + n):
            array[i, j] = 0.0
    for q in range(k):
        for i in range(q, k):
            array[q, i] = noise[q, i]
    for l in range(n):
        column, into = root[l], array[k + l]
        for j in range(n):
            into[k + j] = column[j]
        for e in range(count):
            row = place[where[e, 0]]
            if row >= 0:
                into[row] += c[where[e, 0], where[e, 1]] * column[where[e, 1]]
    for i in range(k):
        pivot = array[i]
        for l in range(n - 1, -1, -1):
            column = array[k + l]
            entry = column[i]
            if entry == 0.0:
                continue
            radius = math.sqrt(pivot[i] * pivot[i] + entry * entry)
            cosine, sine = pivot[i] / radius, entry / radius
            for j in range(i, k):
                above, here = pivot[j], column[j]
                pivot[j] = cosine * above + sine * here
                column[j] = cosine * here - sine * above
            for j in range(k + l, k + n):
                above, here = pivot[j], column[j]
                pivot[j] = cosine * above + sine * here
                column[j] = cosine * here - sine * above
            column[i] = 0.0


class Roots(NamedTuple):
    """What the roots of a filter go on by, D states and K components of y.

    root (D, D): transposed root of what is known of x. array (K + D, K + D): of `update_root`.
    a, c : `where` of A and C. state_noise (D, D): transposed root of Q; noise (K, K) and place
    (K,): of `noise_columns`. counts : of a, of c, rank of Q, how many components were measured.
    full, r_root, both, dots : scratch, but that r_root keeps a root of R.
    """

    root: np.ndarray
    array: np.ndarray
    a: np.ndarray
    c: np.ndarray
    state_noise: np.ndarray
    noise: np.ndarray
    place: np.ndarray
    counts: np.ndarray
    full: np.ndarray
    r_root: np.ndarray
    both: np.ndarray
    dots: np.ndarray


@exact
def roots_of(n, k_all):
    """Room for them."""
    return Roots(
        np.empty((n, n)), np.empty((k_all + n, k_all + n)), np.empty((n * n, 2), np.int64),
        np.empty((k_all * n, 2), np.int64), np.empty((n, n)), np.empty((k_all, k_all)),
        np.empty(k_all, np.int64), np.zeros(4, np.int64), np.empty((n, n)),
        np.empty((k_all, k_all)), np.empty((2 * n, n)), np.empty(max(n, k_all)),
    )  # fmt: skip


@exact
def begin_roots(P, s):
    """The root of x_1; False where P is no covariance."""
    if not square_root(P, s.full):
        return False
    turn(s.full, s.root)
    reflect_columns(s.root, s.root.shape[0], s.root.shape[0], s.dots)
    return True


@exact
def predict_step(A, Q, t, s):
    """The root of x_t from that of x_{t-1}; False where Q is no covariance. A and Q are looked at
    anew where they change; t > 0."""
    if t == 1 or A.shape[0] > 1:
        s.counts[0] = nonzeros(A[at(t, A.shape[0])], s.a)
    if t == 1 or Q.shape[0] > 1:
        if not square_root(Q[at(t, Q.shape[0])], s.full):
            return False
        s.counts[2] = columns_of(s.full, s.state_noise)
    a = A[at(t, A.shape[0])]
    predict_root(a, s.a, s.counts[0], s.state_noise, s.counts[2], s.root, s.both, s.dots)
    return True


@exact
def measure_step(C, R, t, seen, alike, s):
    """What of C and R the update of step t takes; False where R is no covariance.

    alike : whether the same components were measured as in the step before.
    """
    if t == 0 or C.shape[0] > 1:
        s.counts[1] = nonzeros(C[at(t, C.shape[0])], s.c)
    if t == 0 or R.shape[0] > 1:
        if not square_root(R[at(t, R.shape[0])], s.r_root):
            return False
    if not alike or R.shape[0] > 1:
        s.counts[3] = noise_columns(s.r_root, seen, s.place, s.noise, s.dots)
    return True


@exact
def update_step(c, s):
    """The root of x_t given y_t, and the array; after `measure_step`."""
    k = s.counts[3]
    update_root(c, s.c, s.counts[1], s.place, s.noise, k, s.root, s.array)
    for i in range(s.root.shape[0]):
        for j in range(s.root.shape[0]):
            s.root[i, j] = s.array[k + i, k + j]


@exact
def learn(array, k, residual, seen, mean, z):
    """mean <- that given the seen components of y; (log density, smallest |S^1/2_ii|).

    array, k : of `update_root`. residual : (K,) y less its prediction. z : (K,) scratch.
    """
    log_density, least = -0.5 * k * LOG_2PI, np.inf
    i = 0
    for row in range(seen.size):  # z = S^-1/2 residual
        if seen[row] != 0.0:
            z[i] = residual[row]
            for j in range(i):
                z[i] -= array[j, i] * z[j]
            z[i] /= array[i, i]
            least = min(least, abs(array[i, i]))
            log_density -= math.log(abs(array[i, i])) + 0.5 * z[i] * z[i]
            i += 1
    for j in range(k):
        column = array[j]
        for i in range(mean.size):
            mean[i] += column[k + i] * z[j]
    return log_density, least


@exact
def rests(root, last):
    """Whether a triangular root, transposed, is the last one but for rounding; last <- root.

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
            entry = root[j, i] if root[j, j] >= 0.0 else -root[j, i]
            squares += entry * entry
            change = max(change, abs(entry - last[j, i]))
        if not change <= SETTLED * math.sqrt(squares):
            still = False
            break
    for j in range(n):
        column, kept = root[j], last[j]
        sign = 1.0 if column[j] >= 0.0 else -1.0
        size, change, noise = 0.0, 0.0, 0.0
        if still:
            for i in range(j, n):
                size = max(size, abs(column[i]))
                change = max(change, abs(sign * column[i] - kept[i]))
                for k in range(i + 1):
                    noise = max(noise, SETTLED * abs(root[k, i]))
        for i in range(j, n):
            kept[i] = sign * column[i]
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
    settled, s = False, roots_of(n, k_all)
    x, before, last = m.copy(), np.empty(n), np.zeros((n, n))
    predicted, residual, z = np.empty(k_all), np.empty(k_all), np.empty(k_all)
    log_increment[:] = -np.inf
    if not begin_roots(P, s):
        return NOT_COVARIANCE, 0
    for t in range(n_steps):
        c = C[at(t, C.shape[0])]
        alike = t > 0 and same(seen[t], seen[t - 1])
        settled = settled and alike
        if not settled:
            if t > 0 and not predict_step(A, Q, t, s):
                return NOT_COVARIANCE, t
            if not measure_step(C, R, t, seen[t], alike, s):
                return NOT_COVARIANCE, t
        if t > 0:
            copy_row(x, before)
            b_t = b[at(t, b.shape[0])]
            affine_known(A[at(t, A.shape[0])], s.a, s.counts[0], before, b_t, x)
        affine_known(c, s.c, s.counts[1], x, d[at(t, d.shape[0])], predicted)
        if moments:
            copy_row(x, mean_predicted[t])
            copy_row(predicted, observation_mean[t])
            if settled:
                copy_rows(covariance_predicted[t - 1], covariance_predicted[t])
                copy_rows(observation_covariance[t - 1], observation_covariance[t])
            else:
                square_columns(s.root, covariance_predicted[t])
                copy_rows(R[at(t, R.shape[0])], observation_covariance[t])
                add_spread(c, s.root, observation_covariance[t])
        for j in range(k_all):
            residual[j] = y[t, j] - predicted[j]
        if not settled:
            update_step(c, s)
        increment, least = learn(s.array, s.counts[3], residual, seen[t], x, z)
        if least == 0.0:
            return SINGULAR, t
        if not abs(increment) < np.inf:
            return NOT_FINITE, t
        log_increment[t] = increment
        if moments:
            copy_row(x, mean[t])
            if settled:
                copy_rows(covariance[t - 1], covariance[t])
            else:
                square_columns(s.root, covariance[t])
        if constant and not settled:
            settled = rests(s.root, last) and alike
    return OK, n_steps
