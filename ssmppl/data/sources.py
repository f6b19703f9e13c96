"""What users hold data in: mappings of arrays, DataFrames and Datasets, as named columns.

pandas and xarray are recognised by what their objects can do, so that neither is imported here.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ssmppl.data.experiments import is_dataset, is_table, split
from ssmppl.data.times import as_dates, label_text
from ssmppl.data.values import Fault, as_numbers, short
from ssmppl.errors import DataError
from ssmppl.language.model.model import Model

FILE = "ssmppl_file"  # key of `attrs` for the name of the file that a table was read from


@dataclass
class Source:
    """One data set: its columns as the user holds them, and the labels of its rows.

    label : "data", or "data set 2" where there are several, with the name of its file if known.
    time : labels of the rows, None where the data have none; of dates with a zone those of UTC.
    zone : name of the zone that dates were given in; empty where they have none.
    experiment : what the user calls it; None where it has no name.
    """

    label: str
    kind: str
    columns: dict[str, Any]
    time: np.ndarray | None = None
    time_name: str = "time"
    zone: str = ""
    experiment: Any = None
    known: list[str] = field(default_factory=list)

    def place(
        self, name: str = "", index: tuple[int, ...] | None = None, column: str | None = None
    ) -> str:
        """Where in the data: data set, variable (with its component) and row, from 1."""
        parts = []
        if name:
            entry = ", ".join(map(str, index[1:])) if index else ""
            parts.append(f"{name!r}" + (f"[{entry}]" if entry else ""))
            if column and column != name:
                parts[-1] += f" (column {column!r})"
        if index:
            row = index[0]
            parts.append(f"row {row + 1}" + self.at(row))
        return f"In {self.label}" + (f", {', '.join(parts)}" if parts else "")

    def at(self, row: int) -> str:
        """The label of a row, in brackets; empty where rows have none."""
        if self.time is None or row >= len(self.time):
            return ""
        return f" ({self.time_name} {label_text(self.time[row])})"


def sources(
    data: Any, named: Iterable[str], argument: str = "data", by: str | None = None
) -> list[Source]:
    """The data sets in `data`; `named` are the quantities of the model that data may hold, `by` the
    column that tells experiments apart."""
    named = list(named)
    if isinstance(data, (list, tuple)) and data:
        if all(isinstance(d, (int, float, np.number)) or d is None for d in data):
            raise _not_a_data_set(data, argument, argument, named)
    parts = split(data, named, by, argument)
    if parts is None:
        return [_source(data, argument, argument, named)]
    if not parts:
        raise DataError(
            f"{argument} is an empty list of data sets",
            fix="give at least one data set; a single one needs no list",
        )
    out = []
    for i, (label, one) in enumerate(parts, start=1):
        which = f"{argument} set {i}{_file(one)}" if len(parts) > 1 else argument
        which = which if label is None else f"experiment {label!r}"
        out.append(_source(one, which, argument, named))
        out[-1].experiment = label
    return out


def _file(data: Any) -> str:
    """The name of the file that a table came from, in brackets; "" where it is not known."""
    attrs = getattr(data, "attrs", None)
    name = attrs.get(FILE) if isinstance(attrs, Mapping) else None
    return f" ({name})" if isinstance(name, str) else ""


def _source(data: Any, label: str, argument: str, named: list[str]) -> Source:
    if _is_series(data) and data.name in named:  # it says itself what it is
        data = data.to_frame()
    elif hasattr(data, "to_dataset") and getattr(data, "name", None) in named:
        data = data.to_dataset()
    if is_dataset(data):
        return _from_dataset(data, label)
    if is_table(data):
        return _from_frame(data, label, named)
    if isinstance(data, Mapping):
        return _from_mapping(data, label, named)
    raise _not_a_data_set(data, label, argument, named)


def _is_series(data: Any) -> bool:
    """Whether it is a column of a table of pandas, or of what is like it."""
    return hasattr(data, "iloc") and hasattr(data, "to_frame")


def _not_a_data_set(data: Any, label: str, argument: str, named: list[str]) -> DataError:
    some = next(iter(named), "y")
    example = f"{{{some!r}: array}}"
    if data is None:
        found, fix = f"{label} is None", f"give a mapping of arrays such as {example}"
    elif isinstance(data, (str, os.PathLike)):
        path = os.fspath(data)
        found = f"{label} is the {'text' if isinstance(data, str) else 'path'} {path!r}"
        fix = f"read the file first, pd.read_csv({path!r}) for a CSV, and pass the DataFrame"
    elif isinstance(data, Model):
        found = f"{label} is the model {data.name!r}"
        fix = "pass the model first and the data second"
    elif getattr(getattr(data, "dtype", None), "names", None):
        found = f"{label} is a structured array with the fields {', '.join(data.dtype.names)}"
        fix = f"make a table of it: pd.DataFrame({argument})"
    elif hasattr(data, "name") and hasattr(data, "__array__"):  # a Series, an Index or a DataArray
        kind, own = type(data).__name__, data.name
        found = f"{label} is a {kind}, one variable" + ("" if own is None else f" named {own!r}")
        some = own if own in named else some
        fix = f"give a mapping of variables by name: {{{some!r}: {argument}}}"
    elif isinstance(data, (np.ndarray, list, tuple)) or hasattr(data, "__array__"):
        found = f"{label} is {short(data)} of type {type(data).__name__}, which names no variable"
        fix = f"name it: {{{some!r}: {argument}}}"
    else:
        found = f"{label} is {short(data)} of type {type(data).__name__}"
        fix = (
            f"give a mapping of arrays such as {example}, a pandas DataFrame, an xarray Dataset, "
            "or a list of those"
        )
    return DataError(found, fix=fix)


def _from_mapping(data: Mapping[Any, Any], label: str, named: list[str]) -> Source:
    columns = {str(k): v for k, v in data.items()}
    known = list(columns)
    source = Source(label, "mapping", columns, known=known)
    if "time" in columns and "time" not in named:
        source.time = _labels(columns.pop("time"), source)
        return source
    for name, column in columns.items():  # labels of Series and DataArrays, the same for all
        if hasattr(column, "dims") and "time" in column.dims:
            columns[name] = column.transpose("time", ...)
            index, word = column.coords.get("time"), "time"
        else:
            index, word = getattr(column, "index", None), "index"
            if not (hasattr(column, "iloc") and _informative(index)):
                continue
        if index is None:
            continue
        labels = _labels(index, source, word)
        if source.time is None:
            source.time, source.time_name, first = labels, word, name
        elif not np.array_equal(source.time, labels):
            raise DataError(
                f"{first!r} and {name!r} label their rows differently ({word})",
                fix="put them into one DataFrame, pd.DataFrame({...}), which aligns the rows",
                where=source.place(),
            )
    return source


def _from_frame(data: Any, label: str, named: list[str]) -> Source:
    names = ["_".join(map(str, c)) if isinstance(c, tuple) else str(c) for c in data.columns]
    source = Source(label, "DataFrame", {}, known=names, time_name="index")
    repeated = [n for i, n in enumerate(names) if n in names[:i]]
    if repeated:
        raise DataError(
            f"the DataFrame has more than one column named {repeated[0]!r}",
            fix="rename or drop one of them",
            where=source.place(),
        )
    source.columns = {n: data.iloc[:, i] for i, n in enumerate(names)}
    if getattr(data.index, "nlevels", 1) > 1:
        raise DataError(
            "the rows have an index of several levels",
            fix="where a level tells experiments apart, name it in the model, "
            f"ssm.Model(..., experiment={str(data.index.names[0] or 'id')!r})"
            + (
                ""
                if data.index.names[0]
                else ", and in the data, data.index.names = ['id', 'time']"
            )
            + "; else data.reset_index()",
            where=source.place(),
        )
    column = "time" in names and "time" not in named
    # Whole numbers are what is left of row numbers where rows were dropped or chosen.
    numbers = getattr(data.index.dtype, "kind", "") in "iu"
    if _informative(data.index) and not (column and numbers):
        source.time = _labels(data.index, source, "index")
    elif column:
        source.time_name = "time"
        source.time = _labels(source.columns.pop("time"), source)
    return source


def _from_dataset(data: Any, label: str) -> Source:
    source = Source(label, "Dataset", {}, known=[str(n) for n in data.data_vars])
    if "time" not in data.dims:
        dims = ", ".join(map(str, data.dims)) or "none"
        raise DataError(
            f"the Dataset has no dimension 'time'; its dimensions are: {dims}",
            fix="rename the one that counts the rows, data.rename("
            f"{{{str(next(iter(data.dims), 'step'))!r}: 'time'}})",
            where=source.place(),
        )
    for name, variable in data.data_vars.items():
        if "time" not in variable.dims:  # its rows are counted otherwise, if it has any
            source.columns[str(name)] = _Timeless(variable.dims) if variable.dims else variable
            continue
        extra = [d for d in variable.dims if d in ("draw", "trajectory", "chain", "sample")]
        wide = [d for d in extra if variable.sizes[d] > 1]
        if wide and str(name) in source.known:
            source.columns[str(name)] = _Wide(wide[0], variable.sizes[wide[0]])
            continue
        variable = variable.squeeze(extra, drop=True).transpose("time", ...)
        labelled = variable.ndim == 2 and variable.dims[1] in variable.coords
        source.columns[str(name)] = variable.to_pandas() if labelled else variable.values
    if "time" in data.coords:
        source.time = _labels(data["time"], source)
    return source


@dataclass(frozen=True)
class _Wide:
    """Stands for a variable of a Dataset that holds several draws."""

    dim: str
    size: int


@dataclass(frozen=True)
class _Timeless:
    """Stands for a variable of a Dataset that has dimensions, and no `time` among them."""

    dims: tuple[Any, ...]


def check_single(value: Any, name: str, source: Source) -> None:
    """Refuse a variable of a Dataset that is not one series over its rows."""
    if isinstance(value, _Timeless):
        dims = ", ".join(map(str, value.dims))
        raise DataError(
            f"{name!r} has no dimension 'time', which counts the rows; its dimensions are: {dims}",
            fix="if these are the same rows, rename it: "
            f"data[{name!r}].rename({{{str(value.dims[0])!r}: 'time'}})",
            where=source.place(name),
        )
    if isinstance(value, _Wide):
        raise DataError(
            f"{name!r} holds {value.size} series along the dimension {value.dim!r}",
            fix=f"choose one, data.isel({value.dim}=0); or pass a list of data sets, if each is "
            "an experiment of its own",
            where=source.place(name),
        )


def _informative(index: Any) -> bool:
    """Whether an index says more than the row number."""
    if index is None or callable(index):
        return False
    plain = type(index).__name__ == "RangeIndex" and index.start == 0 and index.step == 1
    return not plain


def _read_dates(values: Any, name: str, source: Source) -> Any:
    """Labels that are texts or objects: as dates, where they are that."""
    code = "data.index" if name == "index" else f"data[{source.time_name!r}]"
    try:
        dates = as_dates(values, f"the {name}", code)
    except DataError as error:
        raise DataError(error.found, fix=error.fix, where=source.place()) from None
    return values if dates is None else dates


def _labels(values: Any, source: Source, name: str = "time") -> np.ndarray:
    """Labels of the rows as an array, increasing where they have an order."""
    where = source.place()
    if getattr(values, "dtype", np.asarray(values).dtype).kind in "OUT":
        values = _read_dates(values, name, source)
    dates: Any = getattr(values, "dt", None) if hasattr(values, "iloc") else values
    if getattr(dates, "tz", None) is not None:
        source.zone, values = str(dates.tz), dates.tz_convert(None)
    elif hasattr(dates, "to_timestamp"):
        values = dates.to_timestamp()
    labels = np.asarray(values)
    if labels.ndim != 1:
        raise DataError(
            f"the {name} has shape {labels.shape}", fix="give one label for each row", where=where
        )
    if labels.dtype.kind == "O":
        numbers = as_numbers(labels)
        if isinstance(numbers, Fault):
            numbers = np.array([str(v) for v in labels], dtype=str)  # NumPy takes tuples for arrays
        labels = numbers
    ordered = labels.dtype.kind in "iufmM"
    if labels.dtype.kind in "fmM":
        absent = ~np.isfinite(labels)
        if absent.any():
            row = int(np.argmax(absent))
            raise DataError(
                f"the {name} is {labels[row]} in row {row + 1}",
                fix=f"give every row its {name}, or drop the {name} altogether",
                where=where,
            )
    first: dict[Any, int] = {}
    for row, value in enumerate(labels.tolist()):
        if value in first:
            raise DataError(
                f"the {name} {label_text(labels[row])} stands in rows {first[value] + 1} "
                f"and {row + 1}",
                fix="one experiment has one row for each time: remove the repetition; or number "
                "the rows, where two were measured at one time; or, of several experiments, name "
                'the column that tells them apart, ssm.Model(..., experiment="id"), or pass a '
                "dictionary or a list of data sets",
                where=where,
            )
        first[value] = row
    if ordered and len(labels) > 1 and not (labels[1:] > labels[:-1]).all():
        row = int(np.argmax(~(labels[1:] > labels[:-1]))) + 1
        raise DataError(
            f"the {name} is not increasing: {label_text(labels[row])} in row {row + 1} follows "
            f"{label_text(labels[row - 1])} in row {row}",
            fix="sort the rows by time (data.sort_index() or data.sort_values('time')); years "
            "before an epoch are negative",
            where=where,
        )
    return labels
