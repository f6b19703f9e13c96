"""One draw of all states of a linear Gaussian model, by the smoothed mean of another record.

With (x*, y*) drawn from the model without its means, x* + E[x | y - y*] is a draw of x given y (J.
Durbin and S. J. Koopman, "A simple and efficient simulation smoother for state space time series
analysis", *Biometrika* 89 (2002), in the form of M. Jarocinski, *Computational Statistics and Data
Analysis* 91 (2015)). The smoothed mean takes the filter's forward pass, the derivatives r of log p
in the means of the steps going back (`adjoint.py`), and the disturbances Q r going forth: no matrix
goes back, so that one draw takes little more than one likelihood. Many draws share what the exact
kernel (`smoother.draw`) finds once, and it serves where this one cannot:

The recursion forth ends at the filter's own mean; how far off it does is its rounding error, which
a start that is next to unknown and an unstable model make large. Beyond a share of the standard
deviation nothing is drawn.
"""

from __future__ import annotations

import numpy as np

from ssmppl.codegen.kernels.kalman.adjoint import filter_forward, means_forward
from ssmppl.codegen.kernels.kalman.square_root import NOT_COVARIANCE, OK, at, square_root
from ssmppl.codegen.kernels.kalman.steps import root_at
from ssmppl.codegen.kernels.math.flags import exact
from ssmppl.codegen.kernels.math.random import fill_normal

UNSURE = 4  # status: rounding errors are too large
CLOSE = 1e-6  # of a standard deviation
ROUNDING, ROUNDED = 2.0**-52, 2.0**-48  # of one operation; of a few in a row, relative


@exact
def without_means(model, stream, states, less):
    """Draw the record without means: states (T, D), written, and less (T, K), from which y* is
    taken off; False where some matrix is no covariance."""
    (n_steps, n), k_all = states.shape, less.shape[1]
    q_root, r_root, e = np.empty((n, n)), np.empty((k_all, k_all)), np.empty(n + k_all)
    if not square_root(model.P, q_root):
        return False
    for t in range(n_steps):
        fill_normal(stream, e)
        if t > 0 and not root_at(model.Q, t, 1, q_root):
            return False
        if not root_at(model.R, t, 0, r_root):
            return False
        c, x = model.C[at(t, model.C.shape[0])], states[t]
        for i in range(n):
            total = 0.0
            for j in range(n):
                total += q_root[i, j] * e[j]
            x[i] = total
        if t > 0:
            a, before = model.A[at(t, model.A.shape[0])], states[t - 1]
            for i in range(n):
                total = x[i]
                for j in range(n):
                    total += a[i, j] * before[j]
                x[i] = total
        for p in range(k_all):
            total = less[t, p]
            for j in range(n):
                total -= c[p, j] * x[j]
            for q in range(k_all):
                total -= r_root[p, q] * e[n + q]
            less[t, p] = total
    return True


@exact
def slopes_back(model, seen, kept, z, r):
    """r (T, D) <- the derivatives of log p in the means of the steps.

    kept, z : of `filter_forward`, for one column of means.
    """
    (n_steps, n), k_all = r.shape, seen.shape[1]
    rho, u = np.zeros(n), np.empty(k_all)
    for t in range(n_steps - 1, -1, -1):
        array, c, own = kept[t], model.C[at(t, model.C.shape[0])], r[t]
        k = 0
        for p in range(k_all):
            k += 1 if seen[t, p] != 0.0 else 0
        for i in range(k - 1, -1, -1):  # S^-T/2 times z - K^-' rho
            total = z[t, i, 0]
            for j in range(n):
                total -= array[i, k + j] * rho[j]
            for l in range(i + 1, k):
                total -= array[i, l] * u[l]
            u[i] = total / array[i, i]
        for j in range(n):
            own[j] = rho[j]
        i = 0
        for p in range(k_all):
            if seen[t, p] != 0.0:
                for j in range(n):
                    own[j] += c[p, j] * u[i]
                i += 1
        if t > 0:
            a = model.A[at(t, model.A.shape[0])]
            for j in range(n):
                rho[j] = 0.0
            for i in range(n):
                factor = own[i]
                for j in range(n):
                    rho[j] += a[i, j] * factor


@exact
def draw_by_correction(model, start, y, seen, stream, known, kept, roots, out):
    """One draw from p(x_{1:T} | y_{1:T}); returns (status, t) of the forward pass, or UNSURE.

    start (D, F) as of `smoother.draw`. stream : state of the random numbers, advanced. known :
    whether kept and roots are those of a record that misses the same; else they are written, as of
    `filter_forward`. out (T, D), written.
    """
    n_steps, n, k_all, columns = y.shape[0], start.shape[0], y.shape[1], start.shape[1]
    weight, mean = np.empty(columns), np.zeros((n, 1))
    fill_normal(stream, weight)
    weight[0] = 1.0
    for i in range(n):
        for f in range(columns):
            mean[i, 0] += start[i, f] * weight[f]
    states, less = np.empty((n_steps, n)), y.copy()
    if not without_means(model, stream, states, less):
        return NOT_COVARIANCE, 0
    x, z, increments = np.empty((n_steps, n, 1)), np.empty((n_steps, k_all, 1)), np.empty(n_steps)
    if known:
        status, stopped = means_forward(model, mean, less, seen, x, kept, z, increments)
    else:
        status, stopped = filter_forward(model, mean, less, seen, x, kept, z, roots, increments)
    if status != OK:
        return status, stopped
    r = np.empty((n_steps, n))
    slopes_back(model, seen, kept, z, r)
    spread, largest = np.zeros(n), np.zeros(n)
    for i in range(n):
        for c in range(n):
            spread[i] += roots[n_steps - 1, c, i] ** 2
        spread[i] = np.sqrt(spread[i])
        for t in range(n_steps):
            largest[i] = max(largest[i], abs(r[t, i]))
    here, before = np.empty(n), np.empty(n)
    for t in range(n_steps):
        for i in range(n):
            total = mean[i, 0] if t == 0 else model.b[at(t, model.b.shape[0])][i]
            q = model.P if t == 0 else model.Q[at(t, model.Q.shape[0])]
            for j in range(n):
                total += q[i, j] * r[t, j]
            here[i] = total
        if t == 0:
            for i in range(n):
                off = 0.0
                for j in range(n):
                    off += ROUNDING * abs(model.P[i, j]) * largest[j]
                if not off <= CLOSE * spread[i] + ROUNDED * abs(here[i]):
                    return UNSURE, 0
        else:
            a = model.A[at(t, model.A.shape[0])]
            for i in range(n):
                for j in range(n):
                    here[i] += a[i, j] * before[j]
        for i in range(n):
            before[i] = here[i]
            out[t, i] = here[i] + states[t, i]
            # where the two all but cancel, what they have in common is lost
            off = ROUNDED * (abs(here[i]) + abs(states[t, i]))
            if not off <= CLOSE * spread[i] + 2.0 * ROUNDED * abs(out[t, i]):
                return UNSURE, t
    for i in range(n):
        off = abs(here[i] - x[n_steps - 1, i, 0])
        if not off <= CLOSE * spread[i] + n_steps * ROUNDED * abs(here[i]):
            return UNSURE, n_steps
    return OK, n_steps
