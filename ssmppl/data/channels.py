"""One variable of a data set: found under the spellings users give it, as float64 (T, *shape)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ssmppl.data.sources import Source, check_single
from ssmppl.data.values import Fault, as_numbers, number
from ssmppl.errors import DataError, listing

MOST_NAMED = 12  # columns in a message
Labels = Sequence[Any]  # of a vector's components, as `coords` has them; empty where it has none


def column_names(name: str, index: tuple[int, ...], labels: Labels = ()) -> tuple[str, ...]:
    """Under which a component may stand in a table, what is written first where one lacks."""
    inside = list(map(str, index))
    plain = (f"{name}_{'_'.join(inside)}", f"{name}[{','.join(inside)}]",
             f"{name}[{', '.join(inside)}]")  # fmt: skip
    if not labels:
        return plain
    label = str(labels[index[0]])
    return (label, f"{name}_{label}", f"{name}[{label}]", *plain)


def holds(source: Source, name: str, shape: tuple[int, ...], labels: Labels = ()) -> bool:
    """Whether the data hold anything of the variable: its name, or one of its components'."""
    if name in source.columns:
        return True
    return any(
        c in source.columns for index in np.ndindex(*shape) if shape
        for c in column_names(name, index, labels)
    )  # fmt: skip


def channel(
    source: Source, name: str, shape: tuple[int, ...], role: str, labels: Labels = ()
) -> np.ndarray:
    """(T, *shape), NaN for missing."""
    if name in source.columns and not _is_label(name, labels, source):
        value = _in_order(source.columns[name], labels, name, source)
        check_single(value, name, source)
        array = _converted(source, name, name, value, ())
        if array.ndim == 1 and shape == (1,):
            array = array[:, None]
        if array.ndim == 0 or array.shape[1:] != shape:
            raise _wrong_shape(source, name, array, shape, role)
        return array
    if not shape or not holds(source, name, shape, labels):
        raise _left_out(source, name, shape, role, labels)
    parts = {}
    for index in np.ndindex(*shape):
        spelled = column_names(name, index, labels)
        column = next((c for c in spelled if c in source.columns), None)
        if column is None:
            raise _left_out(source, name, shape, role, labels, index)
        check_single(source.columns[column], name, source)
        parts[index] = _converted(source, name, column, source.columns[column], index)
        if parts[index].ndim != 1:
            raise _wrong_shape(source, column, parts[index], (), role)
    lengths = {len(p) for p in parts.values()}
    if len(lengths) > 1:
        raise DataError(
            f"the columns of {name!r} have different lengths: {sorted(lengths)}",
            fix="give all of them the same number of rows",
            where=source.place(name),
        )
    out = np.empty((lengths.pop(), *shape))
    for index, part in parts.items():
        out[(slice(None), *index)] = part
    return out


def _is_label(name: str, labels: Labels, source: Source) -> bool:
    """Whether a column of the variable's name is that of its component so called."""
    known = [str(label) for label in labels]
    return name in known and all(k in source.columns for k in known)


def _in_order(value: Any, labels: Labels, name: str, source: Source) -> Any:
    """A table for a vector with its columns in the order of the components that they are named
    after; other names are no labels, and stand for their places."""
    given = [str(c) for c in getattr(value, "columns", ())]
    wanted = [str(label) for label in labels]
    if not set(given) & set(wanted) or given == wanted:
        return value
    if set(wanted) <= set(given) and len(set(given)) == len(given):
        return value.iloc[:, [given.index(w) for w in wanted]]
    raise DataError(
        f"the columns of {name!r} are {', '.join(given)}, and its components {', '.join(wanted)}",
        fix="give a column of each component's name (of NaN, if nothing of it was measured), or "
        f"an array in the order of the components, data[{name!r}].to_numpy()",
        where=source.place(name),
    )


def _converted(
    source: Source, name: str, column: str, value: Any, component: tuple[int, ...]
) -> np.ndarray:
    array = as_numbers(value)
    if isinstance(array, Fault):
        index = (*array.index, *component) if array.index else None
        found = array.found if array.index else f"{column!r} {array.found}"
        raise DataError(found, fix=array.fix, where=source.place(name, index, column))
    return array


def _wrong_shape(
    source: Source, name: str, array: np.ndarray, shape: tuple[int, ...], role: str
) -> DataError:
    found = f"{name!r} has shape {array.shape}, and the {role} of the model has shape {shape}"
    wanted = "(T,)" if not shape else f"(T, {', '.join(map(str, shape))})"
    if array.ndim == 0:
        found = f"{name!r} is the number {number(float(array))}, no array"
        fix = f"give an array of shape {wanted}, one value for each row: " + (
            f"np.full(T, {number(float(array))})" if not shape else "np.tile(value, (T, 1))"
        )
    elif not shape and array.ndim == 2 and 1 in array.shape:
        taken = "[:, 0]" if array.shape[1] == 1 else "[0]"
        fix = f"give an array of shape (T,): data[{name!r}]{taken}"
    elif len(shape) == 1 and array.shape[:-1] == shape and array.ndim == 2:
        fix = f"rows come first, shape {wanted}: transpose it, data[{name!r}].T"
    elif shape and array.ndim == 1 and source.kind == "DataFrame":
        names = ", ".join(column_names(name, i)[0] for i in np.ndindex(*shape))
        fix = f"give one column for each component: {names}"
    else:
        fix = f"give an array of shape {wanted}, or the model's {role} the shape {array.shape[1:]}"
    return DataError(found, fix=fix, where=source.place(name))


def _left_out(
    source: Source,
    name: str,
    shape: tuple[int, ...],
    role: str,
    labels: Labels = (),
    index: tuple[int, ...] | None = None,
) -> DataError:
    things = "columns" if source.kind == "DataFrame" else "variables"
    wanted = f" of shape (T, {', '.join(map(str, shape))})" if shape else ""
    found = f"{_a(role)} named {name!r}{wanted} is missing from the {source.kind}"
    if index is not None:
        names = ", ".join(column_names(name, i, labels)[0] for i in np.ndindex(*shape))
        first = column_names(name, index, labels)[0]
        found = f"{_a(role)} named {name!r} lacks its component {first!r}; needed are {names}"
    wanted_name = name if index is None else column_names(name, index, labels)[0]
    fix = f"its {things} are: {listing(wanted_name, source.known)}; rename one, or add "
    fix += repr(wanted_name)
    if role == "observation":
        fix += " (a column of NaN, if nothing of it was measured)"
    if index is None and shape and source.kind == "DataFrame":  # no column has that shape
        names = ", ".join(column_names(name, i, labels)[0] for i in np.ndindex(*shape))
        found = f"{_a(role)} named {name!r} is missing from the DataFrame; needed are {names}"
        fix = f"its columns are, in their order: {', '.join(source.known[:MOST_NAMED])}; rename to "
        fix += f"{names} those that are meant"
    if not source.known:
        found = f"the {source.kind} holds no {things}, and needs {_a(role)} named {name!r}{wanted}"
        fix = f"give an array for {name!r}"
    return DataError(found, fix=fix, where=source.place())


def _a(word: str) -> str:
    return f"an {word}" if word[0] in "aeiou" else f"a {word}"
