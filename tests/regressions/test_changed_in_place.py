"""What laws read in some way other than by an attribute's name, changed between two verbs."""

import collections
import dataclasses
import operator
import types

import numpy as np
import pandas as pd
import pytest
import scipy.interpolate
import scipy.sparse
import xarray as xr

import ssmppl as ssm
from ssmppl.language.tracing import trace


@dataclasses.dataclass
class Config:
    gain: float = 1.0
    results: list = dataclasses.field(default_factory=list)


class Slotted:
    __slots__ = ("gain",)

    def __init__(self):
        self.gain = 1.0


class Table:
    """Read by special methods."""

    def __init__(self):
        self.values = {"gain": 1.0}

    def __getitem__(self, key):
        return self.values[key]

    def __iter__(self):
        return iter(self.values.values())

    def __float__(self):
        return self.values["gain"]

    def __mul__(self, other):
        return self.values["gain"] * other


class Bunch:
    def __init__(self):
        self.__dict__["_own"] = {"gain": 1.0}

    def __getattr__(self, name):
        return self.__dict__["_own"][name]  # a KeyError for what is not there


class Attributes(dict):
    __getattr__ = dict.__getitem__
    __setattr__ = dict.__setitem__


class Numbers(list):
    gain = 1.0


class Gain:
    def __init__(self):
        self.kept = 1.0

    def __get__(self, instance, owner):
        return self.kept


class Described:
    def __init__(self):
        self.own = type("Own", (), {"gain": Gain()})()


def gain_of(thing):
    return thing.gain


def function_with_attribute():
    def function():
        return None

    function.gain = 1.0
    return function


def set_gain(thing):
    thing.gain = 5.0


def set_item(key="gain"):
    return lambda thing: operator.setitem(thing, key, 5.0)


def of_table(thing):
    thing.values["gain"] = 5.0


SHARED = {"gain": 1.0}
CUBIC = scipy.interpolate.CubicSpline
WAYS = {  # what is made, how a law reads 1 of it, and how it becomes 5
    "argument of a helper": (Config, gain_of, set_gain),
    "astuple": (Config, lambda c: dataclasses.astuple(c)[0], set_gain),
    "asdict": (Config, lambda c: dataclasses.asdict(c)["g" + "ain"], set_gain),
    "vars": (Config, lambda c: next(iter(vars(c).values())), set_gain),
    "attrgetter": (Config, lambda c: operator.attrgetter("ga" + "in")(c), set_gain),
    "slots": (Slotted, lambda c: getattr(c, "GAIN".lower()), set_gain),
    "item": (Table, lambda t: t["gain"], of_table),
    "loop": (Table, sum, of_table),
    "number": (Table, float, of_table),
    "product": (Table, lambda t: t * 1.0, of_table),
    "other attribute": (Bunch, lambda b: b.gain, lambda b: b._own.update(gain=5.0)),
    "dictionary's attribute": (lambda: Attributes(gain=1.0), lambda a: a.gain, set_gain),
    "list's attribute": (Numbers, lambda n: n.gain, set_gain),
    "function's attribute": (function_with_attribute, lambda f: f.gain, set_gain),
    "descriptor": (
        Described,
        lambda d: d.own.gain,
        lambda d: setattr(vars(type(d.own))["gain"], "kept", 5.0),
    ),
    "Series": (lambda: pd.Series({"gain": 1.0}), lambda s: s["gain"], set_item()),
    "values": (lambda: pd.Series({"gain": 1.0}), lambda s: s.values[0], set_item()),
    "DataFrame": (
        lambda: pd.DataFrame({"gain": [1.0]}),
        lambda f: f["gain"].iloc[0],
        lambda f: operator.setitem(f.loc, (0, "gain"), 5.0),
    ),
    "DataArray": (lambda: xr.DataArray([1.0]), lambda a: float(a[0]), set_item(0)),
    "Dataset": (lambda: xr.Dataset({"gain": 1.0}), lambda d: float(d.gain), set_item()),
    "sparse": (
        lambda: scipy.sparse.csr_array([[1.0]]), lambda m: m[0, 0],
        lambda m: operator.setitem(m.data, 0, 5.0),
    ),
    "spline": (
        lambda: CUBIC([0.0, 1.0], [1.0, 1.0]), lambda s: float(s(0.0)),
        lambda s: operator.setitem(s.c, (3, 0), 5.0),
    ),
    "polynomial": (
        lambda: np.polynomial.Polynomial([1.0, 0.0]), lambda p: p(1.0),
        lambda p: operator.setitem(p.coef, 0, 5.0),
    ),
    "deque": (lambda: collections.deque([1.0]), lambda d: d[0], set_item(0)),
    "ChainMap": (lambda: collections.ChainMap({"gain": 1.0}), lambda c: c["gain"], set_item()),
    "proxy": (
        lambda: types.MappingProxyType(SHARED), lambda p: p["gain"],
        lambda p: SHARED.update(gain=5.0),
    ),
    "memoryview": (lambda: memoryview(np.array([1.0])), lambda m: m[0], set_item(0)),
}  # fmt: skip


@pytest.mark.parametrize("way", WAYS)
def test_what_a_law_reads_is_read_again_where_it_changed_in_place(way):
    make, read, change = WAYS[way]
    thing = make()
    model = ssm.Model("read")
    model.initial(lambda: {"x": ssm.Normal(read(thing), sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(x, sd=1)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=1)})

    def mean():
        location, *_ = trace(model).initial["x"].distribution.parameters.values()
        return repr(location.ravel()[0])

    first = trace(model)
    assert mean() == "1"
    assert trace(model) is first  # for as long as nothing changed
    change(thing)
    assert mean() == "5"


def test_what_no_law_reads_of_an_object_changes_nothing():
    config = Config()
    model = ssm.Model("named")
    model.initial(lambda: {"x": ssm.Normal(gain_of(config), sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(x, sd=1)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=1)})
    first = trace(model)
    config.results.append(3.0)
    assert trace(model) is first
