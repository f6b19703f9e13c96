"""`--json`: what a command prints then, against the verb of Python with the same seed."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr

import ssmppl as ssm
from ssmppl.cli import main
from ssmppl.cli.rendering import plain
from ssmppl.modelfile import load_model, read_csv
from ssmppl.results import arviz
from tests.cli.shared import QUICK, WEATHER, answer, run, write
from tests.diagnosis.made_up import effect_found

PAGE = Path(__file__).parent.parent.parent / "docs" / "command_line.md"
Q = ("-p", "q=0.3")


def documented():
    """The keys of each command, from the page."""
    rows = re.findall(r"^\| ((?:`[\w-]+`(?:, )?)+) \| ((?:`\w+`(?:, )?)+) \|$",
                      PAGE.read_text(encoding="utf-8"), re.M)  # fmt: skip
    return {
        command: {"command", "model", *re.findall(r"`(\w+)`", keys)}
        for commands, keys in rows
        for command in re.findall(r"`([\w-]+)`", commands)
    }


KEYS = documented()


def told(*args, code=0):
    """The answer, its keys compared with the page's."""
    found = answer(*args, code=code)
    assert found["command"] == args[0]
    assert set(found) == KEYS[args[0]]
    return found


def test_the_page_has_the_keys_of_every_command():
    assert set(KEYS) == set(main.commands) - {"completion"}


# -- the model
def test_explain(series):
    found = told("explain", "walk.py", series)
    plan = ssm.explain(load_model("walk.py"), read_csv(series))
    assert found["data"] == "20 rows, none missing"
    pairs = [(s["title"], [(r["what"], r["how"]) for r in s["rows"]]) for s in found["sections"]]
    assert pairs == plan.sections()
    assert told("explain", "walk.py")["data"] is None


def test_compile(folder):
    program = ssm.compile(load_model("walk.py"))
    found = told("compile", "walk.py")
    assert found["source"] == program.source()
    assert Path(found["path"]) == program.path
    assert run("compile", "walk.py").stdout == program.source() + "\n"
    assert Path(run("compile", "walk.py", "--path").stdout.strip()).is_file()


def test_simulate(folder):
    found = told("simulate", "walk.py", "--steps", 5, *Q, "--draws", 2, "-o", "s.csv")
    assert (found["rows"], found["columns"]) == (10, ["draw", "time", "x", "y"])
    # without a seed one is drawn, and told
    again = ssm.simulate(load_model("walk.py"), {"q": 0.3}, steps=5, draws=2, seed=found["seed"])
    np.testing.assert_array_equal(pd.read_csv(found["files"][0])["y"], again["y"].values.ravel())


# -- states and likelihood
def test_log_likelihood(series):
    model, data = load_model("walk.py"), read_csv(series)
    exact = told("log-likelihood", "walk.py", series, *Q)
    assert exact["log_likelihood"] == list(ssm.log_likelihood(model, data, {"q": 0.3}))
    assert exact["standard_error"] is None
    words = ("--proposal", "bootstrap", "--repeats", 4, "--particles", 50, "--seed", 3)
    found = told("log-likelihood", "walk.py", series, *Q, *words)
    expected = ssm.log_likelihood(
        model, data, {"q": 0.3}, proposal="bootstrap", repeats=4, particles=50, seed=3
    )
    assert found["log_likelihood"] == list(expected)
    assert found["log_mean"] == pytest.approx(np.log(np.mean(np.exp(expected))))
    share = np.exp(expected - expected.max())
    error = np.std(share, ddof=1) / np.mean(share) / 2
    assert found["standard_error"] == pytest.approx(error)
    shown = run("log-likelihood", "walk.py", series, *Q, *words).stdout
    assert f"{expected[1]:.10g}\n" in shown
    assert f"log of the mean {found['log_mean']:.6f}" in shown


def test_what_is_not_finite_is_null(series):
    pd.DataFrame({"y": [0.0, 1e200]}).to_csv("far.csv", index=False)
    words = ("--proposal", "bootstrap", "--particles", 5, "--seed", 1)
    found = told("log-likelihood", "walk.py", "far.csv", *Q, *words)
    assert found["log_likelihood"] == [None]
    assert "-inf" in run("log-likelihood", "walk.py", "far.csv", *Q, *words).stdout


def test_kalman_filter(series):
    found = told("kalman-filter", "walk.py", series, *Q, "--quantiles", "0.1,0.9", "-o", "f.nc")
    expected = ssm.kalman_filter(
        load_model("walk.py"), read_csv(series), {"q": 0.3}, quantiles=(0.1, 0.9)
    )
    (one,) = found["experiments"]
    assert one["states"]["x"]["mean"] == list(expected["x"].values[0])
    assert one["states"]["x"]["sd"] == list(expected["x_sd"].values[0])
    assert one["predicted"]["y"]["mean"] == list(expected["y_predicted"].values[0])
    assert one["predicted"]["y"]["sd"] == list(expected["y_predicted_sd"].values[0])
    assert set(one["predicted"]["y"]) == {"mean", "sd", "q10", "q90"}
    quantiles = expected["y_predicted_quantile"].values[0]
    assert one["predicted"]["y"]["q10"] == list(quantiles[:, 0])
    assert one["predicted"]["y"]["q90"] == list(quantiles[:, 1])
    assert one["time"] == list(range(1, 21))
    total = float(expected["log_likelihood_increment"].sum())
    assert found["log_likelihood"] == pytest.approx([total])
    with xr.open_dataset("f.nc", engine="h5netcdf") as written:
        np.testing.assert_array_equal(written["x_quantile"], expected["x_quantile"])


def test_particle_filter_of_several_files_and_repeats(series):
    words = ("--particles", 40, "--repeats", 2, "--seed", 5, "--proposal", "bootstrap")
    found = told("particle-filter", "walk.py", series, series, *Q, *words, "-o", "f.nc")
    data = [read_csv(series)] * 2
    expected = ssm.particle_filter(
        load_model("walk.py"), data, {"q": 0.3}, particles=40, repeats=2, seed=5,
        proposal="bootstrap",
    )  # fmt: skip
    totals = [e["log_likelihood_increment"].sum("time").values for e in expected]
    assert found["log_likelihood"] == pytest.approx(list(totals[0] + totals[1]))
    assert found["files"] == ["f_1.nc", "f_2.nc"]
    for one, e in zip(found["experiments"], expected, strict=True):
        assert one["states"]["x"]["mean"] == list(e["x"].values[0])
        assert one["ess"] == list(e["ess"].values[0])
    run("particle-filter", "walk.py", series, *Q, "--seed", 1, "-o", "f.csv")
    table = pd.read_csv("f.csv", index_col="time")
    assert list(table.columns[:2]) == ["x mean", "x sd"]
    assert len(table) == 20


def test_forward_filter(folder):
    write("weather.py", WEATHER)
    pd.DataFrame({"y": [0.1, 2.2, 1.9, np.nan, -0.5]}).to_csv("w.csv", index=False)
    found = told("forward-filter", "weather.py", "w.csv", "-p", "stay=0.8", "--seed", 1)
    expected = ssm.forward_filter(load_model("weather.py"), read_csv(Path("w.csv")),
                                  {"stay": 0.8}, seed=1)  # fmt: skip
    law = found["experiments"][0]["probabilities"]["wet"]
    assert law["values"] == [0, 1]
    np.testing.assert_array_equal(law["probability"], expected["wet_probability"].values[0])
    assert found["files"] == ["w_filter.nc"]
    words = ("weather.py", "w.csv", "-p", "stay=0.8", "-o", "s.nc")
    for method in ("forward-backward", "forward_backward", "FORWARD_BACKWARD"):
        smoothed = told("smooth", *words, "--method", method)
        assert smoothed["method"] == "ForwardBackward"
    exact = ssm.smooth(load_model("weather.py"), read_csv(Path("w.csv")), {"stay": 0.8})
    (one,) = smoothed["experiments"]
    np.testing.assert_allclose(one["states"]["wet"]["mean"], exact["wet"].values[0])


def test_smooth(series):
    found = told("smooth", "walk.py", series, *Q, "-o", "s.nc")
    expected = ssm.smooth(load_model("walk.py"), read_csv(series), {"q": 0.3})
    (one,) = found["experiments"]
    assert one["states"]["x"]["mean"] == list(expected["x"].values[0])
    assert one["log_likelihood"] == expected.attrs["log_likelihood"]
    assert (found["method"], found["trajectories"]) == ("KalmanSmoother", None)
    words = ("--trajectories", 30, "--seed", 2, "-o", "t.nc")
    drawn = told("smooth", "walk.py", series, *Q, *words)
    expected = ssm.smooth(load_model("walk.py"), read_csv(series), {"q": 0.3}, trajectories=30,
                          seed=2)  # fmt: skip
    np.testing.assert_allclose(
        drawn["experiments"][0]["states"]["x"]["sd"], expected["x"].std("trajectory", ddof=1)
    )
    assert drawn["trajectories"] == 30


def test_score(series):
    found = told("score", "walk.py", series, *Q)
    expected = ssm.score(load_model("walk.py"), read_csv(series), {"q": 0.3})
    assert found["gradient"] == expected.gradient
    assert found["information"] == {"labels": ["q"], "values": expected.information.values.tolist()}
    assert found["log_likelihood"] == expected.log_likelihood
    assert f"{expected.gradient['q']:.6g}" in run("score", "walk.py", series, *Q).stdout


# -- parameters
def test_sample_and_summary(series):
    found = told("sample", "walk.py", series, *QUICK, "-o", "post.nc")
    idata = ssm.sample(load_model("walk.py"), read_csv(series), draws=30, warmup=10, chains=2,
                       seed=1, progress=False)  # fmt: skip
    table = ssm.summary(idata)
    for name, value in table.loc["q"].items():
        assert found["parameters"]["q"][name] == pytest.approx(value, nan_ok=True)
    assert (found["method"], found["chains"], found["draws"]) == ("Gibbs", 2, 30)
    assert (found["seed"], found["interrupted"], found["files"]) == (1, False, ["post.nc"])
    assert told("summary", "post.nc")["parameters"] == found["parameters"]
    run("summary", "post.nc", "-o", "table.csv")
    read = pd.read_csv("table.csv", index_col="parameter")
    assert read.loc["q", "mean"] == pytest.approx(table.loc["q", "mean"])
    states = told("summary", "post.nc", "--var-names", "x,q")["parameters"]
    assert len(states) == 21
    assert states["q"] == found["parameters"]["q"]


def test_maximize(series):
    found = told("maximize", "walk.py", series, "--seed", 1)
    expected = ssm.maximize(load_model("walk.py"), read_csv(series), seed=1, progress=False)
    assert found["parameters"] == expected.parameters
    assert found["standard_errors"] == expected.standard_errors
    assert found["covariance"]["values"] == expected.covariance.values.tolist()
    assert found["log_likelihood"] == expected.log_likelihood
    assert (found["converged"], found["seed"]) == (True, 1)


def test_evidence(series):
    words = ("--draws", 60, "--warmup", 30, "--chains", 2, "--seed", 4)
    found = told("evidence", "walk.py", series, *words)
    expected = ssm.evidence(load_model("walk.py"), read_csv(series), draws=60, warmup=30,
                            chains=2, seed=4, progress=False)  # fmt: skip
    assert found["log_evidence"] == expected.log_evidence
    assert found["standard_error"] == expected.standard_error
    assert set(found["report"]) == set(expected.report)
    shown = run("evidence", "walk.py", series, *words).stdout
    assert f"log evidence {expected.log_evidence:.4f}" in shown


# -- prediction
@pytest.fixture
def sampled(posterior, monkeypatch):
    monkeypatch.chdir(posterior)
    return arviz().from_netcdf("post.nc")


def test_predict_from_the_posterior(sampled, tmp_path):
    file = tmp_path / "pred.nc"
    words = ("--posterior", "post.nc", "--seed", 3, "-o", file)
    found = told("predict", "walk.py", "sim.csv", *words)
    expected = ssm.predict(load_model("walk.py"), sampled, read_csv(Path("sim.csv")), seed=3)
    y = expected["posterior_predictive"]["y"].values.reshape(80, 12)
    (one,) = found["experiments"]
    np.testing.assert_allclose(one["observations"]["y"]["mean"], y.mean(axis=0))
    np.testing.assert_allclose(one["observations"]["y"]["sd"], y.std(axis=0, ddof=1))
    np.testing.assert_allclose(one["observations"]["y"]["q95"], np.quantile(y, 0.95, axis=0))
    assert (found["group"], found["draws"], found["conditional"]) == (
        "posterior_predictive", 80, True,
    )  # fmt: skip
    written = arviz().from_netcdf(str(file))["posterior_predictive"]["y"]
    np.testing.assert_array_equal(written.values.reshape(80, 12), y)
    free = told("predict", "walk.py", "sim.csv", *words, "--free-run")
    assert free["conditional"] is False
    assert free["experiments"] != found["experiments"]


def test_predict_from_the_prior(folder):
    words = ("--steps", 4, "--draws", 50, "--seed", 1, "-o", "prior.nc")
    found = told("predict", "walk.py", *words)
    expected = ssm.predict(load_model("walk.py"), steps=4, draws=50, seed=1)
    y = expected["prior_predictive"]["y"].values[0]
    np.testing.assert_allclose(found["experiments"][0]["observations"]["y"]["q05"],
                               np.quantile(y, 0.05, axis=0))  # fmt: skip
    assert (found["group"], found["draws"], found["conditional"]) == ("prior_predictive", 50, None)


def test_forecast(sampled, tmp_path):
    words = ("--steps", 3, "--seed", 7)
    found = told("forecast", "walk.py", "post.nc", *words, "-o", tmp_path / "f.nc")
    expected = ssm.forecast(load_model("walk.py"), sampled, 3, seed=7)
    np.testing.assert_allclose(found["variables"]["y"]["q50"], np.median(expected["y"], axis=0))
    np.testing.assert_allclose(found["variables"]["x"]["mean"], expected["x"].mean("draw"))
    assert (found["time"], found["after"], found["draws"]) == ([13, 14, 15], 12, 80)
    run("forecast", "walk.py", "post.nc", *words, "-o", tmp_path / "f.csv")
    table = pd.read_csv(tmp_path / "f.csv")
    assert len(table) == 240
    np.testing.assert_allclose(table["y"], expected["y"].values.ravel())


def test_leave_future_out(series):
    words = ("--first", 15, "--draws", 40, "--warmup", 20, "--chains", 2, "--seed", 2)
    found = told("leave-future-out", "walk.py", series, *words, "-o", "scores.csv")
    expected = ssm.leave_future_out(load_model("walk.py"), read_csv(series), first=15, draws=40,
                                    warmup=20, chains=2, seed=2, progress=False)  # fmt: skip
    assert found["elpd"] == expected.attrs["elpd"]
    assert found["standard_error"] == expected.attrs["standard_error"]
    assert [row["elpd"] for row in found["rows"]] == list(expected["elpd"].values)
    assert [row["time"] for row in found["rows"]] == list(range(15, 21))
    assert found["rows"][0]["pareto_shape"] is None  # -inf, of draws that are new
    assert pd.read_csv("scores.csv")["elpd"].sum() == pytest.approx(found["elpd"])


# -- the others
def test_diagnose(series, monkeypatch):
    report = dataclasses.replace(effect_found(), missing=None)
    monkeypatch.setattr(ssm, "diagnose", lambda *a, **k: report, raising=False)
    monkeypatch.setattr(type(report), "save", lambda self, folder: folder / "index.html")
    found = told("diagnose", "walk.py", series, "-o", "out")
    assert (found["verdict"], found["chosen"]) == (report.verdict, report.chosen)
    for name in ("where", "causes", "classes", "closed"):
        table = getattr(report, name)
        assert len(found[name]) == len(table) > 0
        assert list(found[name][0]) == list(table.columns)
    assert found["causes"][0]["effect"] == report.causes["effect"].iloc[0]
    assert found["missing"] is None
    assert found["files"] == ["out/index.html"]


def test_new(folder):
    found = told("new", "flow")
    assert found["files"] == ["flow.py", "flow.csv"]
    assert found["rows"] == len(pd.read_csv("flow.csv")) == 200
    assert found["columns"] == ["time", "x", "y"]


@pytest.mark.slow
def test_demo(folder):
    found = told("demo", "--draws", 50, "-o", "v.nc")
    assert set(found["methods"]) == {"PGAS", "PMMH"}
    assert found["exact"]["phi"]["mean"] == pytest.approx(0.950254)
    assert found["files"] == ["v.nc", "v_pmmh.nc"]


def test_plain_values():
    stamp = pd.Timestamp("2024-02-03 04:05")
    value = {
        "a": np.float32(0.5), "b": np.array([1.0, np.nan, -np.inf]), 3: (np.int64(2), np.True_),
        "t": np.array(["2024-01-01"], dtype="datetime64[D]"), "s": stamp, "p": Path("x/y"),
        "n": None, "z": np.array(2.5), "m": np.array([["a"], ["b"]]),
    }  # fmt: skip
    assert plain(value) == {
        "a": 0.5, "b": [1.0, None, None], "3": [2, True], "t": ["2024-01-01"],
        "s": "2024-02-03T04:05:00", "p": "x/y", "n": None, "z": 2.5, "m": [["a"], ["b"]],
    }  # fmt: skip


def test_predict_of_several_experiments_and_of_one_draw(series, recwarn):
    """Channels had the experiment's number behind their names, as components of a vector have."""
    run("simulate", "walk.py", "--steps", 12, *Q, "--seed", 2, "-o", "other.csv")
    run("sample", "walk.py", series, "other.csv", *QUICK, "--chains", 1, "-o", "two.nc")
    words = ("walk.py", series, "other.csv", "--posterior", "two.nc", "--seed", 1, "-o", "p.nc")
    found = told("predict", *words)
    assert [list(one["observations"]) for one in found["experiments"]] == [["y"], ["y"]]
    assert [len(one["observations"]["y"]["mean"]) for one in found["experiments"]] == [20, 12]
    one = told("predict", "walk.py", "--steps", 4, "--draws", 1, "--seed", 1, "-o", "one.nc")
    assert one["experiments"][0]["observations"]["y"]["sd"] == [None] * 4
    assert not [w for w in recwarn if "Degrees of freedom" in str(w.message)]


def test_a_summary_of_one_chain_is_silent(series, caplog):
    run("sample", "walk.py", series, *QUICK, "--chains", 1, "-o", "alone.nc")
    with caplog.at_level("WARNING"):
        told("summary", "alone.nc")
    assert not caplog.records
