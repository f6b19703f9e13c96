"""Exact smoothing and sampling of whole models, against the dense Gaussian of the same laws."""

import numpy as np
import pytest

from ssmppl.codegen.kernels.math.random import new_state
from ssmppl.errors import SamplingError
from ssmppl.inference.exact.kalman import kalman_model
from tests.models.kalman import MODELS, posed, scalar
from tests.statistics.checks import seed_of


def joint(dense, experiment):
    """Mean (T, D) and covariance (T, D, T, D) of all states given the data."""
    steps = experiment.steps
    target = np.concatenate([x[0] for x in dense.x]), np.concatenate([x[1] for x in dense.x])
    mean, covariance = dense.given(target, experiment.y, experiment.seen, steps)
    return mean.reshape(steps, -1), covariance.reshape(steps, len(mean) // steps, steps, -1)


@pytest.mark.parametrize("missing", [0.0, 0.3])
@pytest.mark.parametrize("build", MODELS)
def test_smoother_is_the_dense_gaussian(build, missing):
    traced, theta, experiment, dense = posed(build, missing)
    model = kalman_model(traced)
    found = model.smooth(experiment, theta)
    mean, covariance = joint(dense, experiment)
    upto = dense.log_likelihood(experiment.y, experiment.seen, experiment.steps)
    assert found.log_likelihood == pytest.approx(upto, abs=1e-9)
    np.testing.assert_allclose(found.mean, mean, atol=1e-9)
    for t in range(experiment.steps):
        np.testing.assert_allclose(found.covariance[t], covariance[t, :, t], atol=1e-9)
        if t:
            np.testing.assert_allclose(found.cross[t], covariance[t, :, t - 1], atol=1e-9)
    noises = model.disturbances(experiment, theta)
    forms = model.matrices(experiment, theta)
    a, b = (np.broadcast_to(f, (experiment.steps, *f.shape[1:])) for f in (forms.A, forms.b))
    step = mean[1:] - np.einsum("tij,tj->ti", a[1:], mean[:-1]) - b[1:]
    np.testing.assert_allclose(noises.state_mean[1:], step, atol=1e-9)


@pytest.mark.parametrize("build", MODELS)
def test_draws_are_of_the_dense_gaussian(build):
    traced, theta, experiment, dense = posed(build, 0.3)
    stream = new_state(np.random.SeedSequence(seed_of("kalman draws", build.__name__)))
    draws = kalman_model(traced).draw(experiment, theta, stream, 4_000)
    mean, covariance = joint(dense, experiment)
    size = mean.size
    x, c = draws.reshape(len(draws), size) - mean.ravel(), covariance.reshape(size, size)
    spread = np.sqrt((np.outer(np.diag(c), np.diag(c)) + c**2) / len(draws))
    assert (np.abs(x.mean(0)) <= 5 * np.sqrt(np.diag(c).clip(0) / len(draws)) + 1e-9).all()
    assert (np.abs(x.T @ x / len(draws) - c) <= 5 * spread + 1e-9).all()


def test_what_does_not_exist_is_named():
    traced, theta, experiment, _ = posed(scalar, 0.0)
    bad = np.where(np.arange(len(theta)) == 1, -1.0, theta)
    model = kalman_model(traced)
    for call in (model.smooth, model.disturbances):
        with pytest.raises(SamplingError, match="positive semidefinite at t=1"):
            call(experiment, bad)
    with pytest.raises(SamplingError, match="positive semidefinite at t=1"):
        model.draw(experiment, bad, np.ones(4, dtype=np.uint64), 2)
