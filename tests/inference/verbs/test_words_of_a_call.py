"""What a call is told that has a word or a value wrong: by ssmppl, with a fix that can be done."""

import numpy as np
import pandas as pd
import pytest
import xarray as xr

import ssmppl as ssm

Y = {"y": [0.1, 0.2, -0.3]}


def walk(width=None):
    model = ssm.Model("walk")
    zero = 0.0 if width is None else np.zeros(width)
    model.prior(lambda: {"q": ssm.InverseGamma(3, scale=1)})
    model.initial(lambda: {"x": ssm.Normal(zero, sd=1)})
    model.transition(lambda x, q: {"x": ssm.Normal(x, variance=q)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=1)})
    return model


FILTERS = [
    ssm.kalman_filter,
    lambda *a, **k: ssm.particle_filter(*a, proposal="bootstrap", particles=10, **k),
    ssm.smooth,
]


@pytest.mark.parametrize("verb", FILTERS)
@pytest.mark.parametrize("quantiles", [None, "0.5", ["a"], 1.0, [0.0], [[0.1], [0.9]], 0.5 + 0j])
def test_levels_that_are_none_are_refused_by_name(verb, quantiles):
    with pytest.raises(ssm.ArgumentError, match=r"quantiles=.*\n.*between 0 and 1"):
        verb(walk(), Y, {"q": 1.0}, quantiles=quantiles)


def test_a_single_level_is_a_number():
    one, many = (
        ssm.kalman_filter(walk(), Y, {"q": 1.0}, quantiles=q)["x_quantile"] for q in (0.5, [0.5])
    )
    np.testing.assert_array_equal(one, many)
    np.testing.assert_array_equal(one.squeeze(), ssm.kalman_filter(walk(), Y, {"q": 1.0})["x"][0])


EXECUTED = {
    "log_likelihood": lambda **k: ssm.log_likelihood(walk(), Y, {"q": 1.0}, **k),
    "particle_filter": lambda **k: ssm.particle_filter(
        walk(), Y, {"q": 1.0}, proposal="bootstrap", **k
    ),
    "score": lambda **k: ssm.score(walk(), Y, {"q": 1.0}, **k),
    "sample": lambda **k: ssm.sample(walk(), Y, **k),
    "maximize": lambda **k: ssm.maximize(walk(), Y, **k),
    "evidence": lambda **k: ssm.evidence(walk(), Y, **k),
    "leave_future_out": lambda **k: ssm.leave_future_out(walk(), Y, **k),
    "diagnose": lambda **k: ssm.diagnose(walk(), Y, **k),
}


@pytest.mark.parametrize("verb", EXECUTED)
@pytest.mark.parametrize("executor", [4, "threads", dict])
def test_what_is_no_executor_is_refused_by_exact_models_too(verb, executor):
    with pytest.raises(ssm.ArgumentError, match=r"executor=.* is no .*Executor\n"):
        EXECUTED[verb](executor=executor)


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("emission", "@model.observation"),
        ("measurement", "@model.observation"),
        ("dynamics", "@model.transition"),
        ("priro", "@model.prior"),
        ("sample", r"ssm.sample\(model, ...\)"),
        ("log_likelihod", r"ssm.log_likelihood\(model, ...\)"),
        ("zzz", "decorators are prior, initial"),
    ],
)
def test_a_name_that_a_model_does_not_have(name, told):
    model = ssm.Model("empty")
    with pytest.raises(ssm.ModelError, match=rf"no {name!r}\nFix: .*{told}") as error:
        getattr(model, name)
    assert __file__ in str(error.value)
    assert not hasattr(model, name)
    with pytest.raises(AttributeError):
        model._anything  # noqa: B018


def test_verbs_of_models_exist():
    from ssmppl.language.model.model import VERBS

    assert all(hasattr(ssm, verb) for verb in VERBS)


def test_filter_is_told_as_a_filter():
    with pytest.raises(AttributeError, match=r"ssm\.particle_filter"):
        ssm.filter  # noqa: B018


@pytest.mark.parametrize("columns", [["y0", "y1"], pd.MultiIndex.from_product([["a"], ["y", "z"]])])
def test_columns_of_a_vector_are_named(columns):
    with pytest.raises(ssm.DataError, match=r"needed are y_0, y_1\n.*rename to y_0, y_1 those"):
        ssm.kalman_filter(walk(2), pd.DataFrame(np.ones((3, 2)), columns=columns), {"q": 1.0})


def test_predict_looks_at_its_arguments_in_their_order():
    with pytest.raises(ssm.ArgumentError, match=r"idata is dict.*\n.*predict\(model, None, data\)"):
        ssm.predict(walk(), Y)
    with pytest.raises(ssm.ArgumentError, match="neither data nor steps"):
        ssm.predict(walk())
    idata = ssm.sample(walk(), Y, draws=4, warmup=4, chains=1, seed=1, progress=False)
    with pytest.raises(ssm.ArgumentError, match="neither data nor steps"):
        ssm.predict(walk(), idata)


def test_a_surface_needs_two_parameters():
    with pytest.raises(ssm.ArgumentError, match=r"the model has 1\n.*log_likelihood"):
        ssm.plot_likelihood(walk(), Y)


@pytest.mark.parametrize(
    ("data", "told", "fix"),
    [
        (pd.Series([1.0, 2.0], name="z"), "Series, one variable named 'z'", "{'y': data}"),
        (xr.DataArray([1.0, 2.0], dims="time", name="z"), "DataArray", "{'y': data}"),
        (pd.Series([1.0, 2.0]), "Series, one variable", "{'y': data}"),
        (xr.Dataset({"y": ("t", [1.0, 2.0])}), "are: t", "data.rename({'t': 'time'})"),
    ],
)
def test_fixes_of_data_can_be_done(data, told, fix):
    with pytest.raises(ssm.DataError, match=told) as error:
        ssm.kalman_filter(walk(), data, {"q": 1.0})
    assert str(error.value).endswith(fix)
    fixed = eval(fix, {"data": data})
    assert ssm.kalman_filter(walk(), fixed, {"q": 1.0}).sizes["time"] == 2


@pytest.mark.parametrize(
    "data",
    [
        pd.Series([1.0, 2.0], name="y", index=pd.Index([3.0, 4.0], name="time")),
        xr.DataArray([1.0, 2.0], dims="time", name="y", coords={"time": [3.0, 4.0]}),
    ],
    ids=["Series", "DataArray"],
)
def test_a_series_is_known_by_its_name(data):
    found = ssm.kalman_filter(walk(), data, {"q": 1.0})
    np.testing.assert_array_equal(found["time"], [3.0, 4.0])


def test_arrays_in_a_fix_are_python():
    with pytest.raises(ssm.ModelError, match=r"write MvNormal\(mean, covariance=...\)"):
        ssm.MvNormal(np.zeros(2), np.eye(2))
