"""How particles move: what a proposal is, the transition itself, the laws taken apart.

A `Proposal` says how a particle moves and what it weighs, as expressions:

* `draw` gives x_t from x_{t-1} and random draws, `initial_draw` gives x_1;
* `weight` are the terms of log [ f(x_t | x_{t-1}) g(y_t | x_t) / q(x_t | x_{t-1}, y_t) ];
* `look_ahead` approximates log p(y_t | x_{t-1}), the auxiliary weight of Pitt and Shephard (1999);
* `fit` are subexpressions of these, functions of x_{t-1} and y_t, that are computed once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ssmppl.analysis.density import Missing, Term, terms
from ssmppl.analysis.structure import GaussianBlock, gaussian_block
from ssmppl.expressions.arrays import ExprArray, array, elementwise
from ssmppl.expressions.expr import Expr, attributed, depends_on, substitute, topological
from ssmppl.language.distributions import Draws
from ssmppl.language.traced import Site, Trace


@dataclass(frozen=True)
class Proposal:
    """How particles move and what they weigh; see the module's docstring."""

    name: str
    initial_draw: dict[Expr, Expr]
    initial_weight: tuple[Term, ...]
    draw: dict[Expr, Expr]
    weight: tuple[Term, ...]
    look_ahead: Expr | None = None
    exact_look_ahead: bool = False
    fit: tuple[Expr, ...] = ()
    explanation: str = ""
    looped: int = 0  # multiplications per particle, of a proposal that is not written out


def bootstrap(trace: Trace, missing: Missing) -> Proposal:
    """Move by the transition, weigh by the observation (Gordon, Salmond and Smith 1993)."""
    observed = tuple(terms(trace, "observation", missing))
    return Proposal(
        "bootstrap",
        resolved(draws_of(trace, list(trace.initial.values()))),
        observed,
        resolved(draws_of(trace, list(trace.transition.values()))),
        observed,
        explanation="particles move by the transition and are weighed by the observation",
    )


def draws_of(trace: Trace, sites: list[Site]) -> dict[Expr, Expr]:
    """A draw from the law of every component, which may name others of the same step; NaN where a
    parameter of the law is out of its range."""
    out: dict[Expr, Expr] = {}
    for site in sites:
        law = site.distribution
        with attributed(trace.locations, law.location):
            sample = drawn(site)
        out.update(zip(site.value.ravel(), sample.ravel(), strict=True))
    return out


def drawn(site: Site, draws: Draws | None = None) -> ExprArray:
    """A draw from a law, of its shape; NaN where a parameter is out of its range.

    Of a flat law, and of an observation's without a sampler, NaN, for code that is never run: no
    algorithm starts from the one, and what would draw the other refuses.

    draws : the random numbers that it is made of; None: its own.
    """
    law = site.distribution
    if not law.drawable:
        return array(np.full(site.shape, math.nan))
    sample = array(law.sample(draws or Draws(site.name)) if law.proper else law.mean())
    inside = law.in_range()
    return sample if inside is None else array(elementwise("where", inside, sample, math.nan))


def resolved(values: dict[Expr, Expr]) -> dict[Expr, Expr]:
    """Such draws in terms of x_{t-1} alone."""
    if not any(depends_on(e, list(values)) for e in values.values()):
        return values
    known: dict[Expr, Expr] = {}
    for s, e in values.items():  # what follows stands behind what it follows from
        (known[s],) = substitute([e], known)
    return known


@dataclass(frozen=True)
class Split:
    """The states of one law: Gaussian ones, and the others with their draws.

    following : those of the others that are functions of the Gaussian ones of the same step.
    """

    gaussian: GaussianBlock
    others: dict[Expr, Expr]
    random: bool  # whether some other state is random
    following: dict[Expr, Expr]

    def insert(self, expressions: dict[Expr, Expr]) -> dict[Expr, Expr]:
        """`expressions` with the other states replaced by their draws."""
        values = substitute(list(expressions.values()), self.others)
        return dict(zip(expressions, values, strict=True))

    def complete(self, draw: dict[Expr, Expr]) -> dict[Expr, Expr]:
        """The draws of all states, given those of the Gaussian ones."""
        draw = self.insert(draw)
        after = substitute(list(self.following.values()), draw)
        return {**self.others, **draw, **dict(zip(self.following, after, strict=True))}


def split(trace: Trace, sites: list[Site]) -> Split:
    """The initial law or the transition, taken apart."""
    block = gaussian_block(sites)
    own = set(block.symbols)
    others = {s: e for s, e in draws_of(trace, sites).items() if s not in own}
    following = {s: e for s, e in others.items() if depends_on(e, block.symbols)}
    random = any(n.op == "random" for n in topological(others.values()))
    return Split(block, others, random, following)
