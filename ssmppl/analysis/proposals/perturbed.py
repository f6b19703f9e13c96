"""A model whose parameters are carried by each particle, and take a random walk.

The free parameters become states z on their unconstrained scale. At every row

    z_t = z_{t-1} + s_t * normal,  x_t ~ f(. | x_{t-1}, theta(z_t)),  y_t ~ g(. | x_t, theta(z_t)),

with x_1 ~ mu(. | theta(z_1)): the perturbed model of iterated filtering (Ionides, Nguyen, Atchadé,
Stoev and King 2015, algorithm IF2). The standard deviations s_t are inputs of the new model: how
they cool, and which parameters move at the first row only, is data.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ssmppl.analysis.density import Missing, Term, terms
from ssmppl.analysis.proposals.proposals import Proposal, bootstrap
from ssmppl.analysis.structure import unused_name
from ssmppl.errors import Location
from ssmppl.expressions.arrays import array
from ssmppl.expressions.expr import Expr, attributed, substitute, symbol, symbols_of
from ssmppl.language.distributions import Draws, Normal
from ssmppl.language.model.trace import Site, Trace, previous, symbols
from ssmppl.language.model.transforms import Unconstrained, unconstrained


@dataclass(frozen=True)
class Perturbed:
    """The perturbed model: F unconstrained numbers behind the D states.

    trace : with z for a further state, and inputs behind the model's own: the F standard deviations
    of the row, and where the prior counts, 1 at the row that it is to count at, else 0.
    proposal : how particles move and what they weigh; initial draws read z_0 from the previous
    states.
    moving : (F,) whether a number acts at more than the first row of an experiment. Those that do
    not act in the initial distribution only, or only in the prior. acting : (F,) whether it acts at
        all.
    """

    trace: Trace
    proposal: Proposal
    moving: np.ndarray
    acting: np.ndarray


def perturbed(
    trace: Trace, missing: Missing, free: Sequence[bool], with_prior: bool = False
) -> Perturbed:
    """The perturbed form of a model.

    free : of each parameter, whether it moves; the others stay parameters. with_prior : whether the
    log prior density, of the parameters on their own scale, is one more weight.
    """
    form = unconstrained(trace, free)
    n, where = len(form.z), _location(trace)
    taken = {*trace.parameters, *trace.initial, *trace.observations, *trace.inputs}
    z_name, spread_name, counts_name = (
        unused_name(n, taken) for n in ("unconstrained", "perturbation", "prior_counts")
    )
    z = symbols("state", z_name, (n,))
    walk = Normal(array([previous(s) for s in z]), sd=symbols("input", spread_name, (n,)))
    walk.location = where
    moved = array(walk.sample(Draws("perturbation"))).ravel()
    walked = dict(zip(z.ravel(), moved, strict=True))
    plain = bootstrap(trace, missing)
    fresh, kept = (_values(form, at) for at in (list(moved), list(z.ravel())))
    first = _moved(plain.initial_draw, trace, trace.initial, fresh)
    later = _moved(plain.draw, trace, trace.transition, fresh)
    observed = _weighed(plain.weight, trace, kept)
    inputs, beginning = {**trace.inputs, spread_name: (n,)}, list(observed)
    if with_prior:
        inputs[counts_name] = ()
        guard = symbol("input", counts_name, ())
        beginning += [replace(t, guard=guard) for t in _weighed(terms(trace, "prior"), trace, kept)]
    site = Site(z_name, "state", walk, z, where)
    augmented = replace(
        trace,
        initial={**trace.initial, z_name: site},
        transition={**trace.transition, z_name: site},
        proposal={},
        inputs=inputs,
    )
    proposal = replace(
        plain, name="perturbed", initial_draw={**first, **walked}, draw={**later, **walked},
        initial_weight=tuple(beginning), weight=tuple(observed),
        explanation="parameters take a step, and particles move by the transition under them",
    )  # fmt: skip
    moving = _reached(later, observed, z)
    return Perturbed(augmented, proposal, moving, moving | _reached(first, beginning, z))


def _location(trace: Trace) -> Location:
    """A line to attribute the walk to: that of the first prior."""
    site = next(iter((trace.parameters or trace.initial).values()))
    return site.distribution.location


def _values(form: Unconstrained, at: list[Expr]) -> dict[Expr, Expr]:
    """The parameters as functions of these expressions for their unconstrained numbers."""
    new = substitute(list(form.values.values()), dict(zip(form.z, at, strict=True)))
    return dict(zip(form.values, new, strict=True))


def _moved(
    draws: dict[Expr, Expr], trace: Trace, sites: dict[str, Site], new: dict[Expr, Expr]
) -> dict[Expr, Expr]:
    out: dict[Expr, Expr] = {}
    for site in sites.values():
        with attributed(trace.locations, site.distribution.location):
            own = {s: draws[s] for s in site.components}
            out.update(zip(own, substitute(list(own.values()), new), strict=True))
    return out


def _weighed(weight: Sequence[Term], trace: Trace, new: dict[Expr, Expr]) -> list[Term]:
    out = []
    for term in weight:
        with attributed(trace.locations, term.where):
            out.append(replace(term, log_density=substitute([term.log_density], new)[0]))
    return out


def _reached(draws: dict[Expr, Expr], weight: Sequence[Term], z: np.ndarray) -> np.ndarray:
    """(F,) which of the walking numbers some draw or weight depends on."""
    found = symbols_of([*draws.values(), *(t.log_density for t in weight)])
    return np.array([s in found or previous(s) in found for s in z.ravel()], dtype=bool)
