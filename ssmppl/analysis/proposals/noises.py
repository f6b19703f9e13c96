"""The states of a model by their noises: x_1 = F_1(e_1; theta), x_t = F(x_{t-1}, e_t; theta).

With a distribution of location and scale, x = m + S e, the noise e has a distribution that is free
of the parameters in m and S: the state is non-centred. A move of theta that holds the noises fixed
takes the trajectory along (Papaspiliopoulos, Roberts and Sköld 2007, "A general framework for the
parametrization of hierarchical models", *Statistical Science* 22). Nothing is asked of the
distribution of e itself: the Jacobian of x in e is all that such a move needs, so a Student t may
even have its degrees of freedom moved. States of other distributions stay centred, deterministic
ones follow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ssmppl.analysis.density import Missing, terms
from ssmppl.analysis.new_values import resolved
from ssmppl.analysis.proposals.twisted import GivenDraws, LookaheadModel, lookahead_model
from ssmppl.analysis.structure import component_means
from ssmppl.errors import NotApplicable
from ssmppl.expressions.arrays import ExprArray, array
from ssmppl.expressions.calculus import differentiate
from ssmppl.expressions.expr import Expr, apply, constant, symbol, symbols_of
from ssmppl.language.distributions import Dirac
from ssmppl.language.model.trace import Site, Trace


@dataclass(frozen=True)
class NonCentred:
    """A distribution by its noise.

    noise : symbols of e (R,). value : F by component, in the order of the trace's states, as a
    function of x_{t-1} and e; a centred state is its own symbol. recovered : (R,) e as a function
    of x_{t-1} and x. log_volume : log |dx / de| over the states with noise. centred : names of the
    states that have no such noise and are not deterministic.
    """

    noise: tuple[Expr, ...]
    value: ExprArray
    recovered: ExprArray
    log_volume: Expr
    centred: tuple[str, ...]

    @property
    def parameters(self) -> frozenset[str]:
        """Parameters that move the states when the noises are held fixed."""
        return frozenset(
            s.data[1] for s in symbols_of(list(self.value)) if s.data[0] == "parameter"
        )


@dataclass(frozen=True)
class Noises:
    """Both distributions of a model by noise; parameters : names of those that move the states with
    them.

    tied : names of all parameters that stand in a factor with a state. lookahead : what a Gaussian
    approximation to the states' posterior can be found from, or why there is none.
    """

    initial: NonCentred
    transition: NonCentred
    parameters: tuple[str, ...]
    tied: tuple[str, ...]
    lookahead: LookaheadModel | NotApplicable


def noises(trace: Trace, missing: Missing) -> Noises | NotApplicable:
    """The model by its noises; NotApplicable where no state has noise of its own that can be told
    from it."""
    states = trace.state_symbols
    initial = non_centred(list(trace.initial.values()), states)
    transition = non_centred(list(trace.transition.values()), states)
    if not transition.noise:
        site = next(iter(trace.transition.values()))
        kinds = sorted({type(s.distribution).__name__ for s in trace.transition.values()})
        return NotApplicable(
            f"no state has a location-scale distribution ({', '.join(kinds)}): no "
            "non-centred parametrisation",
            site.distribution.location,
        )
    held = initial.parameters | transition.parameters
    tied = set(held)
    for role in ("initial", "transition", "observation"):
        for term in terms(trace, role, missing, guard=False):
            inside = symbols_of(term.log_density)
            if any(s.data[0] in ("state", "state_prev") for s in inside):
                tied |= {s.data[1] for s in inside if s.data[0] == "parameter"}
    lookahead = lookahead_model(trace, missing)
    if not (tied if isinstance(lookahead, LookaheadModel) else held):
        site = next(iter(trace.transition.values()))
        return NotApplicable(
            "no parameter is in the distribution of a state", site.distribution.location
        )
    first, second = ([p for p in trace.parameters if p in names] for names in (held, tied))
    return Noises(initial, transition, tuple(first), tuple(second), lookahead)


def non_centred(sites: Sequence[Site], states: Sequence[Expr]) -> NonCentred:
    """The distributions of one role by their noises."""
    value: dict[Expr, Expr] = {}
    noise: list[Expr] = []
    recovered: list[Expr] = []
    log_volume, centred = constant(0.0), []
    for site in sites:
        d, own = site.distribution, site.value.ravel()
        if isinstance(d, Dirac):
            value.update(component_means([site]))
            continue
        new = [symbol("noise", "noise", (len(noise) + i,)) for i in range(len(own))]
        pair = _by_noise(site, new)
        if pair is None:
            centred.append(site.name)
            continue
        noise += new
        value.update(zip(own, pair[0].ravel(), strict=True))
        recovered += list(pair[1].ravel())
        for s, e in zip(own, pair[1].ravel(), strict=True):
            # de / dx is triangular, within a site and from one to those that read its new value
            (slope,) = differentiate([e], s)
            log_volume = log_volume - apply("log", apply("abs", slope))
    moved = resolved(value)
    ordered = array([moved.get(s, s) for s in states])
    return NonCentred(tuple(noise), ordered, array(recovered), log_volume, tuple(centred))


def _by_noise(site: Site, noise: list[Expr]) -> tuple[ExprArray, ExprArray] | None:
    """(x as a function of e, e as a function of x), None where the distribution is not of that
    kind."""
    d: Any = site.distribution
    x = site.value
    if d.gaussian_noise:
        return array(d.sample(GivenDraws(site.name, noise))), array(d.standard(x))
    found = d.location_and_scale()
    if found is None:
        return None
    location, scale = (array(np.broadcast_to(array(a).view(np.ndarray), d.shape)) for a in found)
    e = array(np.array(noise, dtype=object).reshape(d.shape))
    return array(location + scale * e), array((x - location) / scale)
