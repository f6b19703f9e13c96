"""Data sets and parameter values as arrays over the symbols; test_errors.py: what is refused."""

import decimal
from datetime import date
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from numpy.testing import assert_array_equal

from ssmppl import datasets
from ssmppl.data import (
    bind,
    bind_inputs,
    check_parameters,
    check_values,
    unpack_observations,
    unpack_parameters,
    unpack_states,
)
from ssmppl.data.times import label_text, spacing
from ssmppl.errors import DataError
from ssmppl.language import distributions as ssm
from ssmppl.language.model.model import Model
from ssmppl.language.tracing import trace

NAN = np.nan


def scalar():
    model = Model("scalar")
    model.prior(lambda: {"s": ssm.HalfNormal(sd=1)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x, s: {"x": ssm.Normal(x, sd=s)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=1)})
    return trace(model)


def mixed():
    """A count, a vector and a symmetric matrix are measured; a scalar and a vector are inputs."""
    model = Model("mixed", inputs={"u": None, "w": 2})
    model.prior(
        lambda: {
            "a": ssm.Normal(0, sd=1),
            "S": ssm.InverseWishart(4, scale=np.eye(2)),
            "B": ssm.Normal(np.zeros((2, 3)), sd=1),
        }
    )
    model.initial(lambda: {"x": ssm.Normal(0, sd=1), "z": ssm.Normal(np.zeros(2), sd=1)})
    model.transition(
        lambda x, z, u, w: {"x": ssm.Normal(x + u, sd=1), "z": ssm.Normal(z + w, sd=1)}
    )
    model.observation(
        lambda x, z: {
            "n": ssm.Poisson(np.exp(x)),
            "y": ssm.MvNormal(z, covariance=np.eye(2)),
            "C": ssm.Wishart(4, scale=np.eye(2)),
        }
    )
    return trace(model)


MATRICES = np.array([[[2.0, 0.5], [0.5, 1.0]], [[3.0, 0.1], [0.1, 2.0]], [[1.0, 0.0], [0.0, 4.0]]])
MIXED = {
    "n": [3, None, 0],
    "y": [[1.0, 2.0], [NAN, 4.0], [NAN, NAN]],
    "C": MATRICES,
    "u": [0, 1, 2],
    "w": [[1, 2], [3, 4], [5, 6]],
}


def one(t, data, **kwargs):
    (experiment,) = bind(t, data, **kwargs)
    return experiment


def assert_same(a, b):
    assert_array_equal(a.y, b.y)
    assert_array_equal(a.seen, b.seen)
    assert_array_equal(a.u, b.u)
    for name in a.observed:
        assert_array_equal(a.observed[name], b.observed[name])


def test_the_arrays_of_an_experiment():
    e = one(mixed(), MIXED)
    # columns: n, y[0], y[1], and the lower half of C
    assert_array_equal(
        e.y, [[3, 1, 2, 2, 0.5, 1], [0, 0, 4, 3, 0.1, 2], [0, 0, 0, 1, 0, 4]]
    )  # fmt: skip
    assert_array_equal(e.seen, [[1, 1, 1, 1, 1, 1], [0, 0, 1, 1, 1, 1], [1, 0, 0, 1, 1, 1]])
    assert_array_equal(e.u, [[0, 1, 2], [1, 3, 4], [2, 5, 6]])
    assert e.partial == {"y"}
    assert e.steps == 3
    assert e.time is None
    assert list(e.observed) == ["n", "y", "C"]
    assert_array_equal(e.observed["n"], [3, NAN, 0])
    assert e.observed["C"].shape == (3, 2, 2)
    assert e.inputs["w"].shape == (3, 2)
    for array in (e.y, e.seen, e.u):
        assert array.dtype == np.float64
        assert array.flags.c_contiguous


def frame(data=MIXED, brackets=False, index=None):
    columns = {"n": data["n"], "u": data["u"]}
    for name in ("y", "w"):
        for i in range(2):
            columns[f"{name}[{i}]" if brackets else f"{name}_{i}"] = np.array(data[name])[:, i]
    for i in range(2):
        for j in range(2):
            columns[f"C[{i}, {j}]" if brackets else f"C_{i}_{j}"] = data["C"][:, i, j]
    return pd.DataFrame(columns | {"unused": "text"}, index=index)


@pytest.mark.parametrize("brackets", [False, True])
def test_a_dataframe_says_the_same(brackets):
    e = one(mixed(), frame(brackets=brackets))
    assert_same(e, one(mixed(), MIXED))
    assert e.time is None


def test_a_dataset_says_the_same_in_any_order_of_dimensions():
    data = xr.Dataset(
        {
            "n": ("time", np.array(MIXED["n"], dtype=float)),
            "y": (("axis", "time"), np.array(MIXED["y"]).T),
            "C": (("time", "i", "j"), MATRICES),
            "u": ("time", np.array(MIXED["u"])),
            "w": (("time", "axis"), np.array(MIXED["w"])),
            "unused": 3.0,
        },
        coords={"time": [10.0, 10.5, 12.0]},
    )
    e = one(mixed(), data)
    assert_same(e, one(mixed(), MIXED))
    assert_array_equal(e.time, [10.0, 10.5, 12.0])
    simulated = data.expand_dims("draw")  # as `simulate` returns it
    assert_same(one(mixed(), simulated), e)


@pytest.mark.parametrize(
    "values",
    [
        [1.0, None, 2.0],
        (1, NAN, 2),
        np.array([1, NAN, 2], dtype=np.float32),
        np.array([1, None, 2], dtype=object),
        np.ma.masked_array([1, -999, 2], mask=[False, True, False]),
        pd.array([1, None, 2], dtype="Int64"),
        pd.Series([1, pd.NA, 2], dtype="Float64"),
        pd.Series([1, pd.NA, 2], dtype=object),
        xr.DataArray([1, NAN, 2], dims="time"),
        [decimal.Decimal(1), None, np.int8(2)],
        [decimal.Decimal(1), decimal.Decimal("sNaN"), decimal.Decimal(2)],
        [True, None, 2],
    ],
    ids=lambda v: type(v).__name__,
)
def test_missing_values_however_they_are_written(values):
    e = one(scalar(), {"y": values})
    assert_array_equal(e.observed["y"], [1, NAN, 2])
    assert_array_equal(e.y[:, 0], [1, 0, 2])
    assert_array_equal(e.seen[:, 0], [1, 0, 1])


def test_nullable_columns_of_a_dataframe():
    data = pd.DataFrame({"y": [1, None, 2]}).convert_dtypes()
    assert str(data["y"].dtype) == "Int64"
    assert_array_equal(one(scalar(), data).observed["y"], [1, NAN, 2])


@pytest.mark.parametrize("values", [np.array([1, 0, 1], dtype=np.int8), [True, False, True]])
def test_integers_and_truth_values_are_numbers(values):
    assert_array_equal(one(scalar(), {"y": values}).y[:, 0], [1, 0, 1])


def test_a_channel_may_be_missing_in_every_row():
    e = one(scalar(), {"y": [NAN, NAN]})
    assert not e.seen.any()
    assert e.steps == 2


def test_one_component_given_without_its_axis():
    model = Model("short vector")
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(x, sd=1)})
    model.observation(lambda x: {"y": ssm.Normal(np.zeros(1) + x, sd=1)})
    assert one(trace(model), {"y": [1.0, 2.0]}).observed["y"].shape == (2, 1)


def test_the_users_data_are_left_alone():
    y = np.array([1.0, NAN, 2.0])
    e = one(scalar(), {"y": y})
    e.y[:] = 7.0
    assert_array_equal(y, [1.0, NAN, 2.0])


def test_several_experiments():
    first, second = bind(scalar(), [{"y": [1.0, 2.0]}, pd.DataFrame({"y": [3.0]})])
    assert (first.steps, second.steps) == (2, 1)
    (alone,) = bind(scalar(), ({"y": [1.0, 2.0]},))
    assert_same(alone, first)


@pytest.mark.parametrize(
    ("data", "time"),
    [
        ({"y": [1, 2, 3]}, None),
        ({"y": [1, 2, 3], "time": [0.0, 0.1, 0.3]}, [0.0, 0.1, 0.3]),
        (pd.DataFrame({"y": [1, 2, 3]}), None),
        (pd.DataFrame({"y": [1, 2, 3]}, index=[1990, 1991, 1995]), [1990, 1991, 1995]),
        (pd.DataFrame({"y": [9, 1, 2, 3]})[1:], [1, 2, 3]),
        (pd.DataFrame({"y": [1, 2, 3], "time": [5, 6, 7]}), [5, 6, 7]),
        (pd.DataFrame({"y": [1, 2, 3]}, index=["c", "a", "b"]), ["c", "a", "b"]),
        ({"y": pd.Series([1, 2, 3], index=[4, 5, 6])}, [4, 5, 6]),
        (xr.Dataset({"y": ("time", [1, 2, 3])}), None),
        ({"y": xr.DataArray([1, 2, 3], {"time": [4, 5, 6]}, ["time"])}, [4, 5, 6]),
    ],
)
def test_labels_of_the_rows(data, time):
    e = one(scalar(), data)
    assert_array_equal(e.y[:, 0], [1, 2, 3])
    if time is None:
        assert e.time is None
    else:
        assert_array_equal(e.time, time)


@pytest.mark.parametrize(
    "index",
    [
        pd.date_range("2020-01-01", periods=3),
        pd.date_range("2020-01-01", periods=3, tz="UTC"),
        pd.period_range("2020-01-01", periods=3, freq="D"),
    ],
    ids=["dates", "dates with a zone", "periods"],
)
def test_dates_become_datetime64(index):
    e = one(scalar(), pd.DataFrame({"y": [1, 2, 3]}, index=index))
    assert e.time.dtype.kind == "M"
    assert str(e.time[1]).startswith("2020-01-02")
    with pytest.raises(DataError, match=r"row 2 \(index 2020-01-02"):
        bind(scalar(), pd.DataFrame({"y": [1, np.inf, 3]}, index=index))


def test_a_column_of_dates_named_time():
    dates = pd.Series(pd.date_range("2020-01-01", periods=3, tz="Europe/Stockholm"))
    for times, zone in ((dates, "Europe/Stockholm"), (dates.dt.tz_localize(None), "")):
        e = one(scalar(), pd.DataFrame({"y": [1, 2, 3], "time": times}))
        assert e.time.dtype.kind == "M"
        assert e.zone == zone
        assert str(e.time[0])[:13] == ("2019-12-31T23" if zone else "2020-01-01T00")


@pytest.mark.parametrize(
    "labels",
    [
        ["2021-03-28", "2021-03-29", "2021-03-30"],
        [date(2021, 3, 28), date(2021, 3, 29), date(2021, 3, 30)],
        ["20210328", "20210329", "20210330"],
        ["2021-03-28 00:00", "2021-03-29 00:00", "2021-03-30 00:00"],
        pd.Categorical(["2021-03-28", "2021-03-29", "2021-03-30"]),
        ["2021-03-28T01:00+01:00", "2021-03-29T02:00+02:00", "2021-03-30T02:00+02:00"],
        [pd.Timestamp(f"2021-03-{d}T00:00+0{h}:00") for d, h in ((28, 1), (29, 2), (30, 2))],
    ],
    ids=["text", "dates", "digits", "clocks", "categories", "offsets", "stamps with offsets"],
)
@pytest.mark.parametrize("as_index", [True, False])
def test_dates_written_as_text_or_objects_are_dates_and_have_an_order(labels, as_index):
    """As pd.read_csv(file, index_col="date") has them without parse_dates."""

    def table(order):
        own = pd.Series(labels, dtype=object).iloc[order].to_list()
        columns = {"y": [1.0, 2.0, 3.0]}
        if as_index:
            return pd.DataFrame(columns, index=pd.Index(own, dtype=object))
        return {**columns, "time": own}

    e = one(scalar(), table([0, 1, 2]))
    assert e.time.dtype.kind == "M"
    exact = pd.to_datetime(pd.Series(labels, dtype=object), utc=True, format="ISO8601")
    assert_array_equal(e.time, exact.dt.tz_convert(None))
    with pytest.raises(DataError, match="is not increasing: 2021-03-2"):
        bind(scalar(), table([2, 1, 0]))


@pytest.mark.parametrize(
    ("labels", "told"),
    [
        (["04.01.2021", "05.01.2021"], "another form.*'04.01.2021'\n.*data.index, dayfirst=True"),
        (["2021-01-04T00:00", "2021-01-05T00:00+01:00"], "with and without.*'2021-01-04T00:00'"),
        (["2021-01-04", None], "is NaT in row 2"),
    ],
)
def test_dates_that_can_be_read_in_two_ways_are_refused(labels, told):
    with pytest.raises(DataError, match=told):
        bind(scalar(), pd.DataFrame({"y": [1.0, 2.0]}, index=pd.Index(labels, dtype=object)))


def test_text_that_is_no_date_has_no_order():
    for labels in (["north", "south"], ["1200", "1100"], ["2021-W02", "2021-W01"]):
        e = one(scalar(), pd.DataFrame({"y": [1.0, 2.0]}, index=labels))
        assert e.time.tolist() == labels


def test_what_the_fix_for_dates_says_reads_them():
    for text in ("04.01.2021", "04/01/2021", "4/1/21", "4 Jan 2021"):
        found = pd.to_datetime(pd.Series([text]), dayfirst=True)
        assert found[0] == pd.Timestamp("2021-01-04")


def test_embedded_series_bind_as_they_are():
    e = one(scalar(), datasets.load("lgss_main_text"))
    assert e.steps == 100
    assert_array_equal(e.time, np.arange(100))


def test_an_observation_named_by_a_transition_may_be_missing_in_the_last_row_only():
    model = Model("feedback")
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x, y: {"x": ssm.Normal(x + y[1], sd=1)})
    model.observation(lambda x: {"y": ssm.Normal(np.zeros(2) + x, sd=1)})
    t = trace(model)
    assert one(t, {"y": [[NAN, 1], [1, 2], [NAN, NAN]]}).partial == {"y"}
    with pytest.raises(DataError, match=r"'y'\[1\], row 2"):
        bind(t, {"y": [[1, 1], [1, NAN], [1, 1]]})


def test_observations_may_be_left_out_of_predictions():
    e = one(mixed(), {"u": MIXED["u"], "w": MIXED["w"]}, need_observations=False)
    assert not e.seen.any()
    assert e.y.shape == (3, 6)
    assert np.isnan(e.observed["C"]).all()
    e = one(mixed(), {n: MIXED[n] for n in ("u", "w", "n")}, need_observations=False)
    assert_array_equal(e.seen[:, 0], [1, 0, 1])
    e = one(scalar(), None, need_observations=False, steps=4)
    assert e.steps == 4
    with pytest.raises(DataError, match="number of steps"):
        bind(scalar(), None, need_observations=False)


def test_steps_must_agree_with_the_rows():
    assert one(scalar(), {"y": [1.0, 2.0]}, steps=2).steps == 2
    with pytest.raises(DataError, match="'y' has 2 rows, and steps is 3"):
        bind(scalar(), {"y": [1.0, 2.0]}, steps=3)


def test_inputs_of_a_simulation():
    u, steps, source = bind_inputs(mixed(), {"u": MIXED["u"], "w": MIXED["w"]}, None)
    assert_array_equal(u, [[0, 1, 2], [1, 3, 4], [2, 5, 6]])
    assert (steps, source.time) == (3, None)
    u, steps, source = bind_inputs(mixed(), frame(index=[1.0, 2.0, 4.0]), 3)
    assert_array_equal(source.time, [1.0, 2.0, 4.0])
    for nothing in (None, {}):
        u, steps, source = bind_inputs(scalar(), nothing, 7)
        assert (u.shape, steps, source.time) == ((7, 0), 7, None)
    u, steps, source = bind_inputs(scalar(), {"time": [0.5, 1.0]}, None)
    assert (u.shape, steps) == ((2, 0), 2)


def test_bounds_that_depend_on_states_are_left_to_the_density():
    model = Model("bounded")
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(x, sd=1)})
    model.observation(lambda x: {"y": ssm.Truncated(ssm.Normal(x, sd=1), lower=x, upper=9)})
    assert one(trace(model), {"y": [-50.0]}).y[0, 0] == -50.0
    with pytest.raises(DataError, match="10 is outside the support of the truncated Normal"):
        bind(trace(model), {"y": [10.0]})


# -- parameters
PARAMETERS = {"a": 0.5, "S": [[2.0, 0.5], [0.5, 1.0]], "B": np.arange(6.0).reshape(2, 3)}


def test_theta_and_back():
    t = mixed()
    theta = check_parameters(t, PARAMETERS)
    assert_array_equal(theta, [0.5, 2.0, 0.5, 1.0, 0, 1, 2, 3, 4, 5])
    assert theta.dtype == np.float64
    for name, value in unpack_parameters(t, theta).items():
        assert_array_equal(value, PARAMETERS[name])
    draws = unpack_parameters(t, np.stack([theta, 2 * theta]).reshape(2, 1, -1))
    assert draws["S"].shape == (2, 1, 2, 2)
    assert draws["a"].shape == (2, 1)
    assert_array_equal(draws["S"][1, 0], 2 * np.array(PARAMETERS["S"]))


def test_fixed_parameters_join_the_others():
    t = mixed()
    rest = {n: PARAMETERS[n] for n in ("S", "B")}
    assert check_parameters(t, rest, fixed={"a": 0.25})[0] == 0.25
    assert check_parameters(t, PARAMETERS, fixed={"a": 0.5})[0] == 0.5
    fixed = check_values(t, {"a": 1}, argument="fixed")
    assert_array_equal(fixed["a"], 1.0)
    assert check_values(t, None) == {}


def test_parameters_from_a_dataset():
    draws = xr.Dataset({"s": ((), 0.5)})
    assert_array_equal(check_parameters(scalar(), draws), [0.5])


def test_a_model_without_parameters():
    t = SimpleNamespace(parameters={}, parameter_symbols=[])
    assert check_parameters(t, None).shape == (0,)
    assert unpack_parameters(t, np.zeros((4, 0))) == {}


def test_states_and_observations_unpack():
    t = mixed()
    states = unpack_states(t, np.arange(12.0).reshape(4, 3))
    assert_array_equal(states["x"], [0, 3, 6, 9])
    assert_array_equal(states["z"][1], [4, 5])
    observed = unpack_observations(t, np.arange(6.0))
    assert_array_equal(observed["C"], [[3, 4], [4, 5]])
    with pytest.raises(ValueError, match="last axis must have length 3: x, z"):
        unpack_states(t, np.zeros(4))


def test_an_index_of_tuples_labels_rows_by_their_text():
    index = pd.Index([("a", 1), ("a", 2)], tupleize_cols=False)
    e = one(scalar(), pd.DataFrame({"y": [1.0, 2.0]}, index=index))
    assert list(e.time) == ["('a', 1)", "('a', 2)"]


# -- labels of rows
@pytest.mark.parametrize(
    ("label", "text"),
    [
        (np.datetime64("2024-03-01T00:00:00.000000"), "2024-03-01"),
        (np.datetime64("2024-03-01T00:00"), "2024-03-01"),
        (np.datetime64("2024-03-10"), "2024-03-10"),
        (np.datetime64("2024-03-01T06:30:00.000000000"), "2024-03-01T06:30:00"),
        (np.datetime64("2024-03-01T06:30:00.250"), "2024-03-01T06:30:00.25"),
        (np.int64(1900), "1900"),
        (np.str_("row 100"), "row 100"),
    ],
)
def test_labels_are_written_without_an_empty_clock(label, text):
    assert label_text(label) == text


@pytest.mark.parametrize(
    ("time", "found"),
    [
        (pd.date_range("2024-01-01", periods=30, freq="MS"), ""),
        (pd.date_range("2024-01-01", periods=9, freq="W").delete([3, 4]), "from 7 days to 21 days"),
        (pd.date_range("2024-01-01", periods=9, freq="h").delete(3), "from 1 h to 2 h"),
        (np.array([0.0, 0.1, 0.2, 0.5]), "from 0.1 to 0.3"),
        (np.arange(1900, 1920), ""),
        (np.array(["a", "b", "c", "d"]), ""),
        (np.array([1.0, 5.0]), ""),
    ],
)
def test_steps_that_differ_in_length_are_told(time, found):
    text = spacing(np.asarray(time))
    assert text.startswith(found)
    assert bool(text) == bool(found)


def test_the_first_text_that_is_no_number_is_named_and_not_the_numbers_before_it():
    column = pd.Series(["18.0", NAN, "ca. 20", "7", "many"])
    with pytest.raises(DataError) as caught:
        bind(scalar(), pd.DataFrame({"y": column}))
    assert "row 3" in str(caught.value)
    assert "the text 'ca. 20' stands" in str(caught.value)
    assert "as does one other" in str(caught.value)
