"""Ten random multivariate linear Gaussian models with missing values, against statsmodels."""

import numpy as np
import pytest

from ssmppl.inference.exact.kalman import start_of
from ssmppl.inference.exact.kalman_matrices import smoothed
from tests.codegen.kernels.kalman_matrices import random_data, random_model, with_flat
from tests.codegen.kernels.test_kalman_diffuse import experiment
from tests.statistics.checks import seed_of

kalman_smoother = pytest.importorskip("statsmodels.tsa.statespace.kalman_smoother")
STEPS = 60


def reference(model, flat, y, seen):
    """statsmodels' results; its transition is that out of step t, its noise has its own loading."""
    d, k = len(model.m), y.shape[1]
    ssm = kalman_smoother.KalmanSmoother(k, d, d)
    ssm.bind(np.where(seen == 1.0, y, np.nan))
    names = ("transition", "state_intercept", "state_cov", "design", "obs_intercept", "obs_cov")
    for name, field in zip(names, model[2:], strict=True):
        ssm[name] = field[0][:, None] if name.endswith("intercept") else field[0]
    ssm["selection"] = np.eye(d)
    if flat:
        ssm.initialize_diffuse()
    else:
        ssm.initialize_known(model.m, model.P)
    return ssm.smooth()


@pytest.mark.filterwarnings("ignore:The univariate filtering approach")
@pytest.mark.parametrize("diffuse", [False, True])
@pytest.mark.parametrize("number", range(10))
def test_random_models(number, diffuse):
    rng = np.random.default_rng(seed_of("statsmodels", number, diffuse))
    d, k = int(rng.integers(1, 6)), int(rng.integers(1, 5))
    flat = tuple(range(d)) if diffuse else ()
    model = with_flat(random_model(rng, d, k, None if number % 2 else max(d - 1, 1)), flat)
    y, seen = random_data(rng, model, STEPS, 0.25)
    exact = reference(model, flat, y, seen)
    data = experiment(y, seen)
    start = start_of(None, flat, model, data)
    found, _ = smoothed(model, start.columns, data)
    # a flat component counts with density 1; there it contributes -log(2 pi)/2
    expected = exact.llf + 0.5 * len(flat) * np.log(2 * np.pi)
    assert start.log_density(found.log_likelihood) == pytest.approx(expected, rel=1e-8)
    np.testing.assert_allclose(found.mean, exact.smoothed_state.T, rtol=1e-8, atol=1e-8)
    covariance = np.moveaxis(exact.smoothed_state_cov, -1, 0)
    np.testing.assert_allclose(found.covariance, covariance, rtol=1e-8, atol=1e-8)
    # of x_{t+1} with x_t; statsmodels leaves it out while the start is diffuse
    cross = np.moveaxis(exact.smoothed_state_autocov, -1, 0)[exact.nobs_diffuse : -1]
    mine = found.cross[1 + exact.nobs_diffuse :]
    assert len(mine) > STEPS // 2
    np.testing.assert_allclose(mine, cross, rtol=1e-8, atol=1e-8)
