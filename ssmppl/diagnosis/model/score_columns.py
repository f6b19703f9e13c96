"""Score columns: derivatives of the complete-data log density, row by row.

The model with all candidates in it (`augment`) is derived in its own parameters and in the
candidates' strengths, at strengths of zero. What the derivatives need beyond the states of the
model - auxiliary states of some effects, sensitivities of deterministic components - is carried as
further deterministic components of a model whose other distributions are the base model's.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ssmppl.analysis.density import Missing
from ssmppl.analysis.score import CompleteScore, Sums
from ssmppl.codegen.text.render import identifier
from ssmppl.diagnosis.model.changed_laws import substituted
from ssmppl.errors import NotApplicable
from ssmppl.expressions.arrays import array
from ssmppl.expressions.calculus import NotDifferentiable, differentiate
from ssmppl.expressions.expr import Expr, constant, dependent, substitute, symbol
from ssmppl.language.distributions import Dirac
from ssmppl.language.model.trace import Site, Trace, previous


@dataclass(frozen=True)
class ScoreExpressions:
    """The score columns as expressions: F derivatives, those in the P nuisance parameters first,
    then those in the strengths.

    base : the model. carried : the model over whose states the expressions are; the base itself
    where nothing has to be carried. follows : role -> (component, value) of what is carried.
    given : the trace whose parameters the expressions may hold: the base's, then shapes.
    initial, later : (F) at row 1 and at the others. names : of the strengths.
    refused : why a strength or parameter has no column.
    """

    base: Trace
    carried: Trace
    given: Trace
    initial: tuple[Expr, ...]
    later: tuple[Expr, ...]
    nuisance: tuple[Expr, ...]
    names: tuple[str, ...]
    follows: dict[str, list[tuple[Expr, Expr]]] = field(default_factory=dict)
    refused: dict[str, NotApplicable] = field(default_factory=dict)


def score_columns(
    base: Trace, superset: Trace, strengths: Collection[str], held: Collection[str],
    missing: Missing,
) -> ScoreExpressions:  # fmt: skip
    """The columns of a model with candidates; `held` parameters, or components of them by their
    text, have none.

    superset : the base model with candidates, as of `augment`; the base itself for none.
    strengths : names of the superset's parameters that are strengths; other further parameters
        (shapes) stay.
    """
    wanted: list[Expr] = []
    refused: dict[str, NotApplicable] = {}
    own = set(base.parameter_symbols)
    # Auxiliary states come in multiplied by a strength, which is zero.
    inert = frozenset(superset.state_symbols) - frozenset(base.state_symbols)
    superset = _linear_in(superset, strengths, inert, refused)
    free = [s for s in superset.parameter_symbols if not {s.data[1], repr(s)} & set(held)]
    free = [s for s in free if s in own or s.data[1] in strengths]
    free = [s for s in free if repr(s) not in refused]
    derived = CompleteScore(superset, free, missing, inert)
    there = _without(superset, strengths)
    for s in free:
        reason = derived.obstacle(s, there)
        if reason is None:
            wanted.append(s)
        else:
            refused[repr(s)] = reason
    derived, sums = _gradient(superset, wanted, missing, inert, refused)
    zero: dict[Expr, Expr] = {
        s: constant(0.0) for s in superset.parameter_symbols if s.data[1] in strengths
    }
    zero |= _plain_names(sums.columns)
    parts = {role: substitute(list(es), zero) for role, es in sums.parts.items()}
    initial = [a + b for a, b in zip(parts["initial"], parts["observation"], strict=True)]
    later = [a + b for a, b in zip(parts["transition"], parts["observation"], strict=True)]
    further = len(superset.state_symbols) > len(base.state_symbols) or sums.columns
    given = replace(
        superset, parameters={n: s for n, s in superset.parameters.items() if n not in strengths}
    )
    if not further:
        given = replace(base, parameters=given.parameters)  # its laws hold no strength
    carried = base
    follows: dict[str, list[tuple[Expr, Expr]]] = {}
    if further:
        carried = _carried(base, given, sums, zero)
        given = carried
        known = set(base.state_symbols)
        for role, sites in (("initial", carried.initial), ("transition", carried.transition)):
            follows[role] = [
                (s, e)
                for site in sites.values()
                for s, e in zip(
                    site.value.ravel(), array(site.distribution.mean()).ravel(), strict=True
                )
                if s not in known
            ]
    return ScoreExpressions(
        base, carried, given, tuple(initial), tuple(later),
        tuple(s for s in derived.parameters if s in own),
        tuple(s.data[1] for s in derived.parameters if s not in own), follows, refused,
    )  # fmt: skip


def _linear_in(
    superset: Trace, strengths: Collection[str], inert: Collection[Expr],
    refused: dict[str, NotApplicable],
) -> Trace:  # fmt: skip
    """The trace with deterministic distributions linear in strengths, which is all that first
    derivatives at zero see: products of two of them would have to be carried for nothing. In the
    distributions of what is inert the strengths are zero, as are those without a derivative, which
    are `refused`."""
    own = [s for s in superset.parameter_symbols if s.data[1] in strengths]
    zero: dict[Expr, Expr] = {s: constant(0.0) for s in own}

    def linear(site: Site) -> Site:
        roots = list(array(site.distribution.mean()).ravel())
        inside = dependent(roots, own)
        if not isinstance(site.distribution, Dirac) or not inside.intersection(roots):
            return site
        values = substitute(roots, zero)
        for s in () if site.value.ravel()[0] in inert else own:
            if dependent(roots, [s]).intersection(roots):
                try:
                    slopes = substitute(differentiate(roots, s), zero)
                except NotDifferentiable as error:
                    refused[repr(s)] = NotApplicable(error.found)
                    continue
                values = [v + s * d for v, d in zip(values, slopes, strict=True)]
        law = Dirac(array(np.array(values, dtype=object).reshape(site.shape)))
        law.location = site.distribution.location
        return replace(site, distribution=law)

    return replace(
        superset,
        initial={n: linear(s) for n, s in superset.initial.items()},
        transition={n: linear(s) for n, s in superset.transition.items()},
    )


def _without(superset: Trace, strengths: Collection[str]) -> Trace:
    """The trace with deterministic distributions of strengths 0: a slope in one, which may jump as
    friction's does, is multiplied by it, and a derivative at 0 does not see how it changes."""
    zero: dict[Expr, Expr] = {
        s: constant(0.0) for s in superset.parameter_symbols if s.data[1] in strengths
    }

    def plain(site: Site) -> Site:
        law = site.distribution
        return replace(site, distribution=substituted(law, zero)) if type(law) is Dirac else site

    return replace(
        superset,
        initial={n: plain(s) for n, s in superset.initial.items()},
        transition={n: plain(s) for n, s in superset.transition.items()},
    )


def _gradient(
    superset: Trace,
    wanted: list[Expr],
    missing: Missing,
    inert: Collection[Expr],
    refused: dict[str, NotApplicable],
) -> tuple[CompleteScore, Sums]:
    """The derivatives in closed form; what has none is moved to `refused`."""
    derived = CompleteScore(superset, wanted, missing, inert)
    try:
        return derived, derived.gradient()
    except NotDifferentiable:
        kept = []
        for s in wanted:
            try:
                CompleteScore(superset, [s], missing, inert).gradient()
                kept.append(s)
            except NotDifferentiable as error:
                refused[repr(s)] = NotApplicable(error.found)
        derived = CompleteScore(superset, kept, missing, inert)
        return derived, derived.gradient()


def _plain_names(columns: Sequence[Expr]) -> dict[Expr, Expr]:
    """Sensitivities, which stand under names with blanks, as states that code can name."""
    out: dict[Expr, Expr] = {}
    for k, column in enumerate(columns):
        plain = symbol("state", f"{identifier(column.data[1])}_{k}", ())
        out[column], out[previous(column)] = plain, previous(plain)
    return out


def _carried(base: Trace, given: Trace, sums: Sums, zero: dict[Expr, Expr]) -> Trace:
    """The superset at strength zero with the sensitivities as deterministic states."""

    def at_zero(sites: dict[str, Site]) -> dict[str, Site]:
        return {
            n: replace(s, distribution=substituted(s.distribution, zero)) for n, s in sites.items()
        }

    # The model's own laws as they are: at strength zero some are only next to them (tails).
    initial = {**at_zero(given.initial), **base.initial}
    transition = {**at_zero(given.transition), **base.transition}
    location = next(iter(given.transition.values())).distribution.location
    for role, sites in (("initial", initial), ("transition", transition)):
        value = dict(sums.follows.get(role, []))
        for column in sums.columns:
            (e,) = substitute([value.get(column, constant(0.0))], zero)
            own = zero[column]
            law = Dirac(e)
            law.location = location
            sites[own.data[1]] = Site(own.data[1], "state", law, array(own), location)
    return replace(
        given, initial=initial, transition=transition, observations=base.observations, proposal={}
    )
