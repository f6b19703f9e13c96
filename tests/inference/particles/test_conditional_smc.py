"""Trajectories of conditional SMC obey what the model makes certain."""

import numpy as np
import pytest

import ssmppl as ssm


def lagged():
    """An autoregression, its last two values as states, and their sum with noise."""
    model = ssm.Model("lagged")
    model.prior(lambda: {"phi": ssm.Uniform(-1, 1)})
    model.initial(
        lambda: {"x": ssm.Normal(0, sd=1), "before": ssm.Dirac(0.0), "older": ssm.Dirac(0.0)}
    )
    model.transition(
        lambda x, before, phi: {
            "x": ssm.Normal(phi * x, sd=0.5), "before": ssm.Dirac(x), "older": ssm.Dirac(before),
        }
    )  # fmt: skip
    model.observation(lambda x, before, older: {"y": ssm.Normal(x + before + older, sd=0.3)})
    return model


@pytest.mark.parametrize("proposal", ["bootstrap", "guided"])
@pytest.mark.parametrize("particles", [6, 20])
def test_deterministic_states_follow_from_the_ancestors(particles, proposal):
    """The reference joins other ancestors now and then: its lags have to be theirs."""
    y = ssm.simulate(lagged(), {"phi": 0.8}, steps=60, seed=1)["y"].values[0]
    idata = ssm.sample(
        lagged(), {"y": y}, ssm.PGAS(particles=particles, proposal=proposal), draws=60, warmup=10,
        chains=2, seed=1, progress=False,
    )  # fmt: skip
    x, before, older = (idata["posterior"][n].values for n in ("x", "before", "older"))
    np.testing.assert_array_equal(before[..., 1:], x[..., :-1])
    np.testing.assert_array_equal(older[..., 1:], before[..., :-1])
    np.testing.assert_array_equal(older[..., 0], 0.0)
    assert np.mean(x[:, 1:] != x[:, :-1]) > 0.2, "and the trajectories change"
