"""Metropolis-Hastings chains over parameters, whatever the likelihood and the proposal.

Metropolis et al. (1953), Hastings (1970); Schön et al. (2015), algorithms 1 and 4. With an unbiased
estimate in place of the likelihood it is kept with the point it was made for (Andrieu and Roberts
2009), and so is whatever else of that run the proposal goes by, so that the chain on point and run
has the posterior for its marginal. The random walk adapts during warmup and is then held fixed.

With a first stage acceptance is delayed (Christen and Fox 2005, "Markov chain Monte Carlo using an
approximation"): a proposal is accepted or refused by an approximate likelihood, and only what that
accepts is worth a run of the exact one, by which it is accepted with the probability that makes the
whole exact. The first part of the warmup, whose draws count for nothing, goes by the approximation
alone.

A chain moves in coordinates: each parameter keeps to the unconstrained scale of
`language/model/transforms.py`, or is moved itself, or its logarithm or reciprocal is. A proposal
outside the support has density zero there.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol, cast

import numpy as np

from ssmppl.analysis.bounds import Interval, interval
from ssmppl.errors import ArgumentError, listing
from ssmppl.expressions.arrays import array
from ssmppl.expressions.expr import Expr
from ssmppl.inference.gaussian.likelihood import Approximated, ApproximateLikelihood
from ssmppl.inference.preparation.gaussian_pilot import DEGREES
from ssmppl.inference.preparation.space import Space
from ssmppl.inference.run.draws import Block
from ssmppl.inference.run.problem import Problem
from ssmppl.language.model.trace import Site
from ssmppl.language.model.transforms import transforms

SCALES = ("unconstrained", "natural", "log", "reciprocal")
STEP = 1e-3  # of finite differences, in standard deviations
ADAPTATION_POWER = 0.66
STARTS = 50  # runs of the likelihood at a start until one is positive


@dataclass(frozen=True)
class Coordinates:
    """w (d,), the free parameters on the scales that were chosen.

    kinds : (d,) one of `SCALES` each. place : (d,) positions in z where the kind is
    "unconstrained", else in theta. by_z : (sites,) which sites are computed from z.
    """

    space: Space
    kinds: np.ndarray
    place: np.ndarray
    by_z: np.ndarray

    def __len__(self) -> int:
        return len(self.kinds)

    @property
    def problem(self) -> Problem:
        return self.space.problem

    def at(self, z_free: np.ndarray) -> np.ndarray:
        """w of a point given by the unconstrained values of the free parameters.

        Raises
        ------
        ArgumentError : some parameter has no w there, as 0 has no reciprocal.
        """
        if bool(np.all(self.kinds == "unconstrained")):
            return z_free
        theta, _ = self.space.parameters(z_free)
        z = self.space.z.copy()
        z[self.space.positions] = z_free
        w = np.where(self.kinds == "unconstrained", z[self._in_z], theta[self._in_theta])
        log, reciprocal = self.kinds == "log", self.kinds == "reciprocal"
        with np.errstate(divide="ignore", invalid="ignore"):  # seen below
            w[log], w[reciprocal] = np.log(w[log]), 1.0 / w[reciprocal]
        for i in np.flatnonzero(~np.isfinite(w) & (log | reciprocal)):
            symbol = self.problem.trace.parameter_symbols[self.place[i]]
            name, value = symbol.data[1], theta[self.place[i]]
            raise ArgumentError(
                f"a chain would start at {symbol!r} = {value:g}, which has no finite value on the "
                f"{self.kinds[i]} scale",
                fix=f'use "natural" or "unconstrained" for {name}, or give start={{"{name}": ...}}',
            )
        return w

    def parameters(self, w: np.ndarray) -> tuple[np.ndarray, float]:
        """(theta, log prior + log |d theta / d w|), -inf outside the support."""
        space = self.space
        if bool(np.all(self.by_z == space.free)):
            return space.parameters(w)
        z, theta, log_jacobian = space.z.copy(), space.theta.copy(), 0.0
        for value, kind, i in zip(w.tolist(), self.kinds, self.place, strict=True):
            if kind == "unconstrained":
                z[i] = value
            elif kind == "natural":
                theta[i] = value
            elif kind == "log":
                theta[i] = np.exp(min(value, 700.0))
                log_jacobian += value
            else:
                if value == 0.0:
                    return theta, -np.inf
                theta[i] = 1.0 / value
                log_jacobian -= 2.0 * np.log(abs(value))
        program = space.problem.program
        log_jacobian += program.entry("constrain")(theta, z, self.by_z)
        log_density = program.entry("log_prior")(theta) + log_jacobian
        if not np.all(np.isfinite(theta)) or not log_density < np.inf:
            return theta, -np.inf
        return theta, float(log_density)

    @property
    def _in_z(self) -> np.ndarray:
        return np.where(self.kinds == "unconstrained", self.place, 0)

    @property
    def _in_theta(self) -> np.ndarray:
        return np.where(self.kinds == "unconstrained", 0, self.place)


def coordinates(space: Space, scale: str, transform: Mapping[str, str] | None) -> Coordinates:
    """The coordinates that a method's `scale` and `transform` ask for.

    Raises
    ------
    ArgumentError : an unknown scale or parameter, or a scale that a parameter cannot have.
    """
    trace = space.problem.trace
    given = dict(transform or {})
    for name in given:
        if name not in trace.parameters:
            raise ArgumentError(
                f"transform names {name!r}, which is no parameter",
                fix=f"the parameters are: {listing(name, trace.parameters)}",
            )
    for name, kind in [("", scale), *given.items()]:
        if kind not in SCALES or (not name and kind not in SCALES[:2]):
            valid = SCALES if name else SCALES[:2]
            raise ArgumentError(
                f"transform={{{name!r}: {kind!r}}} is unknown" if name else f"scale={kind!r}",
                fix=f"use one of: {listing(str(kind), valid)}",
            )
    kinds: list[str] = []
    place: list[int] = []
    by_z = np.zeros(len(trace.parameters), dtype=bool)
    index = {s: i for i, s in enumerate(trace.parameter_symbols)}
    reach, start = _reach(space), 0
    for k, (site, t) in enumerate(zip(trace.parameters.values(), transforms(trace), strict=True)):
        kind = given.get(site.name, scale)
        if space.free[k] and kind == "unconstrained":
            by_z[k] = True
            kinds += [kind] * len(t.free)
            place += range(start, start + len(t.free))
        elif space.free[k]:
            _check(site, kind, reach)
            kinds += [kind] * len(site.components)
            place += [index[s] for s in site.components]
        start += len(t.free)
    return Coordinates(space, np.array(kinds, dtype="U13"), np.array(place, dtype=int), by_z)


def _reach(space: Space) -> dict[Expr, Interval]:
    """An enclosure of the support of each parameter's components, those of its parents known."""
    reach: dict[Expr, Interval] = {}
    values = dict(zip(space.problem.trace.parameter_symbols, space.theta.tolist(), strict=True))
    for site, free in zip(space.problem.trace.parameters.values(), space.free, strict=True):
        support = site.distribution.support()
        ends = [np.broadcast_to(array(a).view(np.ndarray), site.shape).ravel()
                for a in (support.lower, support.upper)]  # fmt: skip
        for s, low, high in zip(site.value.ravel(), *ends, strict=True):
            whole = interval(low, reach)[0], interval(high, reach)[1]
            reach.setdefault(s, whole if free else (values[s], values[s]))
    return reach


def _check(site: Site, kind: str, reach: Mapping[Expr, Interval]) -> None:
    tied = site.distribution.support().tied
    if tied:
        raise ArgumentError(
            f"{site.name} is {tied}: it cannot move on the {kind} scale",
            fix=f'add transform={{"{site.name}": "unconstrained"}}',
            where=site.distribution.location,
        )
    if kind == "log" and not all(reach[s][0] >= 0.0 for s in site.components):
        raise ArgumentError(
            f"{site.name} is not confined to positive numbers: it has no logarithm",
            fix=f'use "natural" or "unconstrained" for {site.name}',
            where=site.distribution.location,
        )


@dataclass(frozen=True)
class LocalDerivatives:
    """Derivatives of theta and of the log prior at a point, in w (d,).

    jacobian (P, d), second (P, d, d) : of theta. slope (d,), curvature (d, d) : of the log prior
    with the log Jacobian; 0 where there is no finite difference, next to the support's end.
    """

    jacobian: np.ndarray
    second: np.ndarray
    slope: np.ndarray
    curvature: np.ndarray


def local_derivatives(
    at: Coordinates, w: np.ndarray, sd: np.ndarray, second: bool
) -> LocalDerivatives:
    """Central differences; sd (d,) gives the scale of each coordinate."""
    d, h = len(w), STEP * sd
    theta, log_p = at.parameters(w)
    jacobian, slope = np.zeros((len(theta), d)), np.zeros(d)
    twice, curvature = np.zeros((len(theta), d, d)), np.zeros((d, d))
    ends = []
    for i in range(d):
        unit = np.eye(d)[i] * h[i]
        up, down = at.parameters(w + unit), at.parameters(w - unit)
        ends.append((up, down))
        if np.isfinite(up[1]) and np.isfinite(down[1]):
            jacobian[:, i] = (up[0] - down[0]) / (2.0 * h[i])
            slope[i] = (up[1] - down[1]) / (2.0 * h[i])
            twice[:, i, i] = (up[0] - 2.0 * theta + down[0]) / h[i] ** 2
            curvature[i, i] = (up[1] - 2.0 * log_p + down[1]) / h[i] ** 2
    for i in range(d if second else 0):
        for j in range(i):
            step = np.eye(d)[i] * h[i] + np.eye(d)[j] * h[j]
            up, down = at.parameters(w + step), at.parameters(w - step)
            logs = [up[1], down[1], *(e[1] for k in (i, j) for e in ends[k])]
            if np.all(np.isfinite(logs)):
                singles = [ends[k][m] for k in (i, j) for m in (0, 1)]
                area = 2.0 * h[i] * h[j]
                both = up[0] + down[0] + 2.0 * theta - sum(s[0] for s in singles)
                twice[:, i, j] = twice[:, j, i] = both / area
                both = up[1] + down[1] + 2.0 * log_p - sum(s[1] for s in singles)
                curvature[i, j] = curvature[j, i] = both / area
    return LocalDerivatives(jacobian, twice, slope, curvature)


@dataclass(frozen=True)
class LikelihoodRun:
    """What a likelihood gave at a point.

    paths, increments : of each experiment, (T, D) and (T,), where the run makes them.
    score, information : (P,), (P, P) estimates of the log-likelihood's derivatives.
    numbers : the normals that the run was made from, for those who move them.
    """

    log_likelihood: float
    paths: tuple[np.ndarray, ...] = ()
    increments: tuple[np.ndarray, ...] = ()
    score: np.ndarray | None = None
    information: np.ndarray | None = None
    numbers: Any = None


@dataclass(frozen=True)
class ChainPoint:
    """w (d,), theta (P,), log_density = log prior + log Jacobian, the run, what the proposal knows
    at this point, and the first stage's log-likelihood, where there is one and it is known."""

    w: np.ndarray
    theta: np.ndarray
    log_density: float
    run: LikelihoodRun
    local: Any = None
    approximate: float | None = None


class Likelihood(Protocol):
    """Where log-likelihoods come from."""

    def run(
        self, theta: np.ndarray, before: LikelihoodRun | None, stream: np.ndarray
    ) -> LikelihoodRun | None:
        """A run at theta, from the run of the current point; None where it is zero, or is none:
        infinite."""

    def kept(self, point: ChainPoint, stream: np.ndarray) -> dict[str, np.ndarray]:
        """What a kept draw has besides theta: path_<i>, increment_<i>."""


class GuidedLikelihood(Likelihood, Protocol):
    """One that can begin from what a first stage has found."""

    def run_given(
        self, theta: np.ndarray, found: Approximated | None, stream: np.ndarray
    ) -> LikelihoodRun | None:
        """As `run`."""


class Proposal(Protocol):
    """How a point moves; `tuning` is what adaptation changes."""

    def local(self, w: np.ndarray, run: LikelihoodRun) -> Any:
        """What the proposal goes by at a point, made once for it."""

    def propose(
        self, point: ChainPoint, tuning: Any, generator: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """A new w, and the standard normals of the walk's step; None where it was no step of one,
        and tells adaptation nothing."""

    def log_ratio(
        self, old: ChainPoint, new: ChainPoint, tuning: Any, normals: np.ndarray | None
    ) -> float:
        """log q(old | new) - log q(new | old), of the kind of step that `propose` made."""

    def adapt(self, tuning: Any, normals: np.ndarray, excess: float, iteration: int) -> Any:
        """The tuning after a step whose probability of acceptance was in excess of the target."""


@dataclass(frozen=True)
class Metropolis:
    """A Metropolis-Hastings kernel: adapts in its first `adapting` iterations; the first `warmup`
    draws are not thinned.

    first : of delayed acceptance; None: there is none. approximate : so many iterations go by it
    alone.
    """

    coordinates: Coordinates
    likelihood: Likelihood
    proposal: Proposal
    warmup: int
    adapting: int
    target: float
    thin: int
    first: ApproximateLikelihood | None = None
    approximate: int = 0


@dataclass(frozen=True)
class WalkState:
    """Where a chain stands; everything that its future depends on."""

    point: ChainPoint
    tuning: Any
    iteration: int
    generator: np.random.Generator
    stream: np.ndarray


def start_chain(
    kernel: Metropolis, w: np.ndarray, tuning: Any, generator: np.random.Generator,
    stream: np.ndarray,
) -> WalkState:  # fmt: skip
    """A chain at w (d,); of log-likelihood -inf where no run of several has a positive one."""
    theta, log_density = kernel.coordinates.parameters(w)
    stream, found = stream.copy(), None
    if kernel.first is not None:
        found = kernel.first.at(theta)
    if found is not None and kernel.approximate:
        run = LikelihoodRun(found.log_likelihood)
    else:
        run = _positive_run(kernel, theta, found, stream)
    known = None if found is None else found.log_likelihood
    point = ChainPoint(w, theta, log_density, run, kernel.proposal.local(w, run), known)
    return WalkState(point, tuning, 0, generator, stream)


def _positive_run(
    kernel: Metropolis, theta: np.ndarray, found: Approximated | None, stream: np.ndarray
) -> LikelihoodRun:
    """A run of positive likelihood out of several; of log-likelihood -inf where none has one."""
    for _ in range(STARTS):
        run = _run(kernel, theta, None, found, stream)
        if run is not None:
            return run
    return no_run(kernel.coordinates.problem)


def no_run(problem: Problem) -> LikelihoodRun:
    """In place of a run where every one has likelihood zero."""
    d = len(problem.trace.state_symbols)
    return LikelihoodRun(
        -np.inf,
        tuple(np.zeros((e.steps, d)) for e in problem.experiments),
        tuple(np.full(e.steps, -np.inf) for e in problem.experiments),
    )


def _run(
    kernel: Metropolis, theta: np.ndarray, before: LikelihoodRun | None,
    found: Approximated | None, stream: np.ndarray,
) -> LikelihoodRun | None:  # fmt: skip
    if kernel.first is None:
        return kernel.likelihood.run(theta, before, stream)
    return cast(GuidedLikelihood, kernel.likelihood).run_given(theta, found, stream)


def metropolis_block(kernel: Metropolis, state: WalkState, n: int) -> tuple[WalkState, Block]:
    """n draws of one chain, each after `thin` iterations (warmup draws are not thinned)."""
    state = replace(state, generator=copy.deepcopy(state.generator), stream=state.stream.copy())
    draws: dict[str, list[np.ndarray]] = {"theta": []}
    stats: dict[str, list[float]] = {
        "log_marginal_likelihood": [], "lp": [], "acceptance_rate": []
    }  # fmt: skip
    for _ in range(n):
        accepted, iterations = 0.0, kernel.thin if state.iteration >= kernel.warmup else 1
        for _ in range(iterations):
            state, rate = _iterate(kernel, state)
            accepted += rate / iterations
        point = state.point
        draws["theta"].append(point.theta)
        for name, value in kernel.likelihood.kept(point, state.stream).items():
            draws.setdefault(name, []).append(value)
        stats["log_marginal_likelihood"].append(float(point.run.log_likelihood))
        stats["lp"].append(float(point.run.log_likelihood + point.log_density))
        stats["acceptance_rate"].append(accepted)
    return state, Block.of(draws, stats)


LONGEST_HELD = 50  # thinned steps, after which a draw counts as another one at the same place


def jump_block(kernel: Metropolis, state: WalkState, n: int) -> tuple[WalkState, Block]:
    """n distinct draws of the chain thinned to every `thin`-th step, with their holding times in
    such steps; in the warmup n steps, as `metropolis_block`."""
    if state.iteration < kernel.warmup:
        return metropolis_block(kernel, state, n)
    state = replace(state, generator=copy.deepcopy(state.generator), stream=state.stream.copy())
    draws: dict[str, list[np.ndarray]] = {"theta": []}
    stats: dict[str, list[float]] = {"lp": [], "holding": [], "acceptance_rate": []}
    for _ in range(n):
        point, held, accepted = state.point, 0, 0.0
        while state.point is point and held < LONGEST_HELD:
            for _ in range(kernel.thin):
                state, rate = _iterate(kernel, state)
                accepted += rate
            held += 1
        draws["theta"].append(point.theta)
        stats["lp"].append(float(point.run.log_likelihood + point.log_density))
        stats["holding"].append(float(held))
        stats["acceptance_rate"].append(accepted / (held * kernel.thin))
    return state, Block.of(draws, stats)


def _iterate(kernel: Metropolis, state: WalkState) -> tuple[WalkState, float]:
    if kernel.first is not None and state.iteration == kernel.approximate > 0:
        found = kernel.first.at(state.point.theta)  # from here on by the exact likelihood
        run = _positive_run(kernel, state.point.theta, found, state.stream)
        state = replace(state, point=replace(state.point, run=run))
    old, generator = state.point, state.generator
    w, normals = kernel.proposal.propose(old, state.tuning, generator)
    theta, log_density = kernel.coordinates.parameters(w)
    new, probability, promising = None, 0.0, 0.0
    if log_density > -np.inf:
        made = ChainPoint(w, theta, log_density, old.run)
        if kernel.first is None:
            new, probability = _decided(kernel, state, made, normals)
            promising = probability
        else:
            new, promising, probability = _delayed(kernel, state, made, normals)
    accept = generator.uniform() < probability
    tuning = state.tuning
    if state.iteration < kernel.adapting and len(w) and normals is not None:
        excess = promising - kernel.target
        tuning = kernel.proposal.adapt(tuning, normals, excess, state.iteration)
    point = new if accept and new is not None else old
    return replace(state, point=point, tuning=tuning, iteration=state.iteration + 1), float(accept)


def _decided(
    kernel: Metropolis, state: WalkState, made: ChainPoint, normals: np.ndarray | None
) -> tuple[ChainPoint | None, float]:
    """The proposed point with its run, and its probability of acceptance."""
    old = state.point
    run = kernel.likelihood.run(made.theta, old.run, state.stream)
    if run is None:
        return None, 0.0
    new = replace(made, run=run, local=kernel.proposal.local(made.w, run))
    change = run.log_likelihood + new.log_density - old.run.log_likelihood - old.log_density
    change += kernel.proposal.log_ratio(old, new, state.tuning, normals)
    return new, 1.0 if not change < 0.0 else float(np.exp(change))


def _delayed(
    kernel: Metropolis, state: WalkState, made: ChainPoint, normals: np.ndarray | None
) -> tuple[ChainPoint | None, float, float]:
    """The proposed point, if the first stage accepts it; the probabilities of acceptance by the
    first stage, and by the second once the first has.

    Where the approximation is no number at either point the first stage accepts, and the second
    decides by the whole ratio.
    """
    old, first = state.point, kernel.first
    assert first is not None
    before, found = old.approximate, first.at(made.theta)
    if before is None:
        before = first.at(old.theta).log_likelihood
    ratio = kernel.proposal.log_ratio(old, made, state.tuning, normals)
    ratio += made.log_density - old.log_density
    alone = state.iteration < kernel.approximate
    known = before > -np.inf and found.log_likelihood > -np.inf
    change = found.log_likelihood - before if known else 0.0
    if alone and not known:
        change = 0.0 if found.log_likelihood > -np.inf else -np.inf
    promising = 1.0
    if (known or alone) and change + ratio < 0.0:
        promising = float(np.exp(change + ratio))
    if not state.generator.uniform() < promising:
        return None, promising, 0.0
    made = replace(made, approximate=found.log_likelihood)
    if alone:
        return replace(made, run=LikelihoodRun(found.log_likelihood)), promising, 1.0
    run = _run(kernel, made.theta, None, found, state.stream)
    if run is None:
        return None, promising, 0.0
    rest = run.log_likelihood - old.run.log_likelihood
    rest += -change if known else ratio
    return replace(made, run=run), promising, 1.0 if not rest < 0.0 else float(np.exp(rest))


# What checkpoints of Metropolis chains are made of.
WALK_STATES = (WalkState, ChainPoint, LikelihoodRun)


@dataclass(frozen=True)
class RandomWalk:
    """w' = w + S e. `tuning` is S (d, d), a Cholesky factor."""

    def local(self, w: np.ndarray, run: LikelihoodRun) -> None:
        return None

    def propose(
        self, point: ChainPoint, tuning: np.ndarray, generator: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray | None]:
        normals = generator.standard_normal(len(point.w))
        return point.w + tuning @ normals, normals

    def log_ratio(
        self, old: ChainPoint, new: ChainPoint, tuning: np.ndarray, normals: np.ndarray | None
    ) -> float:
        return 0.0

    def adapt(
        self, tuning: np.ndarray, normals: np.ndarray, excess: float, iteration: int
    ) -> np.ndarray:
        """S S' <- S (I + gain * excess * e e' / |e|^2) S' (Vihola 2012, equation 1)."""
        d = len(normals)
        gain = min(1.0, d * (iteration + 1.0) ** -ADAPTATION_POWER)
        unit = normals / np.linalg.norm(normals)
        middle = np.eye(d) + gain * excess * np.outer(unit, unit)
        return np.linalg.cholesky(tuning @ middle @ tuning.T)


@dataclass(frozen=True)
class WalkAndIndependence(RandomWalk):
    """A random walk, and in a share of the steps w' ~ Student's t round the mode, whatever w is
    (Tierney 1994, section 2.3.3, and 2.4 on mixtures of kernels).

    Where the posterior is about Gaussian these forget where the chain is within a step or two; the
    walk takes it to where they are not a good fit.

    centre (d,), factor (d, d) : of t, of whose scale matrix the factor is a Cholesky factor.
    share : of the steps.
    """

    centre: np.ndarray
    factor: np.ndarray
    share: float

    def propose(
        self, point: ChainPoint, tuning: np.ndarray, generator: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray | None]:
        if generator.uniform() >= self.share:
            return super().propose(point, tuning, generator)
        stretch = np.sqrt(DEGREES / generator.chisquare(DEGREES))
        normals = generator.standard_normal(len(point.w))
        return self.centre + stretch * (self.factor @ normals), None

    def log_ratio(
        self, old: ChainPoint, new: ChainPoint, tuning: np.ndarray, normals: np.ndarray | None
    ) -> float:
        if normals is not None:
            return 0.0
        return self._log_density(old.w) - self._log_density(new.w)

    @cached_property
    def _inverse(self) -> np.ndarray:
        return np.linalg.inv(self.factor)

    def _log_density(self, w: np.ndarray) -> float:
        """Log density of t at w, up to a constant."""
        white, d = self._inverse @ (w - self.centre), len(w)
        return -0.5 * (DEGREES + d) * float(np.log1p(white @ white / DEGREES))
