"""The gradient in theta of Laplace's log-likelihood at a mode, exact, by the adjoint method.

At the mode e* of J, L = J(e*) - log det(-J'') / 2. The determinant depends on theta directly, and
by way of e*, x and the costate l, all of which the mode ties together: x_t = F(x_{t-1}, e_t), l_t =
g_t + J_{t+1}' l_{t+1}, e_t = L_t' l_t. With a multiplier for each of these three (Griewank and
Walther 2008, chapter 15; Skaug and Fournier 2006 for the gradient of Laplace's approximation),

- the derivative of -log det / 2 in the entries of -J'' is minus half the covariance of the noise:
  one pass forward gives Xi_t, that of (x_{t-1}, e_t), and the weights of first and second
  derivatives of F and log g;
- the multipliers b_t of the costate and w_t of the noise are a trajectory of the model made linear:
  its optimal control with linear costs, for which the factors of the mode are at hand; one pass
  backward, one forward;
- what is left is the gradient in theta of one number a row.

Notation as in `mode.py`; `third` and `third_seen` are gradients of the determinant's part in what
moves, `fixed` and `fixed_seen` those of all in theta.
"""

from __future__ import annotations

import numpy as np

from ssmppl.codegen.kernels.gaussian.mode_moments import joint_moments
from ssmppl.codegen.kernels.math.flags import exact
from ssmppl.codegen.kernels.twisted.lookahead_backward import solve


@exact
def mode_gradient(
    prepare, step, third_initial, third, third_seen, fixed_initial, fixed, fixed_seen, sizes,
    theta, y, seen, u, r, x, e, gain, root, jacobian, spread, information, costate, out,
):  # fmt: skip
    """out (P,) <- dL / dtheta; False where it comes to no number.

    r : numbers (R_1, R) of noises. The rest as `mode.gaussian_mode` leaves them.
    """
    n_steps, d = x.shape
    n_parameters, widest = out.size, e.shape[1]
    c, s = np.empty(sizes[0]), np.empty((n_steps, sizes[1]))
    z = d + widest
    # By row, what the passes read: e, l, W, Xi, a, v; and P, b of the observation.
    given = np.zeros((n_steps, widest + d + d * z + z * (z + 1) // 2 + d + z))
    given_seen = np.zeros((n_steps, d * (d + 1) // 2 + d))
    moving, moving_seen = np.zeros((n_steps, z + d)), np.zeros((n_steps, d))
    p, xi, column = np.zeros((d, d)), np.zeros((z, z)), np.zeros((widest, 1))
    dxi = np.zeros((d, z))
    before, now = np.zeros((d, 1)), np.zeros((d, 1))
    values, values_seen = np.zeros((z + d, 1)), np.zeros((d, 1))
    prepare(theta, c)
    for t in range(n_steps):
        step(theta, c, y, seen, u, t, s[t])
        n = r[0] if t == 0 else r[1]
        at = 0 if t == 0 else d
        joint_moments(
            t, n, gain[t], root[t, :n, :n], jacobian[t], spread[t], p, xi, column
        )  # fmt: skip
        m = 0
        for k in range(n):
            given[t, m] = e[t, k]
            m += 1
        for i in range(d):
            given[t, m] = costate[t, i]
            m += 1
        for i in range(d):
            for j in range(at + n):
                total = 0.0
                for k in range(at):
                    total += jacobian[t, i, k] * xi[k, j]
                for k in range(n):
                    total += spread[t, i, k] * xi[at + k, j]
                dxi[i, j] = total
        for i in range(d):
            for j in range(at + n):
                total = 0.0
                for k in range(d):
                    total -= information[t, i, k] * dxi[k, j]
                given[t, m] = total
                m += 1
        for i in range(at + n):
            for j in range(i + 1):
                given[t, m] = xi[i, j]
                m += 1
        m = 0
        for i in range(d):
            now[i, 0] = x[t, i]
            for j in range(i + 1):
                given_seen[t, m] = p[i, j]
                m += 1
        if t == 0:
            third_initial(theta, c, s[t], given[t], now, values)
        else:
            if t == 1:  # entries that are always 0 are not written
                values[:] = 0.0
            third(theta, c, s[t], before, given[t], now, values)
        third_seen(theta, c, s[t], given_seen[t], now, values_seen)
        for k in range(at + n + d):
            moving[t, k] = values[k, 0]
        for i in range(d):
            moving_seen[t, i] = values_seen[i, 0]
            before[i, 0] = now[i, 0]
    # The control problem, backward: -(b' A b) / 2 + q' b is what rows t, t + 1, ... are worth.
    q, steer = np.zeros((n_steps, d)), np.zeros((n_steps, widest))
    rest = np.zeros(d)
    for t in range(n_steps - 1, -1, -1):
        n = r[0] if t == 0 else r[1]
        at = 0 if t == 0 else d
        for i in range(d):
            q[t, i] += moving_seen[t, i]
        for i in range(d):
            total = q[t, i]
            for j in range(d):
                total -= information[t, i, j] * moving[t, at + n + j]
            rest[i] = total
        for k in range(n):
            total = moving[t, at + k]
            for i in range(d):
                total += spread[t, i, k] * rest[i]
            column[k, 0] = total
        if t > 0:
            for j in range(d):
                total = moving[t, j]
                for i in range(d):
                    total += jacobian[t, i, j] * rest[i]
                for k in range(n):
                    total -= gain[t, k, j] * column[k, 0]
                q[t - 1, j] = total
        solve(root[t, :n, :n], column, 0)
        for k in range(n):
            steer[t, k] = column[k, 0]
    # And forward, with the gradient in theta of each row.
    b, b_before = np.zeros(d), np.zeros(d)
    answer, answer_seen = np.zeros((n_parameters, 1)), np.zeros((n_parameters, 1))
    out[:] = 0.0
    for t in range(n_steps):
        n = r[0] if t == 0 else r[1]
        at = 0 if t == 0 else d
        m = n + d + d * (at + n) + (at + n) * (at + n + 1) // 2
        for k in range(n):
            total = steer[t, k]
            for j in range(at):
                total -= gain[t, k, j] * b_before[j]
            steer[t, k] = total
        for i in range(d):
            total = moving[t, at + n + i]
            for j in range(at):
                total += jacobian[t, i, j] * b_before[j]
            for k in range(n):
                total += spread[t, i, k] * steer[t, k]
            b[i] = total
        for i in range(d):
            total = costate[t, i] + q[t, i]
            for j in range(d):
                total -= information[t, i, j] * b[j]
            given[t, m + i] = total
            now[i, 0] = x[t, i]
            given_seen[t, d * (d + 1) // 2 + i] = b[i]
        for j in range(at):
            given[t, m + d + j] = b_before[j]
        for k in range(n):
            given[t, m + d + at + k] = steer[t, k]
        if t == 0:
            fixed_initial(theta, c, s[t], given[t], now, answer)
        else:
            if t == 1:
                answer[:] = 0.0
            fixed(theta, c, s[t], before, given[t], now, answer)
        fixed_seen(theta, c, s[t], given_seen[t], now, answer_seen)
        for k in range(n_parameters):
            out[k] += answer[k, 0] + answer_seen[k, 0]
        for i in range(d):
            b_before[i] = b[i]
            before[i, 0] = now[i, 0]
    for k in range(n_parameters):
        if not abs(out[k]) < np.inf:
            return False
    return True
