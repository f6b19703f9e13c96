"""Effects that act inside of a simulator's step, by a force that it takes.

A friction in a joint is a torque: it moves the other joints too, as the simulator's inertia has it.
So where a rate comes from a simulator that declares a generalised force on it, an effect in that
rate is added to the force, in the force's unit, and held over the step as inputs are. The step then
is none of a sum, and derivatives at strength 0 are those of the simulator in its force: `linear`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ssmppl.diagnosis.model.changed_laws import scale_of_mean, shifted, substituted
from ssmppl.errors import NotApplicable
from ssmppl.expressions.arrays import array
from ssmppl.expressions.batched.call import OP, Derivative
from ssmppl.expressions.calculus import NotDifferentiable, gradient
from ssmppl.expressions.expr import Expr, constant, substitute, symbols_of
from ssmppl.language.distributions import Dirac, Distribution
from ssmppl.language.model.trace import Site, Trace, previous


@dataclass(frozen=True)
class Force:
    """An argument of a simulator's call that is a force on one of the states that it gives.

    name : of the argument. call : the node. place : of the argument in it. rate : the new value of
    that state, as a node.
    """

    name: str
    call: Expr
    place: int
    rate: Expr

    @property
    def value(self) -> Expr:
        """What the model gives as force."""
        return self.call.args[self.place]

    def slope_of(self, item: Expr) -> Expr:
        """The derivative in the force of a state that the call gives."""
        slope = Derivative(self.call.data.function, (self.place,))
        return Expr("item", (Expr(OP, self.call.args, slope),), item.data)


def force_on(mean: Expr | NotApplicable) -> Force | None:
    """The force on a rate with this mean; None where a simulator gives it no such."""
    if isinstance(mean, NotApplicable) or not _is_given(mean):
        return None
    (call,) = mean.args
    function = call.data.function
    acting = getattr(function.simulator, "forces", None)
    if not isinstance(acting, Mapping) or function is not function.simulator.moves:
        return None
    (k,) = mean.data
    state = function.results[k]
    found = [name for name, on in acting.items() if on == state]
    if len(found) != 1:
        return None
    return Force(found[0], call, function.arguments.index(found[0]), mean)


def _is_given(e: Expr) -> bool:
    return e.op == "item" and e.args[0].op == OP and not e.args[0].data.index


def with_forces(trace: Trace, pushes: list[tuple[Force, Expr]]) -> Trace:
    """The trace with increments of forces."""
    new = _calls(pushes)
    return replace(trace, transition={
        n: _with(s, substituted(s.distribution, new)) for n, s in trace.transition.items()
    })  # fmt: skip


def pushed(force: Force, pushes: list[tuple[Force, Expr]]) -> Force:
    """The force as it is in a trace `with_forces` of these."""
    call = _calls(pushes).get(force.call, force.call)
    return replace(force, call=call, rate=Expr("item", (call,), force.rate.data))


def _calls(pushes: list[tuple[Force, Expr]]) -> dict[Expr, Expr]:
    """The calls with increments of their forces, by those without."""
    calls: dict[Expr, list[Expr]] = {}
    for force, by in pushes:
        arguments = calls.setdefault(force.call, list(force.call.args))
        arguments[force.place] = arguments[force.place] + by
    return {call: Expr(OP, tuple(args), call.data) for call, args in calls.items()}


def linear(trace: Trace, pushes: list[tuple[Force, Expr]]) -> Trace:
    """The trace with what increments of forces do to first order.

    Where the force has a noise w of its own, as torque noise is, w + g takes the place of w: its
    mean is g of the states that it acts on, and they follow from it as they did from w (at the
    first row, which no step leads to, it stays w). What g makes of such noises themselves is left
    out, as if they were 0 there: a noise cannot have itself in its mean. Else the rates' means
    move, by g times their derivatives in the force; what integrates them follows a step later.
    Either way no deterministic state changes with the strengths, whose derivatives would have to be
    carried for each of them.
    """
    sites, added = dict(trace.transition), dict[str, dict[tuple[int, ...], Expr]]()

    def add(name: str, index: tuple[int, ...], by: Expr) -> None:
        own = added.setdefault(name, {})
        own[index] = own[index] + by if index in own else by

    found = [_noise_in(force, trace) for force, _ in pushes]
    noises = {s for s in found if s is not None}
    for (force, by), noise in zip(pushes, found, strict=True):
        if noise is not None:
            lagged = [s for s in symbols_of([by]) if s.data[0].endswith("_prev")]
            by = substitute([by], {s: _now(s) for s in lagged})[0]
            drawn = {s: constant(0.0) for s in symbols_of([by]) if s in noises}
            site = trace.law_of(noise)
            add(site.name, site.index_of(noise), substitute([by], drawn)[0])
            continue
        for name, site in trace.transition.items():
            for index, item in _means(site.distribution).items():
                if _is_given(item) and item.args[0] is force.call:
                    add(name, index, by * force.slope_of(item))
    for name, changes in added.items():
        sites[name] = _with(sites[name], shifted(sites[name].distribution, changes))
    return replace(trace, transition=sites)


def _with(site: Site, law: Distribution) -> Site:
    law.location = site.distribution.location
    return replace(site, distribution=law)


def _now(s: Expr) -> Expr:
    return Expr("symbol", (), (s.data[0].removesuffix("_prev"), *s.data[1:]))


def _means(d: Distribution) -> dict[tuple[int, ...], Expr]:
    """The means of a distribution with noise, by their index; none of others."""
    if isinstance(d, Dirac) or scale_of_mean(d) != "identity":
        return {}
    values = array(d.mean())
    return {index: values[index] for index in np.ndindex(values.shape)}


def _noise_in(force: Force, trace: Trace) -> Expr | None:
    """The state with noise that is added to the force as it is; None where there is none, or
    another distribution reads its new value."""
    own = {previous(s): s for s in trace.state_symbols}
    inside = [own[s] for s in symbols_of([force.value]) if s in own]
    noisy = [
        s
        for s in inside
        if not isinstance(trace.law_of(s).distribution, Dirac)
        and scale_of_mean(trace.law_of(s).distribution) == "identity"
    ]
    if len(noisy) != 1 or not isinstance(_law_of(force.rate, trace), Dirac):
        return None
    (s,) = noisy
    try:
        (slope,) = gradient(force.value, [previous(s)])
    except NotDifferentiable:
        return None
    read = symbols_of([
        e for site in trace.transition.values() for a in site.distribution.parameters.values()
        for e in array(a).ravel()
    ])  # fmt: skip
    return s if slope.op == "const" and slope.data == 1.0 and s not in read else None


def _law_of(rate: Expr, trace: Trace) -> Distribution | None:
    """The distribution of the state whose new value this is."""
    for site in trace.transition.values():
        d = site.distribution
        if isinstance(d, Dirac) and any(e is rate for e in array(d.mean()).ravel()):
            return d
    return None
