"""Distributions of a step that read new values of other states, x_t beside x_{t-1}.

They stand in an order in which each reads new values of earlier ones only, so that p(x_t | x_{t-1})
is the product of their densities as they are. What is drawn, or derived from the past alone, has
the earlier values put in: `resolved`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from ssmppl.expressions.expr import Expr, depends_on, substitute, symbols_of
from ssmppl.language.model.trace import Site


def reads_of(site: Site) -> frozenset[Expr]:
    """The symbols in a distribution, those of its own value not among them."""
    found = symbols_of(site.distribution.arguments())
    return frozenset(found) - frozenset(site.components)


def resolved(values: dict[Expr, Expr]) -> dict[Expr, Expr]:
    """Draws or values that name others of the same step, in terms of what came before."""
    if not any(depends_on(e, list(values)) for e in values.values()):
        return values
    known: dict[Expr, Expr] = {}
    for s, e in values.items():  # what follows stands behind what it follows from
        (known[s],) = substitute([e], known)
    return known


def in_order(sites: Mapping[str, Site]) -> dict[str, Site] | None:
    """The sites, each behind those whose new values it reads, else as they stand; None where they
    read each other's in a circle."""
    owner = {s: name for name, site in sites.items() for s in site.components}
    needs = {
        name: {owner[s] for s in reads_of(site) if s in owner} - {name}
        for name, site in sites.items()
    }
    out: dict[str, Site] = {}
    while len(out) < len(sites):
        ready = next((n for n in sites if n not in out and needs[n] <= set(out)), None)
        if ready is None:
            return None
        out[ready] = sites[ready]
    return out


def reached(reads: Mapping[Expr, Iterable[Expr]], seeds: Iterable[Expr]) -> set[Expr]:
    """The seeds, and all that they read, or what they read does. reads : by component."""
    found: set[Expr] = set()
    waiting = list(seeds)
    while waiting:
        s = waiting.pop()
        if s not in found:
            found.add(s)
            waiting += reads.get(s, ())
    return found
