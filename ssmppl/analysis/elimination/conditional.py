"""Models that are linear and Gaussian given some of their states.

The states are split in two: z, whose distributions are Gaussian (or deterministic) with means
affine in z_{t-1} and spreads free of it, and the others, x, of which coefficients, spreads, and
distributions that are not Gaussian may depend as they like. Given the whole path of x, z is a
linear Gaussian model with known coefficients, and the Kalman filter integrates it out (Doucet, de
Freitas, Murphy and Russell 2000; Schön, Gustafsson and Nordlund 2005, model 18).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from ssmppl.analysis.new_values import reads_of
from ssmppl.analysis.structure import component_means, gaussian_block
from ssmppl.errors import NotApplicable
from ssmppl.expressions.algebra import affine
from ssmppl.expressions.arrays import array
from ssmppl.expressions.expr import Expr, symbols_of
from ssmppl.language.distributions import Dirac, Flat, MvNormal, Normal
from ssmppl.language.model.trace import Site, Trace, previous

MOST = 8  # components of z, and of x that move with it: the filter of each is written out


@dataclass(frozen=True)
class ConditionallyLinear:
    """Components by their part in the split, each in the trace's order.

    linear : z. coupled : those of x that are jointly Gaussian with z given what came before,
        because their mean is affine in z_{t-1} or their noise correlated with that of z.
    channels : observed components whose means are affine in z, with those that share their noise.
    """

    linear: tuple[Expr, ...]
    coupled: tuple[Expr, ...]
    channels: tuple[Expr, ...]


def conditionally_linear(trace: Trace) -> ConditionallyLinear | NotApplicable:
    """The split with the most linear components that was found, or why there is none."""
    states = trace.state_symbols
    if not trace.observations:
        return NotApplicable("there is no observation")
    out = _nonlinear(trace)
    linear = {s for s in states if s not in out}
    linear -= _cover(_products(trace, linear), trace)
    linear = _noisy(trace, linear)
    if not linear:
        reason = next(iter(out.values()), NotApplicable("no state has a Gaussian distribution"))
        return NotApplicable(
            f"no state is linear and Gaussian given the others: {reason.reason}", reason.where
        )
    if len(linear) == len(states):
        return NotApplicable("the whole model is linear and Gaussian")
    coupled = _coupled(trace, linear)
    if max(len(linear), len(coupled)) > MOST:
        return NotApplicable(
            f"{len(linear)} states are linear given the others, of which {len(coupled)} move with "
            f"them: more than {MOST}"
        )
    return ConditionallyLinear(
        tuple(s for s in states if s in linear),
        tuple(s for s in states if s in coupled),
        tuple(_channels(trace, linear)),
    )


def gaussian(site: Site) -> bool:
    """Whether a distribution has a mean and a covariance and nothing else; Dirac's is zero."""
    return isinstance(site.distribution, (Normal, MvNormal, Dirac))


def _laws(trace: Trace) -> Iterable[tuple[Site, dict[Expr, Expr]]]:
    """Every distribution that may depend on states, and the states behind its symbols: of a
    transition those before and new values of others."""
    prev = {previous(s): s for s in trace.state_symbols}
    own = {s: s for s in trace.state_symbols}
    for site in trace.transition.values():
        yield site, prev | {s: s for s in trace.state_symbols if s in reads_of(site)}
    for site in trace.observations.values():
        yield site, own


def _within(expressions: Iterable[Expr], states: dict[Expr, Expr]) -> list[Expr]:
    """The symbols of states that occur, in their order."""
    found = symbols_of(expressions)
    return [s for s in states if s in found]


def _nonlinear(trace: Trace) -> dict[Expr, NotApplicable]:
    """States that cannot be among the linear ones, whatever else is, and why."""
    out: dict[Expr, NotApplicable] = {}
    for sites in (trace.initial, trace.transition):
        for site in sites.values():
            if not gaussian(site) or type(site.distribution) is Flat:
                kind = type(site.distribution).__name__
                reason = NotApplicable(f"{site.name} is {kind}", site.distribution.location)
                out.update(dict.fromkeys(site.components, reason))
    for site, states in _laws(trace):
        d = site.distribution
        if gaussian(site):
            spread = list(gaussian_block([site], dirac=True).covariance.ravel())
            means = list(array(d.mean()).ravel())
        else:
            spread, means = [p for a in d.parameters.values() for p in a.ravel()], []
        for s in _within(spread, states):
            what = "spread" if gaussian(site) else "law"
            reason = NotApplicable(f"the {what} of {site.name} depends on {s!r}", d.location)
            out.setdefault(states[s], reason)
        for e in means:
            for s in _within([e], states):
                form = affine([e], [s])
                if isinstance(form, NotApplicable):
                    reason = NotApplicable(f"the mean of {site.name}: {form.reason}", d.location)
                    out.setdefault(states[s], reason)
    return out


def _products(trace: Trace, linear: set[Expr]) -> set[frozenset[Expr]]:
    """Pairs of which each is affine, and their product not."""
    pairs: set[frozenset[Expr]] = set()
    for site, states in _laws(trace):
        if not gaussian(site):
            continue
        for e in array(site.distribution.mean()).ravel():
            for s in _within([e], states):
                if states[s] not in linear:
                    continue
                form = affine([e], [s])
                assert not isinstance(form, NotApplicable)
                others = [states[o] for o in _within(form[0].ravel(), states)]
                pairs |= {frozenset((states[s], o)) for o in others if o in linear}
    return pairs


def _cover(pairs: set[frozenset[Expr]], trace: Trace) -> set[Expr]:
    """States of which one at least stands in each pair: those in the most pairs first; of equals
    one that is not observed, whose path the observations leave most to the others."""
    observed: set[Expr] = set()
    for site in trace.observations.values():
        observed |= symbols_of(e for a in site.distribution.parameters.values() for e in a.ravel())
    rank = {s: i for i, s in enumerate(trace.state_symbols)}
    taken: set[Expr] = set()
    while pairs:
        count: dict[Expr, int] = {}
        for pair in pairs:
            for s in pair:
                count[s] = count.get(s, 0) + 1
        worst = max(count, key=lambda s: (count[s], s not in observed, -rank[s]))
        taken.add(worst)
        pairs = {p for p in pairs if worst not in p}
    return taken


def _noisy(trace: Trace, linear: set[Expr]) -> set[Expr]:
    """Those that some noise reaches: the others follow from x, with nothing to integrate."""
    reached: set[Expr] = set()
    for sites in (trace.initial, trace.transition):
        for site in sites.values():
            if not isinstance(site.distribution, Dirac):
                reached |= set(site.components) & linear
    grown = True
    while grown:
        before = len(reached)
        for s, e in component_means(trace.transition.values()).items():
            inside = symbols_of([e])
            if s in linear and any(previous(r) in inside or r in inside for r in reached):
                reached.add(s)
        grown = len(reached) > before
    return reached


def _coupled(trace: Trace, linear: set[Expr]) -> set[Expr]:
    """Components of x that are Gaussian jointly with z."""
    sites = [s for s in trace.transition.values() if gaussian(s)]
    before = {previous(s) for s in linear} | linear
    depending = {s for s, e in component_means(sites).items() if before & set(symbols_of([e]))}
    found = depending - linear
    return found | correlated(sites, linear | found) - linear


def correlated(sites: Iterable[Site], seeds: Iterable[Expr]) -> set[Expr]:
    """The components beside `seeds` whose noise is correlated with theirs, or with such ones."""
    blocks = [gaussian_block([site], dirac=True) for site in sites]
    found, more = set(seeds), True
    while more:
        size = len(found)
        for block in blocks:
            for i, a in enumerate(block.symbols):
                for j, b in enumerate(block.symbols):
                    joint = block.covariance[i, j]
                    if b in found and not (joint.op == "const" and joint.data == 0.0):
                        found.add(a)
        more = len(found) > size
    return found - set(seeds)


def _channels(trace: Trace, linear: set[Expr]) -> list[Expr]:
    out: list[Expr] = []
    for site in trace.observations.values():
        if not gaussian(site):
            continue
        means = array(site.distribution.mean()).ravel()
        touched = [bool(linear & set(symbols_of([e]))) for e in means]
        joint = isinstance(site.distribution, MvNormal) and any(touched)
        out += [s for s, t in zip(site.value.ravel(), touched, strict=True) if t or joint]
    return out
