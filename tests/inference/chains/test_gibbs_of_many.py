"""Gibbs of more numbers than a mode is looked for: what sweeps tell stands in its place."""

from __future__ import annotations

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.inference.chains import gibbs

CHANNELS, ROWS, NOISE = 24, 12, 0.5


def offsets(centre: float) -> ssm.Model:
    """Channels of one level, each with an offset of its own."""
    model = ssm.Model("offsets")
    model.prior(lambda: {"b": ssm.Normal(np.full(CHANNELS, centre), sd=3.0)})
    model.initial(lambda: {"x": ssm.Normal(0.0, sd=1.0)})
    model.transition(lambda x: {"x": ssm.Normal(x, sd=0.3)})
    model.observation(lambda x, b: {"y": ssm.Normal(x + b, sd=NOISE)})
    return model


def exact(y: np.ndarray, centre: float) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation of the offsets, of the joint normal distribution."""
    t = np.arange(ROWS)
    level = 1.0 + 0.09 * np.minimum.outer(t, t)
    own = 9.0 * np.eye(CHANNELS)
    data = np.kron(level, np.ones((CHANNELS, CHANNELS))) + NOISE**2 * np.eye(ROWS * CHANNELS)
    data += np.kron(np.ones((ROWS, ROWS)), own)
    both = np.kron(np.ones((ROWS, 1)), own)  # of data and offsets
    gain = np.linalg.solve(data, both).T
    mean = centre + gain @ (y.ravel() - centre)
    return mean, np.sqrt(np.diagonal(own - gain @ both))


@pytest.mark.slow
@pytest.mark.parametrize("centre", [0.0, 1000.0])
def test_posterior(centre, monkeypatch):
    """The steps with the states integrated out begin where the sweeps were, and mix: begun anywhere
    they did not (R-hat of 1.04)."""
    monkeypatch.setattr(gibbs, "MANY", 5)
    rng = np.random.default_rng(3)
    y = centre + rng.normal(size=CHANNELS) * 3.0 + NOISE * rng.normal(size=(ROWS, CHANNELS))
    mean, sd = exact(y, centre)
    idata = ssm.sample(offsets(centre), {"y": y}, ssm.Gibbs(), seed=1, progress=False)
    found = ssm.summary(idata)
    assert found["r_hat"].max() < 1.01
    away = (found["mean"].to_numpy() - mean) / found["mcse_mean"].to_numpy()
    assert np.abs(away).max() < 4.5
    spread = (found["sd"].to_numpy() - sd) / found["mcse_sd"].to_numpy()
    assert np.abs(spread).max() < 4.5
