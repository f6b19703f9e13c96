"""Results under whichever ArviZ is installed: 0.2x (InferenceData) or 1.x (DataTree)."""

import json
import tracemalloc
from dataclasses import dataclass

import numpy as np
import pandas as pd
import pytest

from ssmppl import results, tables
from ssmppl.errors import ArgumentError

CHAINS, DRAWS, T = 3, 200, 7


@dataclass(frozen=True)
class Settings:
    particles: int = 20


@pytest.fixture
def arrays():
    rng = np.random.default_rng(1)
    return {
        "posterior": {
            "phi": rng.normal(size=(CHAINS, DRAWS)),
            "Q": rng.normal(size=(CHAINS, DRAWS, 2, 2)),
            "x": rng.normal(size=(CHAINS, DRAWS, T)),
            "z": rng.normal(size=(CHAINS, DRAWS, T, 2)),
        },
        "sample_stats": {
            "acceptance_rate": rng.uniform(size=(CHAINS, DRAWS)),
            "diverging": rng.uniform(size=(CHAINS, DRAWS)) < 0.5,
            "update_rate": rng.uniform(size=(CHAINS, DRAWS, T)),
        },
        "observed_data": {"y": np.array([1.0, np.nan, 2, 3, 4, 5, 6])},
        "constant_data": {"u": rng.normal(size=(T, 2))},
        "log_likelihood": {"y": rng.normal(size=(CHAINS, DRAWS, T))},
    }


ATTRS = {
    "method": Settings(),
    "seed": 2**130,
    "started": None,
    "interrupted": True,
    "seconds": np.float64(1.5),
    "plan": "tau ~ Gamma\nphi | tau ~ Normal, τ > 0",
    "settings": {"particles": np.int64(20), "start": np.array([1.0, 2.0])},
    "fixed": (),
    "long": "é" * 100_000,
}


@pytest.fixture
def idata(arrays):
    return results.to_inference_data(
        **arrays, over_time={"x", "z"}, stats_over_time={"update_rate"}, attrs=ATTRS
    )


def dims(idata, group, name):
    return tuple(idata[group][name].dims)


def test_groups_and_dims(idata):
    assert dims(idata, "posterior", "phi") == ("chain", "draw")
    assert dims(idata, "posterior", "Q") == ("chain", "draw", "Q_dim_0", "Q_dim_1")
    assert dims(idata, "posterior", "x") == ("chain", "draw", "time")
    assert dims(idata, "posterior", "z") == ("chain", "draw", "time", "z_dim_0")
    assert dims(idata, "sample_stats", "acceptance_rate") == ("chain", "draw")
    assert dims(idata, "sample_stats", "update_rate") == ("chain", "draw", "time")
    assert dims(idata, "observed_data", "y") == ("time",)
    assert dims(idata, "constant_data", "u") == ("time", "u_dim_0")
    assert dims(idata, "log_likelihood", "y") == ("chain", "draw", "time")
    assert idata["posterior"]["time"].values.tolist() == list(range(1, T + 1))
    assert not hasattr(idata, "prior")


def test_attributes_are_plain_and_stand_on_the_whole_and_on_the_draws(idata):
    for attrs in (idata.attrs, idata["posterior"].attrs):
        assert attrs["method"] == "Settings(particles=20)"
        assert attrs["seed"] == str(2**130)
        assert attrs["started"] == "None"
        assert attrs["interrupted"] == 1
        assert attrs["seconds"] == 1.5
        assert json.loads(attrs["settings"]) == {"particles": 20, "start": [1.0, 2.0]}
        assert attrs["fixed"] == "[]"
        assert attrs["inference_library"] == "ssmppl"
        assert attrs["numpy_version"] == np.__version__
        assert len(attrs["long"].encode()) < 2**16
    assert not idata["observed_data"].attrs


def test_round_trip(idata, arrays, tmp_path):
    az = results.arviz()
    path = results.save(idata, tmp_path / "run.nc")
    assert [p.name for p in tmp_path.iterdir()] == ["run.nc"]
    again = az.from_netcdf(str(path))
    for group, variables in arrays.items():
        for name, values in variables.items():
            assert dims(again, group, name) == dims(idata, group, name)
            np.testing.assert_array_equal(again[group][name].values, values)
    assert dict(again.attrs) == dict(idata.attrs)
    assert again["posterior"].attrs["plan"] == ATTRS["plan"]


def test_a_failed_write_leaves_what_was_there(tmp_path):
    class Unwritable:
        def to_netcdf(self, path, engine):
            with open(path, "w") as file:
                file.write("half")
            raise OSError("disk full")

    path = tmp_path / "run.nc"
    path.write_text("earlier")
    with pytest.raises(OSError, match="disk full"):
        results.save(Unwritable(), path)
    assert path.read_text() == "earlier"
    assert len(list(tmp_path.iterdir())) == 1


def test_draws_on_disk_are_saved_without_being_taken_into_memory(tmp_path):
    shape = (2, 500, 8_000)
    draws = np.lib.format.open_memmap(tmp_path / "x.npy", "w+", float, shape)
    draws[:] = np.arange(8_000.0)
    idata = results.to_inference_data(posterior={"x": draws}, over_time=("x",))
    results.save(idata, tmp_path / "warm.nc")  # imports what it needs
    tracemalloc.start()
    try:
        results.save(idata, tmp_path / "out.nc")
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert most < draws.nbytes / 8
    read = results.arviz().from_netcdf(tmp_path / "out.nc")
    np.testing.assert_array_equal(read.posterior["x"][1, 499], np.arange(8_000.0))


@pytest.mark.parametrize(
    "time",
    [
        np.linspace(0, 1, T),
        pd.date_range("1871-01-01", periods=T, freq="YS"),
        pd.period_range("1871", periods=T, freq="Y"),
        pd.date_range("2020-01-01", periods=T, tz="Europe/Stockholm"),
        list("abcdefg"),
    ],
    ids=["floats", "dates", "periods", "zoned", "text"],
)
def test_time_coordinate_survives(arrays, time, tmp_path):
    idata = results.to_inference_data(
        **arrays, over_time={"x", "z"}, stats_over_time={"update_rate"}, time=time
    )
    again = results.arviz().from_netcdf(str(results.save(idata, tmp_path / "run.nc")))
    expected = idata["posterior"]["time"].values
    np.testing.assert_array_equal(again["posterior"]["time"].values, expected)
    assert len(set(expected.tolist())) == T


def test_dims_of_single_variables():
    wheels = np.random.default_rng(2).normal(size=(2, 5, 2))
    idata = results.to_inference_data(
        posterior={"x": np.zeros((2, 5, 3, 4)), "b": wheels},
        dims={"x": ["experiment", "time"], "b": ["wheel"]},
        coords={"experiment": ["a", "b", "c"], "wheel": ["left", "right"]},
        further={"rows": (["experiment"], np.array([4, 4, 2]), {"unit": "1"})},
        time=[1900, 1901, 1902, 1903],
    )
    posterior = idata["posterior"]
    assert posterior["x"].dims == ("chain", "draw", "experiment", "time")
    assert posterior["time"].values.tolist() == [1900, 1901, 1902, 1903]
    assert posterior["rows"].values.tolist() == [4, 4, 2]
    assert posterior["rows"].attrs == {"unit": "1"}
    assert posterior["wheel"].values.tolist() == ["left", "right"]
    assert list(tables.summary(idata).index) == ["b[left]", "b[right]"]


def test_summary_is_of_the_parameters_and_agrees_with_numpy(idata, arrays):
    table = tables.summary(idata)
    assert list(table.columns) == tables.SUMMARY_COLUMNS
    assert list(table.index) == ["phi", "Q[0, 0]", "Q[0, 1]", "Q[1, 0]", "Q[1, 1]"]
    phi = arrays["posterior"]["phi"]
    assert table.loc["phi", "mean"] == pytest.approx(phi.mean())
    assert table.loc["phi", "sd"] == pytest.approx(phi.std(ddof=1), rel=1e-3)
    assert table.loc["phi", "mcse_mean"] == pytest.approx(phi.std() / np.sqrt(phi.size), rel=0.2)
    assert table.loc["phi", "ess_bulk"] == pytest.approx(phi.size, rel=0.3)
    assert table.loc["phi", "r_hat"] == pytest.approx(1, abs=0.02)
    assert table.to_numpy().dtype == np.float64


def test_summary_of_named_variables(idata):
    assert len(tables.summary(idata, ["x"])) == T
    assert list(tables.summary(idata, "phi").index) == ["phi"]
    with pytest.raises(ArgumentError, match=r"no variable 'psi'.*\n.*it has phi,"):
        tables.summary(idata, ["psi"])


def test_summary_of_states_alone_is_empty():
    idata = results.to_inference_data(posterior={"x": np.zeros((2, 5, T))}, over_time={"x"})
    assert tables.summary(idata).empty


def test_summary_says_which_arguments_it_has(idata):
    with pytest.raises(ArgumentError, match="no argument 'states'") as caught:
        tables.summary(idata, states=True)
    assert "var_names" in caught.value.fix


def test_summary_of_something_without_posterior_draws():
    filtered = results.to_dataset({"x": np.zeros((1, T))})
    with pytest.raises(ArgumentError, match="summary of a Dataset, which holds no posterior draws"):
        tables.summary(filtered)
    with pytest.raises(ArgumentError, match="summary of a ndarray"):
        tables.summary(np.zeros(3))


def test_disagreeing_shapes_are_refused():
    with pytest.raises(ValueError, match=r"'b' has 4 along 'draw', but 'a' has 5"):
        results.to_inference_data(posterior={"a": np.zeros((2, 5)), "b": np.zeros((2, 4))})
    with pytest.raises(ValueError, match=r"'x' has shape \(2, 5\), but its dims are"):
        results.to_inference_data(posterior={"x": np.zeros((2, 5))}, over_time={"x"})


@pytest.mark.parametrize("sample_dim", ["draw", "trajectory"])
def test_datasets(sample_dim):
    dataset = results.to_dataset(
        {"x": np.zeros((1, T, 2)), "log_z": np.zeros(1)}, sample_dim=sample_dim, over_time={"x"}
    )
    assert dataset["x"].dims == (sample_dim, "time", "x_dim_0")
    assert dataset["log_z"].dims == (sample_dim,)
    assert dataset.sizes[sample_dim] == 1
    plain = results.to_dataset({"mean": np.zeros(T)}, sample_dim=None, time=np.arange(T) * 0.5)
    assert plain["mean"].dims == ("time",)
    assert plain["time"].values[1] == 0.5
