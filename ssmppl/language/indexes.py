"""Elements of arrays that a state or a parameter chooses: its law has to keep within them.

What inputs choose is checked where there are data.
"""

from __future__ import annotations

import itertools
import math

import numpy as np

from ssmppl.errors import Location, ModelError
from ssmppl.expressions.arrays import plain
from ssmppl.expressions.expr import Expr, symbol, symbols_of, to_text, topological
from ssmppl.expressions.undefined import Undefined, first_undefined
from ssmppl.language.distribution import Distribution
from ssmppl.language.traced import Site, Trace

MOST = 4096  # combinations of values that are tried


class _Range:
    """The values that the laws of one quantity give it."""

    def __init__(self) -> None:
        self.lower, self.upper = math.inf, -math.inf
        self.continuum = False
        self.known = True

    def add(self, kind: str, lower: Expr, upper: Expr) -> None:
        if kind != "integers":
            self.continuum |= kind != "point"
            self.known = False
        elif lower.op != "const" or upper.op != "const":
            self.known = False
        else:
            self.lower, self.upper = min(self.lower, lower.data), max(self.upper, upper.data)

    @property
    def values(self) -> np.ndarray | None:
        """Whole numbers; None where they are too many, or not told by numbers."""
        if not self.known or not self.upper - self.lower < MOST:
            return None
        return np.arange(self.lower, self.upper + 0.5)


def check_indexes(trace: Trace) -> None:
    """Raise for an index that may choose an element that does not exist, as far as the laws of the
    states and parameters in it tell: it would silently be the last.

    Raises
    ------
    ModelError : names the index, its value, the number of elements and the line.
    """
    if not trace.choices:
        return
    ranges = _ranges(trace)
    laws = (trace.parameters, trace.initial, trace.transition, trace.observations, trace.proposal)
    for sites in laws:
        for site in sites.values():
            for form in site.distribution.arguments():
                _check(trace, site, form, ranges)


def _ranges(trace: Trace) -> dict[Expr, _Range]:
    ranges: dict[Expr, _Range] = {}
    for sites in (trace.parameters, trace.initial, trace.transition):
        for site in sites.values():
            for s, lower, upper in _bounds(site.distribution, site.value):
                ranges.setdefault(s, _Range()).add(site.distribution.support().kind, lower, upper)
    before = {symbol(f"{s.data[0]}_prev", *s.data[1:]): r for s, r in ranges.items()}
    return ranges | before


def _bounds(law: Distribution, value: np.ndarray) -> list[tuple[Expr, Expr, Expr]]:
    support = law.support()
    ends = [np.broadcast_to(plain(a), value.shape).ravel() for a in (support.lower, support.upper)]
    return list(zip(plain(value).ravel(), *ends, strict=True))


def _check(trace: Trace, site: Site, form: Expr, ranges: dict[Expr, _Range]) -> None:
    chosen = [n for n in topological([form]) if n in trace.choices]
    indexes = [trace.choices[n][0] for n in chosen]
    for node, index in zip(chosen, indexes, strict=True):
        if index.op == "symbol" and index in ranges:
            where = trace.locations.get(node, site.distribution.location)
            _check_alone(index, trace.choices[node][1], ranges[index], where)
    for read in (symbols_of([form]), symbols_of(indexes)):  # conditions too, if they are few
        values = {s: ranges[s].values for s in read if s in ranges}
        told = {s: v for s, v in values.items() if v is not None}
        size = math.prod(len(v) for v in told.values())
        if told and size <= MOST:
            columns = np.array(list(itertools.product(*told.values())), dtype=float).T
            known = dict(zip(told, columns, strict=True))
            found = first_undefined(form, trace.choices, known, size)
            if found is not None and found.index is not None:
                where = trace.locations.get(found.node, site.distribution.location)
                raise _beyond(found, known, where)
            return


def _check_alone(index: Expr, elements: int, own: _Range, where: Location) -> None:
    """Of a quantity as it is: values that cannot be listed cannot all be elements."""
    last = elements - 1
    if own.continuum:
        raise ModelError(
            f"the index {to_text(index)} takes a continuum of values, and there are {elements} "
            f"elements, 0 to {last}",
            fix=f"make it a whole number, np.clip(np.floor({to_text(index)}), 0, {last}); a state "
            "can have a law of whole numbers, such as Categorical",
            where=where,
        )
    if own.known and own.values is None:
        raise ModelError(
            f"the index {to_text(index)} has no bound, and there are {elements} elements, 0 to "
            f"{last}",
            fix=f"bound it, as in np.minimum({to_text(index)}, {last}), or give "
            f"{index.data[1]!r} a bounded law",
            where=where,
        )


def _beyond(found: Undefined, known: dict[Expr, np.ndarray], where: Location) -> ModelError:
    assert found.index is not None
    last = found.elements - 1
    at = ", ".join(f"{to_text(s)} = {known[s][found.row]:.10g}" for s in symbols_of([found.index]))
    own = "" if found.index.op == "symbol" else f" where {at}"
    return ModelError(
        f"the index {to_text(found.index)} can be {found.value:.10g}{own}, and there are "
        f"{found.elements} elements, 0 to {last}",
        fix="count from 0, as Python does (negative indices do not count from the end), and give "
        "the array an element for each value; or bound the index by np.clip",
        where=where,
    )
