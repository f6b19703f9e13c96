"""Every example as a user meets it: its files are read, explained, and give a likelihood."""

import ast
from pathlib import Path

import numpy as np
import pytest

import ssmppl as ssm
from examples.check import rows
from examples.check.__main__ import main as check_main
from examples.check.by_grid import point_mass
from ssmppl.modelfile import load_model, read_csv

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
NAMES = sorted(path.parent.name for path in EXAMPLES.glob("*/model.py"))
SIMULATED = sorted(path.parent.name for path in EXAMPLES.glob("*/make_data.py"))


def example(name):
    folder = EXAMPLES / name
    return load_model(str(folder / "model.py")), [read_csv(p) for p in sorted(folder.glob("*.csv"))]


@pytest.mark.parametrize("name", NAMES)
def test_model_and_data_belong_together(name):
    model, data = example(name)
    text = str(ssm.explain(model, data))
    assert "Default methods" in text
    ast.parse((EXAMPLES / name / "run.py").read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", NAMES)
def test_there_is_a_page_a_line_and_a_check(name):
    docs = EXAMPLES.parent / "docs"
    page = "tutorials" if name == "ice_varves" else "gallery"
    assert (docs / page / f"{name}.md").exists()
    assert f"| `{name}` |" in (EXAMPLES / "README.md").read_text(encoding="utf-8")
    assert name in {one.example for one in rows.CHECKS}


@pytest.mark.exhaustive  # the examples' scripts and pages draw longer chains in every run
@pytest.mark.parametrize("name", NAMES)
def test_a_short_chain(name):
    model, data = example(name)
    idata = ssm.sample(
        model, data, draws=10, warmup=10, chains=2, states=len(data) == 1, seed=1, progress=False
    )
    assert idata["posterior"].sizes["draw"] == 10
    assert np.isfinite(ssm.summary(idata)["mean"]).all()


def test_the_grid_filter_agrees_with_quadrature_by_hand():
    """Two rows, the second missing in part: p(y_1) of a Normal seen through a Normal."""
    x = np.linspace(-12.0, 12.0, 401)

    def normal(value, mean, variance):
        return np.exp(-0.5 * (value - mean) ** 2 / variance) / np.sqrt(2 * np.pi * variance)

    log_g = np.stack([np.log(normal(0.7, x, 0.5)), np.zeros_like(x), np.log(normal(-0.2, x, 0.5))])
    found = point_mass(x, normal(x, 0, 2.0), lambda t: normal(x[:, None], 0.8 * x, 0.3), log_g)
    # y_1 and y_3 jointly: variances 2.5 and v + 0.5, covariance 0.64 * 2
    v = 0.64 * (0.64 * 2.0 + 0.3) + 0.3
    covariance = np.array([[2.5, 1.28], [1.28, v + 0.5]])
    y = np.array([0.7, -0.2])
    exact = -0.5 * y @ np.linalg.solve(covariance, y) - 0.5 * np.log(np.linalg.det(covariance))
    assert found == pytest.approx(exact - np.log(2 * np.pi), abs=1e-10)


def test_the_table_tells_a_wrong_row_from_a_right_one():
    def row(ours, theirs):
        return rows.Row("made up", "a number", "here", "there", ours, theirs)

    exact, close, far = rows.Estimate(-100.0), rows.Estimate(-100.2, 0.1), rows.Estimate(-99.5, 0.1)
    assert row(exact, rows.Estimate(-100.0 + 1e-10)).holds
    assert not row(exact, rows.Estimate(-100.0 + 1e-4)).holds
    assert row(close, exact).z == pytest.approx(-2.0)
    assert row(close, exact).holds
    assert not row(far, exact).holds


def test_mean_likelihood_has_the_error_of_a_mean():
    draws = np.random.default_rng(1).normal(-50.0, 0.3, size=4000)
    found = rows.mean_likelihood(draws)
    assert abs(found.value - (-50.0 + 0.045)) < 4 * found.error
    assert found.error == pytest.approx(np.sqrt(np.expm1(0.09)) / np.sqrt(4000), rel=0.1)


def test_what_is_not_installed_is_named_and_skipped(monkeypatch, capsys):
    monkeypatch.setattr("importlib.util.find_spec", lambda name, package=None: None)
    monkeypatch.setattr("sys.argv", ["check", "us_growth"])
    assert check_main() == 1
    text = capsys.readouterr().err
    assert "us_growth: skipped, not installed: hmmlearn" in text
    assert "Nothing was checked." in text
