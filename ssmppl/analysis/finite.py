"""Finite states: models whose states take few values, and those values.

Of Categorical, Bernoulli and Binomial distributions, and of Truncated counts between numbers, the
values are known; a deterministic component (a lag, a duration that starts over) takes those of its
expression over the values of what it depends on, iterated until nothing new turns up. Every round
but the last adds a value, so that a counter without end soon has too many.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from ssmppl.analysis.structure import component_means, deterministic
from ssmppl.errors import NotApplicable
from ssmppl.expressions.arrays import array
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import Expr, symbols_of
from ssmppl.language.distributions import Dirac
from ssmppl.language.model.trace import Site, Trace, previous

MOST = 64  # combinations of values: a step costs their square


@dataclass(frozen=True)
class FiniteStates:
    """values : (K, D), every combination of the components' values, in the trace's order."""

    values: np.ndarray


def finite_states(trace: Trace) -> FiniteStates | NotApplicable:
    """The values that x can take, or why they are not few."""
    domain: dict[Expr, tuple[float, ...]] = {}
    if not trace.initial:
        return NotApplicable("there are no states")
    for sites in (trace.initial, trace.transition):
        for site in sites.values():
            if isinstance(site.distribution, Dirac):
                continue
            found = _values(site)
            if isinstance(found, NotApplicable):
                return found
            for s, own in zip(site.value.ravel(), found, strict=True):
                domain[s] = tuple(sorted({*domain.get(s, ()), *own}))
    size = _combinations(domain)
    if size > MOST:
        return NotApplicable(f"the states have {size} combinations of values, more than {MOST}")
    reason = _follow(trace, domain)
    if reason is not None:
        return reason
    columns = [domain[s] for s in trace.state_symbols]
    return FiniteStates(np.array(list(itertools.product(*columns)), dtype=float))


def _combinations(domain: Mapping[Expr, tuple[float, ...]]) -> int:
    return math.prod(map(len, domain.values()))


def _values(site: Site) -> list[tuple[float, ...]] | NotApplicable:
    """Values of each component of a distribution that is not deterministic."""
    d, where = site.distribution, site.distribution.location
    support = d.support()
    if support.kind != "integers":
        return NotApplicable(f"{site.name!r} takes a continuum of values", where)
    out = []
    ends = [np.broadcast_to(array(a).view(np.ndarray), site.shape).ravel()
            for a in (support.lower, support.upper)]  # fmt: skip
    for low, high in zip(*ends, strict=True):
        if low.op != "const" or high.op != "const":
            return NotApplicable(f"the bounds of {site.name!r} are not numbers", where)
        if not np.isfinite(high.data - low.data):
            return NotApplicable(f"{site.name!r} takes infinitely many values", where)
        if high.data - low.data >= MOST:
            return NotApplicable(f"{site.name!r} takes more than {MOST} values", where)
        out.append(tuple(np.arange(low.data, high.data + 0.5).tolist()))
    return out


def _follow(trace: Trace, domain: dict[Expr, tuple[float, ...]]) -> NotApplicable | None:
    """Add the values of the deterministic components to `domain`; or say why they are not few."""
    pairs = [
        (site, s, e)
        for sites in (trace.initial, trace.transition)
        for site in deterministic(list(sites.values()))
        for s, e in component_means([site]).items()
    ]
    before = {previous(s): s for s in trace.state_symbols}
    states = set(trace.state_symbols)
    for site, _, e in pairs:
        others = [s for s in symbols_of([e]) if before.get(s, s) not in states]
        if others:
            return NotApplicable(
                f"the values of {site.name!r} depend on {others[0]!r}", site.distribution.location
            )
    grown = True
    while grown:
        grown = False
        for site, s, e in pairs:
            needed = symbols_of([e])
            known = [domain.get(before.get(n, n), ()) for n in needed]
            new = {*domain.get(s, ()), *_reached(e, needed, known)}
            where = site.distribution.location
            if len(new) > MOST:
                return NotApplicable(f"{site.name!r} takes more than {MOST} values", where)
            if len(new) > len(domain.get(s, ())):
                grown, domain[s] = True, tuple(sorted(new))
                if _combinations(domain) > MOST:
                    return NotApplicable(
                        f"{site.name!r} takes so many values that the states have more than {MOST} "
                        "combinations",
                        where,
                    )
    for site, s, _ in pairs:
        if s not in domain:
            return NotApplicable(f"{site.name!r} takes no value", site.distribution.location)
    return None


def _reached(
    e: Expr, needed: Iterable[Expr], known: Iterable[tuple[float, ...]]
) -> Iterable[float]:
    needed = list(needed)
    combinations = list(itertools.product(*known))  # of two rows of few: at most MOST**2
    if not combinations:
        return []
    columns = dict(zip(needed, np.array(combinations, dtype=float).T, strict=True))
    found = np.asarray(evaluate(e, columns), dtype=float).ravel()
    return np.unique(found[np.isfinite(found)]).tolist()
