"""The Gaussian law of the states round the mode, from the factors that Newton's method leaves.

e_t given x_{t-1} is Gaussian there, with the gains of the mode and the precision root root': one
pass forward. Notation as in `mode.py`; Z is D + R, and R_1 alone in the first row.
"""

from __future__ import annotations

import numpy as np

from ssmppl.codegen.kernels.math.flags import exact
from ssmppl.codegen.kernels.twisted.lookahead_backward import solve


@exact
def joint_moments(t, r, gain, root, jacobian, spread, p, xi, column):
    """xi (Z, Z) <- the covariance of (x_{t-1}, e_t), and p (D, D) <- that of x_t, from that of
    x_{t-1}; in the first row Z is R alone. column (R', 1) : room."""
    d = p.shape[0]
    at = 0 if t == 0 else d
    for k in range(r):  # M^-1, by columns
        for n in range(r):
            column[n, 0] = 1.0 if n == k else 0.0
        solve(root, column, 0)
        for n in range(r):
            xi[at + n, at + k] = column[n, 0]
    if t > 0:
        for i in range(d):
            for j in range(d):
                xi[i, j] = p[i, j]
        for k in range(r):
            for j in range(d):
                total = 0.0
                for i in range(d):
                    total -= gain[k, i] * p[i, j]
                xi[d + k, j] = total
                xi[j, d + k] = total
        for k in range(r):
            for n in range(r):
                total = 0.0
                for i in range(d):
                    total -= gain[k, i] * xi[i, d + n]
                xi[d + k, d + n] += total
    n_all = at + r
    for i in range(d):
        for j in range(i + 1):
            total = 0.0
            for k in range(n_all):
                left = jacobian[i, k] if k < at else spread[i, k - at]
                if left == 0.0:
                    continue
                for n in range(n_all):
                    right = jacobian[j, n] if n < at else spread[j, n - at]
                    total += left * xi[k, n] * right
            p[i, j] = total
            p[j, i] = total


@exact
def mode_moments(r, gain, root, jacobian, spread, covariance, cross):
    """covariance (T, D, D) <- that of x_t, cross (T, D, D) <- that of x_t with x_{t-1}, 0 in the
    first row.

    r : numbers (R_1, R) of noises. gain (T, R', D), root (T, R', R'), jacobian (T, D, D), spread
    (T, D, R') : of the mode.
    """
    n_steps, d, widest = spread.shape
    z = d + widest
    p, xi, column = np.zeros((d, d)), np.zeros((z, z)), np.zeros((widest, 1))
    for t in range(n_steps):
        n = r[0] if t == 0 else r[1]
        joint_moments(t, n, gain[t], root[t, :n, :n], jacobian[t], spread[t], p, xi, column)
        for i in range(d):
            for j in range(d):
                covariance[t, i, j] = p[i, j]
                cross[t, i, j] = 0.0
                if t > 0:
                    for k in range(d):
                        cross[t, i, j] += jacobian[t, i, k] * xi[k, j]
                    for k in range(n):
                        cross[t, i, j] += spread[t, i, k] * xi[d + k, j]
