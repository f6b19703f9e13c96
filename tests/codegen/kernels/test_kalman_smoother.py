"""The smoother and the backward sampler on random matrices, against a dense joint Gaussian."""

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are, solve_discrete_lyapunov

from ssmppl.codegen.kernels.kalman.steps import Matrices
from ssmppl.codegen.kernels.math.random import new_state
from ssmppl.codegen.modules.exact import exact_entry
from tests.codegen.kernels.kalman_matrices import dense, random_data, random_model
from tests.statistics.checks import seed_of

SIZES = [(1, 1), (2, 1), (3, 2), (4, 4), (5, 2), (2, 4)]


def smooth(model, y, seen):
    """(increments, mean, covariance, cross, moments of the noises) from the kernel."""
    (steps, k), d = y.shape, len(model.m)
    out = [np.full(s, np.nan) for s in (
        (steps,), (steps, d), (steps, d, d), (steps, d, d),
        (steps, d), (steps, d, d), (steps, k), (steps, k, k),
    )]  # fmt: skip
    assert exact_entry("smooth")(model, model.m[:, None].copy(), y, seen, *out) == (0, steps)
    return out


@pytest.mark.parametrize("singular", [False, True])
@pytest.mark.parametrize("missing", [0.0, 0.4])
@pytest.mark.parametrize(("d", "k"), SIZES)
def test_moments_are_those_of_the_dense_gaussian(d, k, missing, singular):
    rng = np.random.default_rng(seed_of("smoother", d, k, missing, singular))
    rank = d // 2 if singular else None
    model = random_model(rng, d, k, rank, None if rank is None else max(rank - 1, 0))
    steps = 8
    y, seen = random_data(rng, model, steps, missing)
    increments, mean, covariance, cross, *noises = smooth(model, y, seen)
    exact = dense(model, y, seen)
    joint = exact.covariance.reshape(steps, d, steps, d)
    assert increments.sum() == pytest.approx(exact.log_likelihood, abs=1e-9)
    np.testing.assert_allclose(mean, exact.mean, atol=1e-9)
    assert not cross[0].any()
    for t in range(steps):
        np.testing.assert_allclose(covariance[t], joint[t, :, t], atol=1e-9)
        if t:
            np.testing.assert_allclose(cross[t], joint[t, :, t - 1], atol=1e-9)
    check_noises(model, y, seen, exact, joint, noises)


def check_noises(model, y, seen, exact, joint, noises):
    """The disturbances are what the dense law says of x_t - A x_{t-1} - b and y_t - C x_t - d."""
    state, state_covariance, noise, noise_covariance = noises
    a, b, c, d, r = (model[i][0] for i in (2, 3, 5, 6, 7))
    for t in range(len(y)):
        x, spread = exact.mean[t], joint[t, :, t]
        if t == 0:
            expected, expected_covariance = x - model.m, spread
        else:
            step = np.hstack([np.eye(len(x)), -a])
            pair = np.block([[spread, joint[t, :, t - 1]], [joint[t - 1, :, t],
                                                            joint[t - 1, :, t - 1]]])  # fmt: skip
            expected = x - a @ exact.mean[t - 1] - b
            expected_covariance = step @ pair @ step.T
        np.testing.assert_allclose(state[t], expected, atol=1e-9)
        np.testing.assert_allclose(state_covariance[t], expected_covariance, atol=1e-9)
        s = seen[t] == 1.0
        # a missing component's noise is told by those of the others: regression on them
        slope = np.linalg.solve(r[np.ix_(s, s)], r[s]).T
        told = (y[t] - c @ x - d)[s]
        np.testing.assert_allclose(noise[t], slope @ told, atol=1e-9)
        spread = slope @ (c @ spread @ c.T)[np.ix_(s, s)] @ slope.T + r - slope @ r[s]
        np.testing.assert_allclose(noise_covariance[t], spread, atol=1e-9)


def test_steady_for_a_hundred_thousand_steps():
    """Symmetric, semidefinite, and the solution of the Riccati and Lyapunov equations throughout.

    One component is deterministic, and Q is singular.
    """
    a = np.array([[1.0, 0.1, 0.0], [0.0, 0.9, 0.2], [-0.05, 0.0, 0.7]])
    q, r = np.diag([0.0, 0.1, 0.02]), np.array([[0.3]])
    c = np.array([[1.0, 0.0, 0.5]])
    steps = 100_000
    predicted = solve_discrete_are(a.T, c.T, q, r)
    gain = predicted @ c.T @ np.linalg.inv(c @ predicted @ c.T + r)
    filtered = predicted - gain @ c @ predicted
    back = filtered @ a.T @ np.linalg.inv(predicted)
    steady = solve_discrete_lyapunov(back, filtered - back @ predicted @ back.T)
    model = Matrices(np.zeros(3), filtered, a[None], np.zeros((1, 3)), q[None], c[None],
                     np.zeros((1, 1)), r[None])  # fmt: skip
    rng = np.random.default_rng(seed_of("steady"))
    y, seen = random_data(rng, model, steps, 0.0)
    _, mean, covariance, cross, *_ = smooth(model, y, seen)
    assert np.isfinite(mean).all()
    np.testing.assert_array_equal(covariance, covariance.transpose(0, 2, 1))
    assert np.linalg.eigvalsh(covariance).min() > -1e-16
    middle = slice(1_000, -1_000)
    np.testing.assert_allclose(covariance[middle] - steady, 0.0, atol=1e-14)
    np.testing.assert_allclose(cross[middle] - steady @ back.T, 0.0, atol=1e-13)


def test_sharp_measurements_of_a_vague_state():
    """Where a difference of covariances would leave nothing, and the past tells nothing."""
    one = np.ones((1, 1, 1))
    model = Matrices(np.zeros(1), np.array([[1e10]]), one, np.zeros((1, 1)), 1e-12 * one, one,
                     np.zeros((1, 1)), 1e-14 * one)  # fmt: skip
    y, seen = np.zeros((4, 1)), np.array([[0.0], [1.0], [0.0], [1.0]])
    covariance = smooth(model, y, seen)[2][:, 0, 0]
    ahead = 1 / (1e14 + 1 / (2e-12 + 1e-14))  # of x_2: its measurement, and the one two steps on
    ahead = 1 / (1 / ahead + 1e-10)
    assert covariance[1] == pytest.approx(ahead, rel=1e-9)
    assert covariance[0] == pytest.approx(1e-12 + ahead, rel=1e-9)
    assert covariance[2] == pytest.approx(0.5e-12 + 0.25 * (2e-14), rel=1e-2)


# -- backward sampling
@pytest.mark.parametrize(("d", "k", "rank"), [(1, 1, None), (3, 2, 1), (2, 1, None)])
def test_draws_have_the_joint_moments(d, k, rank):
    """Means and all covariances, across time too, within the error that the Gaussian law gives."""
    seed = seed_of("draws", d, k, rank)
    rng = np.random.default_rng(seed)
    model = random_model(rng, d, k, rank, rank)
    steps, draws = 5, 20_000
    y, seen = random_data(rng, model, steps, 0.4)
    out, increments = np.empty((draws, steps, d)), np.empty(steps)
    stream = new_state(np.random.SeedSequence(seed))
    start = model.m[:, None].copy()
    assert exact_entry("draw")(model, start, y, seen, stream, increments, out) == (0, steps)
    exact = dense(model, y, seen)
    x, variance = out.reshape(draws, -1) - exact.mean.ravel(), np.diag(exact.covariance)
    null = exact.covariance - x.T @ x / draws
    # Var of a product of jointly normal a, b is Var a Var b + Cov(a, b)^2
    spread = np.sqrt((np.outer(variance, variance) + exact.covariance**2) / draws)
    assert (np.abs(x.mean(axis=0)) <= 5 * np.sqrt(variance / draws) + 1e-12).all()
    assert (np.abs(null) <= 5 * spread + 1e-12).all()
    # a draw satisfies the noiseless part of the transition
    if rank is not None:
        value, vector = np.linalg.eigh(model.Q[0])
        silent = vector[:, value < 1e-12]
        step = out[:, 1:] - out[:, :-1] @ model.A[0].T - model.b[0]
        np.testing.assert_allclose(step @ silent, 0.0, atol=1e-9)
    # and another call gives other draws
    again = np.empty((1, steps, d))
    exact_entry("draw")(model, start, y, seen, stream, increments, again)
    assert not np.allclose(again[0], out[0])
