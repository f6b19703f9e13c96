"""Data sets bound to a traced model: arrays over its observation and input symbols.

Rules of the language for data: x_1 and y_1 belong to the first row; NaN in an observation is a
missing value, per component; NaN in an input is an error; an observation that a transition names
must be there. A channel may be missing in every row (a column of NaN), but not be left out.
Columns that the model does not name are ignored, so that a whole table or the Dataset of
`simulate` can be passed as it is.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from ssmppl.counts import check_count
from ssmppl.data.channels import channel, holds
from ssmppl.data.defined import check_defined
from ssmppl.data.parameters import pack
from ssmppl.data.per_experiment import experiment_number
from ssmppl.data.sources import Source, sources
from ssmppl.data.time_steps import with_time_step
from ssmppl.data.values import name_of, number, outside
from ssmppl.errors import ArgumentError, DataError
from ssmppl.expressions.expr import Expr, symbol, symbols_of
from ssmppl.language.distributions.base import Support
from ssmppl.language.distributions.multivariate import Centred
from ssmppl.language.model.trace import EXPERIMENT_NUMBER, Site, Trace


@dataclass(frozen=True)
class Experiment:
    """One data set as the kernels take it: T rows, K observed components, U inputs.

    y : (T, K) over `trace.observation_symbols`, 0.0 where missing.
    seen : (T, K), 1.0 where y was measured and 0.0 where it is missing.
    u : (T, U) over `trace.input_symbols`.
    time : labels of the rows, None where the data have none.
    partial : names of channels that are partly measured in some row.
    observed, inputs : by name, in the user's shapes (T, ...), NaN for missing.
    zone : name of the zone that the labels, in UTC, were given in; empty where there is none.
    label : what the user calls the experiment; None where it has no name.
    """

    y: np.ndarray
    seen: np.ndarray
    u: np.ndarray
    time: np.ndarray | None
    steps: int
    partial: frozenset[str]
    observed: dict[str, np.ndarray]
    inputs: dict[str, np.ndarray]
    zone: str = ""
    label: Any = None


def bind(
    trace: Trace, data: Any, *, need_observations: bool = True, steps: int | None = None
) -> list[Experiment]:
    """The data sets in `data`, each as an `Experiment`.

    Parameters
    ----------
    data : mapping of arrays, pandas DataFrame, xarray Dataset; a list or a dictionary of those, a
        table with the model's column `experiment`, or a Dataset with that dim.
    need_observations : False where channels may be left out (predictions): all missing then.
    steps : number of rows, where there is nothing in `data` to tell it, or to check it by.

    Raises
    ------
    DataError : the data do not fit the model; names data set, variable, row and column.
    """
    if steps is not None:
        check_count("steps", steps, 1)
    if data is None and not need_observations:
        data = {}
    named = [*trace.observations, *trace.inputs]
    common = _Common(
        {n: site.distribution.support() for n, site in trace.observations.items()},
        tuple(_needed(trace)),
    )
    given = [with_time_step(trace, s) for s in sources(data, named, by=trace.experiment)]
    return [
        _bind(trace, s, need_observations, steps, common, experiment_number(trace, s, k))
        for k, s in enumerate(given)
    ]


def unread(trace: Trace, data: Any) -> dict[str, Any]:
    """The columns, with what the first data set has in them, that neither are named as an
    observation or input of the model nor begin with such a name and `[` or `_`, as the components
    of vectors do."""
    named = [*trace.observations, *trace.inputs]
    columns = dict[str, Any]()
    for source in sources(data, named, by=trace.experiment):
        columns = {str(c): values for c, values in source.columns.items()} | columns
    parts = tuple(f"{n}{mark}" for n in named for mark in "[_")
    return {
        c: values for c, values in columns.items()
        if c not in (*named, "time") and not c.startswith(parts)
    }  # fmt: skip


def bind_inputs(
    trace: Trace, inputs: Any, steps: int | None, number: float = 0.0
) -> tuple[np.ndarray, int, Source]:
    """Inputs of a simulation: u (T, U), T, and where they are from, with the labels of the rows.

    `inputs` is None or {} for a model without inputs, which needs `steps`; otherwise a data set,
    whose number of rows is `steps` unless both are given, and then they must agree. `number` is
    that of the experiment, where parameters are of each.
    """
    if steps is not None:
        check_count("steps", steps, 1)
    if inputs is None:
        if trace.given_inputs:
            names = ", ".join(f"{n!r}: ..." for n in _to_give(trace))
            raise ArgumentError(
                f"the model {trace.name!r} has inputs, and none were given",
                fix=f"pass inputs={{{names}}}, one row for each step",
            )
        inputs = {}
    elif not trace.given_inputs and isinstance(inputs, dict) and set(inputs) - {"time"}:
        raise ArgumentError(
            f"inputs gives {', '.join(map(repr, inputs))}, but the model {trace.name!r} declares "
            "no inputs",
            fix=f"declare them, ssm.Model({trace.name!r}, inputs=({next(iter(inputs))!r},))",
        )
    found = sources(inputs, trace.given_inputs, argument="inputs")
    if len(found) > 1:
        raise ArgumentError(
            f"inputs is a list of {len(found)} data sets",
            fix="simulate one experiment at a time",
        )
    if steps is None and not trace.given_inputs and found[0].time is None:
        raise ArgumentError(
            "neither steps nor inputs tell how many rows to simulate", fix="pass steps=100"
        )
    (source,) = found
    source = with_time_step(trace, source)
    values = {n: channel(source, n, shape, "input", trace.component_names.labels(n))
              for n, shape in trace.given_inputs.items()}  # fmt: skip
    rows = _rows(source, values, steps)
    _check_inputs(source, values)
    return _input_array(trace, values, rows, number), rows, source


def _to_give(trace: Trace) -> list[str]:
    """The inputs, with the times of the rows in place of the time step that follows from them."""
    own = None if trace.time_step is None else trace.time_step[0]
    return ["time" if n == own else n for n in trace.given_inputs]


@dataclass(frozen=True)
class _Common:
    """What is the same for all data sets: the channels' supports, and what `_needed` gives."""

    supports: dict[str, Support]
    needed: tuple[tuple[Expr, Site], ...]


def _bind(
    trace: Trace, source: Source, need: bool, steps: int | None, common: _Common, number: float
) -> Experiment:
    inputs = {n: channel(source, n, shape, "input", trace.component_names.labels(n))
              for n, shape in trace.given_inputs.items()}  # fmt: skip
    observed = {}
    for name, site in trace.observations.items():
        labels = trace.component_names.labels(name)
        if not site.distribution.measured:
            _check_no_column(source, site, labels)
        elif need or holds(source, name, site.shape, labels):
            observed[name] = channel(source, name, site.shape, "observation", labels)
    rows = _rows(source, {**observed, **inputs}, steps)
    for name, site in trace.observations.items():
        given = need and not site.distribution.measured  # a term of the density: in every row
        observed.setdefault(name, np.full((rows, *site.shape), 0.0 if given else np.nan))
    _check_inputs(source, inputs)
    u = _input_array(trace, inputs, rows, number)
    env = dict(zip(trace.input_symbols, u.T, strict=True))
    env[symbol("time", "t")] = np.arange(1.0, rows + 1.0)
    partial = {
        name
        for name, site in trace.observations.items()
        if _check_observation(source, site, observed[name], env, common.supports[name])
    }
    packed = pack(trace.observations.values(), observed).reshape(rows, -1)
    missing = np.isnan(packed)
    if need:
        _check_needed(trace, source, missing, common.needed)
    check_defined(trace, source, u, packed, ~missing if need else None)
    return Experiment(
        y=np.ascontiguousarray(np.where(missing, 0.0, packed)),
        seen=np.ascontiguousarray(np.where(missing, 0.0, 1.0)),
        u=u,
        time=source.time,
        steps=rows,
        partial=frozenset(partial),
        observed={n: observed[n] for n, s in trace.observations.items() if s.distribution.measured},
        inputs=inputs,
        zone=source.zone,
        label=source.experiment,
    )


# -- checks over rows
def _check_no_column(source: Source, site: Site, labels: Any) -> None:
    """A term of the log density has no data."""
    if holds(source, site.name, site.shape, labels):
        kind = type(site.distribution).__name__
        raise DataError(
            f"{site.name!r} is a {kind}, a term of the log density, and the {source.kind} has a "
            "column of that name",
            fix="leave the column out, or give its values another name and declare them as an "
            "input that the term reads",
            where=source.place(),
        )


def _rows(source: Source, values: dict[str, np.ndarray], steps: int | None) -> int:
    """The number of rows, which all variables share."""
    lengths = {n: len(v) for n, v in values.items()}
    if source.time is not None:
        lengths.setdefault(source.time_name, len(source.time))
    if len(set(lengths.values())) > 1:
        text = ", ".join(f"{n!r} has {k}" for n, k in lengths.items())
        raise DataError(
            f"the numbers of rows differ: {text}",
            fix="give every variable one row for each time; inputs too, the last row included "
            "(it acts in the last observation)",
            where=source.place(),
        )
    if not lengths and steps is None:
        raise DataError(
            f"the {source.kind} has nothing that the model names",
            fix="give data for its observations or inputs, or the number of steps",
            where=source.place(),
        )
    rows = next(iter(lengths.values())) if lengths else int(steps or 0)
    if rows == 0:
        raise DataError(
            f"there are no rows: {', '.join(map(repr, lengths))} of length 0",
            fix="give at least one row",
            where=source.place(),
        )
    if steps is not None and rows != steps:
        names = ", ".join(map(repr, lengths))
        raise DataError(
            f"{names} has {rows} rows, and steps is {steps}",
            fix=f"leave steps out, or give {steps} rows (the row of the last step included)",
            where=source.place(),
        )
    return rows


def _first(mask: np.ndarray) -> tuple[int, ...]:
    return tuple(int(i) for i in np.argwhere(mask)[0])


def _check_inputs(source: Source, inputs: dict[str, np.ndarray]) -> None:
    for name, value in inputs.items():
        bad = ~np.isfinite(value)
        if bad.any():
            index = _first(bad)
            raise DataError(
                f"the input {name!r} is {number(value[index])}",
                fix="give every input a finite value in every row, for example by "
                "interpolation; only observations may be missing",
                where=source.place(name, index),
            )


def _input_array(
    trace: Trace, inputs: dict[str, np.ndarray], rows: int, number: float
) -> np.ndarray:
    """(T, U). number : that of the experiment, an input where parameters are of each."""
    inputs = inputs | {EXPERIMENT_NUMBER: np.full(rows, number)}
    columns = [inputs[n].reshape(rows, -1) for n in trace.inputs]
    return np.ascontiguousarray(np.concatenate([np.zeros((rows, 0)), *columns], axis=1))


def _check_observation(
    source: Source, site: Site, values: np.ndarray, env: dict[Expr, np.ndarray], support: Support
) -> bool:
    """Whether some row holds a part of the channel only; an error for values it cannot have."""
    infinite = np.isinf(values)
    if infinite.any():
        index = _first(infinite)
        raise DataError(
            f"the observation is {number(values[index])}",
            fix="write NaN where nothing was measured",
            where=source.place(site.name, index),
        )
    fault = outside(site.distribution, values, env, support)
    if fault is not None:
        whole = fault.found.startswith("the ")  # "the shares [...] sum to 0.9"
        found = fault.found if whole else f"the observation {fault.found}"
        raise DataError(
            f"{found} (declared at {site.distribution.location})",
            fix=f"give {fault.fix}; NaN where nothing was measured; or give the channel a "
            "distribution that allows the value",
            where=source.place(site.name, fault.index),
        )
    gaps = np.isnan(values).reshape(len(values), -1)
    partly = gaps.any(axis=1) & ~gaps.all(axis=1)
    if not partly.any():
        return False
    law = site.distribution
    if law.joint and not (isinstance(law, Centred) and law.margins):
        row = int(np.argmax(partly))
        raise DataError(
            f"a part of the observation is missing: {values[row].tolist()}; "
            f"{name_of(site.distribution)} has no density for the rest alone",
            fix="give all entries of the row, or make all of them NaN",
            where=source.place(site.name, (row,)),
        )
    return True


def _needed(trace: Trace) -> Iterator[tuple[Expr, Site]]:
    """The observed components that a transition names, as y_{t-1}, each with its reader."""
    for site in trace.transition.values():
        for parameter in site.distribution.parameters.values():
            for s in symbols_of(parameter.ravel()):
                if s.data[0] == "observation_prev":
                    yield symbol("observation", *s.data[1:]), site


def _check_needed(
    trace: Trace, source: Source, missing: np.ndarray, needed: Iterable[tuple[Expr, Site]]
) -> None:
    order = {s: k for k, s in enumerate(trace.observation_symbols)}
    for s, site in needed:
        gaps = missing[:-1, order[s]]
        if gaps.any():
            name, component = s.data[1:]
            raise DataError(
                f"the observation is missing, and the transition of {site.name!r} needs it "
                f"({site.where})",
                fix="give it in all rows but the last, or write the transition without it; where "
                "state and observation share a noise, let that be a state, e, and observe "
                "ssm.Dirac(... + e), which may be missing",
                where=source.place(name, (int(np.argmax(gaps)), *component)),
            )
