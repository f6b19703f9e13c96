"""Proposals of the particle filter, derived from the model: how particles move and what they weigh.

A `Proposal` holds, as expressions,

* `draw`, x_t from x_{t-1} and random draws, and `initial_draw`, x_1;
* `weight`, the terms of log [ f(x_t | x_{t-1}) g(y_t | x_t) / q(x_t | x_{t-1}, y_t) ];
* `look_ahead`, an approximation to log p(y_t | x_{t-1}), the auxiliary weight of Pitt and Shephard
  (1999);
* `fit`, subexpressions of these, functions of x_{t-1} and y_t, that are computed once.

Tiers, best first (Doucet, Godsill and Andrieu 2000, section II): the locally optimal proposal of
a Gaussian transition with an observation affine in the state; a Laplace approximation to it (a few
Newton steps per particle, curvature clipped to its concave part, in a defensive mixture with the
transition); the transition itself (bootstrap).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from ssmppl.analysis.density import Missing, Term, mask_covariance, terms, where_measured
from ssmppl.analysis.new_values import reached, reads_of, resolved
from ssmppl.analysis.structure import (
    GaussianBlock,
    affine_observation,
    exact_observation,
    flat_start,
    gaussian_block,
    singular_states,
)
from ssmppl.errors import NotApplicable
from ssmppl.expressions.arrays import (
    ExprArray,
    array,
    cholesky,
    elementwise,
    inverse,
    log_determinant,
)
from ssmppl.expressions.calculus import NotDifferentiable, gradient, hessian, lower_inverse
from ssmppl.expressions.expr import (
    Expr,
    apply,
    attributed,
    constant,
    depends_on,
    substitute,
    symbols_of,
    topological,
)
from ssmppl.expressions.properties import may_vanish_by_data
from ssmppl.language.distributions import Draws
from ssmppl.language.distributions.continuous import LOG_2PI
from ssmppl.language.distributions.multivariate import (
    singular_numbers,
    surely_positive,
    where_definite,
)
from ssmppl.language.model.trace import Site, Trace, seen

NEWTON_STEPS = 3
LONGEST_STEP = 2.0  # in standard deviations of the transition
DEFENSIVE = 0.05  # share of the transition in the Laplace proposal's mixture
# What is written out at most, which compiles in some seconds: products of entries of matrices, and
# nodes of slopes times the states that they are differentiated in once more.
MOST_PRODUCTS, MOST_NODES = 16_000, 500_000
LARGEST_EXPONENT = 600.0  # of q / f where exp is taken


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
    unsuited: str = ""  # why filters other than its own cannot run it, if they cannot
    # the rows at which states are drawn, and weighed, given the observation in closed form
    conditioned: Literal["none", "all but the first", "all"] = "none"

    @property
    def look_ahead_kind(self) -> str:
        """Name of the kernels' constant for what its look-ahead knows."""
        if self.look_ahead is None:
            return "NO_LOOK_AHEAD"
        return "EXACT" if self.exact_look_ahead else "APPROXIMATE"


def derive(trace: Trace, missing: Missing) -> dict[str, Proposal | NotApplicable]:
    """All proposals by name: "bootstrap", "guided", "auxiliary", and the user's own."""
    reason = without_start(trace)
    if reason is not None:
        names = ("bootstrap", "guided", "auxiliary", *(["user"] if trace.proposal else []))
        return dict.fromkeys(names, reason)
    found: dict[str, Proposal | NotApplicable] = {"bootstrap": bootstrap(trace, missing)}
    if trace.proposal:
        found["user"] = _user(trace, missing)
    guided = _locally_optimal(trace, missing)
    if isinstance(guided, NotApplicable) and not isinstance(guided, TooLarge):
        affine_reason = guided
        guided = _laplace(trace, missing)
        if isinstance(guided, NotApplicable):
            same = affine_reason.reason == guided.reason
            both = guided.reason if same else f"{affine_reason.reason}; {guided.reason}"
            guided = NotApplicable(both, affine_reason.where)
    found["guided"] = guided
    if isinstance(guided, NotApplicable):
        found["auxiliary"] = guided
    elif guided.look_ahead is None:
        new = set(trace.state_symbols)
        reading = any(reads_of(site) & new for site in trace.transition.values())
        which = (
            "that is drawn by its own distribution, as others read its new value or it is not "
            "Gaussian,"
        )
        plain = "with neither a Gaussian nor a deterministic distribution"
        found["auxiliary"] = NotApplicable(
            f"a state {which if reading else plain} stands between x_{{t-1}} and y_t"
        )
    else:
        found["auxiliary"] = replace(
            guided,
            name="auxiliary",
            explanation=guided.explanation
            + ", and resampled with first-stage weights approximating "
            "p(y_t | x_{t-1})",
        )
        found["guided"] = replace(guided, look_ahead=None)
    return found


def without_start(trace: Trace) -> NotApplicable | None:
    """Why no particle can be drawn at the first row, if none can."""
    flat = flat_start(trace)
    if not flat:
        return None
    reason = (
        f"the initial distribution of {flat[0].name!r} is Flat: no particle can be drawn from it"
    )
    return NotApplicable(reason, flat[0].distribution.location)


# -- tier 1: the transition


def bootstrap(trace: Trace, missing: Missing) -> Proposal:
    """Move by the transition, weigh by the observation (Gordon, Salmond and Smith 1993)."""
    observed = tuple(terms(trace, "observation", missing))
    return Proposal(
        "bootstrap",
        resolved(draws_of(trace, list(trace.initial.values()))),
        observed,
        resolved(draws_of(trace, list(trace.transition.values()))),
        observed,
        explanation="particles move by the transition and are weighted by the observation density",
    )


def draws_of(trace: Trace, sites: list[Site]) -> dict[Expr, Expr]:
    """A draw from the distribution of every component, which may name others of the same step; NaN
    where a parameter of the distribution is out of its range."""
    out: dict[Expr, Expr] = {}
    for site in sites:
        law = site.distribution
        with attributed(trace.locations, law.location):
            sample = drawn(site)
        out.update(zip(site.value.ravel(), sample.ravel(), strict=True))
    return out


def drawn(site: Site, draws: Draws | None = None) -> ExprArray:
    """A draw from a distribution, of its shape; NaN where a parameter is out of its range.

    Of a flat distribution, and of an observation's without a sampler, NaN, for code that is never
    run: no algorithm starts from the one, and what would draw the other refuses.

    draws : the random numbers that it is made of; None: its own.
    """
    law = site.distribution
    if not law.drawable:
        return array(np.full(site.shape, math.nan))
    sample = array(law.sample(draws or Draws(site.name)) if law.proper else law.mean())
    inside = law.in_range()
    return sample if inside is None else array(elementwise("where", inside, sample, math.nan))


@dataclass(frozen=True)
class Split:
    """The states of one distribution: Gaussian ones, and the others with their draws.

    others : as functions of the past, and of new values of the Gaussian ones. random : whether some
    of them is random. following : those of them that are functions of the Gaussian ones of the same
    step without further randomness.
    """

    gaussian: GaussianBlock
    others: dict[Expr, Expr]
    random: bool
    following: dict[Expr, Expr]

    def insert(self, expressions: dict[Expr, Expr]) -> dict[Expr, Expr]:
        """`expressions` with the other states replaced by their draws."""
        values = substitute(list(expressions.values()), self.others)
        return dict(zip(expressions, values, strict=True))

    def complete(self, draw: dict[Expr, Expr]) -> dict[Expr, Expr]:
        """The draws of all states, given those of the Gaussian ones."""
        draw = self.insert(draw)
        after = {s: e for s, e in self.others.items() if depends_on(e, list(draw))}
        moved = substitute(list(after.values()), draw)
        return {**self.others, **draw, **dict(zip(after, moved, strict=True))}


def split(trace: Trace, sites: list[Site]) -> Split:
    """The initial distribution or the transition, taken apart.

    A Gaussian state that reads new values of others in another way than by an affine mean is
    Gaussian given these: where it is observed they are drawn first, else it is drawn last.
    """
    laws = [site.distribution for site in trace.observations.values()]
    observed = symbols_of(e for law in laws for e in law.arguments())
    reads = {s: reads_of(site) for site in sites for s in site.components}
    draws = draws_of(trace, sites)
    first: set[Expr] = set()
    while True:
        block = gaussian_block(sites, given=first)
        inside = set(block.symbols)
        others = resolved({s: e for s, e in draws.items() if s not in inside})
        following = {s: e for s, e in others.items() if depends_on(e, block.symbols)}
        last = {s for s, e in following.items() if _random(e)}
        before = reached(reads, last & observed) & inside
        if not before:
            break
        first |= before
    following = {s: e for s, e in following.items() if s not in last}
    return Split(block, others, any(map(_random, others.values())), following)


def _random(e: Expr) -> bool:
    return any(n.op == "random" for n in topological([e]))


class TooLarge(NotApplicable):
    """Derived, but not written out."""


def _too_large(trace: Trace, size: int, most: int) -> TooLarge | None:
    """Why a proposal of this size is not written out; None where it is no larger than `most`."""
    if size <= most:
        return None
    channels = sum(len(site.components) for site in trace.observations.values())
    return TooLarge(
        f"with {channels} observed components and {len(trace.state_symbols)} states, its "
        "conditional distributions would fill a program that takes minutes to compile",
        next(iter(trace.observations.values())).distribution.location,
    )


def _products(q: ExprArray, h: ExprArray, r: ExprArray) -> int:
    """How many products of entries that are not zero make the covariance H Q H' + R of the
    observation, and the gain Q H' (H Q H' + R)^-1."""
    own_q, own_h, own_r = (
        np.array([e is not constant(0.0) for e in m.ravel()], dtype=int).reshape(m.shape)
        for m in (q, h, r)
    )
    covariance = own_h @ own_q @ own_h.T
    whole = covariance + own_r
    apart = np.count_nonzero(whole) == np.count_nonzero(np.diagonal(whole))
    inverse_ = np.eye(len(own_h), dtype=int) if apart else np.ones_like(covariance)
    return int(covariance.sum() + (own_q @ own_h.T @ inverse_).sum())


# -- tier 2: locally optimal


def _locally_optimal(trace: Trace, missing: Missing) -> Proposal | NotApplicable:
    sites = list(trace.observations.values())
    if not sites:
        return NotApplicable("there is no observation")
    singular = singular_states(trace)
    if singular is not None:
        return singular
    transition = split(trace, list(trace.transition.values()))
    if not len(transition.gaussian):
        where = next(iter(trace.transition.values())).distribution.location
        return NotApplicable("no state has a Gaussian transition", where)
    observation = affine_observation(sites, transition.gaussian.symbols, transition.following)
    if isinstance(observation, NotApplicable):
        return observation
    q, h, r = transition.gaussian.covariance, observation.matrix, observation.covariance
    large = _too_large(trace, _products(q, h, r), MOST_PRODUCTS)
    if large is not None:
        return large
    if all(e.op == "const" and e.data == 0.0 for e in observation.matrix.ravel()):
        return NotApplicable(
            "the observation does not depend on the states with a Gaussian transition",
            sites[0].distribution.location,
        )
    masks = None if missing.none else array([seen(s) for s in observation.symbols])
    y = array(list(observation.symbols))

    def law(split: Split) -> tuple[dict[Expr, Expr], Expr]:
        """Draw of x given y, and log p(y | x_prev), for a Gaussian block of states."""
        h, d, r = observation.matrix, observation.offset, observation.covariance
        block = split.gaussian
        residual = y - h @ block.mean - d
        sure = surely_positive(r)
        if masks is not None:
            h = where_measured(array(masks[:, None]), h)
            residual = where_measured(masks, residual)
            r = mask_covariance(r, masks)
        draw, predictive = _condition(block, h, r, residual, masks)
        if not sure:  # the sum of the covariances of x and of no law may be one all the same
            singular = exact_observation(trace) is not None or may_vanish_by_data(r.ravel())
            predictive = where_definite(array(r), predictive, singular)
        return split.complete(draw), predictive

    draw, predictive = law(transition)
    start = split(trace, list(trace.initial.values()))
    same = set(start.gaussian.symbols) == set(transition.gaussian.symbols)
    given_first = same and not transition.following
    if given_first:
        place = {s: i for i, s in enumerate(start.gaussian.symbols)}  # no .index: == is symbolic
        order = [place[s] for s in transition.gaussian.symbols]
        start = replace(start, gaussian=_reorder(start.gaussian, order))
        initial_draw, initial_predictive = law(start)
        site = sites[0]
        initial_weight: tuple[Term, ...] = (Term(site, initial_predictive, None),)
    else:
        initial_draw = resolved(draws_of(trace, list(trace.initial.values())))
        initial_weight = tuple(terms(trace, "observation", missing))
    weight = Term(sites[0], predictive, None)
    look_ahead = (
        None if transition.random else transition.insert({predictive: predictive})[predictive]
    )
    return Proposal(
        "guided",
        initial_draw,
        initial_weight,
        draw,
        (weight,),
        look_ahead,
        exact_look_ahead=look_ahead is not None,
        conditioned="all" if given_first else "all but the first",
        explanation="locally optimal: particles are drawn from p(x_t | x_{t-1}, y_t), which is "
        "Gaussian, and weighed by p(y_t | x_{t-1})",
    )


def _reorder(block: GaussianBlock, order: list[int]) -> GaussianBlock:
    return GaussianBlock(
        tuple(block.symbols[i] for i in order),
        array(block.mean[order]),
        array(block.covariance[np.ix_(order, order)]),
        block.diagonal,
    )


def _condition(
    block: GaussianBlock,
    h: ExprArray,
    r: ExprArray,
    residual: ExprArray,
    masks: ExprArray | None,
) -> tuple[dict[Expr, Expr], Expr]:
    """Condition a Gaussian block on h x + noise; masked entries of h and residual are zero."""
    draws, n, k = Draws("guided"), len(block), len(residual)
    q = block.covariance
    s = array(h @ q @ h.T + r)
    gain = array(q @ h.T @ inverse(s))
    count = constant(float(k)) if masks is None else np.sum(masks)
    predictive = -0.5 * (count * LOG_2PI + log_determinant(s) + residual @ inverse(s) @ residual)
    mean = block.mean + gain @ residual
    if n == 1:
        if singular_numbers(r):
            left = apply("maximum", 0.0, q[0, 0] - (array(gain @ h) @ q)[0, 0])
        else:
            left = 1.0 / (1.0 / q[0, 0] + (array(h.T @ inverse(r) @ h))[0, 0])
        x = mean[0] + apply("sqrt", left) * draws.normal()
        return {block.symbols[0]: x}, predictive
    # Matheron's rule: a joint draw (x*, e*) from the prior, corrected by the gain. No posterior
    # covariance is factorised, so a nearly singular one is no trouble.
    prior = array([draws.normal() for _ in range(n)])
    noise = array([draws.normal() for _ in range(k)])
    x_star = cholesky(q) @ prior
    e_star = cholesky(r) @ noise
    x = mean + x_star - gain @ (h @ x_star + e_star)
    return dict(zip(block.symbols, x, strict=True)), predictive


# -- tier 3: Laplace


def _laplace(trace: Trace, missing: Missing) -> Proposal | NotApplicable:
    sites = list(trace.observations.values())
    if not sites:
        return NotApplicable("there is no observation")
    observed = terms(trace, "observation", missing)
    # the density without the guards of its support: these depend on y alone or end the particle
    smooth = terms(trace, "observation", missing, guard=False)
    total = constant(0.0)
    for t in smooth:
        total = total + t.guarded()
    singular = singular_states(trace)
    if singular is not None:
        return singular
    transition = split(trace, list(trace.transition.values()))
    (total,) = substitute([total], transition.following)
    where = sites[0].distribution.location
    if not len(transition.gaussian):
        law = next(iter(trace.transition.values())).distribution
        return NotApplicable("no state has a Gaussian transition", law.location)
    if not depends_on(total, transition.gaussian.symbols):
        return NotApplicable("no state with a Gaussian transition is observed", where)
    try:
        slope = array(gradient(total, transition.gaussian.symbols))
        own = set(transition.gaussian.symbols)
        nodes = sum(len(topological([e])) * len(symbols_of(e) & own) for e in slope)
        large = _too_large(trace, nodes, MOST_NODES)
        if large is not None:
            return large
        curvature = hessian(total, transition.gaussian.symbols)
    except NotDifferentiable as error:
        return NotApplicable(f"the observation is not twice differentiable: {error.found}", where)
    if all(e.op == "const" and e.data == 0.0 for e in curvature.ravel()):
        return NotApplicable("the observation has no curvature in the state", where)
    draw, fit, log_ratio, look_ahead = _newton(transition, total, slope, curvature)
    correction = Term(observed[0].site, -log_ratio, None)
    return Proposal(
        "guided",
        resolved(draws_of(trace, list(trace.initial.values()))),
        tuple(observed),
        draw,
        (*observed, correction),
        None if transition.random else look_ahead,
        fit=fit,
        explanation="Laplace: particles are drawn from a Gaussian fitted to "
        "f(x_t | x_{t-1}) g(y_t | x_t) by "
        f"{NEWTON_STEPS} Newton steps each, mixed with {DEFENSIVE:.0%} of the transition",
    )


def _newton(
    transition: Split, total: Expr, slope: ExprArray, curvature: ExprArray
) -> tuple[dict[Expr, Expr], tuple[Expr, ...], Expr, Expr]:
    """(draw, fit, log (q / f)(x_t | x_{t-1}, y_t), log of Laplace's approximation to
    p(y_t | x_{t-1})) of a few Newton steps from the mean of the transition."""
    block, n = transition.gaussian, len(transition.gaussian)
    precision = inverse(block.covariance)
    spread = array([apply("sqrt", block.covariance[i, i]) for i in range(n)])
    x, factor = gaussian_fit(block, slope, curvature, precision)
    draws = Draws("laplace")
    z = array([draws.normal() for _ in range(n)])
    from_fit = x + lower_inverse(factor).T @ z
    from_transition = block.mean + cholesky(block.covariance) @ z
    defend = apply("lt", draws.uniform(), DEFENSIVE)
    chosen = {
        s: apply("where", defend, b, a)
        for s, a, b in zip(block.symbols, from_fit, from_transition, strict=True)
    }
    own = array(list(block.symbols))
    from_mean = array(own - block.mean)
    distance = 0.5 * (from_mean @ precision @ from_mean - np.sum(array(factor.T @ (own - x)) ** 2))
    # how much narrower the fit is than the transition: the ratio of the roots of determinants
    narrower = spread[0] if n == 1 else apply("exp", 0.5 * log_determinant(block.covariance))
    for i in range(n):
        narrower = narrower * factor[i, i]
    log_ratio = log_mixture(narrower, distance, DEFENSIVE)
    at_mode = dict(zip(block.symbols, x, strict=True))
    (g_mode,) = substitute([total], at_mode)
    to_mode = array(x - block.mean)
    look_ahead = g_mode - 0.5 * (to_mode @ precision @ to_mode) - apply("log", narrower)
    ahead = transition.insert({look_ahead: look_ahead})[look_ahead]
    fit = (*x, *(factor[i, j] for i in range(n) for j in range(i + 1)))
    if depends_on(look_ahead, list(transition.others)):  # the fit is no function of x_{t-1} alone
        fit = ()
    return transition.complete(chosen), fit, log_ratio, ahead


def gaussian_fit(
    block: GaussianBlock, slope: ExprArray, curvature: ExprArray, precision: ExprArray
) -> tuple[ExprArray, ExprArray]:
    """A Gaussian fitted to f(x_t | x_{t-1}) g(y_t | x_t) for a Gaussian f: its mode (n,) after a
    few Newton steps from the mean of f, and the Cholesky factor (n, n) of its precision, without
    the part of g that is not concave.

    slope, curvature : of log g in the block's symbols. precision : of the transition.
    """
    n = len(block)
    x = block.mean
    spread = array([apply("sqrt", block.covariance[i, i]) for i in range(n)])
    for _ in range(NEWTON_STEPS):
        g, w = _at(block, x, slope, curvature)
        pull = g - precision @ (x - block.mean)
        if n == 1:
            step = pull / (precision[0] + np.maximum(w[0], 0.0))
        else:
            root = lower_inverse(_factor(w, precision))
            step = array(root.T @ (root @ pull))
        limit = LONGEST_STEP * spread
        x = array(x + np.minimum(np.maximum(step, -limit), limit))
    _, w = _at(block, x, slope, curvature)
    factor = _factor(w, precision)
    # slope or curvature over- or underflowed: the transition itself is a valid proposal
    total = constant(0.0)
    for e in (*x, *np.diagonal(factor.view(np.ndarray))):
        total = total + e
    finite: Any = apply("lt", apply("abs", total), np.inf)
    return array(np.where(finite, x, block.mean)), array(
        np.where(finite, factor, written_cholesky(precision))
    )


def _at(
    block: GaussianBlock, x: ExprArray, slope: ExprArray, curvature: ExprArray
) -> tuple[ExprArray, ExprArray]:
    """Slope (n,) of log g at x, and minus its curvature (n, n)."""
    n = len(block)
    at = dict(zip(block.symbols, x, strict=True))
    flat = substitute([*slope, *curvature.ravel()], at)
    return array(flat[:n]), array(-array(flat[n:]).reshape(n, n))


def _factor(w: ExprArray, precision: ExprArray) -> ExprArray:
    """Cholesky factor of precision + w, or of precision + the positive part of w's diagonal."""
    n = len(w)
    diagonal = np.diag(array(np.maximum(array(np.diagonal(w.view(np.ndarray))), 0.0)))
    safe = written_cholesky(array(precision + diagonal))
    if n == 1:
        return safe
    full = written_cholesky(array(precision + w))
    last = full[n - 1, n - 1]
    concave: Any = apply("eq", last, last)  # nan where the matrix is not positive definite
    return array(np.where(concave, full, safe))


def log_mixture(volume: Expr, distance: Expr, share: float) -> Expr:
    """log (q / f) of a fit mixed with a share of f, where fit / f = volume * exp(distance)."""
    ratio = volume * apply("exp", apply("minimum", distance, LARGEST_EXPONENT))
    log_ratio = apply("log", share + (1.0 - share) * ratio)
    # beyond the cap the share of f counts for nothing, and log q / f goes on as distance
    mixture: Expr = log_ratio + np.maximum(distance - LARGEST_EXPONENT, 0.0)
    return mixture


def written_cholesky(a: ExprArray) -> ExprArray:
    """Cholesky factor written out in scalars (nan where a is not positive definite)."""
    n, zero = len(a), constant(0.0)
    out = np.empty((n, n), dtype=object)
    out[...] = [[zero] * n] * n
    for j in range(n):
        total = a[j, j]
        for k in range(j):
            total = total - out[j, k] ** 2
        out[j, j] = apply("sqrt", total)
        for i in range(j + 1, n):
            total = a[i, j]
            for k in range(j):
                total = total - out[i, k] * out[j, k]
            out[i, j] = total / out[j, j]
    return array(out)


# -- the user's own


def _user(trace: Trace, missing: Missing) -> Proposal:
    """@proposal where the channels it names were measured, the transition elsewhere."""
    base = bootstrap(trace, missing)
    laws = [p for site in trace.proposal.values()
            for a in site.distribution.parameters.values() for p in a.ravel()]  # fmt: skip
    named = [s for s in trace.observation_symbols if any(depends_on(p, [s]) for p in laws)]
    measured: Expr | None = None
    if not missing.none:
        for s in named:
            measured = seen(s) if measured is None else apply("minimum", measured, seen(s))
    draw = draws_of(trace, list(trace.transition.values()))
    correction = constant(0.0)
    own: set[Expr] = set()
    for site in trace.proposal.values():
        sample = array(site.distribution.sample(Draws("proposal_" + site.name)))
        for s, e in zip(site.value.ravel(), sample.ravel(), strict=True):
            draw[s] = e if measured is None else apply("where", measured, e, draw[s])
            own.add(s)
        correction = correction - site.distribution.log_density(site.value)
    transition = [t for t in terms(trace, "transition") if set(t.site.value.ravel()) & own]
    site = transition[0].site
    ratio = tuple(
        [replace(t, guard=measured) for t in transition] + [Term(site, correction, measured)]
    )
    return replace(
        base,
        name="user",
        draw=resolved(draw),
        weight=(*base.weight, *ratio),
        # no file and line: a generated text must not change with the number of a notebook's cell
        explanation=f"as written in {next(iter(trace.proposal.values())).where.function}()",
    )
