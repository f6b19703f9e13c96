"""Several experiments in one object: a list or a dictionary of data sets, a long table with a
column that tells them apart, a Dataset with a dim `experiment`.

What comes out are single data sets, each with its label: the key of the dictionary, the value of
the column, or None in a list.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ssmppl.errors import DataError, listing

EXPERIMENT = "experiment"  # the dim of results
# Coordinates along it: numbers of rows, and their labels, with an attribute where these are whole.
ROWS, TIMES, WHOLE = "rows", "times", "whole_numbers"

Labelled = list[tuple[Any, Any]]  # (label, data set)


def is_table(data: Any) -> bool:
    """Whether it is a table of pandas, or of what is like it."""
    return hasattr(data, "iloc") and hasattr(data, "columns")


def is_dataset(data: Any) -> bool:
    """Whether it is a Dataset of xarray, or what is like it."""
    return hasattr(data, "data_vars") and hasattr(data, "coords")


def split(data: Any, named: Sequence[str], by: str | None, argument: str) -> Labelled | None:
    """The data sets in `data`, with their labels; None where it is a single one.

    Parameters
    ----------
    named : the quantities of the model.
    by : the column that tells the experiments of a long table apart.

    Raises
    ------
    DataError : the column is not there, or a label stands for two of them.
    """
    found = _split(data, named, by, argument)
    labels = [str(k) for k, _ in found or () if k is not None]
    for k in labels:
        if labels.count(k) > 1:
            raise DataError(
                f"two experiments of {argument} are called {k!r}",
                fix="give each a name of its own",
            )
    return found


def _split(data: Any, named: Sequence[str], by: str | None, argument: str) -> Labelled | None:
    if isinstance(data, (list, tuple)):
        parts = [(None, d) for d in data]
        return _split_parts(parts, by, argument) if by else parts
    if isinstance(data, Mapping) and data and not set(map(str, data)) & set(named):
        if all(is_table(d) or is_dataset(d) or isinstance(d, Mapping) for d in data.values()):
            return [(_plain(k), d) for k, d in data.items()]
    if is_dataset(data) and EXPERIMENT in data.dims:
        return _of_dataset(data)
    return _long(data, by, argument) if by else None


def _split_parts(parts: Labelled, by: str, argument: str) -> Labelled:
    """Data sets of a list that may hold several experiments each."""
    out: Labelled = []
    for label, one in parts:
        own = _long(one, by, argument) if _holds(one, by) else [(label, one)]
        out += own
    return out


def _holds(data: Any, by: str) -> bool:
    if is_table(data):
        return by in list(data.columns) or by in (data.index.names or [])
    return by in data if isinstance(data, Mapping) or is_dataset(data) else False


def _long(data: Any, by: str, argument: str) -> Labelled:
    if not _holds(data, by):
        known = [str(c) for c in (data.columns if is_table(data) else data)] if (
            is_table(data) or isinstance(data, Mapping)
        ) else []  # fmt: skip
        raise DataError(
            f"{argument} has no column {by!r}, which the model names by experiment={by!r}",
            fix=f"add it, with the experiment of each row (there are "
            f"{listing(by, known) or 'no columns'}); or give a list or a dictionary of data sets",
        )
    if is_table(data):
        return _of_table(data, by)
    values = np.asarray(data[by])
    rest = {k: np.asarray(v) for k, v in data.items() if k != by}
    short = next((k for k, v in rest.items() if v.ndim == 0 or len(v) != len(values)), None)
    if short is not None:
        raise DataError(
            f"{short!r} of {argument} has {len(np.atleast_1d(rest[short]))} rows, {by!r} has "
            f"{len(values)}",
            fix="give every variable one value for each row",
        )
    labels = list(dict.fromkeys(_plain(v) for v in values))
    _check_labels(labels, by, argument)
    same = [np.array([_plain(v) == label for v in values]) for label in labels]
    return [(k, {n: v[own] for n, v in rest.items()}) for k, own in zip(labels, same, strict=True)]


def _of_table(data: Any, by: str) -> Labelled:
    """Rows keep their index where it says more than their number."""
    level = by in (data.index.names or []) and by not in list(data.columns)
    plain = type(data.index).__name__ == "RangeIndex"
    groups = data.groupby(level=by if level else None, by=None if level else by, sort=False,
                          dropna=False)  # fmt: skip
    out: Labelled = []
    for label, part in groups:
        if level:
            part = part.droplevel(by) if part.index.nlevels > 1 else part.reset_index(drop=True)
        else:
            part = part.drop(columns=by)
            part = part.reset_index(drop=True) if plain else part
        out.append((_plain(label), part))
    _check_labels([k for k, _ in out], by, "data")
    return out


def _of_dataset(data: Any) -> Labelled:
    """As results have them: rows after the end of a shorter one are left out."""
    labels = [_plain(k) for k in data[EXPERIMENT].values]
    return [(k, own) for k, (_, own) in zip(labels, experiments_of(data), strict=True)]


def experiments_of(dataset: Any) -> list[tuple[str, Any]]:
    """Each experiment of a group of results, with its label: without the dim `experiment`, with its
    own rows and their labels. A single one has the label ""."""
    if EXPERIMENT not in dataset.dims:
        return [("", dataset)]
    out = []
    for i, label in enumerate(dataset[EXPERIMENT].values):
        own = dataset.isel({EXPERIMENT: i}).drop_vars(EXPERIMENT, errors="ignore")
        if ROWS in own.coords:
            rows = int(own[ROWS])
            own = own.drop_vars(ROWS)
            own = own.isel(time=slice(0, rows)) if "time" in own.dims else own
        if TIMES in own.coords:
            times = own[TIMES].values
            if _absent(times).all():  # its rows have no labels
                times = np.arange(1, len(times) + 1)
            elif own[TIMES].attrs.get(WHOLE):
                times = times.astype(int)
            own = own.assign_coords(time=times).drop_vars(TIMES)
        out.append((str(label), own))
    return out


def _absent(labels: np.ndarray) -> np.ndarray:
    return np.asarray(labels == "" if labels.dtype.kind in "OU" else np.isnan(labels))


def _plain(label: Any) -> Any:
    """A label as a coordinate can hold it: a number, a text, None, or what else it is in words."""
    value = label.item() if isinstance(label, np.generic) else label
    return value if value is None or isinstance(value, (bool, int, float, str)) else str(value)


def _check_labels(labels: Sequence[Any], by: str, argument: str) -> None:
    for label in labels:
        if label is None or label != label:
            raise DataError(
                f"{by!r} of {argument} is missing in some row",
                fix="give the experiment of every row, or drop those rows",
            )
