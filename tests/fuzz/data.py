"""Random data and parameters for a model: plain ones, and what people hand over by mistake."""

from __future__ import annotations

import datetime
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from tests.fuzz.models import BINARY, COUNT, LABEL, POSITIVE, REAL, UNIT, Recipe

ODD = (
    np.nan, np.inf, -np.inf, 0.0, -0.0, -1.0, 1e308, -1e308, 5e-324, 1e-300, 1e16, 0.5, 1.0,
    2.0**63,
)  # fmt: skip


def values(rng: np.random.Generator, support: str, shape: tuple[int, ...]) -> np.ndarray:
    """Ordinary values of a support."""
    draw = {
        REAL: lambda: rng.normal(size=shape), POSITIVE: lambda: rng.gamma(2.0, size=shape),
        UNIT: lambda: rng.uniform(0.01, 0.99, size=shape),
        COUNT: lambda: rng.integers(0, 7, size=shape).astype(float),
        BINARY: lambda: rng.integers(0, 2, size=shape).astype(float),
        LABEL: lambda: rng.integers(0, 3, size=shape).astype(float),
    }  # fmt: skip
    return np.asarray(draw[support]())


def random_data(rng: np.random.Generator, recipe: Recipe, odd: float) -> tuple[Any, bool]:
    """A data set (or several) of the model, and whether it is an ordinary one.

    odd : probability that something about it is not ordinary.
    """
    if rng.random() < 0.06:
        sets = [random_data(rng, recipe, odd / 2) for _ in range(rng.integers(1, 4))]
        return [d for d, _ in sets], all(plain for _, plain in sets)
    steps = int(rng.choice([1, 2, 3, 5, 8, 12, 12, 20]))
    columns: dict[str, Any] = {}
    for name, (support, shape) in recipe.channels.items():
        columns[name] = values(rng, support, (steps, *shape))
        if rng.random() < 0.25:
            columns[name] = columns[name].astype(float)
            columns[name][rng.random(steps) < rng.choice([0.1, 0.5, 1.0])] = np.nan
    for name, length in recipe.inputs.items():
        columns[name] = rng.normal(size=(steps, length) if length > 1 else steps)
    if rng.random() < odd:
        return _odd(rng, columns, steps), False
    if rng.random() < 0.3:
        scalars = all(np.ndim(v) == 1 for v in columns.values())
        return pd.DataFrame(columns) if scalars else _as_dataset(columns), True
    return columns, True


def _as_dataset(columns: dict[str, Any]) -> xr.Dataset:
    return xr.Dataset({
        n: (["time", *(f"{n}_{i}" for i in range(1, np.ndim(v)))], v) for n, v in columns.items()
    })  # fmt: skip


def _odd(rng: np.random.Generator, columns: dict[str, Any], steps: int) -> Any:
    """One thing is wrong, or at least unusual."""
    name = str(rng.choice(list(columns)))
    v = np.asarray(columns[name])
    at = rng.integers(steps)
    change = {
        "value": lambda: _set(v, at, rng.choice(ODD)),
        "values": lambda: np.where(rng.random(v.shape) < 0.3, rng.choice(ODD), v),
        "constant": lambda: np.full(v.shape, rng.choice([0.0, 1.0, -3.0, 1e10])),
        "large": lambda: v * 10.0 ** rng.integers(3, 200),
        "integers": lambda: np.nan_to_num(v).astype(rng.choice(["i1", "i8", "u2", "?"])),
        "single": lambda: v.astype("f4"), "big end first": lambda: v.astype(">f8"),
        "halves": lambda: v.astype("f2"), "complex": lambda: v + 1j * rng.integers(0, 2),
        "objects": lambda: _set(v.astype(object), at, rng.choice(np.array(["", "NA", "a", None]))),
        "strings": lambda: v.astype(str), "bytes": lambda: v.astype("S"),
        "list": lambda: v.tolist(), "tuple": lambda: tuple(v.tolist()),
        "ragged": lambda: [*v.tolist()[:-1], [1.0, 2.0]],
        "scalar": lambda: float(np.nanmax(v, initial=0.0)),
        "None": lambda: None, "text": lambda: "y.csv", "short": lambda: v[:-1],
        "empty": lambda: v[:0], "column": lambda: v.reshape(steps, -1, 1),
        "wide": lambda: np.repeat(v.reshape(steps, -1), 2, axis=1), "row": lambda: v[None],
        "strided": lambda: np.repeat(v, 2, axis=0)[::2], "backwards": lambda: v[::-1],
        "frozen": lambda: _frozen(v),
        "masked": lambda: np.ma.masked_where(rng.random(v.shape) < 0.3, v),
        "dates": lambda: np.arange(steps).astype("M8[D]"),
        "delays": lambda: np.arange(steps).astype("m8[s]"),
        "series": lambda: pd.Series(v.reshape(steps, -1)[:, 0], index=rng.integers(0, 3, steps)),
        "array of xarray": lambda: xr.DataArray(v), "generator": lambda: (x for x in v),
        "set": lambda: {1.0, 2.0}, "function": lambda: len, "range": lambda: range(steps),
        "decimal": lambda: [datetime.date(2020, 1, 1)] * steps,
        "nullable": lambda: pd.array([None, *np.zeros(steps - 1)], dtype="Float64"),
        "category": lambda: pd.Categorical(["a"] * steps),
    }  # fmt: skip
    whole = {
        "missing column": lambda: {n: c for n, c in columns.items() if n != name},
        "another column": lambda: {**columns, "weather": np.zeros(steps)},
        "a name in capitals": lambda: {n.upper(): c for n, c in columns.items()},
        "nothing": dict, "None": lambda: None, "no mapping": lambda: v,
        "a path": lambda: "data.csv", "pairs": lambda: list(columns.items()),
        "a nested mapping": lambda: {"data": columns}, "an empty list": list,
        "a list of None": lambda: [None],
        "numbers as names": lambda: dict(enumerate(columns.values())),
        "frame": lambda: _frame(rng, columns, steps),
        "time": lambda: {**columns, "time": _time(rng, steps)}, "number": lambda: 3.0,
    }  # fmt: skip
    if rng.random() < 0.3:
        return whole[str(rng.choice(list(whole)))]()
    return {**columns, name: change[str(rng.choice(list(change)))]()}


def _set(v: np.ndarray, at: int, value: Any) -> np.ndarray:
    out = v.copy()
    out[at] = value
    return out


def _frozen(v: np.ndarray) -> np.ndarray:
    out = v.copy()
    out.flags.writeable = False
    return out


def _time(rng: np.random.Generator, steps: int) -> Any:
    days = np.datetime64("2020-01-01") + np.arange(steps)
    kinds = (
        days, days[::-1], np.repeat(days[:1], steps), np.arange(steps), -np.arange(steps) / 3,
        ["a"] * steps, np.full(steps, np.nan), days[:-1], rng.permutation(steps), None,
    )  # fmt: skip
    return kinds[rng.integers(len(kinds))]


def _frame(rng: np.random.Generator, columns: dict[str, Any], steps: int) -> pd.DataFrame:
    """A table with an index as tables have them."""
    table = pd.DataFrame({n: np.asarray(c).reshape(steps, -1)[:, 0] for n, c in columns.items()})
    days = pd.date_range("2021-03-01", periods=steps, freq="D")
    kinds = (
        days, days[::-1], days.repeat(steps)[:steps], pd.Index(["r"] * steps),
        pd.MultiIndex.from_product([[1], range(steps)]), rng.permutation(steps),
        days.tz_localize("Europe/Stockholm"), pd.PeriodIndex(days, freq="D"),
    )  # fmt: skip
    table.index = pd.Index(kinds[rng.integers(len(kinds))])
    if rng.random() < 0.3:
        table = pd.concat([table, table], axis=1)  # each name twice
    return table


def random_parameters(rng: np.random.Generator, recipe: Recipe, odd: float) -> Any:
    """Values of the parameters, ordinary ones or not."""
    given: dict[str, Any] = {
        name: values(rng, support, shape) if shape else float(values(rng, support, ()))
        for name, (support, shape) in recipe.parameters.items()
    }
    if rng.random() >= odd:
        return given
    name = str(rng.choice([*given, "p0"]))
    shape = recipe.parameters.get(name, ("", ()))[1]
    change = (
        lambda: {**given, name: np.full(shape, rng.choice(ODD))[()]},
        lambda: {n: v for n, v in given.items() if n != name},
        lambda: {**given, "zeta": 1.0}, lambda: {**given, name: "0.5"},
        lambda: {**given, name: None}, lambda: {**given, name: True},
        lambda: {**given, name: np.ones((2, 2))}, lambda: {**given, name: [0.5]},
        lambda: {**given, name: 1 + 2j}, lambda: {**given, name: 10**400}, lambda: None, list,
        lambda: 0.5, lambda: list(given.values()),
        lambda: {**given, name: np.float32(0.5)}, lambda: {**given, name: np.array(0.5)},
        lambda: {k: np.array([v, v]) for k, v in given.items()}, lambda: {1: 2.0},
        lambda: {**given, name: {"value": 1.0}}, lambda: pd.Series(given, dtype=object),
    )  # fmt: skip
    return change[rng.integers(len(change))]()
