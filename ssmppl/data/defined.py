"""Distributions that the inputs, the row number or earlier observations leave without a parameter
that is a number: an index that no element has, the root of a negative number. Found before anything
runs, where all that is left of it in a kernel is a likelihood of zero."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ssmppl.data.sources import Source
from ssmppl.data.values import name_of, number
from ssmppl.errors import DataError
from ssmppl.expressions.expr import Expr, symbol, symbols_of, to_text
from ssmppl.expressions.properties import (
    DATA,
    DATA_PREV,
    Undefined,
    first_undefined,
    may_be_undefined,
)
from ssmppl.language.distributions.base import Distribution
from ssmppl.language.model.trace import Site, Trace, once_per_trace, previous

CHUNK = 1 << 16  # rows that are looked at together


class _Suspect(NamedTuple):
    """An entry of a distribution's parameter that may have no value in some row."""

    site: Site
    law: Distribution  # the site's, or one inside of it
    parameter: str
    form: Expr
    weighs: tuple[Expr, ...]  # the components that have to be measured for it to count


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
            ("initial", DATA), ("transition", DATA_PREV), ("observations", DATA),
        )
    }  # fmt: skip


def _entries(site: Site, law: Distribution) -> Iterator[_Suspect]:
    for inner in law.inside():  # first: the outer one may have their parameters too, renamed
        yield from _entries(site, inner)
    for name, values in law.parameters.items():
        for i, form in np.ndenumerate(values):
            weighs: tuple[Expr, ...]
            if values.shape == site.shape:
                weighs = (site.value[i],)
            elif values.shape == 2 * site.shape:  # of a covariance
                weighs = tuple(site.value[[*i]])
            else:
                weighs = tuple(site.components)
            yield _Suspect(site, law, name.rstrip("_"), form, weighs)


def check_defined(
    trace: Trace,
    source: Source,
    u: np.ndarray,
    y: np.ndarray | None = None,
    measured: np.ndarray | None = None,
    after: int = 0,
) -> None:
    """Raise where a parameter of a distribution is not a number whatever states and parameters are.

    u : (T, U) inputs.
    y : (T, K) observations, NaN where missing; None where they are drawn.
    measured : (T, K) whether an observation is weighed; the distributions of others do not matter.
        None: all are drawn.
    after : of a forecast, the number of rows before those of `source`, whose last one is gone on
        from; the distributions of these rows do not matter.

    Raises
    ------
    DataError : names the input, its row, and the distribution with its line.
    """
    suspects = _suspects(trace)
    if not any(suspects.values()):
        return
    steps, order = len(u), {s: k for k, s in enumerate(trace.observation_symbols)}
    now = dict(zip(trace.input_symbols, u.T, strict=True))
    now[symbol("time", "t")] = np.arange(1.0, steps + 1.0)
    before = {previous(s): v for s, v in now.items()}
    if y is not None:
        before |= {previous(s): v for s, v in zip(trace.observation_symbols, y.T, strict=True)}
    spans = {
        "initial": (now, 0, 0 if after else 1),
        "transition": (before, max(after - 1, 0), steps - 1),
        "observations": (now, after, steps),
    }
    for role, (known, begin, end) in spans.items():
        own = suspects[role]
        needed = symbols_of([suspect.form for suspect in own])
        read = {s: v for s, v in known.items() if s in needed}
        for first in range(begin, end if own else begin, CHUNK):
            rows = slice(first, min(first + CHUNK, end))
            at = {s: v[rows] for s, v in read.items()}
            asked = []
            for suspect in own:
                where = np.ones(rows.stop - first, dtype=bool)
                if role == "observations" and measured is not None:
                    where &= measured[rows, [order[s] for s in suspect.weighs]].all(axis=1)
                for s in symbols_of([suspect.form]):
                    if s in at and s.data[0] == "observation_prev":  # drawn where it is missing
                        where &= ~np.isnan(at[s])
                asked.append(where)
            forms = [suspect.form for suspect in own]
            found = first_undefined(forms, trace.choices, at, rows.stop - first, asked)
            if found is not None:
                which, undefined = found
                raise _error(trace, source, own[which], undefined, first, read, after)


def _error(
    trace: Trace,
    source: Source,
    suspect: _Suspect,
    found: Undefined,
    first: int,
    read: dict[Expr, np.ndarray],
    after: int,
) -> DataError:
    """first : row of the data where the arrays began that `found` was found in."""
    law, row = suspect.law, first + found.row
    whose = (
        f"the {suspect.parameter} of {name_of(law)}, the distribution of {suspect.site.name!r} "
        f"({trace.locations.get(found.node, law.location)})"
    )
    node = found.node if found.index is None else found.index
    at = {s: read[s][row] for s in symbols_of([node]) if s in read}
    columns = sorted((s for s in at if not s.data[0].startswith("time")), key=repr)
    name, component = columns[0].data[1:] if columns else ("", ())
    where = source.place(name, (row - after, *component))
    if row < after:
        where = "In the last row of the data" + (f", {name!r}" if name else "")
    here = ", ".join(f"{to_text(s)} = {number(v)}" for s, v in at.items())
    if found.index is None:
        return DataError(
            f"{whose} is not a number: {to_text(node)}" + (f" at {here}" if here else ""),
            fix="write the distribution for this value too, with np.where, or give another value",
            where=where,
        )
    value, last = found.value, found.elements - 1
    if value != np.floor(value):
        return DataError(
            f"the index {to_text(node)} is {value!r}, which is not whole, in {whose}",
            fix="round it, np.floor(index + 0.5)",
            where=where,
        )
    return DataError(
        f"the index {to_text(node)} is {number(value)}, and there are {found.elements} elements, 0 "
        f"to {last}, in {whose}",
        fix="count from 0, as Python does (codes that begin with 1: take index - 1); negative "
        "indices do not count from the end; where none is meant, rule it out by np.where",
        where=where,
    )
