"""`ssmppl new`: the files that it writes run as they stand, and nothing is written over."""

import re
import shlex
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import ssmppl as ssm
from ssmppl.cli.templates import TEMPLATES
from ssmppl.modelfile import load_model
from tests.cli.shared import answer, fails, run

KINDS = list(TEMPLATES)


@pytest.fixture
def empty(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("kind", KINDS)
def test_the_files_run_as_they_stand(empty, kind):
    out = run("new", "flow", "--template", kind).stdout
    assert sorted(p.name for p in empty.iterdir()) == ["flow.csv", "flow.py"]
    assert "ssmppl sample flow.py flow.csv" in out
    assert load_model("flow.py").name == "flow"
    assert "200 rows, none missing" in run("explain", "flow.py", "flow.csv").stdout
    text = Path("flow.py").read_text(encoding="utf-8")
    assert not re.search("NAME|SIMULATE", text)
    assert max(map(len, text.splitlines())) <= 110


@pytest.mark.parametrize("kind", KINDS)
def test_the_data_are_those_of_the_command_in_the_file(empty, kind):
    run("new", "flow", "--template", kind)
    (line,) = re.findall(r"    ssmppl (simulate .*)", Path("flow.py").read_text(encoding="utf-8"))
    run(*shlex.split(line))
    assert Path("again.csv").read_bytes() == Path("flow.csv").read_bytes()


def test_the_parameters_of_the_data_are_found_again(empty):
    run("new", "flow")
    found = answer("maximize", "flow.py", "flow.csv", "--seed", 1, "--no-progress")
    for name, true in TEMPLATES["scalar"].parameters.items():
        assert abs(found["parameters"][name] - true) < 4 * found["standard_errors"][name], name
    sampled = answer("sample", "flow.py", "flow.csv", "--draws", 50, "--warmup", 50, "--chains", 2,
                     "--seed", 1)  # fmt: skip
    assert set(sampled["parameters"]) == {"a", "q", "r"}


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_every_template_is_sampled(empty, kind):
    run("new", "flow", "--template", kind)
    found = answer("sample", "flow.py", "flow.csv", "--seed", 1)
    for name, true in TEMPLATES[kind].parameters.items():
        row = found["parameters"][name]
        assert row["r_hat"] < 1.03
        assert abs(row["mean"] - true) < 4 * row["sd"]


def test_the_template_with_inputs_has_them_in_its_data(empty):
    run("new", "flow", "--template", "inputs")
    table = pd.read_csv("flow.csv")
    assert list(table.columns) == ["time", "x", "y", "u"]
    expected = ssm.simulate(load_model("flow.py"), {"loss": 0.1, "gain": 1, "q": 0.02, "r": 0.2},
                            inputs={"u": table["u"]}, seed=1)  # fmt: skip
    np.testing.assert_allclose(table["y"], expected["y"].values[0])


@pytest.mark.parametrize("there", ["flow.py", "flow.csv"])
def test_nothing_is_written_over(empty, there):
    Path(there).write_text("mine", encoding="utf-8")
    said = fails("new", "flow")
    assert f"{there} is there already" in said
    assert Path(there).read_text(encoding="utf-8") == "mine"
    assert len(list(empty.iterdir())) == 1


@pytest.mark.parametrize("there", ["flow.py", "flow.csv"])
def test_a_file_that_comes_in_between_is_not_written_over(empty, monkeypatch, there):
    def slowly(*args, simulate=ssm.simulate, **kwargs):
        Path(there).write_text("mine", encoding="utf-8")
        return simulate(*args, **kwargs)

    monkeypatch.setattr(ssm, "simulate", slowly)
    assert f"{there} cannot be written" in fails("new", "flow")
    assert Path(there).read_text(encoding="utf-8") == "mine"
    assert [p.name for p in empty.iterdir()] == [there]  # both, or none


@pytest.mark.parametrize("name", ["a b", "", "x'y", 'x"', ".py", "a\nb", ".."])
def test_names_that_are_none(empty, name):
    assert "no good name" in fails("new", name)
    assert list(empty.iterdir()) == []


def test_a_name_may_have_a_folder_and_a_suffix(empty):
    assert "the folder models does not exist" in fails("new", "models/flow")
    Path("models").mkdir()
    found = answer("new", "models/my-flow.py")
    assert found["files"] == ["models/my-flow.py", "models/my-flow.csv"]
    assert load_model("models/my-flow.py").name == "my-flow"
