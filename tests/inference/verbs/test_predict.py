"""Predictive draws: their exact laws, and the groups that they come back in."""

import numpy as np
import pytest
from scipy import stats

import ssmppl as ssm
from ssmppl.errors import ArgumentError, ModelError
from ssmppl.inference.verbs.predict import group
from ssmppl.results import save, to_inference_data
from tests.statistics.checks import LEVEL, seed_of

ROWS, DRAWS = 6, 20_000
U = np.linspace(-1.0, 2.0, ROWS)


def model(start=None):
    """m ~ N(1, 2^2), x_1 ~ N(m, 1), x' ~ N(x / 2 + u, 0.7^2), y ~ N(x + m, 0.5^2)."""
    out = ssm.Model("drift", inputs=("u",))
    out.prior(lambda: {"m": ssm.Normal(1.0, sd=2.0)})
    out.initial(lambda m: {"x": start or ssm.Normal(m, sd=1.0)})
    out.transition(lambda x, u: {"x": ssm.Normal(0.5 * x + u, sd=0.7)})
    out.observation(lambda x, m: {"y": ssm.Normal(x + m, sd=0.5)})
    return out


def agree(values, mean, variance, tests=40):
    n, limit = len(values), stats.norm.isf(LEVEL / (2 * tests))
    assert abs(values.mean() - mean) < limit * np.sqrt(variance / n)
    assert abs(values.var() - variance) < limit * variance * np.sqrt(2.0 / n)


def moments(sd_of_m, m=1.0):
    """Mean and variance of each y_t, with m ~ N(m, sd^2)."""
    slope, mean, noise = 1.0, 0.0, 1.0  # x_t = slope m + mean + noise
    for t in range(ROWS):
        yield (slope + 1.0) * m + mean, (slope + 1.0) ** 2 * sd_of_m**2 + noise + 0.25
        slope, mean, noise = 0.5 * slope, 0.5 * mean + U[t], 0.25 * noise + 0.49


def test_prior_predictive_draws_have_the_models_law():
    found = ssm.predict(model(), data={"u": U}, draws=DRAWS, seed=seed_of("prior"))
    prior, drawn = group(found, "prior"), group(found, "prior_predictive")
    assert prior["m"].dims == ("chain", "draw")
    assert prior["x"].dims == drawn["y"].dims == ("chain", "draw", "time")
    for t, (mean, variance) in enumerate(moments(2.0)):
        agree(drawn["y"].values[0, :, t], mean, variance)
    agree(prior["m"].values[0], 1.0, 4.0)
    residual = drawn["y"] - prior["x"] - prior["m"]
    agree(residual.values.ravel(), 0.0, 0.25)
    assert group(found, "observed_data") is None
    assert group(found, "constant_data")["u"].values.tolist() == U.tolist()


def posterior(states=True):
    rng = np.random.default_rng(seed_of("posterior", ""))
    own = {"x": rng.normal(5.0, 3.0, (2, 4000, ROWS))} if states else {}
    m = np.repeat([[1.0], [-4.0]], 4000, axis=1)
    return to_inference_data(posterior={"m": m, **own}, over_time={"x"})


def test_given_the_trajectories_or_simulated_anew():
    y = np.arange(1.0, ROWS + 1)
    y[2] = np.nan
    data, idata = {"y": y, "u": U}, posterior()
    near = group(ssm.predict(model(), idata, data, seed=1), "posterior_predictive")["y"]
    drawn = group(idata, "posterior")
    agree((near - drawn["x"] - drawn["m"]).values.ravel(), 0.0, 0.25)
    assert np.all(np.isfinite(near))  # missing rows too
    free = ssm.predict(model(), idata, data, conditional=False, seed=1)
    for chain, m in enumerate((1.0, -4.0)):
        for t, (mean, variance) in enumerate(moments(0.0, m)):
            own = group(free, "posterior_predictive")["y"].values[chain, :, t]
            agree(own, mean, variance)
    without = ssm.predict(model(), posterior(states=False), data, seed=1)
    assert group(without, "posterior_predictive").attrs["conditional"] == 0
    observed = group(free, "observed_data")["y"].values
    np.testing.assert_array_equal(observed, y)
    bare = ssm.predict(model(), idata, {"u": U}, conditional=False, seed=1)
    drawn = group(bare, "posterior_predictive")["y"].values
    np.testing.assert_array_equal(drawn, group(free, "posterior_predictive")["y"].values)
    assert group(bare, "observed_data") is None


def test_several_experiments(tmp_path):
    data = [{"y": np.zeros(ROWS), "u": U}, {"y": np.zeros(3), "u": U[:3]}]
    found = ssm.predict(model(), None, data, draws=10, seed=1)
    drawn = group(found, "prior_predictive")
    assert drawn["y"].dims == ("chain", "draw", "experiment", "time")
    assert drawn["y"].shape == (1, 10, 2, ROWS)
    assert np.isnan(drawn["y"].values[:, :, 1, 3:]).all()
    assert np.isfinite(drawn["y"].values[:, :, 1, :3]).all()
    assert drawn["rows"].values.tolist() == [ROWS, 3]
    assert group(found, "observed_data")["y"].dims == ("experiment", "time")
    save(found, tmp_path / "drawn.nc")
    with pytest.raises(ssm.ArgumentError, match="trajectories of 1 data sets, the data are 2"):
        ssm.predict(model(), posterior(), data, seed=1)


def test_after_sampling():
    """The whole way, and the container goes with the one that was sampled."""
    data = {"y": np.random.default_rng(3).normal(size=ROWS), "u": U}
    idata = ssm.sample(model(), data, draws=50, warmup=20, chains=2, seed=1, progress=False)
    found = ssm.predict(model(), idata, data, seed=2)
    assert group(found, "posterior_predictive")["y"].shape == (2, 50, ROWS)
    ahead = ssm.forecast(model(), idata, inputs={"u": [0.0, 1.0]}, seed=2)
    assert ahead["y"].shape == (100, 2)


def test_what_cannot_be_predicted_is_said():
    data = {"y": np.zeros(ROWS), "u": U}
    with pytest.raises(ArgumentError, match="have 6 rows, the data 3"):
        ssm.predict(model(), posterior(), {"y": np.zeros(3), "u": U[:3]})
    with pytest.raises(ArgumentError, match="conditional=True"):
        ssm.predict(model(), posterior(states=False), data, conditional=True)
    three = [data, data, data]
    whole = ssm.sample(model(), three, draws=5, warmup=2, chains=1, seed=1, progress=False)
    with pytest.raises(ArgumentError, match="trajectories of 3 data sets, the data are 2"):
        ssm.predict(model(), whole, three[:2])
    ssm.predict(model(), whole, three[:2], conditional=False)
    with pytest.raises(ModelError, match="Flat"):
        ssm.predict(model(ssm.Flat()), None, data)
    blind = ssm.Model("blind")
    blind.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    blind.transition(lambda x: {"x": ssm.Normal(x, sd=1)})
    with pytest.raises(ModelError, match="nothing to predict"):
        ssm.predict(blind, None, steps=3)
