"""The twisted proposal: particles that are drawn and resampled by all that the data will say.

N. Whiteley and A. Lee, "Twisted particle filters", *Annals of Statistics* 42 (2014); P. Guarniero,
A. M. Johansen and A. Lee, "The iterated auxiliary particle filter", *JASA* 112 (2017). With a
twisting function

    log psi_t(x) = g_t' (x - m_t) - (x - m_t)' A_t (x - m_t) / 2 + constant,

about log p(y_t, ..., y_T | x_t = x), particles are proposed from f(x_t | x_{t-1}) psi_t(x_t),
normalised, and resampled by how much of psi_t they can expect. It comes from a Gaussian
approximation to the whole smoothing problem (`codegen/kernels/twisted/lookahead.py`), so that a
velocity is drawn by the positions that follow it, where a look at y_t alone says nothing.

All is done on standard normal noise e with x_t = F(x_{t-1}, e), F affine in e about e = 0: with
f = F(x_{t-1}, 0) and L = dF / de, e is Gaussian of precision I + L' A L under the twisted
distribution. So states that follow without noise of their own need no density, and a singular
covariance is no trouble. A small share of the particles is drawn from the transition, which bounds
the weights.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ssmppl.analysis.density import Missing, Term, terms
from ssmppl.analysis.new_values import resolved
from ssmppl.analysis.proposals.proposals import (
    Proposal,
    drawn,
    log_mixture,
    without_start,
    written_cholesky,
)
from ssmppl.analysis.structure import component_means
from ssmppl.errors import NotApplicable
from ssmppl.expressions.arrays import ExprArray, array
from ssmppl.expressions.calculus import (
    NotDifferentiable,
    differentiate,
    gradient,
    hessian,
    lower_inverse,
)
from ssmppl.expressions.expr import Expr, apply, constant, depends_on, substitute, symbol
from ssmppl.expressions.properties import may_vanish_by_data
from ssmppl.language.distributions import Dirac, Draws, LogNormal, MvNormal
from ssmppl.language.model.trace import Site, Trace

DEFENSIVE = 0.02  # share of the transition in the proposal's mixture
# Noises up to which the matrices are written out, in which LLVM finds what they have in common;
# beyond, compilation takes minutes, at forty more than 20 GB: see `kernels/twisted/twisting.py`.
WRITTEN_OUT = 6


@dataclass(frozen=True)
class NoiseForm:
    """A distribution as x = F(e), e standard normal.

    noise : symbols of e (R,). value : F by component, in the order of the trace's states.
    recovered : (R,) e as a function of x and x_{t-1}.
    """

    noise: tuple[Expr, ...]
    value: ExprArray
    recovered: ExprArray

    def at_rest(self) -> ExprArray:
        """F at e = 0."""
        zero = constant(0.0)
        return array(substitute(list(self.value), dict.fromkeys(self.noise, zero)))

    def spread(self) -> ExprArray:
        """dF / de (D, R) at e = 0."""
        if not self.noise:
            return array(np.empty((len(self.value), 0), dtype=object))
        columns = [differentiate(list(self.value), e) for e in self.noise]
        zero = constant(0.0)
        flat = substitute(
            [c for column in columns for c in column], dict.fromkeys(self.noise, zero)
        )
        shape = (len(self.noise), len(self.value))
        return array(array(flat).reshape(shape).T)

    def padded(self, noises: int) -> NoiseForm:
        """The same with so many noises, of which the last move nothing and are 0."""
        more = range(len(self.noise), noises)
        return NoiseForm(
            (*self.noise, *(symbol("noise", "noise", (k,)) for k in more)),
            self.value,
            array([*self.recovered, *(constant(0.0) for _ in more)]),
        )


@dataclass(frozen=True)
class LookaheadModel:
    """What the lookahead pass, which finds the twisting function, needs to know of a model.

    initial, transition : its distributions by noise. observed : log g(y_t | x_t), 0 where nothing
        was seen.
    slope (D,), curvature (D, D) : of it, the latter with the sign changed. flat : whether the
    curvature is the same wherever the states are.
    """

    initial: NoiseForm
    transition: NoiseForm
    observed: Expr
    slope: ExprArray
    curvature: ExprArray
    flat: bool

    @property
    def written_out(self) -> bool:
        """Whether the noises are few enough for matrices to be written out in scalars."""
        return len(self.transition.noise) <= WRITTEN_OUT and len(self.initial.noise) <= WRITTEN_OUT


def noise_form(sites: list[Site], states: list[Expr]) -> NoiseForm | NotApplicable:
    """A distribution by the noise that drives it; NotApplicable where some state's is not of that
    kind."""
    value: dict[Expr, Expr] = {}
    noise: list[Expr] = []
    recovered: list[Expr] = []
    for site in sites:
        d: Any = site.distribution
        own = site.value.ravel()
        if isinstance(d, Dirac):
            value.update(component_means([site]))
            continue
        if not d.gaussian_noise:
            kind = type(d).__name__
            reason = f"the distribution of {site.name} is {kind}, not driven by Gaussian noise"
            return NotApplicable(reason, d.location)
        new = [symbol("noise", "noise", (len(noise) + i,)) for i in range(len(own))]
        noise += new
        sample = drawn(site, GivenDraws(site.name, new)).ravel()
        value.update(zip(own, sample, strict=True))
        recovered += _recovered(d, site.value)
    value = resolved(value)
    return NoiseForm(tuple(noise), array([value[s] for s in states]), array(recovered))


def _recovered(law: Any, value: ExprArray) -> list[Expr]:
    """The standard normal draws behind a value; 0 for those that move nothing, as of a covariance
    that is singular, in all rows or where the data leave it so. Twisted and not, such a draw has
    the same distribution, so that its value does not count."""
    if isinstance(law, MvNormal):
        factor = law.factor()
        singular = law.root is not None or may_vanish_by_data(factor.ravel())
        if law.spread != "precision" and singular:
            return list(lower_inverse(factor, singular=True) @ array(value - law.mean_))
        return list(law.standard(value).ravel())
    found = law.standard(value).ravel()
    spread = law.sd.ravel() if isinstance(law, LogNormal) else law.sd().ravel()
    if not may_vanish_by_data(spread):
        return list(found)
    return [apply("where", apply("lt", 0.0, s), e, 0.0) for s, e in zip(spread, found, strict=True)]


class GivenDraws(Draws):
    """Draws of a sampler that takes normals only, which are these symbols, in turn."""

    def __init__(self, site: str, symbols: list[Expr]):
        super().__init__(site)
        self._next = iter(symbols)

    def normal(self) -> Expr:
        return next(self._next)


def lookahead_model(trace: Trace, missing: Missing) -> LookaheadModel | NotApplicable:
    """What a twisting function can be found from; the reason where there is none."""
    if not trace.observations:
        return NotApplicable("there is no observation")
    unstarted = without_start(trace)
    if unstarted is not None:
        return unstarted
    states = trace.state_symbols
    initial = noise_form(list(trace.initial.values()), states)
    transition = noise_form(list(trace.transition.values()), states)
    if isinstance(initial, NotApplicable):
        return initial
    if isinstance(transition, NotApplicable):
        return transition
    where = next(iter(trace.transition.values())).distribution.location
    if not transition.noise:
        return NotApplicable("no state has noise", where)
    noises = max(len(initial.noise), len(transition.noise))
    if noises > WRITTEN_OUT:
        initial, transition = initial.padded(noises), transition.padded(noises)
    total = constant(0.0)
    for t in terms(trace, "observation", missing, guard=False):
        total = total + t.guarded()
    site = next(iter(trace.observations.values()))
    if not depends_on(total, states):
        return NotApplicable("no state is observed", site.distribution.location)
    try:
        slope, curvature = array(gradient(total, states)), array(-hessian(total, states))
    except NotDifferentiable as error:
        reason = f"the observation is not twice differentiable: {error.found}"
        return NotApplicable(reason, site.distribution.location)
    try:
        jacobian(transition, trace)
    except NotDifferentiable as error:
        return NotApplicable(f"the transition is not differentiable: {error.found}", where)
    same = not any(depends_on(e, states) for e in curvature.ravel())
    return LookaheadModel(initial, transition, total, slope, curvature, same)


def jacobian(transition: NoiseForm, trace: Trace) -> ExprArray:
    """dF / dx_{t-1} (D, D) at e = 0."""
    rest = list(transition.at_rest())
    return array(array([differentiate(rest, p) for p in trace.state_prev_symbols]).T)


def twisting_symbols(d: int) -> tuple[ExprArray, ExprArray, ExprArray]:
    """A (D, D), g (D,), m (D,) of the twisting function at a step."""
    a = np.empty((d, d), dtype=object)
    for i in range(d):
        for j in range(i + 1):
            a[i, j] = a[j, i] = symbol("guide", "precision", (i, j))
    g = array([symbol("guide", "pull", (i,)) for i in range(d)])
    m = array([symbol("guide", "centre", (i,)) for i in range(d)])
    return array(a), g, m


def start_symbols(r: int) -> tuple[ExprArray, ExprArray]:
    """Mean (R,) of the noise of x_1 under the twisted distribution, and the lower factor (R, R) of
    its precision."""
    factor = np.full((r, r), constant(0.0), dtype=object)
    for i in range(r):
        for j in range(i + 1):
            factor[i, j] = symbol("guide", "start_factor", (i, j))
    return array([symbol("guide", "start", (i,)) for i in range(r)]), array(factor)


def twisting_order(d: int, r: int) -> list[Expr]:
    """The symbols of the twisting function as they stand in a row, of D states and R noises of x_1:
    A's lower half, g, m, mean and lower half of the factor of the start."""
    a, g, m = twisting_symbols(d)
    start, factor = start_symbols(r)
    halves = [[x[i, j] for i in range(n) for j in range(i + 1)] for x, n in ((a, d), (factor, r))]
    return [*halves[0], *g, *m, *start, *halves[1]]


UNSUITED = "these filters do not compute the guide of the twisted proposal"


def twisted(trace: Trace, missing: Missing) -> Proposal | NotApplicable:
    """The proposal in the twisting function's symbols; its distributions where they are written
    out."""
    found = lookahead_model(trace, missing)
    if isinstance(found, NotApplicable):
        return found
    explanation = (
        "twisted: particles move and are resampled by a Gaussian approximation to what "
        f"all later observations say, mixed with {DEFENSIVE:.0%} of the transition"
    )
    if not found.written_out:
        d, r = len(trace.state_symbols), len(found.transition.noise)
        looped = d * d + 2 * r * r
        return Proposal(
            "twisted", {}, (), {}, (), explanation=explanation, looped=looped, unsuited=UNSUITED
        )
    observed = tuple(terms(trace, "observation", missing))
    states = trace.state_symbols
    start = _initial_law(found.initial, states)
    later = _transition_law(found.transition, states)
    site = observed[0].site
    return Proposal(
        "twisted",
        start.draw,
        (*observed, Term(site, -start.log_ratio, None)),
        later.draw,
        (*observed, Term(site, -later.log_ratio, None)),
        later.ahead,
        fit=later.fit,
        explanation=explanation,
        unsuited=UNSUITED,
    )


@dataclass(frozen=True)
class _Law:
    """Draws, log (q / f), the log of what psi can be expected to be, what is computed once."""

    draw: dict[Expr, Expr]
    log_ratio: Expr
    ahead: Expr
    fit: tuple[Expr, ...]


def _initial_law(form: NoiseForm, states: list[Expr]) -> _Law:
    """x_1 under the twisted distribution, which the kernel has worked out: it depends on no
    particle."""
    mean, factor = start_symbols(len(form.noise))
    root = lower_inverse(factor) if form.noise else factor
    return _twisted_law(form, states, mean, factor, root, constant(0.0))


def _transition_law(form: NoiseForm, states: list[Expr]) -> _Law:
    """x_t under the twisted distribution, given x_{t-1}."""
    r = len(form.noise)
    precision, pull, centre = twisting_symbols(len(states))
    away = array(form.at_rest() - centre)
    tilt = array(pull - precision @ away)
    spread = form.spread()
    middle = array(np.eye(r) + array(spread.T @ precision @ spread))
    factor = written_cholesky(middle)
    root = lower_inverse(factor)
    half = array(root @ array(spread.T @ tilt))  # C^-1 h, C C' = I + L'AL
    ahead = pull @ away - 0.5 * (away @ precision @ away) + 0.5 * np.sum(array(half**2))
    return _twisted_law(form, states, array(root.T @ half), factor, root, ahead)


def _twisted_law(
    form: NoiseForm, states: list[Expr], mean: ExprArray, factor: ExprArray, root: ExprArray,
    ahead: Expr,
) -> _Law:  # fmt: skip
    """A distribution whose noise has this mean (R,) and, as factor of its precision, the lower
    `factor`."""
    r = len(form.noise)
    if r == 0:
        return _Law(dict(zip(states, form.value, strict=True)), constant(0.0), ahead, ())
    volume = constant(1.0)
    for i in range(r):
        volume = volume * factor[i, i]
    draws = Draws("twisted")
    z = array([draws.normal() for _ in range(r)])
    defend = apply("lt", draws.uniform(), DEFENSIVE)
    tilted = array(mean + root.T @ z)
    chosen = [apply("where", defend, a, b) for a, b in zip(z, tilted, strict=True)]
    value = substitute(list(form.value), dict(zip(form.noise, chosen, strict=True)))
    e = form.recovered
    inward = array(factor.T @ array(e - mean))
    distance = 0.5 * (np.sum(array(e**2)) - np.sum(array(inward**2)))
    log_ratio = log_mixture(volume, distance, DEFENSIVE)
    fit = (*mean, *(factor[i, j] for i in range(r) for j in range(i + 1)))
    draw = dict(zip(states, value, strict=True))
    return _Law(draw, log_ratio, ahead - apply("log", volume), fit)
