"""Draws past the data: their exact law in a linear model, their inputs, their time."""

import arviz as az
import numpy as np
import pandas as pd
import pytest
from scipy import stats

import ssmppl as ssm
from ssmppl.errors import ArgumentError
from ssmppl.inference.verbs.forecast import after
from ssmppl.results import save, to_inference_data
from tests.statistics.checks import LEVEL, seed_of

A, B, Q, R = 0.8, 0.5, 0.5, 0.4
CHAINS, DRAWS, ROWS, STEPS = 2, 10_000, 7, 5


def model(feedback=False):
    out = ssm.Model("autoregression", inputs=("u",))
    out.prior(lambda: {"a": ssm.Uniform(-1, 1), "b": ssm.Normal(0, sd=1)})
    out.initial(lambda: {"x": ssm.Normal(0.0, sd=1.0)})
    if feedback:
        out.transition(lambda y, u, a, b: {"x": ssm.Normal(a * y + b * u, sd=Q)})
    else:
        out.transition(lambda x, u, t, a, b: {"x": ssm.Normal(a * x + b * u + 0.1 * t, sd=Q)})
    out.observation(lambda x, u: {"y": ssm.Normal(x - u, sd=R)})
    return out


def made(*name, last=None, time=None, second=False):
    """A posterior whose parameters differ between chains, and its data. x_T is N(2, 0.3^2)."""
    rng = np.random.default_rng(seed_of("forecast", *name))
    x = rng.normal(2.0, 0.3, (CHAINS, DRAWS, ROWS))
    a = np.repeat([[A], [-A]], DRAWS, axis=1)
    y = rng.standard_normal(ROWS)
    if last is not None:
        y[-1] = last
    u, axis = np.linspace(-1, 1, ROWS), {}
    if second:  # of two experiments, the first of which has a row less
        x, y, u = (np.stack([np.zeros_like(v), v], axis=-2) for v in (x, y, u))
        axis = {
            "dims": {n: ["experiment", "time"] for n in "xyu"}, "coords": {"experiment": [1, 2]},
            "further": {"rows": (["experiment"], np.array([ROWS - 1, ROWS]), {})},
        }  # fmt: skip
    return to_inference_data(
        posterior={"a": a, "x": x}, over_time={"x"}, attrs={"fixed": {"b": B}}, time=time,
        observed_data={"y": y}, constant_data={"u": u}, **axis,
    )  # fmt: skip


FUTURE = np.array([0.3, -0.7, 2.0, 0.0, 1.0])


def agree(values, mean, variance, tests=40):
    n, limit = len(values), stats.norm.isf(LEVEL / (2 * tests))
    assert abs(values.mean() - mean) < limit * np.sqrt(variance / n)
    assert abs(values.var() - variance) < limit * variance * np.sqrt(2.0 / n)


@pytest.mark.parametrize("feedback", [False, True])
@pytest.mark.parametrize("seen", [0.6, np.nan])
def test_a_forecast_has_the_law_of_the_model(feedback, seen):
    """By the parameters of each chain, from x_T (or y_T, drawn where it is missing), driven by the
    last input of the data and then by the given ones; t goes on."""
    found = ssm.forecast(
        model(feedback), made(feedback, seen, last=seen), inputs={"u": FUTURE}, seed=1
    )
    assert dict(found.sizes) == {"draw": CHAINS * DRAWS, "time": STEPS}
    assert found["time"].values.tolist() == list(range(ROWS + 1, ROWS + STEPS + 1))
    for chain, a in enumerate((A, -A)):
        own = found.isel(draw=slice(chain * DRAWS, (chain + 1) * DRAWS))
        assert np.all(own["a"] == a)
        assert np.all(own["b"] == B)
        mean, variance = 2.0, 0.3**2
        if feedback:  # y_T
            known = np.isfinite(seen)
            mean, variance = (seen, 0.0) if known else (mean - 1.0, variance + R**2)
        before = [1.0, *FUTURE]
        for h in range(STEPS):
            mean = a * mean + B * before[h] + (0.0 if feedback else 0.1 * (ROWS + h))
            variance = a**2 * variance + Q**2
            agree(own["x"].values[:, h], mean, variance)
            agree(own["y"].values[:, h], mean - FUTURE[h], variance + R**2)
            if feedback:
                mean, variance = mean - FUTURE[h], variance + R**2


SPREADS = {
    "same": lambda x, a, u: np.array([[1.0, 0.9, 0.3], [0.9, 1.0, 0.2], [0.3, 0.2, 0.5]]),
    "by state, parameter, input": lambda x, a, u: np.array(  # x = 2 +- 0.3, a = +-A, u = 1
        [[1.0 + x**2, a * x, 0.0], [a * x, 1.0 + 0.5 * u, 0.4], [0.0, 0.4, 1.0]]
    ),
}


@pytest.mark.parametrize(
    "measured", [[False, True, True], [True, False, True], [False, True, False]]
)
@pytest.mark.parametrize("spread", SPREADS)
def test_what_is_missing_of_a_vector_is_drawn_given_the_rest(spread, measured):
    """The transition reads y_T, of which a part was measured: exact given x_T, theta and that."""
    covariance, measured = SPREADS[spread], np.array(measured)
    m = ssm.Model("partly", inputs=("u",))
    m.prior(lambda: {"a": ssm.Uniform(-1, 1)})
    m.initial(lambda: {"x": ssm.Normal(0.0, sd=1.0)})
    m.transition(lambda y: {"x": ssm.Normal(y[0] + 2.0 * y[1] - y[2], sd=Q)})
    m.observation(lambda x, a, u: {
        "z": ssm.Normal(x, sd=1.0),
        "y": ssm.MvNormal(np.stack([x, -x, a]), covariance=covariance(x, a, u)),
    })  # fmt: skip
    rng = np.random.default_rng(seed_of("partly", spread))
    x = rng.normal(2.0, 0.3, (CHAINS, DRAWS, ROWS))
    y = rng.normal(size=(ROWS, 3))
    y[-1] = np.where(measured, [2.5, -1.0, 0.7], np.nan)
    idata = to_inference_data(
        posterior={"a": np.repeat([[A], [-A]], DRAWS, axis=1), "x": x}, over_time={"x"},
        observed_data={"y": y, "z": np.full(ROWS, np.nan)},
        constant_data={"u": np.linspace(-1, 1, ROWS)},
    )  # fmt: skip
    seed = seed_of("partly", spread, measured)
    found = ssm.forecast(m, idata, inputs={"u": [0.0]}, seed=seed)["x"].values[:, 0]
    normal = []
    for value, last, a in zip(found, x[:, :, -1].ravel(), np.repeat([A, -A], DRAWS), strict=True):
        c, mean, w = (
            covariance(last, a, 1.0),
            np.array([last, -last, a]),
            np.array([1.0, 2.0, -1.0]),
        )
        gain = c[:, measured] @ np.linalg.inv(c[np.ix_(measured, measured)])
        middle = mean + gain @ (y[-1] - mean)[measured]
        rest = c - gain @ c[measured]
        normal.append((value - w @ middle) / np.sqrt(w @ rest @ w + Q**2))
    normal = np.array(normal)
    agree(normal, 0.0, 1.0)
    assert stats.kstest(normal, "norm").pvalue > LEVEL / 12


def test_the_same_seed_gives_the_same_draws():
    one, two, other = (
        ssm.forecast(model(), made(), inputs={"u": FUTURE}, seed=s) for s in (1, 1, 2)
    )
    assert one.equals(two)
    assert not one.equals(other)


def test_one_of_several_experiments():
    idata = made(second=True)
    found = ssm.forecast(model(), idata, inputs={"u": FUTURE}, experiment=2, seed=1)
    plain = ssm.forecast(model(), made(), inputs={"u": FUTURE}, seed=1)
    np.testing.assert_array_equal(found["y"], plain["y"])
    first = ssm.forecast(model(), idata, inputs={"u": FUTURE}, experiment=1, seed=1)
    assert first.attrs["after"] == ROWS - 1
    with pytest.raises(ArgumentError, match=r"experiment=3[\s\S]*experiment=1"):
        ssm.forecast(model(), idata, inputs={"u": FUTURE}, experiment=3)
    with pytest.raises(ArgumentError, match="leave experiment out"):
        ssm.forecast(model(), made(), inputs={"u": FUTURE}, experiment=3)


def test_days_of_a_market_go_on_without_weekends():
    """Holidays among them are no gaps in what was measured."""
    days = pd.bdate_range("2024-03-25", periods=14).delete([4, 5]) + pd.Timedelta(hours=16)
    found = after(days.to_numpy(), 3)
    assert found.astype("datetime64[h]").astype(str).tolist() == [
        "2024-04-12T16", "2024-04-15T16", "2024-04-16T16",
    ]  # fmt: skip
    with pytest.warns(UserWarning, match="not evenly spaced"):
        after(days.to_numpy()[:8], 1)  # a week has not shown


def test_time_goes_on():
    months = pd.date_range("2020-01-31", periods=4, freq="ME").to_numpy()
    assert after(months, 2).astype("datetime64[D]").astype(str).tolist() == [
        "2020-05-31", "2020-06-30",
    ]  # fmt: skip
    with pytest.warns(UserWarning, match="not evenly spaced(.|\n)*numbered on from 4"):
        assert after(np.delete(months, 1), 2).tolist() == [4, 5]
    np.testing.assert_allclose(after(np.array([0.0, 0.1, 0.2]), 2), [0.3, 0.4])
    assert after(np.arange(1871, 1971), 2).tolist() == [1971, 1972]
    assert after(np.array([1.0, 2.0, 5.0]), 2).tolist() == [4, 5]
    assert after(np.array(["a", "b"]), 2).tolist() == [3, 4]
    assert after(np.array([7]), 1).tolist() == [8]
    assert after(1e-9 * np.array([1.0, 2.0, 4.0]), 1).tolist() == [4]
    np.testing.assert_allclose(after(1.6e9 + 0.01 * np.arange(5), 1), [1.6e9 + 0.05], rtol=1e-15)
    hours = pd.timedelta_range("1h", periods=5, freq="90min").to_numpy()
    np.testing.assert_array_equal(after(hours[:3], 2), hours[3:])
    assert after(hours[[0, 1, 3]], 2).tolist() == [4, 5]
    assert after(hours[:1], 2).tolist() == [2, 3]
    found = ssm.forecast(model(), made(time=np.arange(1990, 1990 + ROWS)), inputs={"u": FUTURE})
    assert found["time"].values.tolist() == list(range(1997, 2002))


CLOCKS = {  # first date in Berlin, step, rows of the data: the clock is set between or after them
    "days into summer": ("2024-03-28", "D", 3), "days of summer": ("2024-03-30", "D", 4),
    "days into winter": ("2024-10-25", "D", 3), "weeks": ("2024-03-10 18:00", "W", 4),
    "months": ("2024-01-01", "MS", 3), "ends of months": ("2024-08-31", "ME", 4),
    "hours": ("2024-03-30 22:00", "h", 4), "half days": ("2024-03-30", "12h", 3),
}  # fmt: skip


@pytest.mark.parametrize("case", CLOCKS)
def test_days_and_months_are_those_of_the_zone(case):
    first, step, rows = CLOCKS[case]
    dates = pd.date_range(first, periods=rows + 6, freq=step, tz="Europe/Berlin")
    utc = dates.tz_convert(None).to_numpy()
    np.testing.assert_array_equal(after(utc[:rows], 6, "Europe/Berlin"), utc[rows:])


def test_an_hour_that_a_clock_leaves_out_or_has_twice():
    def local(day, steps):
        dates = pd.date_range(day, periods=3, freq="D", tz="Europe/Berlin").tz_convert(None)
        found = after(dates.to_numpy(), steps, "Europe/Berlin")
        there = pd.DatetimeIndex(found).tz_localize("UTC").tz_convert("Europe/Berlin")
        return there.strftime("%d %H:%M %z").tolist()

    assert local("2024-03-28 02:30", 2) == ["31 03:00 +0200", "01 02:30 +0200"]
    assert local("2024-10-24 02:30", 2) == ["27 02:30 +0200", "28 02:30 +0100"]


def test_a_zone_that_is_not_known_here_is_left_out():
    days = pd.date_range("2024-03-28", periods=3, freq="D").to_numpy()
    np.testing.assert_array_equal(after(days, 2, "Nowhere/Land"), after(days, 2))


@pytest.mark.parametrize("several", [False, True])
def test_the_zone_of_the_data_gets_to_the_forecast(several, tmp_path):
    """Through a posterior that was written and read; without it the days would end at 22:00."""
    level = ssm.Model("level")
    level.prior(lambda: {"q": ssm.Gamma(2, rate=2)})
    level.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    level.transition(lambda x, q: {"x": ssm.Normal(x, precision=q)})
    level.observation(lambda x: {"y": ssm.Normal(x, sd=0.5)})
    dates = pd.date_range("2024-03-29", periods=8, freq="D", tz="Europe/Berlin")
    table = pd.DataFrame({"y": [0.1, 0.5, 0.2, 0.4]}, index=dates[:4])
    plain = pd.DataFrame({"y": [0.1, 0.5, 0.2]})
    idata = ssm.sample(
        level, [plain, table] if several else table, draws=5, warmup=5, chains=1, seed=1,
        progress=False,
    )  # fmt: skip
    idata = az.from_netcdf(save(idata, tmp_path / "p.nc"))
    found = ssm.forecast(level, idata, 4, experiment=2 if several else None, seed=1)
    np.testing.assert_array_equal(found["time"], dates[4:].tz_convert(None).to_numpy())
    assert found.attrs["time_zones"] == '{"1": "Europe/Berlin"}'
    if several:
        found = ssm.forecast(level, idata, 2, experiment=1, seed=1)
        assert found["time"].values.tolist() == [4, 5]
        assert "time_zones" not in found.attrs


def test_what_cannot_be_continued_is_said():
    bare = to_inference_data(posterior={"a": np.zeros((1, 2)), "b": np.zeros((1, 2))})
    with pytest.raises(ArgumentError, match="states=True"):
        ssm.forecast(model(), bare, inputs={"u": FUTURE})
    with pytest.raises(ArgumentError, match="without a group `posterior`"):
        ssm.forecast(model(), {"a": 1.0}, inputs={"u": FUTURE})
    with pytest.raises(ArgumentError, match=r"estimate.parameters, steps, data=data\)$"):
        ssm.forecast(model(), None, inputs={"u": FUTURE})
    with pytest.raises(ArgumentError, match="no parameter 'b'"):
        ssm.forecast(model(), to_inference_data(posterior={"a": np.zeros((1, 2))}),
                     inputs={"u": FUTURE})  # fmt: skip
    with pytest.raises(ArgumentError, match="has inputs"):
        ssm.forecast(model(), made(), 3)


@pytest.mark.parametrize(
    ("time", "wrong", "right"),
    [
        (np.arange(ROWS) + 1.0, np.arange(5) + 1.0, np.arange(5) + ROWS + 1.0),
        (
            pd.date_range("2024-01-01", periods=ROWS), pd.date_range("2024-01-02", periods=5),
            pd.date_range("2025-01-01", periods=5),
        ),
    ],
)  # fmt: skip
def test_inputs_of_rows_of_the_data_drive_no_forecast(time, wrong, right):
    """Of all inputs, past and future, the first drove the first row ahead, under its own label."""
    with pytest.raises(ArgumentError, match=r"are not after the data\n.*rows after"):
        ssm.forecast(model(), made(time=np.asarray(time)), inputs={"u": FUTURE, "time": wrong})
    found = ssm.forecast(model(), made(time=np.asarray(time)), inputs={"u": FUTURE, "time": right})
    assert np.array_equal(found["time"].values, np.asarray(right))
    ssm.forecast(model(), made(time=np.asarray(time)), inputs={"u": FUTURE})


@pytest.mark.parametrize("proposal", [None, "laplace", "extended", "unscented"])
def test_at_known_parameters(proposal):
    """From the exact law of x_T of a linear model: by hand, with NumPy's Kalman filter."""
    u, y = np.linspace(-1, 1, ROWS), np.random.default_rng(seed_of("known")).standard_normal(ROWS)
    y[2] = np.nan
    mean, variance = 0.0, 1.0
    for t in range(ROWS):
        if t:
            mean, variance = A * mean + B * u[t - 1] + 0.1 * t, A**2 * variance + Q**2
        if np.isfinite(y[t]):
            gain = variance / (variance + R**2)
            mean, variance = mean + gain * (y[t] - mean + u[t]), (1 - gain) * variance
    found = ssm.forecast(
        model(), {"a": A, "b": B}, inputs={"u": FUTURE}, data={"y": y, "u": u}, seed=3,
        proposal=proposal, draws=20_000,
    )  # fmt: skip
    assert found.attrs.get("approximate", 0) == (proposal is not None)
    assert found.sizes["draw"] == 20_000
    before = u[-1]
    for h in range(STEPS):
        mean = A * mean + B * before + 0.1 * (ROWS + h)
        variance = A**2 * variance + Q**2
        agree(found["x"].values[:, h], mean, variance)
        agree(found["y"].values[:, h], mean - FUTURE[h], variance + R**2)
        before = FUTURE[h]


def test_an_estimate_is_known_parameters():
    drawn = ssm.simulate(model(), {"a": A, "b": B}, inputs={"u": np.ones(30)}, seed=1)
    data = [{"y": drawn["y"].values[0], "u": np.ones(30)}, {"y": [0.1, 0.2], "u": [1.0, 1.0]}]
    estimate = ssm.maximize(model(), data, progress=False)
    inputs = {"u": np.ones(2)}
    of_second = ssm.forecast(model(), estimate, inputs=inputs, data=data, experiment=2, seed=1)
    assert of_second.attrs["after"] == 2
    assert of_second["a"].values[0] == estimate.parameters["a"]
    with pytest.raises(ArgumentError, match="experiment=3, and the data are of"):
        ssm.forecast(model(), estimate, inputs=inputs, data=data, experiment=3)
    every = ssm.forecast(model(), estimate, inputs=inputs, data=data, seed=1)
    assert every["y"].dims == ("draw", "experiment", "time")
    assert every["after"].values.tolist() == [30, 2]
    with pytest.raises(ArgumentError, match="needs the data"):
        ssm.forecast(model(), estimate, inputs=inputs, proposal="laplace")
    with pytest.raises(ArgumentError, match="which is no parameters"):
        ssm.forecast(model(), 3.0, inputs=inputs, data=data)


@pytest.mark.parametrize("first", ["2017-01-31", "2030-01-31"])
def test_inputs_of_other_rows_than_those_that_follow_are_noticed(first, recwarn):
    driven = ssm.Model("driven", inputs=("u",))
    driven.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    driven.transition(lambda x, u: {"x": ssm.Normal(0.9 * x + u, sd=0.3)})
    driven.observation(lambda x: {"y": ssm.Normal(x, sd=0.4)})
    months = pd.date_range("2015-01-31", periods=24, freq="ME")
    data = pd.DataFrame({"y": np.zeros(24), "u": 0.1}, index=months)
    to_come = pd.DataFrame({"u": np.ones(3)}, index=pd.date_range(first, periods=3, freq="ME"))
    ssm.forecast(driven, {}, inputs=to_come, data=data, seed=1)
    said = [str(w.message) for w in recwarn]
    if first == "2017-01-31":
        assert not said
    else:
        assert "2030-01-31 to 2030-03-31, and the rows after the data are 2017-01-31 to" in said[0]
