"""Which states the tempered particle filter can move by themselves.

Between two temperatures particles take random-walk steps in x_t that leave the distribution of
density proportional to f(x_t | x_{t-1}) g(y_t | x_t)^temperature invariant. That needs a density of
x_t, and room to move: components of a continuous distribution have both. The others stay where the
transition put them, deterministic ones too, as long as they follow from no state that moves in the
same step.
"""

from __future__ import annotations

from dataclasses import dataclass

from ssmppl.analysis.density import Missing, Term, terms
from ssmppl.analysis.structure import deterministic, flat_start, singular_states
from ssmppl.errors import NotApplicable
from ssmppl.expressions.arrays import array
from ssmppl.expressions.expr import Expr, depends_on, symbols_of
from ssmppl.language.model.trace import Site, Trace

MOVABLE = ("real", "interval")  # supports that a random walk can move about in


@dataclass(frozen=True)
class Tempered:
    """What moves at t = 1 and later, by component in the trace's order, and by which densities.

    initial, transition : the log densities of all components that are not deterministic.
    """

    moved_initial: tuple[bool, ...]
    moved: tuple[bool, ...]
    initial: tuple[Term, ...]
    transition: tuple[Term, ...]


def tempered(trace: Trace, missing: Missing) -> Tempered | NotApplicable:
    """What the tempered filter moves; the reason where it can move nothing that is observed."""
    flat = flat_start(trace)
    if flat:
        where = flat[0].distribution.location
        return NotApplicable(f"the initial distribution of {flat[0].name!r} is Flat", where)
    singular = singular_states(trace)
    if singular is not None:
        return singular
    states = trace.state_symbols
    moving: list[set[Expr]] = []
    densities: list[tuple[Term, ...]] = []
    for role, sites in (("initial", trace.initial), ("transition", trace.transition)):
        known = deterministic(list(sites.values()))
        own = {s for site in sites.values() if _continuous(site) for s in site.components}
        for site in known:
            if any(depends_on(e, list(own)) for e in array(site.distribution.mean()).ravel()):
                return NotApplicable(
                    f"the {role} distribution of {site.name!r} is Dirac and follows from states of "
                    "the same step, which cannot be moved by themselves",
                    site.distribution.location,
                )
        moving.append(own)
        names = {site.name for site in known}
        densities.append(tuple(t for t in terms(trace, role) if t.site.name not in names))
    first, later = moving
    observed = [t.log_density for t in terms(trace, "observation", missing)]
    where = next(iter(trace.transition.values())).distribution.location
    if not later:
        return NotApplicable("no state has a continuous transition to move about in", where)
    if later.isdisjoint(symbols_of(observed)):
        return NotApplicable(
            "the observation depends on no state that has a continuous transition", where
        )
    return Tempered(
        tuple(s in first for s in states), tuple(s in later for s in states), *densities
    )


def _continuous(site: Site) -> bool:
    d = site.distribution
    return d.support().kind in MOVABLE and not d.discrete
