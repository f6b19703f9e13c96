"""The complete-data log density as terms, and each of them separated in a block of parameters.

    log p(theta, x_{1:T}, y_{1:T}) = prior + initial + sum_{t=2}^T transition_t
                                   + sum_{t=1}^T observation_t

With everything but a block fixed, every term is sum_i c_i(rest) s_i(block), so that

    log p(block | rest) = const + sum_i C_i s_i(block),
    C_i = prior_i + initial_i + sum_t transition_i + sum_t observation_i.

The functions s_i are common to all roles; the C_i are the statistics. Terms that do not hold
the block are left out. Supports are kept apart: the densities here are unguarded, and what a
support asks of the block is given by `CompleteData.restrictions`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from ssmppl.analysis.density import Missing, terms
from ssmppl.errors import Location, NotApplicable
from ssmppl.expressions.algebra import ONE, Monomial, Separation, monomial_expr, separate
from ssmppl.expressions.arrays import array
from ssmppl.expressions.expr import Expr, constant, symbols_of, to_text
from ssmppl.language.distributions import Dirac
from ssmppl.language.model.trace import Site, Trace

ROLES = ("prior", "initial", "transition", "observation")
BOUNDED_ROLES = ("prior", "initial")  # as many terms, however long the series
_BOUNDED = ("interval", "integers", "ordered")


@dataclass(frozen=True)
class JointTerm:
    """One summand of the complete-data log density: of one site, or one component of it.

    density : log density on the support; of an observation 0 where it is missing.
    degenerate : a Dirac, whose density is 0 or infinite; `density` is then the value.
    """

    role: str
    site: str
    density: Expr
    where: Location
    symbols: frozenset[Expr]
    degenerate: bool = False


@dataclass(frozen=True)
class Restriction:
    """A bound that one component of a site must respect, where it is no number."""

    role: str
    site: str
    value: Expr
    bound: Expr
    where: Location

    @property
    def symbols(self) -> frozenset[Expr]:
        return symbols_of(self.bound)


@dataclass(frozen=True)
class CompleteData:
    """The terms of a model and the bounds that its supports set."""

    trace: Trace
    terms: tuple[JointTerm, ...]
    restrictions: tuple[Restriction, ...]

    def holding(self, block: Iterable[Expr]) -> list[JointTerm]:
        """The terms that hold a symbol of the block."""
        wanted = frozenset(block)
        return [f for f in self.terms if f.symbols & wanted]


@dataclass(frozen=True)
class BlockForm:
    """log p(block | rest) = const + sum_i C_i s_i(block).

    functions : the s_i; `monomials` holds them as products of powers.
    coefficients : role -> the summands of C_i, aligned with `functions`.
    origins : monomial -> the terms it comes from.
    inseparable : terms of the prior and the initial distribution that do not separate, and why;
        they are missing in the sum. Empty unless it was asked for.
    """

    components: tuple[Expr, ...]
    monomials: tuple[Monomial, ...]
    functions: tuple[Expr, ...]
    coefficients: dict[str, tuple[Expr, ...]]
    origins: dict[Monomial, tuple[JointTerm, ...]] = field(repr=False)
    inseparable: tuple[tuple[JointTerm, NotApplicable], ...] = ()

    @cached_property
    def places(self) -> dict[Monomial, int]:
        """Function, as a monomial -> position."""
        return {m: i for i, m in enumerate(self.monomials)}

    def roles(self, monomial: Monomial) -> frozenset[str]:
        """The roles of the terms that a function comes from."""
        return frozenset(f.role for f in self.origins[monomial])


NOTHING_MISSING = Missing()


def complete_data(trace: Trace, missing: Missing = NOTHING_MISSING) -> CompleteData:
    """All terms of a traced model, in the order prior, initial, transition, observation."""
    found: list[JointTerm] = []
    restrictions: list[Restriction] = []
    by_role = (trace.parameters, trace.initial, trace.transition, trace.observations)
    for role, sites in zip(ROLES, by_role, strict=True):
        for site in sites.values():
            if role != "observation":
                found += _terms_of(role, site)
            restrictions += _restrictions(role, site)
    for term in terms(trace, "observation", missing, guard=False):
        for density in _summands(term.guarded()):  # of each channel: a parameter is in few
            found.append(
                JointTerm("observation", term.site.name, density, term.where, symbols_of(density))
            )
    return CompleteData(trace, tuple(found), tuple(restrictions))


def _summands(density: Expr) -> list[Expr]:
    """What a density is the sum of, as it was written."""
    found, waiting = list[Expr](), [density]
    while waiting:
        node = waiting.pop()
        if node.op == "add":
            waiting += reversed(node.args)
        else:
            found.append(node)
    return found


def _terms_of(role: str, site: Site) -> list[JointTerm]:
    law, out = site.distribution, []
    degenerate = isinstance(law, Dirac)
    if degenerate:
        densities = list(law.value.ravel())
    else:
        densities = list(array(law.log_densities(site.value)).ravel())
    for e in densities:
        out.append(JointTerm(role, site.name, e, law.location, symbols_of(e), degenerate))
    return out


def _restrictions(role: str, site: Site) -> list[Restriction]:
    support = site.distribution.support()
    if support.kind not in _BOUNDED:
        return []
    out = []
    shape = site.shape
    for bounds in (support.lower, support.upper):
        for bound, value in zip(
            np.broadcast_to(bounds.view(np.ndarray), shape).ravel(),
            site.value.ravel(),
            strict=True,
        ):
            if bound.op != "const":
                out.append(Restriction(role, site.name, value, bound, site.distribution.location))
    return out


def separate_block(
    trace: Trace | CompleteData, block: Iterable[Expr], leave: bool = False
) -> BlockForm | NotApplicable:
    """The separated log density of a block of parameter components, given all else.

    leave : go on where a term that does not grow with the series does not separate, without it.

    NotApplicable where a term does not separate, where a Dirac's value depends on the block
    (its density is degenerate), or where the support of another quantity does.
    """
    data = trace if isinstance(trace, CompleteData) else complete_data(trace)
    components = tuple(block)
    wanted = frozenset(components)
    sums_by_role: dict[str, dict[Monomial, Expr]] = {role: {} for role in ROLES}
    origins: dict[Monomial, list[JointTerm]] = {}
    inseparable: list[tuple[JointTerm, NotApplicable]] = []
    for refusal in (degenerate(data, components), restricted(data, components)):
        if refusal is not None:
            return refusal
    for term in data.holding(components):
        form = separate(term.density, wanted)
        if not isinstance(form, Separation):
            why = NotApplicable(f"{_law(term)}: {shorten(form.reason, 160)}", term.where)
            if not leave or term.role not in BOUNDED_ROLES:
                return why
            inseparable.append((term, why))
            continue
        for monomial, coefficient in form.terms.items():
            if monomial == ONE:
                continue
            sums = sums_by_role[term.role]
            sums[monomial] = sums.get(monomial, constant(0.0)) + coefficient
            origins.setdefault(monomial, []).append(term)
    texts = {m: monomial_expr(m) for m in origins}
    monomials = tuple(sorted(origins, key=lambda m: to_text(texts[m])))
    zero = constant(0.0)
    return BlockForm(
        components,
        monomials,
        tuple(texts[m] for m in monomials),
        {role: tuple(sums_by_role[role].get(m, zero) for m in monomials) for role in ROLES},
        {m: tuple(o) for m, o in origins.items()},
        tuple(inseparable),
    )


def degenerate(data: CompleteData, block: Iterable[Expr]) -> NotApplicable | None:
    """Why the block has no density given the states: a Dirac's value depends on it."""
    for term in data.holding(block):
        if term.degenerate:
            names = _names(term.symbols & frozenset(block))
            return NotApplicable(
                f"the {term.role} of {term.site} is Dirac and its value depends on {names}: "
                "given the states the value determines the parameter, so that it cannot move",
                term.where,
            )
    return None


def restricted(data: CompleteData, block: Iterable[Expr]) -> NotApplicable | None:
    """Why the block is not free: the support of another quantity depends on it."""
    wanted = frozenset(block)
    for r in data.restrictions:
        inside = r.symbols & wanted
        if inside:
            return NotApplicable(
                f"{_names(inside)} bounds the support of {r.site} ({to_text(r.value)} and "
                f"{shorten(to_text(r.bound), 160)}): the bound is in no separated factor",
                r.where,
            )
    return None


def _law(term: JointTerm) -> str:
    return f"{term.role} of {term.site}"


def _names(symbols: Iterable[Expr]) -> str:
    return ", ".join(sorted({to_text(s) for s in symbols}))


def shorten(text: str, length: int = 100) -> str:
    """A text, or its beginning."""
    return text if len(text) <= length else text[: length - 4] + " ..."
