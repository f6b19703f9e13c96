"""Several experiments in one object, and results with a dim for them."""

from __future__ import annotations

import arviz as az
import numpy as np
import pandas as pd
import pytest
import xarray as xr

import ssmppl as ssm
from ssmppl.data.experiments import experiments_of
from ssmppl.results import save

RNG = np.random.default_rng(1)
YEARS = {"oak": range(1990, 2002), "elm": range(1995, 2003), "ash": range(1980, 1995)}
LONG = pd.concat(
    [
        pd.DataFrame({"tree": k, "time": list(v), "y": RNG.normal(size=len(v))})
        for k, v in YEARS.items()
    ],
    ignore_index=True,
)
FRAMES = {
    k: g.drop(columns="tree").reset_index(drop=True) for k, g in LONG.groupby("tree", sort=False)
}
THETA = {"q": 1.0, "mu": 0.1}
SHORT = {"draws": 10, "warmup": 10, "chains": 2, "seed": 1, "progress": False}


def model_of(**options) -> ssm.Model:
    model = ssm.Model("growth", **options)
    model.prior(lambda: {"q": ssm.InverseGamma(3, scale=1), "mu": ssm.Normal(0, sd=1)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=2)})
    model.transition(lambda x, q, mu: {"x": ssm.Normal(0.8 * x + mu, variance=q)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=0.5)})
    return model


PLAIN, TREES = model_of(), model_of(experiment="tree")
FORMS = {
    "a dictionary of tables": (PLAIN, FRAMES),
    "a dictionary of mappings": (
        PLAIN, {k: {"y": v["y"].values, "time": v["time"].values} for k, v in FRAMES.items()}
    ),
    "a long table": (TREES, LONG),
    "a long table in another order of rows": (
        TREES, LONG.sort_values(["time", "tree"], kind="stable")
    ),
    "a long table with levels": (TREES, LONG.set_index(["tree", "time"])),
    "a mapping of long arrays": (TREES, {n: LONG[n].values for n in LONG}),
    "a list of long tables": (
        TREES, [LONG[LONG["tree"] != "ash"], LONG[LONG["tree"] == "ash"]]
    ),
}  # fmt: skip


@pytest.mark.parametrize("form", list(FORMS))
def test_every_form_is_the_same_experiments(form):
    model, data = FORMS[form]
    expected = sum(float(ssm.log_likelihood(PLAIN, f, THETA)[0]) for f in FRAMES.values())
    assert float(ssm.log_likelihood(model, data, THETA)[0]) == pytest.approx(expected, rel=1e-12)
    smoothed = ssm.smooth(model, data, THETA)
    assert set(smoothed) == set(YEARS)
    for name, years in YEARS.items():
        assert smoothed[name]["time"].values.tolist() == list(years)
        alone = ssm.smooth(PLAIN, FRAMES[name], THETA)
        np.testing.assert_allclose(smoothed[name]["x"].values, alone["x"].values, rtol=1e-12)


def test_results_have_a_dim_with_the_labels(tmp_path):
    idata = ssm.sample(TREES, LONG, **SHORT)
    x = idata["posterior"]["x"]
    assert x.dims == ("chain", "draw", "experiment", "time")
    assert x["experiment"].values.tolist() == list(YEARS)
    assert x["rows"].values.tolist() == [len(v) for v in YEARS.values()]
    assert np.isnan(x.values[:, :, 0, 12:]).all()
    again = az.from_netcdf(save(idata, tmp_path / "p.nc"))
    for (label, own), (name, years) in zip(
        experiments_of(again["posterior"]), YEARS.items(), strict=True
    ):
        assert label == name
        assert own["time"].values.tolist() == list(years)
        assert own["time"].dtype.kind == "i"
        assert np.isfinite(own["x"].values).all()
    ahead = ssm.forecast(TREES, again, 3, experiment="elm", seed=1)
    assert ahead["time"].values.tolist() == [2003, 2004, 2005]
    assert ahead.attrs["after"] == 8
    with pytest.raises(ssm.ArgumentError, match="experiments ash, elm, oak"):
        ssm.forecast(TREES, again, 3, experiment="yew", seed=1)
    predicted = ssm.predict(TREES, again, LONG, seed=1)["posterior_predictive"]
    assert predicted["y"].dims == ("chain", "draw", "experiment", "time")
    assert predicted.attrs["conditional"] == 1
    # what was observed is data again
    assert ssm.log_likelihood(PLAIN, again["observed_data"], THETA) == ssm.log_likelihood(
        TREES, LONG, THETA
    )


def test_log_likelihoods_are_of_the_rows_that_were_measured():
    """Rows without data, or beyond the end of an experiment, counted for ArviZ as observations."""
    method = ssm.MetropolisHastings(log_likelihood=True)
    rows = ssm.sample(TREES, LONG, method, **SHORT)["log_likelihood"]
    assert rows["one_step"].dims == ("chain", "draw", "row")
    assert rows["experiment"].values.tolist() == LONG["tree"].tolist()
    assert rows["time"].values.tolist() == LONG["time"].tolist()
    loo = az.loo(ssm.sample(TREES, LONG, method, **SHORT))
    assert loo.n_data_points == len(LONG)
    y = np.array([0.3, np.nan, 0.1, -0.2])
    dates = pd.date_range("2024-01-01", periods=4)
    single = ssm.sample(PLAIN, pd.DataFrame({"y": y}, index=dates), method, **SHORT)
    assert single["log_likelihood"]["one_step"].shape == (2, 10, 3)
    np.testing.assert_array_equal(single["log_likelihood"]["time"].values, dates[[0, 2, 3]])
    assert single["posterior"]["x"].shape == (2, 10, 4)
    alike = ssm.sample(PLAIN, {k: {"y": np.zeros(3)} for k in "ab"}, method, **SHORT)
    assert alike["log_likelihood"]["one_step"].dims == ("chain", "draw", "experiment", "time")


def test_all_are_forecast_together(tmp_path):
    idata = ssm.sample(TREES, LONG, **SHORT)
    every = ssm.forecast(TREES, idata, 3, seed=1)
    assert every["y"].dims == ("draw", "experiment", "time")
    assert every["after"].values.tolist() == [len(v) for v in YEARS.values()]
    every.to_netcdf(tmp_path / "f.nc", engine="h5netcdf")
    again = xr.load_dataset(tmp_path / "f.nc", engine="h5netcdf")
    for (label, own), years in zip(experiments_of(again), YEARS.values(), strict=True):
        assert own["time"].values.tolist() == [max(years) + k for k in (1, 2, 3)]
        alone = ssm.forecast(TREES, idata, 3, experiment=label, seed=1)
        np.testing.assert_array_equal(own["mu"].values, alone["mu"].values)
        last = idata["posterior"]["x"].sel(experiment=label).values[..., len(years) - 1].ravel()
        step = own["x"].values[:, 0] - 0.8 * last - own["mu"].values
        assert np.abs(step).max() < 8.0 * np.sqrt(own["q"].values.max())
    with pytest.raises(ssm.ArgumentError, match="draws one experiment"):
        ssm.plot_forecast(every, idata)
    twins = ssm.forecast(PLAIN, THETA, 3, data=dict.fromkeys("ab", FRAMES["elm"]), draws=50, seed=1)
    noise = twins["y"].values - twins["x"].values  # of the sensor: each has its own
    assert abs(np.corrcoef(noise[:, 0].ravel(), noise[:, 1].ravel())[0, 1]) < 0.5


def test_inputs_of_the_rows_to_come_of_each():
    model = ssm.Model("driven", inputs=("u",))
    model.initial(lambda: {"x": ssm.Dirac(0.0)})
    model.transition(lambda x, u: {"x": ssm.Dirac(x + u)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=1)})
    data = {k: {"u": np.zeros(n), "y": np.zeros(n)} for k, n in (("a", 3), ("b", 2))}
    steps = {"a": {"u": [1.0, 1.0]}, "b": {"u": [5.0, 5.0]}}
    for inputs in (steps, [steps["a"], steps["b"]]):
        found = ssm.forecast(model, {}, inputs=inputs, data=data, draws=2, seed=1)
        assert found["x"].values[0].tolist() == [[0.0, 1.0], [0.0, 5.0]]
    same = ssm.forecast(model, {}, inputs=steps["a"], data=data, draws=2, seed=1)
    assert same["x"].values[0].tolist() == [[0.0, 1.0]] * 2
    with pytest.raises(ssm.ArgumentError, match="none for the experiment 'b'"):
        ssm.forecast(model, {}, inputs={"a": steps["a"]}, data=data)
    with pytest.raises(ssm.ArgumentError, match="1 data sets, and the experiments are 2"):
        ssm.forecast(model, {}, inputs=[steps["a"]], data=data)


def test_panels_are_titled_by_the_labels():
    idata = ssm.sample(TREES, LONG, **SHORT)
    for axes in (
        ssm.plot_states(idata),
        ssm.plot_states(ssm.smooth(TREES, LONG, THETA)),
        ssm.plot_filter(ssm.kalman_filter(TREES, LONG, THETA)),
        ssm.plot_predictions(ssm.kalman_filter(TREES, LONG, THETA)),
    ):
        titles = [ax.get_title(loc="left").split("\n")[0] for ax in np.ravel(axes)]
        assert [t for t in titles if t in YEARS] == list(YEARS)


def test_ancestry_of_one_of_them():
    found = ssm.particle_filter(TREES, LONG, THETA, particles=20, history=True, seed=1)
    ssm.plot_ancestry(found, experiment="elm")
    with pytest.raises(ssm.ArgumentError, match="result is of elm, oak, ash"):
        ssm.plot_ancestry(found)


@pytest.mark.parametrize("kind", ["dates", "none", "one without", "texts", "alike"])
def test_labels_of_rows_of_each(kind, tmp_path):
    y = [np.zeros(3), np.zeros(2)]
    first = pd.date_range("2024-01-01", periods=3, freq="D")
    index = {
        "dates": [first, first[:2] + pd.Timedelta(days=9)], "none": [None, None],
        "one without": [first, None], "texts": [list("abc"), list("xy")],
        "alike": [[1.5, 2.5, 3.5], [1.5, 2.5, 3.5]],
    }[kind]  # fmt: skip
    y = [np.zeros(3), np.zeros(3)] if kind == "alike" else y
    data = [pd.DataFrame({"y": v}, index=i) for v, i in zip(y, index, strict=True)]
    idata = az.from_netcdf(save(ssm.sample(PLAIN, data, **SHORT), tmp_path / "p.nc"))
    assert ("times" in idata["posterior"].coords) == (kind not in ("none", "alike"))
    for i, (label, own) in enumerate(experiments_of(idata["posterior"])):
        assert label == str(i + 1)
        expected = np.arange(1, len(y[i]) + 1) if index[i] is None else np.asarray(index[i])
        np.testing.assert_array_equal(own["time"].values, expected)


REFUSED = {
    "no column": (TREES, {"y": np.zeros(3)}, "no column 'tree'", "add it"),
    "a missing label": (
        TREES, LONG.assign(tree=[None, *LONG["tree"][1:]]), "missing in some row", "every row"
    ),
    "rows that differ": (
        TREES, {"tree": ["a", "b"], "y": np.zeros(3)}, "'y' of data has 3 rows", "each row"
    ),
    "no experiment in the model": (PLAIN, LONG, "stands in rows", 'experiment="id"'),
    "levels of an index": (
        PLAIN, LONG.set_index(["tree", "time"]), "several levels", "experiment='tree'"
    ),
    "a label twice": (
        TREES, [LONG, LONG[:5]], "two experiments of data are called 'oak'", "of its own"
    ),
    "no data sets": (PLAIN, [], "empty list", "at least one"),
}  # fmt: skip


@pytest.mark.parametrize("case", list(REFUSED))
def test_what_cannot_be_told_apart_is_said(case):
    model, data, found, fix = REFUSED[case]
    with pytest.raises(ssm.DataError) as error:
        ssm.log_likelihood(model, data, THETA)
    assert found in error.value.found
    assert fix in error.value.fix


def test_the_place_of_a_fault_has_the_label():
    broken = LONG.copy()
    broken.loc[15, "y"] = np.inf
    with pytest.raises(ssm.DataError, match=r"experiment 'elm', 'y', row 4 \(time 1998\)"):
        ssm.log_likelihood(TREES, broken, THETA)


def test_labels_of_any_kind_are_kept_in_words():
    data = {
        ("north", 1): {"y": np.zeros(2)},
        pd.Timestamp("2024-01-01"): {"y": np.zeros(2)},
        7: {"y": np.zeros(2)},
    }
    found = ssm.sample(PLAIN, data, **SHORT)["posterior"]["experiment"].values.tolist()
    assert found == ["('north', 1)", "2024-01-01 00:00:00", "7"]
    assert ssm.forecast(PLAIN, THETA, 1, data=data, draws=2, experiment=7, seed=1)["y"].ndim == 2


@pytest.mark.parametrize("given", ["", 3, ["tree"]])
def test_the_name_of_the_column_is_a_text(given):
    with pytest.raises(ssm.ModelError, match="experiment="):
        ssm.Model("growth", experiment=given)


def test_a_channel_given_as_a_table_is_no_experiment():
    """A mapping whose keys are the model's names holds variables."""
    model = ssm.Model("pair")
    model.initial(lambda: {"x": ssm.Normal(np.zeros(2), sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(x, sd=1)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=1)})
    table = pd.DataFrame({"a": [0.0, 1.0], "b": [2.0, 3.0]})
    found = ssm.log_likelihood(model, {"y": table}, {})
    assert found == ssm.log_likelihood(model, {"y": table.values}, {})


def test_one_experiment_of_a_dataset():
    data = xr.Dataset({"y": (("experiment", "time"), np.zeros((1, 4)))}, {"experiment": ["a"]})
    ((label, own),) = experiments_of(data)
    assert (label, own["y"].dims) == ("a", ("time",))
    assert ssm.smooth(PLAIN, data, THETA)["x"].shape == (1, 4)
