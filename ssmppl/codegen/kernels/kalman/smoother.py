"""Smoothing and backward sampling of linear Gaussian models, by orthogonal transformations.

Given the future, the standard normal variables of a step (see `steps.py`) are e = mu + U n,
n ~ N(0, I). Back from t + 1 to t, with the blocks of the two transformations,

    prediction   e_filt = Theta_11 e_pred + Theta_12 rest       rest ~ N(0, I), free
    update       e_pred = Theta_z z + Theta_e e_filt + Theta_rest rest

so mu and U follow by multiplications with blocks of orthogonal matrices, whose norm is at most 1,
and x_t = mean_filt + L_filt e_filt. Nothing is inverted and no covariance is subtracted: the
covariances are positive semidefinite by construction, whatever Q, P and the predicted covariance
are. The moments are those of Rauch, Tung and Striebel (1965); those of the disturbances, found
on the way as Q^1/2 w and R^1/2 nu, are those of de Jong (1988) and Koopman (1993). With a draw in
place of the law of e it is the backward sampler of Carter and Kohn (1994) and Frühwirth-Schnatter
(1994).

The forward pass keeps the predicted means and roots; the backward one repeats the transformation of
each step, which costs less than to keep them.
"""

from __future__ import annotations

import numpy as np

from ssmppl.codegen.kernels.kalman.square_root import OK, at, multiply, reflect
from ssmppl.codegen.kernels.kalman.steps import (
    add_square,
    copy,
    fill,
    forward,
    multiply_add,
    predict_array,
    root_at,
    update,
)
from ssmppl.codegen.kernels.math.flags import exact
from ssmppl.codegen.kernels.math.random import fill_normal


@exact
def smooth(
    model, start, y, seen, log_increment, mean, covariance, cross,
    state_noise, state_noise_covariance, noise, noise_covariance,
):  # fmt: skip
    """Moments of all x_t given y_{1:T}; returns (status, t) of the forward pass.

    start (D, F): the mean of x_1, and a root of the law of its unknown part. Written:
    log_increment (T,); mean (T, D), covariance (T, D, D), cross (T, D, D): of x_t with x_{t-1},
    row 0 zero; and where their first axis is not empty, the moments of x_t - A x_{t-1} - b (of
    x_1 - m in row 0), (T, D) and (T, D, D), and those of y_t - C x_t - d, (T, K) and (T, K, K), for
    missing components too.
    """
    n_steps, n, k_all, columns = y.shape[0], start.shape[0], y.shape[1], start.shape[1]
    x, roots = (
        np.empty((n_steps, n, columns)),
        covariance,
    )  # each root makes room for its covariance
    status, stopped = forward(model, start, y, seen, x, roots, log_increment)
    if status != OK:
        return status, stopped
    q_root, r_root = np.empty((n, n)), np.empty((k_all, k_all))
    both, array = np.empty((3 * n, 2 * n)), np.empty((2 * k_all + 2 * n, k_all + n))
    filtered, later, z = np.empty((n, columns)), np.empty((n, columns)), np.empty((k_all, columns))
    mu, mu_pred = np.zeros((n, columns)), np.zeros((n, columns))  # mu of e_filt and of e_pred
    root, root_pred, left = np.eye(n), np.empty((n, n)), np.empty((n, n))  # U likewise; L_filt
    forth, back, wide = np.empty((n, n)), np.empty((n, n)), np.empty((n, 2 * n + k_all))
    fill(cross[0], 0.0)
    for t in range(n_steps - 1, -1, -1):
        root_at(model.R, t, n_steps - 1, r_root)
        k = update(model, t, y[t], seen[t], x[t], roots[t], r_root, array, z, filtered)
        copy(array[k : k + n, k : k + n], left)
        if t < n_steps - 1:
            root_at(model.Q, t + 1, n_steps - 1, q_root)
            predict_array(model.A[at(t + 1, model.A.shape[0])], left, q_root, both)
            if state_noise is not None:
                law_of_noise(
                    q_root, np.zeros((n, columns)), both[2 * n :, :n], both[2 * n :, n:],
                    mu_pred, root_pred, state_noise[t + 1], state_noise_covariance[t + 1],
                )  # fmt: skip
            multiply(both[n : 2 * n, :n], mu_pred, mu)
            multiply(both[n : 2 * n, :n], root_pred, wide[:, :n])
            multiply(left, wide[:, :n], back)
            multiply(both[:n, :n], root_pred, forth)
            multiply(forth, back.T, cross[t + 1])
            copy(both[n : 2 * n, n:], wide[:, n : 2 * n])
            reflect(wide[:, : 2 * n], n)
            copy(wide[:, :n], root)
        by_e, by_rest = array[k + n :, k : k + n], array[k + n :, k + n :]
        if state_noise is not None:
            known = np.zeros((k_all, columns))
            multiply_add(array[k + 2 * n : k + 2 * n + k_all, :k], z[:k], known)
            law_of_noise(
                r_root, known, by_e[n : n + k_all], by_rest[n : n + k_all], mu, root,
                noise[t], noise_covariance[t],
            )  # fmt: skip
        fill(mu_pred, 0.0)
        multiply_add(array[k + n : k + 2 * n, :k], z[:k], mu_pred)
        multiply_add(by_e[:n], mu, mu_pred)
        multiply(by_e[:n], root, wide[:, :n])
        if k < k_all:
            copy(by_rest[:n], wide[:, n : n + k_all - k])
            reflect(wide[:, : n + k_all - k], n)
        copy(wide[:, :n], root_pred)
        if state_noise is not None and t == 0:
            law_of_noise(
                roots[0], np.zeros((n, columns)), np.eye(n), np.zeros((n, 0)), mu_pred, root_pred,
                state_noise[0], state_noise_covariance[0],
            )  # fmt: skip
        # x_t = filtered + left e_filt; the unknown parts of the start add their columns
        multiply_add(left, mu, filtered)
        multiply(left, root, back)
        fill(covariance[t], 0.0)
        add_square(back, covariance[t])
        add_square(filtered[:, 1:], covariance[t])
        for i in range(n):
            mean[t, i] = filtered[i, 0]
        if t < n_steps - 1 and columns > 1:
            multiply_add(later[:, 1:], filtered[:, 1:].T, cross[t + 1])
        copy(filtered, later)
    return OK, n_steps


@exact
def law_of_noise(noise_root, known, by_e, by_rest, mu, root, mean, covariance):
    """Moments of noise_root (known + by_e e + by_rest rest); rest ~ N(0, I), e ~ (mu, U U')."""
    n, d, more = by_e.shape[0], by_e.shape[1], by_rest.shape[1]
    inner, spread = np.empty((n, d + more)), np.zeros((n, d + more))
    multiply(by_e, root, inner[:, :d])
    copy(by_rest, inner[:, d:])
    multiply_add(noise_root, inner, spread)
    columns = np.zeros((n, mu.shape[1]))
    multiply_add(by_e, mu, known)
    multiply_add(noise_root, known, columns)
    for i in range(n):
        mean[i] = columns[i, 0]
    fill(covariance, 0.0)
    add_square(spread, covariance)
    add_square(columns[:, 1:], covariance)


@exact
def draw(model, start, y, seen, stream, log_increment, out):
    """Draws from p(x_{1:T} | y_{1:T}); returns (status, t) of the forward pass.

    stream : state of the random numbers, advanced. out (M, T, D), written.
    """
    n_steps, n, k_all, columns = y.shape[0], start.shape[0], y.shape[1], start.shape[1]
    draws = out.shape[0]
    x, roots = np.empty((n_steps, n, columns)), np.empty((n_steps, n, n))
    status, stopped = forward(model, start, y, seen, x, roots, log_increment)
    if status != OK:
        return status, stopped
    q_root, r_root = np.empty((n, n)), np.empty((k_all, k_all))
    both, array = np.empty((2 * n, 2 * n)), np.empty((k_all + 2 * n, k_all + n))
    filtered, z = np.empty((n, columns)), np.empty((k_all, columns))
    root, by_e = np.empty((n, n)), np.empty((n, columns))
    weights, fresh = np.empty(columns * draws), np.empty(max(n, k_all) * draws)
    fill_normal(stream, weights[draws:])
    weight = weights.reshape(columns, draws)
    fill(weight[:1], 1.0)
    e, e_pred, state = np.empty((n, draws)), np.empty((n, draws)), np.empty((n, draws))
    for t in range(n_steps - 1, -1, -1):
        root_at(model.R, t, n_steps - 1, r_root)
        k = update(model, t, y[t], seen[t], x[t], roots[t], r_root, array, z, filtered)
        copy(array[k : k + n, k : k + n], root)
        fill_normal(stream, fresh[: n * draws])
        rest = fresh[: n * draws].reshape(n, draws)
        if t == n_steps - 1:
            copy(rest, e)
        else:
            root_at(model.Q, t + 1, n_steps - 1, q_root)
            predict_array(model.A[at(t + 1, model.A.shape[0])], root, q_root, both)
            multiply(both[n:, :n], e_pred, e)
            multiply_add(both[n:, n:], rest, e)
        multiply(filtered, weight, state)
        multiply_add(root, e, state)
        for m in range(draws):
            for i in range(n):
                out[m, t, i] = state[i, m]
        multiply(array[k + n : k + 2 * n, :k], z[:k], by_e)
        multiply(by_e, weight, e_pred)
        multiply_add(array[k + n : k + 2 * n, k : k + n], e, e_pred)
        if k < k_all:
            size = (k_all - k) * draws
            fill_normal(stream, fresh[:size])
            rest = fresh[:size].reshape(k_all - k, draws)
            multiply_add(array[k + n : k + 2 * n, k + n :], rest, e_pred)
    return OK, n_steps
