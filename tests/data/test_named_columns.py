"""Tables whose columns are the labels of a vector's components: taken by their names."""

import numpy as np
import pandas as pd
import pytest
import xarray as xr

import ssmppl as ssm
from ssmppl.errors import DataError
from tests.statistics.checks import seed_of

SERIES = ["gdp", "ip", "hours"]
LOADING = np.array([1.0, 0.3, -0.7])
Y = np.random.default_rng(seed_of("columns")).normal(size=(6, 3))
FRAME = pd.DataFrame(Y, columns=SERIES)


def factor(coords=None):
    labels = {} if coords is None else {"coords": {"series": coords}}
    model = ssm.Model("factor", dims={"y": ["series"]}, **labels)
    model.initial(lambda: {"f": ssm.Normal(0, sd=1)})
    model.transition(lambda f: {"f": ssm.Normal(0.8 * f, sd=1)})
    model.observation(lambda f: {"y": ssm.Normal(LOADING * f, sd=0.5)})
    return model


def value(data, coords=SERIES):
    return ssm.log_likelihood(factor(coords), data, {})[0]


RIGHT = value({"y": Y})
OTHERWISE = FRAME[SERIES[::-1]]


@pytest.mark.parametrize(
    "data",
    [
        {"y": FRAME},
        {"y": OTHERWISE},
        {"y": OTHERWISE.assign(other=1.0)},
        OTHERWISE,
        OTHERWISE.add_prefix("y_"),
        OTHERWISE.rename(columns=lambda c: f"y[{c}]"),
        xr.Dataset({"y": (("time", "series"), OTHERWISE.values)}, {"series": SERIES[::-1]}),
        xr.Dataset({"y": (("time", "series"), Y)}),
        pd.DataFrame(Y, columns=["y_0", "y_1", "y_2"]),
    ],
    ids=range(9),
)
def test_columns_go_by_their_names_whatever_their_order(data):
    assert value(data) == RIGHT


def test_a_component_may_be_called_as_the_channel():
    names = ["gdp", "y", "hours"]
    frame = pd.DataFrame(Y, columns=names)
    assert value(frame[["y", "hours", "gdp"]], names) == RIGHT
    assert value({"y": Y}, names) == RIGHT


def test_names_that_are_no_labels_stand_for_their_places():
    other = FRAME.rename(columns=dict(zip(SERIES, "abc", strict=True)))
    assert value({"y": other}) == RIGHT
    assert value({"y": OTHERWISE}, None) != RIGHT  # the model has no labels


def test_labels_that_are_not_all_there_are_refused():
    with pytest.raises(DataError) as error:
        value({"y": OTHERWISE.rename(columns={"ip": "IP"})})
    assert "are hours, IP, gdp, and its components gdp, ip, hours" in error.value.found
    with pytest.raises(DataError) as error:
        value(OTHERWISE.rename(columns={"ip": "IP"}))
    assert "lacks its component 'ip'; needed are gdp, ip, hours" in error.value.found


def test_columns_are_listed_in_their_order():
    with pytest.raises(DataError) as error:
        value(OTHERWISE.rename(columns=dict(zip(SERIES, "cab", strict=True))))
    assert "in their order: b, a, c; rename to gdp, ip, hours" in error.value.fix
