"""Upper bounds of the transition density of a given x_t over all x_{t-1}.

What rejection sampling of backward indices needs (Douc, Garivier, Moulines and Olsson 2011): for
each distribution, the density with those parameters that depend on x_{t-1} at the values that
maximise it. A location goes to the value itself, a rate or a mean to its maximum likelihood
estimate from one value. The result is free of x_{t-1}, and no smaller than the density anywhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ssmppl.analysis.bounds import interval
from ssmppl.analysis.structure import deterministic, deterministic_memory
from ssmppl.errors import NotApplicable
from ssmppl.expressions.algebra import affine
from ssmppl.expressions.arrays import ExprArray, array
from ssmppl.expressions.arrays import elementwise as ew
from ssmppl.expressions.expr import Expr, apply, attributed, constant, depends_on
from ssmppl.language import distributions as laws
from ssmppl.language.distributions.base import Distribution
from ssmppl.language.model.trace import Site, Trace


def transition_upper_bound(trace: Trace) -> Expr | NotApplicable:
    """An upper bound over x_{t-1} of the log density of the noisy components of x_t.

    An expression in x_t, theta, inputs and time; or the reason why there is none.
    """
    if deterministic_memory(trace) != 0:
        (site, *_) = deterministic(list(trace.transition.values()))
        return NotApplicable(
            f"the deterministic component {site.name} changes later densities too",
            site.distribution.location,
        )
    skipped = {s.name for s in deterministic(list(trace.transition.values()))}
    total = constant(0.0)
    for site in trace.transition.values():
        if site.name in skipped:
            continue
        with attributed(trace.locations, site.distribution.location):
            bound = _upper_bound(site, trace.state_prev_symbols)
        if isinstance(bound, NotApplicable):
            return bound
        total = total + bound
    return total


def _upper_bound(site: Site, prev: Sequence[Expr]) -> Expr | NotApplicable:
    d, where = site.distribution, site.distribution.location
    free = [n for n, p in d.parameters.items() if any(depends_on(e, prev) for e in p.ravel())]
    if not free:
        return d.log_density(site.value, guard=False)
    if isinstance(d, laws.Mixture):
        return _mixture(site, d, prev)
    if isinstance(d, laws.ZeroInflated):
        return _zero_inflated(site, d, prev)
    if d.highest is not None:
        return constant(d.highest)
    if isinstance(d, laws.Uniform):
        return _uniform(site, prev)
    known, changed = d.maximisers, {}
    for name in sorted(free, key=lambda n: n in known):  # spreads first
        if name in known:
            best = array(known[name](d, site.value))
        elif (spread := _spread(site, name, prev)) is not None:
            best = spread
        else:
            which = f"{name.rstrip('_')} of {site.name} ({type(d).__name__})"
            return NotApplicable(f"{which} depends on the state before", where)
        changed[name] = best if d.joint else _replaced(d.parameters[name], best, prev)
    return d.rebuilt(changed).log_density(site.value, guard=False)


def _element(site: Site, law: Distribution, index: tuple[int, ...]) -> Site:
    value = array(site.value[index])
    return Site(site.name, site.role, law.element(index), value, site.where)


def _mixture(site: Site, d: laws.Mixture, prev: Sequence[Expr]) -> Expr | NotApplicable:
    """The sum of the components' own bounds; a weight that depends on the state is at most 1."""
    whole, total = d.support(), constant(0.0)
    for law in d.components:
        own = law.support()
        ends = [(own.lower, whole.lower), (own.upper, whole.upper)]
        if any(
            a is not b for pair in ends for a, b in zip(*(p.ravel() for p in pair), strict=True)
        ):
            return NotApplicable(
                f"the components of {site.name} (Mixture) have different supports", d.location
            )
    for i in np.ndindex(site.shape):
        bound = None
        for law, weight in zip(d.components, d.weights, strict=True):
            part = _upper_bound(_element(site, law, i), prev)
            if isinstance(part, NotApplicable):
                return part
            if not depends_on(weight[i], prev):
                part = apply("log", weight[i]) + part
            bound = part if bound is None else apply("logaddexp", bound, part)
        total = total + bound
    return total


def _zero_inflated(site: Site, d: laws.ZeroInflated, prev: Sequence[Expr]) -> Expr | NotApplicable:
    """At most 1 at zero; elsewhere that of the distribution inside, times 1 - p where p is free of
    the state."""
    total = constant(0.0)
    for i in np.ndindex(site.shape):
        part = _upper_bound(_element(site, d.base, i), prev)
        if isinstance(part, NotApplicable):
            return part
        if not depends_on(d.p[i], prev):
            part = apply("log1p", -d.p[i]) + part
        total = total + apply("where", apply("eq", site.value[i], 0.0), 0.0, part)
    return total


def _uniform(site: Site, prev: Sequence[Expr]) -> Expr | NotApplicable:
    """1 / the smallest width."""
    d: Any = site.distribution
    width = array(d.upper - d.lower)
    form = affine(width.ravel(), prev)  # x + 1 - (x - 1) is 2
    if not isinstance(form, NotApplicable) and all(e.op == "const" and e.data == 0.0
                                                   for e in form[0].ravel()):  # fmt: skip
        width = array(form[1].reshape(width.shape))
    lowest = _lowest(width, prev)
    if lowest is None:
        return NotApplicable(f"the width of {site.name} depends on the state before", d.location)
    return array(np.sum(-array(ew("log", lowest))))[()]


def _spread(site: Site, name: str, prev: Sequence[Expr]) -> ExprArray | None:
    """The value of a parameter of the spread that maximises the density, entry by entry: the
    distance from the centre, or the least that the spread can be where that is more.

    None where the parameter is no such, or has no positive number below it.
    """
    d = site.distribution
    spread, centre = d.variance_link, d.mean_link
    if d.joint or spread is None or centre is None or spread.power < 0.0:
        return None
    lowest = _lowest(d.parameters[name], prev) if name == spread.parameter else None
    if lowest is None:
        return None
    logs = centre.scale == "mean of the log"
    value = array(ew("log", site.value)) if logs else site.value
    best = np.empty(site.shape, dtype=object)
    for i in np.ndindex(site.shape):
        best[i], place = lowest[i], d.parameters[centre.parameter][i]
        if not depends_on(place, prev):
            away = apply("abs", value[i] - place)
            best[i] = apply("maximum", best[i], away**2 if spread.power == 1.0 else away)
    return array(best)


def _lowest(spread: ExprArray, prev: Sequence[Expr]) -> ExprArray | None:
    """`spread` with a positive number below it for each entry that depends on the state before.

    None where there is no such number.
    """
    out = np.empty(spread.shape, dtype=object)
    for i in np.ndindex(spread.shape):
        out[i] = spread[i]
        if depends_on(spread[i], prev):
            low = interval(spread[i], {})[0]
            if not 0.0 < low < np.inf:
                return None
            out[i] = constant(low)
    return array(out)


def _replaced(old: ExprArray, best: ExprArray, prev: Sequence[Expr]) -> ExprArray:
    """`best` in place of the entries of `old` that depend on the state before."""
    wide = np.broadcast_to(best.view(np.ndarray), old.shape)
    out = np.empty(old.shape, dtype=object)
    for i in np.ndindex(old.shape):
        out[i] = wide[i] if depends_on(old[i], prev) else old[i]
    return array(out)
