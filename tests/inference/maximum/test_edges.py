"""Models without parameters, and numbers at the edge of what floats and densities can be.

NumPy's warnings are errors here, as they are where verbs are called at random.
"""

import numpy as np
import pytest

import ssmppl as ssm

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")
SHORT = {"draws": 3, "warmup": 3, "chains": 2, "progress": False, "seed": 1}


def swing():
    """Nothing in it is unknown."""
    model = ssm.Model("swing")

    @model.initial
    def initial():
        return {"x": ssm.Normal(0, sd=1)}

    @model.transition
    def transition(x):
        return {"x": ssm.Normal(0.9 * np.sin(x), sd=0.3)}

    @model.observation
    def observation(x):
        return {"y": ssm.Normal(x, sd=0.2)}

    return model


@pytest.fixture(scope="module")
def swung():
    model = swing()
    data = {"y": ssm.simulate(model, {}, steps=30, seed=2)["y"].values[0]}
    return model, data, ssm.sample(model, data, ssm.PGAS(particles=10), **SHORT)


def test_predictions_of_a_model_without_parameters(swung):
    model, data, idata = swung
    ahead = ssm.forecast(model, idata, steps=4, seed=1)
    assert ahead["y"].shape == (6, 4)
    found = ssm.predict(model, idata, data, seed=1)["posterior_predictive"]
    assert found["y"].shape == (2, 3, 30)
    # given the trajectory, predictions spread by the noise of the observation alone
    assert np.std(found["y"].values - idata["posterior"]["x"].values) == pytest.approx(0.2, rel=0.3)


def test_a_simulator_without_parameters_is_diagnosed(swung):
    model, data, _ = swung
    report = ssm.diagnose(model, data, ["constant load"], mode="fast", particles=50, progress=False)
    assert "constant load" in str(report)


def test_estimates_too_far_apart_to_be_squared():
    """The search for a proposal compares the spread of estimates, here of -1e199 and the like."""
    model = ssm.Model("volatile")

    @model.initial
    def initial():
        return {"x": ssm.Normal(0, sd=1)}

    @model.transition
    def transition(x):
        return {"x": ssm.Normal(np.sin(x), sd=1)}

    @model.observation
    def observation(x):
        return {"y": ssm.Normal(0, sd=np.exp(x))}

    (found,) = ssm.log_likelihood(model, {"y": [1e100, 2.0]}, {}, seed=1)
    assert -1e201 < found < -1e154


def test_the_spread_of_a_certain_prediction():
    model = ssm.Model("certain")

    @model.prior
    def prior():
        return {"b": ssm.Gamma(2, rate=2)}

    @model.initial
    def initial():
        return {"k": ssm.Categorical(np.stack([0.5 * 0.759, 0.5 * 0.759, 1 - 0.759]))}

    @model.transition
    def transition():
        return {"k": ssm.Categorical(np.stack([0.5 * 0.428, 0.5 * 0.428, 1 - 0.428]))}

    @model.observation
    def observation(b, t):
        return {"y": ssm.Bernoulli(0.5 + 0.5 * np.tanh(b * t))}

    for b in np.linspace(0.5, 8.0, 16):
        sd = ssm.forward_filter(model, {"y": np.ones(20)}, {"b": b}, seed=1)["y_predicted_sd"]
        p = 0.5 + 0.5 * np.tanh(b * np.arange(1, 21))
        np.testing.assert_allclose(sd.values[0], np.sqrt(p * (1 - p)), atol=1e-7)


def test_a_score_that_is_infinite_is_no_score():
    """Most draws of a Gamma law of shape 0.001 are 0 to the last bit, and their logarithm -inf."""
    model = ssm.Model("underflow")

    @model.prior
    def prior():
        return {"k": ssm.Gamma(2, rate=2)}

    @model.initial
    def initial(k):
        return {"x": ssm.Gamma(k, rate=1)}

    @model.transition
    def transition(x):
        return {"x": ssm.Normal(x, sd=1)}

    @model.observation
    def observation(x):
        return {"y": ssm.Normal(x, sd=1)}

    data = {"y": [0.0, 0.1]}
    with pytest.raises(ssm.SamplingError, match=r"no finite derivative in k .* at k = 0\.001"):
        ssm.score(model, data, {"k": 0.001}, seed=1, particles=20)
    with pytest.raises(ssm.SamplingError, match="no finite derivative in k"):
        ssm.maximize(
            model, data, ssm.ScoreAscent(particles=20, iterations=3), start={"k": 0.001}, seed=1,
            progress=False,
        )  # fmt: skip


def test_paths_of_states_that_are_no_numbers():
    """The logarithm of a negative parameter, in a state that nothing observes."""
    model = ssm.Model("nowhere")

    @model.prior
    def prior():
        return {"p": ssm.Laplace(0.0, scale=1.0)}

    @model.initial
    def initial():
        return {"x": ssm.Normal(0, sd=1), "z": ssm.Normal(0, sd=1)}

    @model.transition
    def transition(x, z, p):
        return {"x": ssm.Normal(np.sin(x), sd=1), "z": ssm.Normal(0.5 * z + np.log(p), sd=1)}

    @model.observation
    def observation(x):
        return {"y": ssm.Normal(x, sd=1)}

    with pytest.raises(ssm.SamplingError, match="p = -1"):
        ssm.smooth(model, {"y": [0.3, 0.1, 0.2]}, {"p": -1.0}, particles=20, trajectories=5, seed=1)


@pytest.mark.parametrize(
    ("verb", "method", "written"),
    [
        (ssm.sample, ssm.PGAS, "PGAS"), (ssm.sample, "pgas", "PGAS"),
        (ssm.sample, "smc2", "SMC2"), (ssm.maximize, ssm.EM, "EM"), (ssm.maximize, "em", "EM"),
    ],
)  # fmt: skip
def test_a_class_or_a_name_for_a_method_is_told_how_to_be_written(verb, method, written):
    model = ssm.Model("walk")
    model.prior(lambda: {"s": ssm.Gamma(2, rate=1)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x, s: {"x": ssm.Normal(x, sd=s)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=1)})
    with pytest.raises(ssm.ArgumentError, match=rf"Fix: write method=ssm\.{written}\(\)$"):
        verb(model, {"y": np.zeros(4)}, method=method)


@pytest.mark.parametrize("method", [ssm.FFBSi, "FFBSi"])
def test_a_class_for_a_method_of_smoothing_is_told_how_to_be_written(method):
    model = ssm.Model("walk")
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(x, sd=1)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=1)})
    with pytest.raises(ssm.ArgumentError, match=r"Fix: write method=ssm\.FFBSi\(\)$"):
        ssm.smooth(model, {"y": np.zeros(4)}, {}, method=method)


def test_a_singular_covariance_is_told_to_be_a_dirac():
    model = ssm.Model("second order")
    model.prior(lambda: {"q": ssm.InverseGamma(3, scale=1)})
    model.initial(lambda: {"x": ssm.MvNormal(np.zeros(2), covariance=np.eye(2))})
    model.transition(lambda x, q: {
        "x": ssm.MvNormal(
            np.stack([0.5 * x[0] + 0.2 * x[1], x[0]]),
            covariance=q * np.outer([1.0, 0.5], [1.0, 0.5]),
        )
    })  # fmt: skip
    model.observation(lambda x: {"y": ssm.Normal(x[0], sd=1)})
    data = {"y": np.random.default_rng(1).normal(size=20)}
    with pytest.raises(ssm.ArgumentError, match=r"(?s)singular.*MetropolisHastings.*Dirac"):
        ssm.sample(model, data, ssm.Gibbs(), draws=5, warmup=5, seed=1, progress=False)
