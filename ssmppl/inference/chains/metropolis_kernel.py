"""Metropolis-Hastings chains over parameters, whatever the likelihood and the proposal.

Metropolis et al. (1953), Hastings (1970); Schön et al. (2015), algorithms 1 and 4. With an unbiased
estimate in place of the likelihood it is kept with the point it was made for (Andrieu and Roberts
2009), and so is whatever else of that run the proposal goes by, so that the chain on point and run
has the posterior for its marginal. The random walk adapts during warmup and is then held fixed.

A chain moves in coordinates: each parameter keeps to the unconstrained scale of
`language/model/transforms.py`, or is moved itself, or its logarithm or reciprocal is. A proposal
outside the support has density zero there.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from ssmppl.analysis.bounds import Interval, interval
from ssmppl.errors import ArgumentError, listing
from ssmppl.expressions.arrays import array
from ssmppl.expressions.expr import Expr
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
    support = site.distribution.support().kind
    if support in ("simplex", "positive definite"):
        raise ArgumentError(
            f"{site.name} is a {support.replace('simplex', 'probability vector')}"
            f"{' matrix' if support != 'simplex' else ''}: it cannot move on the {kind} scale",
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
    """w (d,), theta (P,), log_density = log prior + log Jacobian, the run, and what the proposal
    knows at this point."""

    w: np.ndarray
    theta: np.ndarray
    log_density: float
    run: LikelihoodRun
    local: Any = None


class Likelihood(Protocol):
    """Where log-likelihoods come from."""

    def run(
        self, theta: np.ndarray, before: LikelihoodRun | None, stream: np.ndarray
    ) -> LikelihoodRun | None:
        """A run at theta, from the run of the current point; None where it is zero, or is none:
        infinite."""

    def kept(self, point: ChainPoint, stream: np.ndarray) -> dict[str, np.ndarray]:
        """What a kept draw has besides theta: path_<i>, increment_<i>."""


class Proposal(Protocol):
    """How a point moves; `tuning` is what adaptation changes."""

    def local(self, w: np.ndarray, run: LikelihoodRun) -> Any:
        """What the proposal goes by at a point, made once for it."""

    def propose(
        self, point: ChainPoint, tuning: Any, generator: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """A new w, and the standard normals behind it."""

    def log_ratio(self, old: ChainPoint, new: ChainPoint, tuning: Any) -> float:
        """log q(old | new) - log q(new | old)."""

    def adapt(self, tuning: Any, normals: np.ndarray, excess: float, iteration: int) -> Any:
        """The tuning after a step whose probability of acceptance was in excess of the target."""


@dataclass(frozen=True)
class Metropolis:
    """A Metropolis-Hastings kernel: adapts in its first `adapting` iterations; the first `warmup`
    draws are not thinned."""

    coordinates: Coordinates
    likelihood: Likelihood
    proposal: Proposal
    warmup: int
    adapting: int
    target: float
    thin: int


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
    stream, run = stream.copy(), None
    for _ in range(STARTS):
        run = kernel.likelihood.run(theta, None, stream)
        if run is not None:
            break
    if run is None:
        problem = kernel.coordinates.problem
        d = len(problem.trace.state_symbols)
        run = LikelihoodRun(
            -np.inf,
            tuple(np.zeros((e.steps, d)) for e in problem.experiments),
            tuple(np.full(e.steps, -np.inf) for e in problem.experiments),
        )
    point = ChainPoint(w, theta, log_density, run, kernel.proposal.local(w, run))
    return WalkState(point, tuning, 0, generator, stream)


def metropolis_block(kernel: Metropolis, state: WalkState, n: int) -> tuple[WalkState, Block]:
    """n draws of one chain, each after `thin` iterations (warmup draws are not thinned)."""
    state = replace(state, generator=copy.deepcopy(state.generator), stream=state.stream.copy())
    draws: dict[str, list[np.ndarray]] = {"theta": []}
    stats: dict[str, list[float]] = {"log_likelihood": [], "lp": [], "acceptance_rate": []}
    for _ in range(n):
        accepted, iterations = 0.0, kernel.thin if state.iteration >= kernel.warmup else 1
        for _ in range(iterations):
            state, rate = _iterate(kernel, state)
            accepted += rate / iterations
        point = state.point
        draws["theta"].append(point.theta)
        for name, value in kernel.likelihood.kept(point, state.stream).items():
            draws.setdefault(name, []).append(value)
        stats["log_likelihood"].append(float(point.run.log_likelihood))
        stats["lp"].append(float(point.run.log_likelihood + point.log_density))
        stats["acceptance_rate"].append(accepted)
    return state, Block.of(draws, stats)


def _iterate(kernel: Metropolis, state: WalkState) -> tuple[WalkState, float]:
    old, generator = state.point, state.generator
    w, normals = kernel.proposal.propose(old, state.tuning, generator)
    theta, log_density = kernel.coordinates.parameters(w)
    new, probability = None, 0.0
    if log_density > -np.inf:
        run = kernel.likelihood.run(theta, old.run, state.stream)
        if run is not None:
            new = ChainPoint(w, theta, log_density, run, kernel.proposal.local(w, run))
            change = run.log_likelihood + log_density - old.run.log_likelihood - old.log_density
            change += kernel.proposal.log_ratio(old, new, state.tuning)
            probability = 1.0 if not change < 0.0 else float(np.exp(change))
    accept = generator.uniform() < probability
    tuning = state.tuning
    if state.iteration < kernel.adapting and len(w):
        excess = probability - kernel.target
        tuning = kernel.proposal.adapt(tuning, normals, excess, state.iteration)
    point = new if accept and new is not None else old
    return replace(state, point=point, tuning=tuning, iteration=state.iteration + 1), float(accept)


# What checkpoints of Metropolis chains are made of.
WALK_STATES = (WalkState, ChainPoint, LikelihoodRun)


@dataclass(frozen=True)
class RandomWalk:
    """w' = w + S e. `tuning` is S (d, d), a Cholesky factor."""

    def local(self, w: np.ndarray, run: LikelihoodRun) -> None:
        return None

    def propose(
        self, point: ChainPoint, tuning: np.ndarray, generator: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        normals = generator.standard_normal(len(point.w))
        return point.w + tuning @ normals, normals

    def log_ratio(self, old: ChainPoint, new: ChainPoint, tuning: np.ndarray) -> float:
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
