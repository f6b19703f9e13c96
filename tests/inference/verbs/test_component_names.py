"""Names for components, through every result, summary, plot and file."""

from __future__ import annotations

import arviz as az
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest

import ssmppl as ssm
from ssmppl.results import save
from ssmppl.tables import state_table

SEASONS, SERIES = ["winter", "spring", "summer"], ["rain", "river"]
QUIET = {"progress": False, "seed": 1}


def model_of(coords=None, dims=None, inputs=("u",)):
    """Effects of three seasons on two series, and a matrix of both; their level is a vector too."""
    model = ssm.Model("seasons", inputs=inputs, coords=coords, dims=dims)

    @model.prior
    def prior():
        return {
            "effect": ssm.Normal(np.zeros(3), sd=1),
            "load": ssm.Normal(np.zeros((2, 3)), sd=1),
            "q": ssm.InverseGamma(3, scale=1),
        }

    @model.initial
    def initial():
        return {"x": ssm.Normal(np.zeros(3), sd=1)}

    @model.transition
    def transition(x, effect, u, q):
        return {"x": ssm.Normal(0.7 * x + effect * u, variance=q)}

    @model.observation
    def observation(x, load):
        return {"y": ssm.Normal(load @ x, sd=0.5)}

    return model


DIMS = {"effect": "season", "load": ["series", "season"], "x": ["season"], "y": ["series"]}
COORDS = {"season": SEASONS, "series": SERIES}


@pytest.fixture(scope="module")
def named():
    return model_of(COORDS, DIMS)


@pytest.fixture(scope="module")
def data():
    rng = np.random.default_rng(1)
    return {"u": rng.standard_normal(30), "y": rng.standard_normal((30, 2))}


@pytest.fixture(scope="module")
def idata(named, data):
    return ssm.sample(named, data, draws=60, warmup=40, chains=2, **QUIET)


def test_a_posterior_has_them(named, idata, data, tmp_path):
    posterior = idata["posterior"]
    assert posterior["effect"].dims == ("chain", "draw", "season")
    assert posterior["load"].dims == ("chain", "draw", "series", "season")
    assert posterior["x"].dims == ("chain", "draw", "time", "season")
    assert list(posterior["season"].values) == SEASONS
    assert idata["observed_data"]["y"].dims == ("time", "series")
    assert list(idata["observed_data"]["series"].values) == SERIES
    plain = ssm.sample(model_of(), data, draws=60, warmup=40, chains=2, **QUIET)["posterior"]
    np.testing.assert_array_equal(posterior["load"].values, plain["load"].values)
    save(idata, tmp_path / "kept.nc")
    again = az.from_netcdf(tmp_path / "kept.nc")
    assert list(again["posterior"]["season"].values) == SEASONS
    forecast = ssm.forecast(named, again, inputs={"u": np.zeros(3)}, seed=1)
    assert forecast["y"].dims == ("draw", "time", "series")
    assert list(forecast["season"].values) == SEASONS
    predicted = ssm.predict(named, again, data, seed=1)["posterior_predictive"]
    assert predicted["y"].dims == ("chain", "draw", "time", "series")


def test_summaries_and_tables_have_them(named, idata, data):
    rows = list(ssm.summary(idata).index)
    assert "effect[spring]" in rows
    assert "load[river, summer]" in rows
    found = ssm.maximize(named, data, **QUIET)
    assert "load[rain, winter]" in found.covariance.columns
    assert found.iterates["effect"].dims[-1] == "season"
    assert list(found.table().index) == list(found.covariance.columns)
    assert "effect[winter]" in str(found)
    smoothed = ssm.smooth(named, data, found.parameters)
    assert list(state_table(smoothed).columns)[:2] == ["x[winter] mean", "x[winter] sd"]


def test_monte_carlo_errors_of_an_estimate_have_them():
    """They were looked for by number, and would have been 0."""
    model = ssm.Model("counts", inputs={"u": 2}, dims={"b": ["side"]}, coords={"side": ["l", "r"]})
    model.prior(lambda: {"b": ssm.Normal(np.zeros(2), sd=1), "q": ssm.Gamma(2, rate=10)})
    model.initial(lambda: {"x": ssm.Normal(1, sd=0.5)})
    model.transition(lambda x, q: {"x": ssm.Normal(0.8 * x, variance=q)})
    model.observation(lambda x, u, b: {"y": ssm.Poisson(np.exp(x + u @ b))})
    u = np.tile([[1.0, 0.0], [0.0, 1.0]], (15, 1))
    y = ssm.simulate(model, {"b": [0.5, -0.5], "q": 0.2}, inputs={"u": u}, seed=1)["y"].values[0]
    found = ssm.maximize(model, {"y": y, "u": u}, **QUIET)
    assert list(found.table().index) == ["b[l]", "b[r]", "q"]
    assert (found.table()["monte_carlo_error"] > 0).all()


def test_states_of_filters_and_simulations_have_them(named, data):
    theta = {"effect": np.ones(3), "load": np.ones((2, 3)), "q": 1.0}
    drawn = ssm.simulate(named, theta, inputs={"u": np.zeros(4)}, seed=1)
    assert drawn["x"].dims == ("draw", "time", "season")
    assert list(drawn["series"].values) == SERIES
    filtered = ssm.kalman_filter(named, data, theta)
    assert filtered["x_sd"].dims == ("draw", "time", "season")
    assert filtered["y_observed"].dims == ("time", "series")
    assert list(filtered["state"].values) == [f"x[{s}]" for s in SEASONS]
    particles = ssm.particle_filter(named, data, theta, particles=20, history=True, seed=1)
    assert particles["x_particles"].dims == ("draw", "time", "season", "particle")


def test_a_frame_is_still_read_by_number(named, data):
    frame = pd.DataFrame({"u": data["u"], "y_0": data["y"][:, 0], "y_1": data["y"][:, 1]})
    theta = {"effect": np.ones(3), "load": np.ones((2, 3)), "q": 1.0}
    assert ssm.log_likelihood(named, frame, theta) == ssm.log_likelihood(named, data, theta)


def test_plots_have_them(named, data, idata):
    theta = {"effect": np.ones(3), "load": np.ones((2, 3)), "q": 1.0}
    for draw in (
        lambda: ssm.plots.plot_states(idata),
        lambda: ssm.plots.plot_states(ssm.smooth(named, data, theta)),
        lambda: ssm.plots.plot_prior_posterior(idata, named),
        lambda: ssm.plots.plot_predictions(ssm.kalman_filter(named, data, theta)),
    ):
        plt.close("all")
        draw()
        texts = " ".join(
            t.get_text()
            for ax in plt.gcf().axes
            for t in (ax.title, ax.xaxis.label, ax.yaxis.label, *ax.texts)
        )
        assert "[0]" not in texts
        assert "[winter]" in texts or "[rain]" in texts or "load[rain, winter]" in texts
    plt.close("all")


def test_a_name_may_stand_for_numbers_only(data):
    """Dims without coords have the numbers of the components."""
    found = ssm.simulate(
        model_of(None, {"x": ["season"]}), steps=2, inputs={"u": np.zeros(2)}, seed=1
    )
    assert found["x"].dims == ("draw", "time", "season")
    assert found["season"].values.tolist() == [0, 1, 2]
    assert found["effect"].dims == ("draw", "effect_dim_0")


@pytest.mark.parametrize(
    ("coords", "dims", "found", "fix"),
    [
        ({"season": SEASONS}, None, "no dim of any quantity", 'dims='),
        (None, {"efect": ["season"]}, "'efect', which the model does not have", "effect"),
        (None, {"q": ["season"]}, "shape ()", "leave it out"),
        (None, {"load": ["series"]}, "1 dims", "give 2"),
        ({"season": SEASONS[:2]}, {"effect": ["season"]}, "2 labels", "one label for each"),
        (None, {"effect": ["s"], "y": ["s"]}, "'y' has 2 components along 's'", "two dims"),
        (None, {"effect": ["time"]}, "which results have of their own", "another name"),
        (None, {"effect": ["the season"]}, "'the season'", "letters"),
        (None, {"effect": ["q"]}, "also a quantity", "rename"),
        (None, {"load": ["s", "s"]}, "a dim twice", "apart"),
        ({"season": ["a", "a", "b"]}, {"effect": ["season"]}, "a label twice", "of its own"),
        ({"season": "abc"}, {"effect": ["season"]}, "'abc'", "list of labels"),
        (["season"], {"effect": ["season"]}, "coords is ['season']", "dictionary"),
        (None, {"effect": 3}, "are 3", "list of names"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_refused(coords, dims, found, fix):
    with pytest.raises(ssm.ModelError) as caught:
        ssm.explain(model_of(coords, dims))
    assert found in caught.value.found
    assert fix in caught.value.fix
    assert caught.value.where.line
