"""Measured data: the loaders on made-up files of the same form, the linear models, and what is said
where the data are absent."""

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

import ssmppl as ssm
from bench.gap.real import run
from ssmppl.language.tracing import trace
from ssmppl.modelfile import load_model

DATA = Path(__file__).parents[2] / ".." / "shared" / "data"
SILVERBOX = {"k": 0.46, "c": 0.067, "b": 0.37, "b_beside": 0.047, "offset": -0.002, "q": 1e-3,
             "r": 1e-4}  # fmt: skip


def model_of(name):
    return load_model(str(run.HERE / f"{name}.py"))


def test_the_models_are_linear():
    rng = np.random.default_rng(1)
    u = rng.standard_normal(60)
    drives = {"gain": 2.0, "lag": 0.2, "k": 0.1, "c": 0.1, "q": 0.1, "r": 0.1}
    for name, theta, data in (
        ("silverbox", SILVERBOX, {"u": u, "beside": np.roll(u, 1)}),
        ("coupled_drives", drives, {"u": u}),
    ):
        model = model_of(name)
        assert set(trace(model).parameters) == set(theta)
        y = ssm.simulate(model, theta, steps=60, inputs=data, seed=1)["y"].values[0]
        found = ssm.kalman_filter(model, {"y": y, **data}, theta)  # refuses what is not linear
        assert np.all(np.isfinite(found["log_likelihood_increment"]))


def test_the_voltages_beside_a_row(tmp_path):
    (tmp_path / "silverbox").mkdir()
    rows = "\n".join(f"{v},{10 * v}," for v in (1.0, 2.0, 4.0, 7.0))
    (tmp_path / "silverbox" / "SNLS80mV.csv").write_text(f'"V1","V2",\n{rows}\n')
    found = run.silverbox(tmp_path)
    assert found["u"].tolist() == [1.0, 2.0, 4.0, 7.0]
    assert found["y"].tolist() == [10.0, 20.0, 40.0, 70.0]
    assert found["beside"].tolist() == [2.0, 5.0, 9.0, 4.0]  # nothing before the first, the last


def test_records_of_the_drives(tmp_path):
    (tmp_path / "coupled_drives").mkdir()
    values = {f"{n}{i}": np.full((5, 1), 10.0 * i + (n == "z")) for n in "uz" for i in (1, 2, 3)}
    savemat(tmp_path / "coupled_drives" / "drive.mat", values)
    assert run.drives(tmp_path, 2).to_dict("list") == {"y": [21.0] * 5, "u": [20.0] * 5}


def test_a_free_run_is_the_difference_equation():
    """Against the recursion by hand, which starts at rest."""
    u = np.sin(0.7 * np.arange(300.0))
    beside = np.convolve(u, [1, 0, 1], "same")
    frame = run.pd.DataFrame({"y": np.zeros(300), "u": u, "beside": beside})
    found = run.run_free(model_of("silverbox"), SILVERBOX, frame)
    x, p = np.zeros(300), SILVERBOX
    for t in range(1, 300):
        before = x[t - 2] if t > 1 else 0.0
        speed = x[t - 1] - before
        x[t] = (x[t - 1] + speed - p["k"] * x[t - 1] - p["c"] * speed + p["b"] * u[t - 1]
                + p["b_beside"] * beside[t - 1] + p["offset"])  # fmt: skip
    np.testing.assert_allclose(found[200:], x[200:], atol=1e-3 * np.ptp(x))


def test_absent_data_are_said(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["run", "--data", str(tmp_path / "nowhere")])
    run.main()
    assert "skipped" in capsys.readouterr().out


def test_the_measured_data_are_what_the_models_are_for():
    if not DATA.exists():
        pytest.skip(f"the measured data are not at {DATA}")
    silverbox = run.silverbox(DATA)
    assert len(silverbox) == 131_072
    lagged = silverbox["u"].to_numpy()[run.GROWING]
    fifths = [part.std() for part in np.array_split(lagged, 5)]
    assert fifths == sorted(fifths)  # of growing amplitude
    assert len(run.drives(DATA, 1)) == 500
    assert set(np.round(run.drives(DATA, 1)["u"].abs(), 6)) == {1.0}
