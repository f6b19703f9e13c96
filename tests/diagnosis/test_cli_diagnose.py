"""`ssmppl diagnose`: what it hands on, prints and writes. The diagnosis itself is made up here."""

import dataclasses
import json

import click.testing
import numpy as np
import pandas as pd
import pytest

import ssmppl as ssm
from ssmppl import cli
from ssmppl.diagnosis.report.findings import tabulate
from ssmppl.errors import DataError
from tests.cli.shared import SEPARATE
from tests.diagnosis.made_up import effect_found, with_experiment

MODEL = """
import ssmppl as ssm

walk = ssm.Model("walk")


@walk.prior
def prior():
    return {"q": ssm.InverseGamma(3, scale=1), "r": ssm.HalfNormal(sd=1)}


@walk.initial
def initial():
    return {"x": ssm.Normal(0, sd=1)}


@walk.transition
def transition(x, q):
    return {"x": ssm.Normal(x, variance=q)}


@walk.observation
def observation(x, r):
    return {"y": ssm.Normal(x, sd=r)}
"""


def light(**changes):
    """A report that is quickly drawn."""
    tables = {"residual_map": tabulate("residual_map"), "free_run": tabulate("free_run")}
    return dataclasses.replace(effect_found(), missing=None, **tables, **changes)


@pytest.fixture
def calls(tmp_path, monkeypatch):
    """Arguments of each call of `diagnose`, in a working directory with a model and data."""
    found = []

    def diagnose(model, data, effects=None, **keywords):
        found.append((model, data, effects, keywords))
        return light()

    monkeypatch.setattr(ssm, "diagnose", diagnose, raising=False)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "walk.py").write_text(MODEL, encoding="utf-8")
    for name in ("series.csv", "other.csv"):
        pd.DataFrame({"y": np.arange(4.0)}).to_csv(tmp_path / name, index=False)
    return found


def run(*args, code=0):
    result = click.testing.CliRunner(**SEPARATE).invoke(cli.main, ["diagnose", *map(str, args)])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == code, result.output
    return result


def test_everything_given_is_handed_on(calls, tmp_path):
    run("walk.py", "series.csv", "-o", "out", "--fast", "--fixed", "q=0.5", "r=1", "--effects",
        "coulomb friction, quadratic drag", "--particles", 500, "--alpha", 0.01, "--horizon",
        40, "--seed", 7)  # fmt: skip
    ((model, data, effects, keywords),) = calls
    assert model.name == "walk"
    assert list(data["y"]) == [0, 1, 2, 3]
    assert effects == ["coulomb friction", "quadratic drag"]
    checkpoint = keywords.pop("checkpoint")
    assert checkpoint.resolve().parent == tmp_path / "out"
    assert keywords == {"mode": "fast", "alpha": 0.01, "fixed": {"q": 0.5, "r": 1.0},
                        "particles": 500, "progress": True, "seed": 7, "debug": False,
                        "horizon": 40, "executor": None}  # fmt: skip


def test_the_words_are_printed_and_the_folder_is_written(calls, tmp_path):
    done = run("walk.py", "series.csv")
    folder = tmp_path / "series_report"
    assert done.stdout.startswith(str(light()))
    assert done.stdout.rstrip().endswith(f"Wrote {folder.name}/index.html")
    assert {"index.html", "causes.csv", "ranked_effects.png", "augmented_model.py",
            "report.txt"} <= {p.name for p in folder.iterdir()}  # fmt: skip
    ((_, _, effects, keywords),) = calls
    assert effects is None
    assert (keywords["mode"], keywords["alpha"], keywords["fixed"]) == ("full", 0.05, None)


def test_an_experiment_is_written_and_told_to_programs(calls, monkeypatch, tmp_path):
    report = dataclasses.replace(
        with_experiment(), residual_map=tabulate("residual_map"), free_run=tabulate("free_run")
    )
    monkeypatch.setattr(ssm, "diagnose", lambda *a, **k: report, raising=False)
    found = json.loads(run("walk.py", "series.csv", "--json").stdout)
    assert (tmp_path / "series_report" / "experiment.csv").exists()
    assert [row["u"] for row in found["experiment"]] == list(report.experiment["u"])
    assert found["separation"] == {
        "effects": [{"effect": "quadratic drag", "equation": "v"},
                    {"effect": "state-dependent damping", "equation": "v"}],
        "recorded": 0.8, "needed": report.separation.needed, "runs": 1, "rows": 400,
        "best": {"signal": "a triangle of u between −1 and 1 with a period of 40 rows",
                 "input": "u", "nats": 7.2},
        "times_as_many": None,
    }  # fmt: skip
    assert found["signals"][1]["nats"] == 7.2
    monkeypatch.setattr(ssm, "diagnose", lambda *a, **k: light(), raising=False)
    found = json.loads(run("walk.py", "series.csv", "--json").stdout)
    assert {found[name] for name in ("experiment", "separation", "signals")} == {None}


def test_several_files_are_several_experiments(calls):
    run("walk.py", "series.csv", "other.csv")
    assert [len(table) for table in calls[0][1]] == [4, 4]


def test_an_interrupt_says_that_the_report_is_not_whole(calls, monkeypatch, tmp_path):
    monkeypatch.setattr(ssm, "diagnose", lambda *a, **k: light(interrupted=True), raising=False)
    done = run("walk.py", "series.csv", code=130)
    assert "the stages done so far tell. series_report/stages holds them" in done.stderr
    assert "resumes from the completed stages" in (tmp_path / "series_report/report.txt").read_text(
        encoding="utf-8"
    )


@pytest.mark.parametrize(
    ("args", "code", "said"),
    [
        (["walk.py"], 2, "DATA"),
        (["walk.py", "none.csv"], 2, "none.csv"),
        (["nowhere.py", "series.csv"], 1, "nowhere.py does not exist"),
        (["walk.py", "series.csv", "--effects", " ,"], 1, "names no effect"),
        (["walk.py", "series.csv", "--alpha", "1.5"], 2, "alpha"),
        (["walk.py", "series.csv", "--fixed", "q"], 1, "name=value"),
        (["walk.py", "series.csv", "-o", "series.csv"], 2, "series.csv"),
        (["walk.py", "series.csv", "-o", "series.csv/report"], 1, "cannot be made"),
    ],
)
def test_wrong_words_are_refused_before_anything_runs(calls, args, code, said):
    done = run(*args, code=code)
    assert said in done.stderr
    assert calls == []
    assert "Traceback" not in done.stdout + done.stderr


def test_a_fault_of_the_data_is_a_message(calls, monkeypatch):
    def diagnose(*args, **keywords):
        raise DataError("row 3 of y is infinite", fix="write a number")

    monkeypatch.setattr(ssm, "diagnose", diagnose, raising=False)
    assert "Fix: write a number" in run("walk.py", "series.csv", code=1).stderr


def test_help_teaches_with_an_example():
    text = run("--help").stdout
    assert "ssmppl diagnose model.py data.csv -o report/" in text
    assert max(map(len, text.splitlines())) <= 100
