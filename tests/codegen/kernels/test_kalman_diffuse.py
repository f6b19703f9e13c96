"""Flat starts: filter, smoother, draws and adjoints against least squares on the dense law."""

from itertools import pairwise

import numpy as np
import pytest

from ssmppl.codegen.kernels.kalman.adjoint import zeros_like
from ssmppl.codegen.kernels.kalman.steps import Matrices
from ssmppl.codegen.modules.exact import exact_entry
from ssmppl.data import Experiment
from ssmppl.inference.exact.kalman import diffuse_filter, start_of
from ssmppl.inference.exact.kalman_matrices import drawn, smoothed
from tests.codegen.kernels.kalman_matrices import DenseFlat, random_data, random_model, with_flat
from tests.statistics.checks import seed_of

CASES = [
    (1, 1, (0,)),
    (2, 1, (0,)),
    (2, 1, (0, 1)),
    (3, 2, (2, 0)),
    (4, 3, (1,)),
    (3, 1, (0, 1, 2)),
]


def experiment(y, seen):
    return Experiment(y, seen, np.zeros((len(y), 0)), None, len(y), frozenset(), {}, {})


def posed(d, k, flat, missing, steps=8):
    rng = np.random.default_rng(seed_of("flat", d, k, flat, missing))
    rank = None if d < 3 else 1
    model = with_flat(random_model(rng, d, k, rank), flat)
    y, seen = random_data(rng, model, steps, missing)
    if missing:
        seen[0], y[0] = 0.0, 0.0  # nothing is told at first
    return model, y, seen


@pytest.mark.parametrize("missing", [0.0, 0.3])
@pytest.mark.parametrize(("d", "k", "flat"), CASES)
def test_likelihood_and_smoothed_moments(d, k, flat, missing):
    model, y, seen = posed(d, k, flat, missing)
    data, exact = experiment(y, seen), DenseFlat(model, flat, y, seen)
    start = start_of(None, flat, model, data)
    assert start.log_likelihood == pytest.approx(exact.log_likelihood, rel=1e-9)
    found, _ = smoothed(model, start.columns, data)
    assert found.log_likelihood == pytest.approx(start.log_given, rel=1e-9)
    scale = 1 + np.abs(exact.covariance).max()
    np.testing.assert_allclose(found.mean.ravel(), exact.mean, rtol=1e-8, atol=1e-9 * scale)
    joint = exact.covariance.reshape(len(y), d, len(y), d)
    for t in range(len(y)):
        np.testing.assert_allclose(found.covariance[t], joint[t, :, t], atol=1e-9 * scale)
        if t:
            np.testing.assert_allclose(found.cross[t], joint[t, :, t - 1], atol=1e-9 * scale)


@pytest.mark.parametrize(("d", "k", "flat"), CASES)
def test_filter_tells_what_the_data_tell_so_far(d, k, flat):
    """At each step the moments given the data up to it; infinite while there are too few."""
    model, y, seen = posed(d, k, flat, 0.3)
    steps = len(y)
    out = [np.empty(s) for s in ((steps,), (steps, d), (steps, d, d), (steps, d), (steps, d, d),
                                 (steps, k), (steps, k, k))]  # fmt: skip
    diffuse_filter(model, flat, experiment(y, seen), *out)
    increments, mean, covariance, ahead, ahead_covariance, y_mean, y_covariance = out
    total = 0.0
    for t in range(steps):
        if seen[: t + 1].sum() < len(flat):
            assert np.isinf(np.diagonal(covariance[t])).any()
            continue
        shown = np.where(np.arange(steps)[:, None] <= t, seen, 0.0)
        exact = DenseFlat(model, flat, y, shown)
        total = increments[: t + 1].sum()
        assert total == pytest.approx(exact.log_likelihood, rel=1e-8)
        joint = exact.covariance.reshape(steps, d, steps, d)
        scale = 1 + np.abs(exact.covariance).max()
        np.testing.assert_allclose(mean[t], exact.mean.reshape(steps, d)[t], atol=1e-8 * scale)
        np.testing.assert_allclose(covariance[t], joint[t, :, t], atol=1e-8 * scale)
        if t + 1 < steps:
            x, p = exact.mean.reshape(steps, d)[t + 1], joint[t + 1, :, t + 1]
            c = model.C[0]
            np.testing.assert_allclose(ahead[t + 1], x, atol=1e-8 * scale)
            np.testing.assert_allclose(ahead_covariance[t + 1], p, atol=1e-8 * scale)
            np.testing.assert_allclose(y_mean[t + 1], c @ x + model.d[0], atol=1e-8 * scale)
            spread = c @ p @ c.T + model.R[0]
            np.testing.assert_allclose(y_covariance[t + 1], spread, atol=1e-8 * scale)
    assert total == pytest.approx(increments.sum())


@pytest.mark.parametrize("missing", [0.0, 0.3])
@pytest.mark.parametrize(("d", "k", "flat"), CASES)
def test_adjoints(d, k, flat, missing):
    """Against central differences of the integral, extrapolated, in random directions."""
    model, y, seen = posed(d, k, flat, missing)
    rng = np.random.default_rng(seed_of("directions", d, k, flat, missing))
    data = experiment(y, seen)
    adjoint, increments = zeros_like(model), np.empty(len(y))
    start = start_of(None, flat, model, data)
    wanted = np.ones(8, np.int64)
    exact_entry("adjoints")(model, start.columns, y, seen, wanted, increments, adjoint)
    for field in Matrices._fields:
        direction = rng.normal(size=getattr(model, field).shape)
        if field in "PQR":
            half = getattr(model, field) * 0.3  # stays semidefinite
            direction = half if field != "P" else model.P * 0.3
        if field == "m":
            direction[list(flat)] = 0.0

        def at(h, field=field, direction=direction):
            moved = model._replace(**{field: getattr(model, field) + h * direction})
            return DenseFlat(moved, flat, y, seen).log_likelihood

        def slope(h, at=at):
            return (at(h) - at(-h)) / (2 * h)

        rough = [slope(h) for h in (4e-3, 2e-3, 1e-3)]
        fine = [(4 * b - a) / 3 for a, b in pairwise(rough)]
        exact = (16 * fine[1] - fine[0]) / 15
        found = float((getattr(adjoint, field) * direction).sum())
        assert found == pytest.approx(exact, rel=1e-6, abs=1e-6), field


def test_draws():
    flat = (0, 1)
    model, y, seen = posed(2, 1, flat, 0.3)
    data, exact, draws = experiment(y, seen), DenseFlat(model, flat, y, seen), 20_000
    start = start_of(None, flat, model, data)
    stream = np.array([1, 2, 0, 0], dtype=np.uint64)
    _, out = drawn(model, start.columns, data, stream, draws)
    x, variance = out.reshape(draws, -1) - exact.mean, np.diag(exact.covariance)
    spread = np.sqrt((np.outer(variance, variance) + exact.covariance**2) / draws)
    assert (np.abs(x.mean(axis=0)) <= 5 * np.sqrt(variance / draws)).all()
    assert (np.abs(x.T @ x / draws - exact.covariance) <= 5 * spread).all()


def test_a_level_far_from_zero_costs_no_digits():
    """The sums of squares whose difference the likelihood is are 1e20 times as large as it."""
    one = np.ones((1, 1, 1))
    zero = np.zeros((1, 1))
    model = Matrices(zero[0], zero, one, zero, 0.1 * one, one, zero, one)
    y = np.random.default_rng(seed_of("far")).normal(size=(50, 1)).cumsum(axis=0)
    seen = np.ones((50, 1))
    near, far = (start_of(None, (0,), model, experiment(v, seen)) for v in (y, y + 1e10))
    assert far.log_likelihood == pytest.approx(near.log_likelihood, abs=1e-4)  # y has 16 digits


def test_equations_that_tell_one_direction_twice():
    """Two regressors that are multiples of each other: rank 1, whatever their units."""
    rng = np.random.default_rng(seed_of("collinear"))
    u = rng.normal(size=(30, 1, 1))
    c = np.concatenate([u, 1e-7 * u], axis=2)
    steps, eye = 30, np.eye(2)[None]
    model = Matrices(np.zeros(2), np.zeros((2, 2)), eye, np.zeros((1, 2)), 0 * eye, c,
                     np.zeros((1, 1)), np.ones((1, 1, 1)))  # fmt: skip
    y, seen = rng.normal(size=(steps, 1)), np.ones((steps, 1))
    factor, _ = diffuse_filter(model, (0, 1), experiment(y, seen), np.empty(steps))
    assert factor[0, 0] != 0.0
    assert factor[1, 1] == 0.0
    model.C[3, 0, 1] *= 1.001  # now they differ, in one row
    factor, _ = diffuse_filter(model, (0, 1), experiment(y, seen), np.empty(steps))
    assert factor[1, 1] != 0.0
