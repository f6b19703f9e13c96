"""Draws past the data: their exact law in a linear model, their inputs, their time."""

import numpy as np
import pandas as pd
import pytest
from scipy import stats

import ssmppl as ssm
from ssmppl.errors import ArgumentError
from ssmppl.inference.forecast import after
from ssmppl.results import to_inference_data
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


def made(*name, last=None, time=None, mark=""):
    """A posterior whose parameters differ between chains, and its data. x_T is N(2, 0.3^2)."""
    rng = np.random.default_rng(seed_of("forecast", *name))
    x = rng.normal(2.0, 0.3, (CHAINS, DRAWS, ROWS))
    a = np.repeat([[A], [-A]], DRAWS, axis=1)
    y = rng.standard_normal(ROWS)
    if last is not None:
        y[-1] = last
    axis = {"dims": {f"{n}{mark}": [f"time{mark}"] for n in "xyu"}} if mark else {}
    return to_inference_data(
        posterior={"a": a, f"x{mark}": x}, over_time={"x"}, attrs={"fixed": {"b": B}}, time=time,
        observed_data={f"y{mark}": y}, constant_data={f"u{mark}": np.linspace(-1, 1, ROWS)}, **axis,
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


def test_the_same_seed_gives_the_same_draws():
    one, two, other = (
        ssm.forecast(model(), made(), inputs={"u": FUTURE}, seed=s) for s in (1, 1, 2)
    )
    assert one.equals(two)
    assert not one.equals(other)


def test_one_of_several_experiments():
    idata = made(mark="_2")
    found = ssm.forecast(model(), idata, inputs={"u": FUTURE}, experiment=2, seed=1)
    plain = ssm.forecast(model(), made(), inputs={"u": FUTURE}, seed=1)
    np.testing.assert_array_equal(found["y"], plain["y"])
    with pytest.raises(ArgumentError, match=r"experiment=None[\s\S]*experiment=2"):
        ssm.forecast(model(), idata, inputs={"u": FUTURE})
    with pytest.raises(ArgumentError, match="leave experiment out"):
        ssm.forecast(model(), made(), inputs={"u": FUTURE}, experiment=3)


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
    found = ssm.forecast(model(), made(time=np.arange(1990, 1990 + ROWS)), inputs={"u": FUTURE})
    assert found["time"].values.tolist() == list(range(1997, 2002))


def test_what_cannot_be_continued_is_said():
    bare = to_inference_data(posterior={"a": np.zeros((1, 2)), "b": np.zeros((1, 2))})
    with pytest.raises(ArgumentError, match="states=True"):
        ssm.forecast(model(), bare, inputs={"u": FUTURE})
    with pytest.raises(ArgumentError, match="without a group `posterior`"):
        ssm.forecast(model(), {"a": 1.0}, inputs={"u": FUTURE})
    with pytest.raises(ArgumentError, match=r"fixed=estimate.parameters, warmup=0\)$"):
        ssm.forecast(model(), None, inputs={"u": FUTURE})
    with pytest.raises(ArgumentError, match="no parameter 'b'"):
        ssm.forecast(model(), to_inference_data(posterior={"a": np.zeros((1, 2))}),
                     inputs={"u": FUTURE})  # fmt: skip
    with pytest.raises(ArgumentError, match="has inputs"):
        ssm.forecast(model(), made(), 3)
