"""Thresholds: slopes that are zero below a hinge under a root, and slopes that are no numbers."""

import numpy as np
import pytest
import scipy.special

import ssmppl as ssm

TRUTH = {"c": 4.0, "k": 1.0}
RESPONSES = {
    "root": lambda u, c: np.sqrt(np.maximum(u - c, 0.0)),
    "power": lambda u, c: np.maximum(u - c, 0.0) ** 0.7,
    "switch": lambda u, c: scipy.special.expit((u - c) / 0.005),
    "steep": lambda u, c: np.arctan(np.exp(100.0 * (u + c))),  # oo / oo^2 is no number
}


def threshold(name):
    model = ssm.Model(name, inputs=("u",))
    model.prior(lambda: {"c": ssm.Normal(5, sd=2), "k": ssm.Normal(1, sd=1)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(0.5 * x, sd=0.3)})
    model.observation(lambda x, u, c, k: {"y": ssm.Normal(x + k * RESPONSES[name](u, c), sd=0.3)})
    return model


def data_of(model):
    u = np.random.default_rng(0).uniform(0.0, 10.0, 60)
    y = ssm.simulate(model, TRUTH, steps=60, inputs={"u": u}, seed=1)["y"]
    return {"y": np.asarray(y).ravel(), "u": u}


@pytest.mark.parametrize("name", ["root", "power", "switch"])
def test_the_score_of_a_threshold_is_that_of_finite_differences(name):
    model = threshold(name)
    data, h = data_of(model), 1e-5
    found = ssm.score(model, data, TRUTH)
    above, below = (
        float(ssm.log_likelihood(model, data, {**TRUTH, "c": 4.0 + step})[0]) for step in (h, -h)
    )
    assert found.gradient["c"] == pytest.approx((above - below) / (2.0 * h), rel=1e-5)
    assert np.all(np.isfinite(found.information))


@pytest.mark.parametrize("method", [None, ssm.EM()])
def test_a_threshold_is_estimated(method):
    model = threshold("root")
    found = ssm.maximize(model, data_of(model), method, seed=1, progress=False)
    assert found.parameters["c"] == pytest.approx(3.84, abs=0.01)
    assert found.parameters["k"] == pytest.approx(0.98, abs=0.02)


@pytest.mark.parametrize("method", [None, ssm.EM(), ssm.ParticleEM()])
def test_a_likelihood_without_slopes_is_not_said_to_be_zero_nor_left_where_it_is(method):
    model = threshold("steep")
    with pytest.raises(ssm.SSMError) as caught:
        ssm.maximize(model, data_of(model), method, seed=1, progress=False)
    assert "it has a value and no finite slope in c at c = " in str(caught.value)
    assert "ssm.IF2()" in caught.value.fix
