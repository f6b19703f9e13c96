"""Elements of arrays that a state or a parameter chooses: its distribution has to keep within them.

What inputs choose is checked where there are data.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable

import numpy as np

from ssmppl.errors import Location, ModelError
from ssmppl.expressions.arrays import plain
from ssmppl.expressions.expr import Expr, symbols_of, to_text, topological
from ssmppl.expressions.properties import Undefined, first_undefined
from ssmppl.language.model.trace import Site, Trace, previous

MOST = 4096  # combinations of values that are tried


class _Values:
    """What the distributions of one quantity give it."""

    def __init__(self) -> None:
        self.found: set[float] = set()
        self.continuum = self.unbounded = False
        self.complete = True  # whether `found` are all

    def add(self, kind: str, lower: Expr, upper: Expr) -> None:
        """Those of a distribution with this support; of points, `_follow` adds them."""
        if kind == "integers" and lower.op == upper.op == "const":
            self.unbounded |= not upper.data - lower.data < MOST
            self.complete &= not self.unbounded
            if self.complete:
                self.found.update(np.arange(lower.data, upper.data + 0.5).tolist())
        elif kind != "point":
            self.continuum |= kind != "integers"
            self.complete = False


def check_indexes(trace: Trace) -> None:
    """Raise for an index that may choose an element that does not exist, as far as the
    distributions of the states and parameters in it tell: it would silently be the last.

    Raises
    ------
    ModelError : names the index, its value, the number of elements and the line.
    """
    if not trace.choices:
        return
    values = _values(trace)
    laws = (trace.parameters, trace.initial, trace.transition, trace.observations, trace.proposal)
    for sites in laws:
        for site in sites.values():
            for form in site.distribution.arguments():
                _check(trace, site, form, values)


def _values(trace: Trace) -> dict[Expr, _Values]:
    """Values of each state, before too, and of each parameter."""
    values: dict[Expr, _Values] = {}
    points: list[tuple[Expr, Expr]] = []
    for sites in (trace.parameters, trace.initial, trace.transition):
        for site in sites.values():
            support = site.distribution.support()
            ends = [
                np.broadcast_to(plain(a), site.shape).ravel()
                for a in (support.lower, support.upper)
            ]
            for s, lower, upper in zip(plain(site.value).ravel(), *ends, strict=True):
                values.setdefault(s, _Values()).add(support.kind, lower, upper)
                if support.kind == "point":
                    points.append((s, lower))
    values |= {previous(s): own for s, own in values.items()}
    for _ in points:  # a lag of a lag takes as many rounds
        _follow(points, values)
    return values


def _follow(points: list[tuple[Expr, Expr]], values: dict[Expr, _Values]) -> None:
    """Give deterministic states the values of what they are set to: a number, or another state."""
    for s, e in points:
        if e.op == "const":
            values[s].found.add(e.data)
        elif e in values and values[e].complete:
            values[s].found.update(values[e].found)
        else:
            values[s].complete = False


def _check(trace: Trace, site: Site, form: Expr, values: dict[Expr, _Values]) -> None:
    chosen = [n for n in topological([form]) if n in trace.choices]
    indexes = [trace.choices[n][0] for n in chosen]
    for node, index in zip(chosen, indexes, strict=True):
        if index.op == "symbol" and index in values:
            where = trace.locations.get(node, site.distribution.location)
            _check_alone(index, trace.choices[node][1], values[index], where)
    known = _combined(symbols_of([form]), values)  # with those in conditions, if they are few
    known = known or _combined(symbols_of(indexes), values)
    if not known:
        return
    size = len(next(iter(known.values())))
    found = first_undefined([form], trace.choices, known, size)
    if found is not None and found[1].index is not None:
        undefined = found[1]
        where = trace.locations.get(undefined.node, site.distribution.location)
        raise _beyond(undefined, known, where)


def _combined(read: Iterable[Expr], values: dict[Expr, _Values]) -> dict[Expr, np.ndarray]:
    """All combinations of values of those symbols whose values are all known; none if too many."""
    listed = {s: sorted(values[s].found) for s in read if s in values and values[s].complete}
    if not listed or math.prod(len(v) for v in listed.values()) > MOST:
        return {}
    columns = np.array(list(itertools.product(*listed.values())), dtype=float).T
    return dict(zip(listed, columns, strict=True))


def _check_alone(index: Expr, elements: int, own: _Values, where: Location) -> None:
    """Of a quantity as it is: values that cannot be listed cannot all be elements."""
    last = elements - 1
    if own.continuum:
        raise ModelError(
            f"the index {to_text(index)} takes a continuum of values, and there are {elements} "
            f"elements, 0 to {last}",
            fix=f"make it a whole number, np.clip(np.floor({to_text(index)}), 0, {last}); a state "
            "can have a distribution of whole numbers, such as Categorical",
            where=where,
        )
    if own.unbounded:
        raise ModelError(
            f"the index {to_text(index)} has no bound, and there are {elements} elements, 0 to "
            f"{last}",
            fix=f"bound it, as in np.minimum({to_text(index)}, {last}), or give "
            f"{index.data[1]!r} a bounded distribution",
            where=where,
        )


def _beyond(found: Undefined, known: dict[Expr, np.ndarray], where: Location) -> ModelError:
    assert found.index is not None
    at = ", ".join(f"{to_text(s)} = {known[s][found.row]:.10g}" for s in symbols_of([found.index]))
    own = "" if found.index.op == "symbol" else f" where {at}"
    return ModelError(
        f"the index {to_text(found.index)} can be {_spelled(found.value)}{own}, and there are "
        f"{found.elements} elements, 0 to {found.elements - 1}",
        fix="count from 0, as Python does (negative indices do not count from the end), and give "
        "the array an element for each value; or bound the index by np.clip, or rule it out by "
        "np.where",
        where=where,
    )


def _spelled(value: float) -> str:
    return f"{value:.0f}" if value == math.floor(value) else repr(value)
