"""Terms of the transition that vanish at moderate numbers: hinges of an input, of the time."""

import numpy as np
import pytest

import ssmppl as ssm
from tests.statistics.checks import assert_within, deviations

U = np.array([15.0, -20.0, 22.0, 26.0, 30.0, 20.0, 2.0, 28.0, 19.0, 31.0])
# Each adds summands to a mean m, one by one, as a user writes them.
KINKS = {
    "degree days": lambda m, u, b: m + b * np.maximum(u - 18, 0) + 0.5 * b * np.maximum(u - 24, 0),
    "above a threshold": lambda m, u, b: m + b * np.maximum(u, 18) - 18 * b,
    "the absolute value": lambda m, u, b: m + b * np.abs(u) - b * u,
    "a dead zone": lambda m, u, b: m + b * np.maximum(u - 2, 0) - b * np.maximum(-u - 2, 0),
    "limits": lambda m, u, b: m + b * u - b * np.clip(u, -3, 3),
}


def driven(kink):
    model = ssm.Model("driven", inputs=("u",))

    @model.prior
    def prior():
        return {"b": ssm.Normal(0, sd=1)}

    @model.initial
    def initial():
        return {"x": ssm.Normal(0, sd=1)}

    @model.transition
    def transition(x, u, b):
        return {"x": ssm.Normal(kink(0.5 * x, u, b), sd=0.5)}

    @model.observation
    def observation(x):
        return {"y": ssm.Normal(x, sd=0.3)}

    return model


def moments(kink, b):
    """Mean (T,) and covariance (T, T) of y, written out."""
    mean, covariance = np.zeros(len(U)), np.zeros((len(U), len(U)))
    covariance[0, 0] = 1.0
    for t in range(1, len(U)):
        mean[t] = float(kink(0.5 * mean[t - 1], U[t - 1], b))
        covariance[t, :t] = covariance[:t, t] = 0.5 * covariance[t - 1, :t]
        covariance[t, t] = 0.25 * covariance[t - 1, t - 1] + 0.25
    return mean, covariance + 0.09 * np.eye(len(U))


def log_density(kink, b, y):
    mean, covariance = moments(kink, b)
    rest = y - mean
    log_det = np.linalg.slogdet(2 * np.pi * covariance)[1]
    return -0.5 * (rest @ np.linalg.solve(covariance, rest) + log_det)


@pytest.mark.parametrize("name", KINKS)
def test_the_exact_likelihood_sees_them(name):
    y = np.sin(np.arange(len(U)))
    model = driven(KINKS[name])
    for b in (0.0, 0.3):
        found = ssm.log_likelihood(model, {"u": U, "y": y}, {"b": b})
        assert found[0] == pytest.approx(log_density(KINKS[name], b, y), rel=1e-9)


@pytest.mark.parametrize("name", KINKS)
def test_gibbs_learns_their_strength(name):
    """The posterior of b is normal: its mean and sd from the log density at three points."""
    y = moments(KINKS[name], 0.4)[0] + 0.2 * np.cos(np.arange(len(U)))
    at = [log_density(KINKS[name], b, y) - 0.5 * b**2 for b in (-1.0, 0.0, 1.0)]
    precision = 2 * at[1] - at[0] - at[2]
    mean, sd = 0.5 * (at[2] - at[0]) / precision, precision**-0.5
    drawn = ssm.sample(
        driven(KINKS[name]), {"u": U, "y": y}, ssm.Gibbs(), draws=1000, warmup=200, chains=2,
        seed=1, progress=False,
    )  # fmt: skip
    assert_within(deviations(drawn.posterior["b"].values, mean, sd))
