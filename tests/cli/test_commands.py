"""The command line: what it writes, what it says, and how it fails."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr

import ssmppl as ssm
from ssmppl.errors import ArgumentError, DataError, SamplingError
from ssmppl.modelfile import load_model, parse_assignments, read_csv
from ssmppl.results import arviz
from tests.cli.shared import PLANE, QUICK, WALK, fails, interrupted_after, run, write

ROOT = Path(__file__).parent.parent.parent


# -- help
def test_help_lists_the_commands_in_the_order_of_use():
    text = run("--help").stdout
    places = [text.index(f"\n  {name} ") for name in ("demo", "explain", "simulate", "sample")]
    assert places == sorted(places)


def test_help_imports_nothing_slow():
    code = (
        "import sys; from ssmppl.cli import main\n"
        "try: main(['--help'])\n"
        "except SystemExit: pass\n"
        "slow = 'arviz', 'pandas', 'xarray', 'matplotlib', 'h5py', 'scipy.stats'\n"
        "slow = (*slow, 'ssmppl.diagnosis')\n"
        "print(*(m for m in slow if m in sys.modules), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.stderr.split() == []


# -- explain
def test_explain_prints_the_plan(folder):
    assert run("explain", "walk.py").stdout == f"{ssm.explain(load_model('walk.py'))}\n"
    assert "inverse Gamma" in run("explain", "walk.py:walk").stdout


def test_explain_takes_account_of_the_data(folder):
    Path("data.csv").write_text("time,y\n1,0.5\n2,\n3,1.0\n", encoding="utf-8")
    assert "3 rows, 1 missing" in run("explain", "walk.py", "data.csv").stdout


def test_explain_prints_the_generated_program(folder):
    source = run("explain", "walk.py", "--source").stdout
    assert source.rstrip("\n") == ssm.compile(load_model("walk.py")).source().rstrip("\n")


# -- simulate
def test_simulate_writes_what_sample_reads(folder):
    run("simulate", "walk.py", "--steps", 30, "-p", "q=0.1", "--seed", 1, "-o", "sim.csv")
    table = pd.read_csv("sim.csv")
    expected = ssm.simulate(load_model("walk.py"), {"q": 0.1}, steps=30, seed=1)
    assert list(table.columns) == ["time", "x", "y"]
    np.testing.assert_allclose(table["y"], expected["y"][0])
    assert "30 rows" in run("explain", "walk.py", "sim.csv").stdout


def test_simulate_vectors_inputs_and_several_draws(folder):
    pd.DataFrame({"u": np.arange(5.0)}).to_csv("u.csv", index=False)
    output = run(
        "simulate", "plane.py", "--inputs", "u.csv", "--draws", 3, "--seed", 1, "-o", "sim.csv"
    ).stdout
    table = pd.read_csv("sim.csv")
    columns = ["draw", "time", "x_0", "x_1", "y_0", "y_1", "beta_0", "beta_1", "u"]
    assert list(table.columns) == columns
    assert "15 rows" in output
    assert table.groupby("draw")["beta_0"].nunique().tolist() == [1, 1, 1]
    assert table["u"].tolist() == [0.0, 1.0, 2.0, 3.0, 4.0] * 3
    one = table[table["draw"] == 2].drop(columns="draw")
    one.to_csv("one.csv", index=False)
    assert "5 rows" in run("explain", "plane.py", "one.csv").stdout
    assert "numbered by the column 'draw'" in run("explain", "plane.py", "sim.csv", code=1).stderr


def test_simulate_takes_values_one_by_one_or_in_a_row(folder):
    pd.DataFrame({"u": np.arange(5.0)}).to_csv("u.csv", index=False)
    write("two.py", PLANE.replace("np.zeros(2), sd=1)}", 'np.zeros(2), sd=1), "s": ssm.Flat()}', 1))
    for i, words in enumerate((["-p", "beta=[1, 2]", "s=3"], ["-p", "beta=[1, 2]", "-p", "s=3"])):
        run("simulate", "two.py", "--inputs", "u.csv", *words, "--seed", 1, "-o", f"{i}.csv")
    assert Path("0.csv").read_text() == Path("1.csv").read_text()


def test_simulate_names_its_file_by_the_model(folder):
    run("simulate", "walk.py:walk", "--steps", 3, "--seed", 1)
    assert Path("walk_simulated.csv").exists()


# -- smooth
def test_smooth_writes_exact_moments_of_a_linear_model(folder):
    run("simulate", "walk.py", "--steps", 30, "-p", "q=0.1", "--seed", 1, "-o", "sim.csv")
    shown = run("smooth", "walk.py", "sim.csv", "-p", "q=0.1").stdout
    assert "KalmanSmoother (chosen automatically" in shown
    expected = ssm.smooth(load_model("walk.py"), read_csv("sim.csv"), {"q": 0.1})
    with xr.open_dataset("sim.nc", engine="h5netcdf") as written:
        np.testing.assert_array_equal(written["x"], expected["x"])
        assert f"{float(expected['x'][0, 0]):.4g}" in shown


def test_smooth_writes_trajectories_of_each_experiment(folder):
    run("simulate", "walk.py", "--steps", 6, "-p", "q=0.1", "--seed", 1, "-o", "a.csv")
    run("simulate", "walk.py", "--steps", 4, "-p", "q=0.1", "--seed", 2, "-o", "b.csv")
    words = ["-p", "q=0.1", "--method", "ffbsi", "--particles", 200, "--trajectories", 50]
    shown = run("smooth", "walk.py", "a.csv", "b.csv", *words, "--seed", 3, "-o", "s.nc").stdout
    assert shown.count("walk by FFBSi (chosen by the user)") == 2
    read = [read_csv("a.csv"), read_csv("b.csv")]
    expected = ssm.smooth(load_model("walk.py"), read, {"q": 0.1}, "ffbsi", particles=200,
                          trajectories=50, seed=3)  # fmt: skip
    for i, one in enumerate(expected, start=1):
        with xr.open_dataset(f"s_{i}.nc", engine="h5netcdf") as written:
            np.testing.assert_array_equal(written["x"], one["x"])
    fault = run("smooth", "walk.py", "a.csv", code=1).stderr
    assert "no value is given for parameter 'q'" in fault


# -- sample
@pytest.mark.parametrize(
    "method",
    [
        [],
        ["--method", "pgas", "--particles", 5],
        ["--method", "PMMH", "--particles", 20, "--no-states"],
        ["--method", "gibbs"],
        ["--method", "mh"],
    ],
)
def test_sample_writes_draws_and_prints_a_table(series, method):
    result = run("sample", "walk.py", series, *QUICK, *method, "-o", "post.nc")
    idata = arviz().from_netcdf("post.nc")
    posterior = idata["posterior"]
    assert posterior["q"].shape == (2, 30)
    assert ("x" in posterior) == ("--no-states" not in method)
    expected = {"pgas": "PGAS", "PMMH": "PMMH", "mh": "MetropolisHastings"}
    assert posterior.attrs["method"] == expected.get(method[1] if method else "", "Gibbs")
    table = result.stdout
    assert "r_hat" in table
    assert "\nq " in table
    assert "Wrote post.nc" in table
    assert "100%" not in table  # progress goes to stderr


def test_sample_holds_fixed_and_starts_near(series):
    result = run("sample", "walk.py", series, *QUICK, "--fixed", "q=0.3")
    assert "no parameters to summarise" in result.stdout
    assert "q" not in arviz().from_netcdf("sim.nc")["posterior"]  # named by the data
    run("sample", "walk.py", series, *QUICK, "--start", "q=0.2", "--thin", 2)


def test_several_files_are_several_experiments(series):
    run("simulate", "walk.py", "--steps", 12, "-p", "q=0.3", "--seed", 2, "-o", "other.csv")
    run("sample", "walk.py", series, "other.csv", *QUICK, "-o", "post.nc")
    posterior = arviz().from_netcdf("post.nc")["posterior"]
    assert posterior["x"].shape == (2, 30, 2, 20)
    assert posterior["rows"].values.tolist() == [20, 12]


@pytest.mark.parametrize("header", ["time,y", ",y", "Unnamed: 0,y"])
def test_labels_of_rows_become_the_time_of_the_result(folder, header):
    lines = [header, *(f"200{i}-01-01,{i}.5" for i in range(6)), "2006-01-01,"]
    Path("dated.csv").write_text("\n".join(lines), encoding="utf-8")
    run("sample", "walk.py", "dated.csv", *QUICK)
    idata = arviz().from_netcdf("dated.nc")
    years = pd.DatetimeIndex(idata["posterior"]["time"].values).year
    assert years.tolist() == list(range(2000, 2007))
    assert np.isnan(idata["observed_data"]["y"].values[-1])


def test_an_interrupt_keeps_what_was_drawn(series, monkeypatch):
    monkeypatch.setattr(ssm, "sample", interrupted_after(7))
    result = run("sample", "walk.py", series, *QUICK, "-o", "post.nc", code=130)
    assert "7 of 30 draws of each chain are kept" in result.stderr
    assert "r_hat" in result.stdout
    assert arviz().from_netcdf("post.nc")["posterior"].sizes["draw"] == 7


def test_an_interrupt_before_the_first_draw_writes_nothing(series, monkeypatch):
    def interrupted(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(ssm, "sample", interrupted)
    result = run("sample", "walk.py", series, "-o", "post.nc", code=130)
    assert "nothing written" in result.stderr
    assert not Path("post.nc").exists()


def test_a_checkpoint_is_gone_on_from(series, monkeypatch):
    plain = [*QUICK, "--seed", 3]
    run("sample", "walk.py", series, *plain, "-o", "whole.nc")
    run("sample", "walk.py", series, *plain, "--draws", 5, "--checkpoint", "k.npz", "-o", "a.nc")
    run("sample", "walk.py", series, *plain, "--checkpoint", "k.npz", "-o", "b.nc")
    whole, found = (arviz().from_netcdf(f)["posterior"] for f in ("whole.nc", "b.nc"))
    np.testing.assert_array_equal(found["x"], whole["x"])
    message = fails("sample", "walk.py", series, *QUICK, "--seed", 4, "--checkpoint", "k.npz")
    assert "seed=3 (now 4)" in message
    unsown = ["--draws", 6, "--warmup", 4, "--chains", 1, "--checkpoint", "u.npz"]
    for name in ("u.nc", "v.nc"):  # without a seed, that of the checkpoint
        run("sample", "walk.py", series, *unsown, "-o", name)
    first, again = (arviz().from_netcdf(f)["posterior"] for f in ("u.nc", "v.nc"))
    np.testing.assert_array_equal(first["x"], again["x"])

    def interrupted(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(ssm, "sample", interrupted)
    result = run("sample", "walk.py", series, "--checkpoint", "k.npz", code=130)
    assert "k.npz holds how far they came" in result.stderr


# -- faults
def test_a_file_with_several_models_has_them_listed(folder):
    write("two.py", WALK + '\n    other = ssm.Model("other")\n')
    message = fails("explain", "two.py")
    assert "two.py:walk" in message
    assert "two.py:other" in message
    assert "inverse Gamma" in run("explain", "two.py:walk").stdout
    assert "its models are: walk, other" in fails("explain", "two.py:wak")


def test_one_model_under_two_names_is_one(folder):
    write("twice.py", WALK + "\n    again = walk\n")
    run("explain", "twice.py")


@pytest.mark.parametrize(
    ("text", "line", "found"),
    [
        ("x = 1\ny = x / 0\n", "line 2", "ZeroDivisionError"),
        ("def f():\n    return missing\nf()\n", "line 2 in f()", "NameError"),
        ("import nowhere_at_all\n", "line 1", "ModuleNotFoundError"),
        ("x = (1\n", "line 1", "SyntaxError"),
        ("raise SystemExit\n", "line 1", "SystemExit"),
        ("import ssmppl as ssm\n\nssm.Normal(0, 1)\n", "line 3", "Fix:"),
        ("x = 1\n", "", "holds no model"),
    ],
)
def test_a_model_file_that_fails_shows_the_users_line(folder, text, line, found):
    write("broken.py", text)
    message = fails("explain", "broken.py")
    assert line in message
    assert found in message


def test_a_model_that_breaks_a_rule_shows_the_users_line(folder):
    write("bad.py", WALK.replace("ssm.Normal(x, variance=q)", "ssm.Normal(x, variance=p)")
          .replace("def transition(x, q)", "def transition(x, p)"))  # fmt: skip
    message = fails("explain", "bad.py")
    assert "bad.py" in message
    assert "'p'" in message
    assert "Fix:" in message


def test_missing_files(folder):
    assert "there: plane.py, walk.py" in fails("explain", "plan.py")
    assert "is a folder" in fails("explain", ".")
    assert "does not exist" in fails("sample", "walk.py", "none.csv", code=2)
    Path("d.csv").write_text("y\n1\n", encoding="utf-8")
    message = fails("sample", "walk.py", "d.csv", "-o", "no/where.nc", code=2)
    assert "the folder no does not exist" in message


def test_a_model_file_may_import_its_neighbours(folder):
    write("constants.py", "SD = 0.5\n")
    write("near.py", WALK.replace("import ssmppl", "from constants import SD\n    import ssmppl")
          .replace("sd=0.5", "sd=SD"))  # fmt: skip
    assert "sd=0.5" in run("explain", "near.py").stdout


@pytest.mark.parametrize(
    ("args", "code", "found"),
    [
        (["--particles", "5"], 2, "--particles needs --method"),
        (["--method", "nuts"], 2, "'pmmh', 'ismcmc', 'pgas'"),
        (["--fixed", "q"], 1, "not of the form name=value"),
        (["--fixed", "p=1"], 1, "'p'"),
        (["--fixed", "q=abc"], 1, "no number"),
        (["--draws", "0"], 1, "draws"),
    ],
)
def test_wrong_options(series, args, code, found):
    assert found in fails("sample", "walk.py", series, *args, code=code)


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".PQ"])
def test_a_suffix_that_draws_do_not_fit_is_refused_at_once(series, monkeypatch, suffix):
    """After all sampling nothing was written, and the draws were gone."""
    for verb in ("sample", "predict"):
        monkeypatch.setattr(ssm, verb, lambda *a, **k: pytest.fail("it was run"))
        said = fails(verb, "walk.py", series, "-o", f"post{suffix}", code=2)
        assert "fit into no table" in said
        assert not Path(f"post{suffix}").exists()


@pytest.mark.parametrize("verb", ["maximize", "summary"])
def test_a_table_is_no_netcdf_file(series, monkeypatch, verb):
    """A table in CSV was written under the name of one."""
    monkeypatch.setattr(ssm, verb, lambda *a, **k: pytest.fail("it was run"))
    given = ["walk.py", series] if verb == "maximize" else ["posterior.nc"]
    Path("posterior.nc").touch()
    said = fails(verb, *given, "-o", "table.nc", code=2)
    assert "Name a file .csv or .parquet" in said
    assert not Path("table.nc").exists()


@pytest.mark.parametrize("verb", ["smooth", "maximize", "simulate", "leave-future-out"])
def test_a_form_that_cannot_be_written_is_refused_at_once(series, monkeypatch, verb):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    monkeypatch.setattr(ssm, verb.replace("-", "_"), lambda *a, **k: pytest.fail("it was run"))
    data = [] if verb == "simulate" else [series]
    assert "pip install 'ssmppl[parquet]'" in fails(verb, "walk.py", *data, "-o", "post.parquet")


def test_nothing_to_sample(series):
    said = fails("sample", "walk.py", series, *QUICK, "--fixed", "q=0.3", "--no-states")
    assert "nothing to draw" in said


def test_data_that_do_not_fit(folder):
    Path("d.csv").write_text("time,z\n1,2\n", encoding="utf-8")
    message = fails("sample", "walk.py", "d.csv")
    assert message.startswith("Error: DataError\n")
    assert "its columns are: z" in message.replace("time, ", "").replace(", time", "")


def test_notes_are_printed(folder, monkeypatch):
    def failing(*args, **kwargs):
        error = SamplingError("all weights are zero")
        error.add_note("in chain 2 of 4")
        raise error

    monkeypatch.setattr(ssm, "explain", failing)
    assert fails("explain", "walk.py").endswith("all weights are zero\nin chain 2 of 4\n")


# -- what is read
def test_values_of_parameters():
    texts = ["a=1", "b = -2.5e-1", "c=[1, 2]", "d=[[1, 0], [0, 1]]", "e=inf"]
    assert parse_assignments(texts, "-p") == {
        "a": 1.0, "b": -0.25, "c": [1, 2], "d": [[1, 0], [0, 1]], "e": np.inf,
    }  # fmt: skip


@pytest.mark.parametrize("texts", [["a"], ["=1"], ["1a=2"], ["a="], ["a={}"], ["a=1", "a=2"]])
def test_values_that_are_none(texts):
    with pytest.raises(ArgumentError, match="-p"):
        parse_assignments(texts, "-p")


@pytest.mark.parametrize("text", ["", "a,b\n1,2,3\n4\n5,6,7,8\n", "\x00\x01,\xff"])
def test_files_that_are_no_tables(tmp_path, text):
    path = tmp_path / "d.csv"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(DataError, match=r"d\.csv"):
        read_csv(path)


def test_spaces_in_the_header(tmp_path):
    path = tmp_path / "d.csv"
    path.write_text("time, y\n1, 2\n2, \n", encoding="utf-8")
    assert list(read_csv(path).columns) == ["time", "y"]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("y\n1\n\n2\n\n\n", [1, np.nan, 2]),
        ("\n\ny\n\n1\n  \n\n2", [np.nan, 1, np.nan, np.nan, 2]),
        ('y\r\n1\r\n\r\n""\r\n2\r\n', [1, np.nan, np.nan, 2]),
        ("y\n\n1\n\n2\n\n3\n", [1, 2, 3]),  # each line has ended twice
        ("y\n", []),
    ],
)
def test_empty_lines_of_one_column_are_missing_rows(tmp_path, text, expected):
    path = tmp_path / "d.csv"
    path.write_bytes(text.encode())
    read = read_csv(path)
    np.testing.assert_array_equal(read["y"].to_numpy(float), expected)
    assert list(read.index) == list(range(len(expected)))


def test_a_column_of_decimal_commas_stays_what_it_is(tmp_path):
    path = tmp_path / "d.csv"
    path.write_text('y\n"1,5"\n\n"2,5"\n', encoding="utf-8")
    assert list(read_csv(path)["y"].fillna("")) == ["1,5", "", "2,5"]


# -- real processes
def program(*args, **settings):
    environment = os.environ | {"PYTHONPATH": str(ROOT), "COLUMNS": "100"}
    return subprocess.Popen(
        [sys.executable, "-m", "ssmppl", *map(str, args)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment, **settings,
    )  # fmt: skip


def test_a_process_of_its_own(series):
    process = program("sample", "walk.py", "sim.csv", *QUICK)
    out, err = process.communicate(timeout=300)
    assert process.returncode == 0, err
    assert "\nq " in out
    assert "Gibbs: 100%" in err  # the walk is linear and Gaussian
    assert Path("sim.nc").stat().st_size > 0


@pytest.mark.slow
def test_ctrl_c_keeps_what_was_drawn(series):
    process = program(
        "sample", "walk.py", "sim.csv", "--draws", 400, "--warmup", 0, "--chains", 2,
        "--thin", 800, "--seed", 1, "--method", "pgas", "-o", "kept.nc",
    )  # fmt: skip
    assert process.stderr is not None
    said = iter(process.stderr.readline, "")  # what is compiled may be told of before
    first = next((line for line in said if "%" in line), "nothing")
    assert first.startswith("PGAS: 2"), first  # a fifth is drawn when the first share is told
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=300)
    assert process.returncode == 130, err
    assert "of 400 draws of each chain are kept" in err
    assert "r_hat" in out
    assert arviz().from_netcdf("kept.nc")["posterior"].attrs["interrupted"] == 1


@pytest.mark.slow
def test_the_demo(folder):
    text = run("demo", "--draws", 100, "--output", "varves.nc").stdout
    for line in ("(phi, tau) jointly", "phi exact", "tau exact", "PGAS:", "PMMH:", "s in all"):
        assert line in text
    assert arviz().from_netcdf("varves.nc")["posterior"]["x"].shape == (4, 100, 634)
    assert arviz().from_netcdf("varves_pmmh.nc")["posterior"].attrs["method"] == "PMMH"


def test_maximize_prints_the_estimate_and_writes_it(series):
    result = run("maximize", "walk.py", series, "--seed", 1, "-o", "estimate.csv")
    assert "DirectOptimization, chosen automatically" in result.stdout
    table = pd.read_csv("estimate.csv", index_col="parameter")
    model = load_model("walk.py")
    exact = ssm.maximize(model, pd.read_csv(series), seed=1, progress=False)
    assert table.loc["q", "estimate"] == pytest.approx(exact.parameters["q"])
    assert table.loc["q", "standard_error"] == pytest.approx(exact.standard_errors["q"])
    assert f"{exact.parameters['q']:.6g}" in result.stdout


def test_maximize_takes_methods_fixed_values_and_the_posterior(series):
    assert "by EM" in run("maximize", "walk.py", series, "--method", "em").stdout
    assert "fixed" in run("maximize", "walk.py", series, "--fixed", "q=0.3").stdout
    mode = run("maximize", "walk.py", series, "--objective", "posterior", "--start", "q=1").stdout
    model = load_model("walk.py")
    exact = ssm.maximize(model, pd.read_csv(series), objective="posterior", progress=False)
    assert f"{exact.parameters['q']:.4f}" in mode
