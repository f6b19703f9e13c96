"""Laws that the inputs, the row number or earlier observations leave without a parameter that is a
number: an index that no element has, the root of a negative number. Found before anything runs,
where all that is left of it in a kernel is a likelihood of zero."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ssmppl.data.sources import Source
from ssmppl.data.values import name_of, number
from ssmppl.errors import DataError
from ssmppl.expressions.expr import Expr, symbol, symbols_of, to_text
from ssmppl.expressions.undefined import Undefined, first_undefined, may_be_undefined
from ssmppl.language.distribution import Distribution
from ssmppl.language.traced import Site, Trace, once_per_trace, previous


class _Suspect(NamedTuple):
    """An entry of a law's parameter that may have no value in some row."""

    site: Site
    law: Distribution  # the site's, or one inside of it
    parameter: str
    form: Expr
    weighs: tuple[Expr, ...]  # the components that depend on it


_DATA = {"input", "time"}
_DATA_PREV = {"input_prev", "time_prev", "observation_prev"}


@once_per_trace
def _suspects(trace: Trace) -> dict[str, list[_Suspect]]:
    return {
        role: [
            suspect
            for site in getattr(trace, role).values()
            for suspect in _entries(site, site.distribution)
            if may_be_undefined(suspect.form, trace.choices, known)
        ]
        for role, known in (
            ("initial", _DATA), ("transition", _DATA_PREV), ("observations", _DATA),
        )
    }  # fmt: skip


def _entries(site: Site, law: Distribution) -> Iterator[_Suspect]:
    for inner in law.inside():  # first: the outer one may have their parameters too, renamed
        yield from _entries(site, inner)
    for name, values in law.parameters.items():
        each = values.shape == site.shape and not site.distribution.joint
        for i, form in np.ndenumerate(values):
            weighs = (site.value[i],) if each else tuple(site.components)
            yield _Suspect(site, law, name.rstrip("_"), form, weighs)


def check_defined(
    trace: Trace, source: Source, u: np.ndarray, y: np.ndarray | None, measured: np.ndarray
) -> None:
    """Raise where a parameter of a law is not a number whatever states and parameters are.

    u : (T, U) inputs. y : (T, K) observations, None where there are none.
    measured : (T, K) whether an observation is weighed; the laws of others do not matter.

    Raises
    ------
    DataError : names the input, its row, and the law with its line.
    """
    suspects = _suspects(trace)
    if not any(suspects.values()):
        return
    steps, order = len(u), {s: k for k, s in enumerate(trace.observation_symbols)}
    now = dict(zip(trace.input_symbols, u.T, strict=True))
    now[symbol("time", "t")] = np.arange(1.0, steps + 1.0)
    before = {previous(s): v[:-1] for s, v in now.items()}
    if y is not None:
        before |= {previous(s): v[:-1] for s, v in zip(trace.observation_symbols, y.T, strict=True)}
    for role, rows in (("initial", 1), ("transition", steps - 1), ("observations", steps)):
        known = before if role == "transition" else {s: v[:rows] for s, v in now.items()}
        for suspect in suspects[role]:
            which = np.arange(rows)
            if role == "observations":
                columns = [order[s] for s in suspect.weighs]
                which = which[measured[:, columns].any(axis=1)]
            at = {s: v[which] for s, v in known.items()}
            found = first_undefined(suspect.form, trace.choices, at, len(which))
            if found is not None:
                raise _error(trace, source, suspect, found, int(which[found.row]), known)


def _error(
    trace: Trace, source: Source, suspect: _Suspect, found: Undefined, row: int, known: dict
) -> DataError:
    """`known`: the symbols' values by the row of the data."""
    law = suspect.law
    whose = (
        f"the {suspect.parameter} of {name_of(law)}, the law of {suspect.site.name!r} "
        f"({trace.locations.get(found.node, law.location)})"
    )
    node = found.node if found.index is None else found.index
    read = [s for s in symbols_of([node]) if s in known]
    inputs = [s for s in read if s.data[0].startswith("input")]
    name, component = inputs[0].data[1:] if inputs else ("", ())
    where = source.place(name, (row, *component))
    if found.index is None:
        at = ", ".join(f"{to_text(s)} = {number(known[s][row])}" for s in read)
        return DataError(
            f"{whose} is not a number: {to_text(node)}" + (f" at {at}" if at else ""),
            fix="give the input a value that the law has a meaning for, or write the law for this "
            "value too, with np.where",
            where=where,
        )
    return DataError(
        f"the index {to_text(node)} is {number(found.value)}, and there are {found.elements} "
        f"elements, 0 to {found.elements - 1}, in {whose}",
        fix="count from 0, as Python does (codes that begin with 1: take index - 1), in whole "
        "numbers; negative indices do not count from the end",
        where=where,
    )
