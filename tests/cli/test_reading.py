"""Data from CSV, Parquet and netCDF files: the same numbers, and nothing of them is executed."""

import pickle
import sys
import types
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr

import ssmppl as ssm
from ssmppl.cli.reading import as_table, read_data, read_table
from ssmppl.errors import ArgumentError, DataError, ModelError
from ssmppl.modelfile import load_model
from ssmppl.results import arviz
from tests.cli.shared import answer, fails, run

Q = ("-p", "q=0.3")


# -- tables as spreadsheets and beginners write them
@pytest.fixture
def dated(tmp_path):
    """Writes a CSV file of dates, counts and text, and gives its path."""

    def write(text, name="dated.csv"):
        path = tmp_path / name
        path.write_text(text)
        return path

    return write


@pytest.mark.parametrize("name", ["date", "week", ""])
def test_a_first_column_of_dates_labels_the_rows_whatever_its_name(dated, name):
    table = read_table(dated(f"{name},y\n2024-01-01,1\n2024-01-08,\n"))
    assert list(table.index) == list(pd.to_datetime(["2024-01-01", "2024-01-08"]))
    assert table.index.name == "time"
    assert list(table.columns) == ["y"]


def test_what_is_no_date_labels_nothing_and_time_goes_before_a_date(dated):
    assert list(read_table(dated("site,y\nnorth,1\nsouth,2\n")).columns) == ["site", "y"]
    assert list(read_table(dated("year,y\n1999,1\n2000,2\n")).columns) == ["year", "y"]
    both = read_table(dated("date,time,y\n2024-01-01,1,5\n2024-01-02,2,6\n"))
    assert list(both.columns) == ["date", "time", "y"]


@pytest.mark.parametrize("name", ["time", "date"])
def test_row_numbers_of_a_table_that_was_cut_or_sorted_label_nothing(dated, name):
    """The numbers that pandas writes before the rows went before the dates beside them."""
    days = ["2021-01-01", "2021-01-02", "2021-01-04"]
    for numbers in ([0, 1, 2], [5, 7, 9], [2, 1, 0]):
        lines = [f",{name},y", *(f"{k},{d},{k}.5" for k, d in zip(numbers, days, strict=True))]
        table = read_table(dated("\n".join(lines)))
        if name == "time":
            assert list(table["time"]) == list(pd.to_datetime(days))
        else:
            assert list(table.index) == list(pd.to_datetime(days))
        assert list(table["y"]) == [k + 0.5 for k in numbers]
    plain = read_table(dated(",y,z\n3,1,2\n4,5,6\n"))
    assert list(plain.index) == [3, 4]
    assert list(plain.columns) == ["y", "z"]


@pytest.mark.parametrize("encoding", ["utf-16", "latin-1"])
def test_an_encoding_that_is_not_utf_8_is_told(tmp_path, encoding):
    path = tmp_path / "d.csv"
    path.write_text("time,y\n1,2\n2,é\n", encoding=encoding)
    with pytest.raises(DataError, match=r"no text in UTF-8.*\n.*save it as UTF-8"):
        read_table(path)


@pytest.mark.parametrize(
    "first", ["04.01.2021", "1/4/2021", "04-01-21", "4 Jan 2021", "may 4 2021"]
)
@pytest.mark.parametrize("name", ["date", "time"])
def test_dates_in_another_form_are_told_and_never_guessed(dated, name, first):
    with pytest.raises(DataError, match=f"column '{name}'.*is '{first}'\n.*2021-01-04"):
        read_table(dated(f"{name},y\n{first},1\n{first.replace('4', '5')},2\n"))


@pytest.mark.parametrize("name", ["date", "time"])
def test_offsets_that_change_with_summer_time_are_one_clock(dated, name):
    path = dated(f"{name},y\n2021-03-28T01:00+01:00,1\n2021-03-28T03:00+02:00,2\n")
    table = read_table(path)
    found = pd.DatetimeIndex(table["time"] if name == "time" else table.index)
    assert list(found) == list(pd.to_datetime(["2021-03-28T00:00Z", "2021-03-28T01:00Z"]))
    walk = ssm.Model("walk")
    walk.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    walk.transition(lambda x: {"x": ssm.Normal(x, sd=1)})
    walk.observation(lambda x: {"y": ssm.Normal(x, sd=1)})
    times = ssm.kalman_filter(walk, table, {})["time"].values
    assert list(times) == [np.datetime64("2021-03-28T00:00"), np.datetime64("2021-03-28T01:00")]


def test_text_that_only_resembles_a_date_stays_text(dated):
    table = read_table(dated("date,y\n3 plot 12,1\n4 plot 12,2\n"))
    assert list(table["y"]) == [1, 2]


def test_dates_that_are_not_in_order_are_refused(folder, dated):
    path = dated("date,y\n2024-01-08,1\n2024-01-01,2\n")
    assert "2024-01-01 in row 2 follows 2024-01-08 in row 1" in fails(
        "log-likelihood", "walk.py", path, *Q
    )


def test_explain_tells_how_rows_are_labelled_and_of_a_week_that_is_not_there(folder, dated):
    path = dated("week,y\n2024-01-01,1\n2024-01-08,2\n2024-01-22,4\n")
    text = " ".join(run("explain", "walk.py", path).stdout.split())
    assert "labels 2024-01-01 to 2024-01-22 steps from 7 days to 14 days long" in text
    path = dated("week,y\n2024-01-01,1\n2024-01-08,2\n2024-01-15,4\n")
    assert "one row is one step" not in run("explain", "walk.py", path).stdout
    path = dated("y\n1\n2\n")
    assert "labels" not in run("explain", "walk.py", path).stdout


def test_explain_tells_which_columns_no_law_reads(folder, dated):
    path = dated("year,y,y_0,depth\n1871,1,0,3\n1872,2,0,4\n")
    text = " ".join(run("explain", "walk.py", path).stdout.split())
    assert "unused columns year, depth; rows have numbers: call a column of times" in text
    path = dated("time,y,depth\n1871,1,3\n1872,2,4\n")
    text = " ".join(run("explain", "walk.py", path).stdout.split())
    assert "unused columns depth Structure" in text.replace("-", "")
    path = dated("time,y\n1871,1\n1872,2\n")
    assert "unused columns" not in run("explain", "walk.py", path).stdout


@pytest.mark.parametrize(
    ("text", "found"),
    [("t;y\n1;2\n", "semicolons"), ("t;y\n1;2,5\n", "semicolons"),
     ("t;a;y\n1;2,5;3,5\n", "semicolons"), ("t\ty\n1\t2\n", "tabs")],
)  # fmt: skip
def test_other_separators_are_named(dated, text, found):
    with pytest.raises(DataError, match=f"are separated by {found}: .*\n?.*sep="):
        read_table(dated(text))


@pytest.mark.parametrize("name", ["t.csv.gz", "t.csv.bz2", "t.csv.xz", "t.csv.zip", "t.nc", "h.nc"])
def test_files_cut_short_are_told(tmp_path, name):
    """Wherever they end; that of a .gz was said to be an abort."""
    path, cut = tmp_path / name, tmp_path / f"cut_{name}"
    y = np.random.default_rng(1).normal(size=200)
    if name.endswith(".nc"):
        engine = "scipy" if name == "t.nc" else "h5netcdf"
        xr.Dataset({"y": ("time", y)}).to_netcdf(path, engine=engine)
    else:
        pd.DataFrame({"y": y}).to_csv(path, index=False)
    whole = path.read_bytes()
    assert len(read_table(path)["y"]) == 200
    for length in [1, 2, 3, 4, 5, 8, *np.linspace(12, 0.95 * len(whole), 12).astype(int)]:
        cut.write_bytes(whole[:length])
        with pytest.raises(DataError, match=f"cut_{name}"):
            read_table(cut)


@pytest.mark.parametrize("rows", ["1,1,5\n2,2,5\n", "1,2,\n2,3,4\n", "a,1,2\nb,2,3\n"])
def test_rows_of_more_values_than_names_are_no_table(dated, rows):
    """pandas takes the first value as a label, and all others stand one column too far left."""
    with pytest.raises(
        DataError, match=r"more values than its first line has names, 2(.|\n)*points"
    ):
        read_table(dated(f"time,y\n{rows}"))


@pytest.mark.parametrize("names", ["time,y", "time,y,"])
def test_a_comma_that_ends_every_row_is_nothing(dated, names):
    table = read_table(dated(f"{names}\n1,1.5,\n2,2.5,\n"))
    assert list(table["time"]) == [1, 2]
    assert list(table["y"]) == [1.5, 2.5]


@pytest.mark.parametrize("names", ["time,y,y", "time,y, y", "y,time,y"])
def test_a_name_that_stands_twice_is_told(dated, names):
    with pytest.raises(DataError, match="more than one column named 'y'"):
        read_table(dated(f"{names}\n1,9,1.5\n2,9,2.5\n"))
    assert list(read_table(dated("time,y,y.1\n1,9,1.5\n"))["y"]) == [9]


@pytest.mark.parametrize("rest", ["time,y\n1,9\n2,8\n", "y\n1\n2\n"])
def test_a_comment_before_the_names_is_told(dated, rest):
    with pytest.raises(DataError, match="begins with a comment, '# of 1998'") as caught:
        read_table(dated(f"# of 1998\n{rest}"))
    assert "comment='#'" in caught.value.fix


def test_one_column_is_a_table(dated):
    assert list(read_table(dated("y\n1\n2\n"))["y"]) == [1, 2]


@pytest.mark.parametrize(
    ("name", "text", "fix"),
    [("a.py", "def f()\n", "it is not Python as it stands"),
     ("b.py", "import nothing_of_that_name\n", "install it into the environment"),
     ("c.csv", "t,y\n2021-01-04,3\n", "c.csv looks like data"),
     ("d.py", "1 / 0\n", "has to run from top to end")],
)  # fmt: skip
def test_a_model_file_that_does_not_run_gets_a_fix_that_fits(dated, name, text, fix):
    with pytest.raises(ModelError) as caught:
        load_model(str(dated(text, name)))
    assert fix in caught.value.fix


def dataset(series):
    table = pd.read_csv(series, index_col="time")
    return xr.Dataset.from_dataframe(table)


def log_likelihood(file):
    (value,) = answer("log-likelihood", "walk.py", file, *Q)["log_likelihood"]
    return value


def test_netcdf_gives_what_csv_gives(series):
    dataset(series).to_netcdf("new.nc", engine="h5netcdf")
    dataset(series).to_netcdf("classic.nc", engine="scipy")
    assert Path("classic.nc").read_bytes()[:3] == b"CDF"
    expected = log_likelihood("sim.csv")
    assert expected == pytest.approx(-34.31, abs=0.01)
    assert [log_likelihood("new.nc"), log_likelihood("classic.nc")] == [expected] * 2


def test_parquet_gives_what_csv_gives(series):
    pytest.importorskip("pyarrow", reason="pyarrow is not installed: no Parquet file to read")
    pd.read_csv(series).to_parquet("table.parquet")
    pd.read_csv(series, index_col="time").to_parquet("index.parquet")
    expected = log_likelihood("sim.csv")
    assert [log_likelihood("table.parquet"), log_likelihood("index.parquet")] == [expected] * 2
    run("simulate", "walk.py", "--steps", 4, *Q, "--seed", 1, "-o", "s.parquet")
    run("simulate", "walk.py", "--steps", 4, *Q, "--seed", 1, "-o", "s.csv")
    assert log_likelihood("s.parquet") == log_likelihood("s.csv")


@pytest.fixture
def arrow(monkeypatch):
    """What stands for pyarrow where it is not installed; `calls` of the reader."""
    module = types.ModuleType("pyarrow")
    module.__version__ = "21.0.0"
    calls = []

    def read_parquet(path, engine):
        calls.append((Path(path).name, engine))
        return pd.read_csv(Path(path).with_suffix(".csv"))

    monkeypatch.setitem(sys.modules, "pyarrow", module)
    monkeypatch.setattr(pd, "read_parquet", read_parquet)
    return types.SimpleNamespace(module=module, calls=calls)


def test_parquet_is_read_by_pyarrow_alone(series, arrow):
    Path("sim.parquet").write_bytes(b"PAR1")
    assert log_likelihood("sim.parquet") == log_likelihood("sim.csv")
    assert arrow.calls == [("sim.parquet", "pyarrow")]


def test_an_old_pyarrow_is_refused(series, arrow):
    arrow.module.__version__ = "14.0.0"
    Path("sim.parquet").write_bytes(b"PAR1")
    said = fails("explain", "walk.py", "sim.parquet")
    assert "pyarrow 14.0.0 is too old" in said
    assert arrow.calls == []


def test_without_pyarrow_the_extra_is_named(series, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    Path("sim.parquet").write_bytes(b"PAR1")
    said = fails("explain", "walk.py", "sim.parquet")
    assert "pip install 'ssmppl[parquet]'" in said
    said = fails("simulate", "walk.py", "--steps", 3, *Q, "-o", "s.parquet")
    assert "pip install 'ssmppl[parquet]'" in said


def test_a_parquet_file_that_is_none(series, arrow, monkeypatch):
    def refusing(path, engine):
        raise ValueError("Parquet magic bytes not found in footer.\nMore")

    monkeypatch.setattr(pd, "read_parquet", refusing)
    Path("sim.parquet").write_bytes(b"none")
    said = fails("explain", "walk.py", "sim.parquet")
    assert "sim.parquet cannot be read as a Parquet file: Parquet magic bytes not found" in said
    assert "More" not in said


def test_dates_label_the_rows_of_each_kind(series, arrow):
    dates = pd.date_range("2024-01-31", periods=20, freq="D")
    table = pd.read_csv(series).assign(time=dates)
    table.to_csv("dated.csv", index=False)
    Path("dated.parquet").write_bytes(b"PAR1")
    xr.Dataset.from_dataframe(table.set_index("time")).to_netcdf("dated.nc", engine="h5netcdf")
    for name in ("dated.csv", "dated.parquet", "dated.nc"):
        run("kalman-filter", "walk.py", name, *Q, "-o", "f.nc")
        with xr.open_dataset("f.nc", engine="h5netcdf") as found:
            np.testing.assert_array_equal(found["time"].values, dates.values, err_msg=name)
    answered = answer("kalman-filter", "walk.py", "dated.nc", *Q)["experiments"][0]["time"]
    assert answered[0].startswith("2024-01-31T00:00:00")


def test_vectors_are_columns_or_dimensions(folder):
    u = np.arange(5.0)
    xr.Dataset({"u": ("time", u)}).to_netcdf("u.nc", engine="h5netcdf")
    pd.DataFrame({"u": u}).to_csv("u.csv", index=False)
    beta = ("-p", "beta=[1, 2]", "--seed", 1)
    for end in ("nc", "csv"):
        run("simulate", "plane.py", "--inputs", f"u.{end}", *beta, "-o", f"from_{end}.csv")
    assert Path("from_nc.csv").read_text() == Path("from_csv.csv").read_text()
    run("simulate", "plane.py", "--inputs", "u.csv", *beta, "-o", "sim.nc")
    with xr.open_dataset("sim.nc", engine="h5netcdf") as found:
        whole = found.load().assign(u=("time", u))
    assert whole["y"].shape == (1, 5, 2)
    whole.to_netcdf("plane.nc", engine="h5netcdf")
    words = ("-p", "beta=[1, 2]")
    from_nc = answer("log-likelihood", "plane.py", "plane.nc", *words)["log_likelihood"]
    from_csv = answer("log-likelihood", "plane.py", "from_csv.csv", *words)["log_likelihood"]
    assert from_nc == pytest.approx(from_csv, rel=1e-12)
    assert list(as_table(whole).columns) == ["time", "x_0", "x_1", "y_0", "y_1", "u"]


@pytest.mark.parametrize("suffix", ["csv", "nc"])
def test_a_simulation_with_its_inputs_is_data(folder, suffix):
    """A netCDF file was without them; and of both kinds what else the file of inputs has is not."""
    Path("u.csv").write_text("u,y\n1,9\n-1,9\n0.5,9\n2,9\n", encoding="utf-8")
    run("simulate", "plane.py", "--inputs", "u.csv", "--seed", 3, "-o", f"d.{suffix}")
    found = answer("log-likelihood", "plane.py", f"d.{suffix}", "-p", "beta=[1, 2]")
    assert np.isfinite(found["log_likelihood"]).all()


def test_a_netcdf_file_of_several_simulations(folder):
    run("simulate", "walk.py", "--steps", 4, *Q, "--draws", 3, "-o", "many.nc")
    assert "draw" in fails("log-likelihood", "walk.py", "many.nc", *Q)


# -- files that are something else
def test_a_file_of_draws_is_no_data(posterior, monkeypatch):
    monkeypatch.chdir(posterior)
    said = fails("explain", "walk.py", "post.nc")
    assert "post.nc holds the groups" in said
    assert "posterior" in said


def test_data_are_no_posterior(posterior, monkeypatch):
    monkeypatch.chdir(posterior)
    assert "sim.csv holds no posterior draws" in fails("summary", "sim.csv")
    assert "holds no posterior draws" in fails("forecast", "walk.py", "sim.csv", "--steps", 2)
    assert "does not exist" in fails("summary", "nowhere.nc", code=2)


def test_a_netcdf_file_that_is_cut_short(series):
    dataset(series).to_netcdf("whole.nc", engine="h5netcdf")
    Path("cut.nc").write_bytes(Path("whole.nc").read_bytes()[:900])
    assert "cut.nc cannot be read as a netCDF file" in fails("explain", "walk.py", "cut.nc")
    assert "cut.nc holds no posterior draws" in fails("summary", "cut.nc")
    Path("text.nc").write_text("time,y\n1,2\n", encoding="utf-8")
    assert "text.nc is not a netCDF file" in fails("explain", "walk.py", "text.nc")


class Trap:
    """Unpickling it writes a file."""

    def __reduce__(self):
        return Path.touch, (Path("sprung"),)


@pytest.mark.parametrize("name", ["t.pkl", "t.csv", "t.nc", "t.h5", "t.parquet"])
def test_nothing_is_unpickled(folder, name):
    Path(name).write_bytes(pickle.dumps(Trap()))
    pickle.loads(Path(name).read_bytes())
    assert Path("sprung").exists()  # the trap is set
    Path("sprung").unlink()
    with pytest.raises((DataError, ArgumentError), match=r"t\.|pyarrow"):
        read_table(Path(name))
    fails("summary", name)
    assert not Path("sprung").exists()


# -- files that are not written over
def test_a_file_that_is_read_is_not_written_over(series):
    before = series.read_bytes()
    commands = (("kalman-filter", *Q), ("smooth", *Q), ("sample",), ("leave-future-out",),
                ("maximize",))  # fmt: skip
    for name, *words in commands:
        said = fails(name, "walk.py", "sim.csv", *words, "-o", "./sim.csv", code=2)
        assert "a file that is read" in said
    Path("sim_2.csv").write_bytes(before)
    said = fails("smooth", "walk.py", "sim.csv", "sim_2.csv", *Q, "-o", "sim.csv", code=2)
    assert "sim_2.csv is a file that is read" in said
    assert series.read_bytes() == Path("sim_2.csv").read_bytes() == before


def test_draws_and_inputs_are_not_written_over(posterior, monkeypatch, folder):
    pd.DataFrame({"u": np.arange(3.0)}).to_csv("plane.csv", index=False)
    beta = ("-p", "beta=[1, 2]")
    found = answer("simulate", "plane.py", "--inputs", "plane.csv", *beta)
    assert found["files"] == ["plane_simulated.csv"]
    assert list(pd.read_csv("plane.csv").columns) == ["u"]
    said = fails("simulate", "plane.py", "--inputs", "plane.csv", *beta, "-o", "plane.csv", code=2)
    assert "a file that is read" in said
    monkeypatch.chdir(posterior)
    before = Path("post.nc").read_bytes()
    for words in (("summary", "post.nc"), ("forecast", "walk.py", "post.nc", "--steps", 2)):
        assert "a file that is read" in fails(*words, "-o", "post.nc", code=2)
    assert Path("post.nc").read_bytes() == before


def test_default_names_leave_data_and_draws_alone(posterior, monkeypatch, tmp_path):
    for name in ("walk.py", "sim.csv", "post.nc"):
        (tmp_path / name).write_bytes((posterior / name).read_bytes())
    monkeypatch.chdir(tmp_path)
    Path("post.nc").rename("sim.nc")  # as `sample` names it
    assert answer("smooth", "walk.py", "sim.csv", *Q)["files"] == ["sim_states.nc"]
    assert "q" in arviz().from_netcdf("sim.nc")["posterior"]
    dataset("sim.csv").to_netcdf("data.nc", engine="h5netcdf")
    words = ("--draws", 4, "--warmup", 2, "--chains", 1, "--seed", 1)
    assert answer("sample", "walk.py", "data.nc", *words)["files"] == ["data_posterior.nc"]
    assert answer("smooth", "walk.py", "data.nc", *Q)["files"] == ["data_states.nc"]
    assert answer("smooth", "walk.py", "sim.csv", *Q, "-o", "here.nc")["files"] == ["here.nc"]


def test_several_files_of_several_kinds(series):
    dataset(series).isel(time=slice(0, 7)).to_netcdf("short.nc", engine="h5netcdf")
    read = read_data([Path("sim.csv"), Path("short.nc")])
    expected = ssm.log_likelihood(load_model("walk.py"), read, {"q": 0.3})
    found = answer("log-likelihood", "walk.py", "sim.csv", "short.nc", *Q)["log_likelihood"]
    assert found == list(expected)
    assert found[0] == pytest.approx(log_likelihood("sim.csv") + log_likelihood("short.nc"))


def test_of_several_files_the_one_at_fault_is_named(folder):
    Path("a.csv").write_text("y\n1\n2\n")
    Path("b.csv").write_text("y\n1\ntext\n")
    xr.Dataset({"z": ("time", [1.0, 2.0])}).to_netcdf("c.nc")
    said = fails("log-likelihood", "walk.py", "a.csv", "b.csv", *Q)
    assert "In data set 2 (b.csv), 'y', row 2" in said
    assert "In data set 2 (c.nc)" in fails("log-likelihood", "walk.py", "a.csv", "c.nc", *Q)
    assert "data set 1" not in fails("log-likelihood", "walk.py", "b.csv", *Q)
