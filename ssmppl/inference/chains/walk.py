"""Metropolis-Hastings chains over parameters, whatever the likelihood and the proposal.

Metropolis et al. (1953), Hastings (1970); Schön et al. (2015), algorithms 1 and 4. With an unbiased
estimate in place of the likelihood it is kept with the point it was made for (Andrieu and Roberts
2009), and so is whatever else of that run the proposal goes by, so that the chain on point and run
has the posterior for its marginal. The random walk adapts during warmup and is then held fixed.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from ssmppl.inference.chains.coordinates import Coordinates
from ssmppl.inference.draws import Block

ADAPTATION_POWER = 0.66
STARTS = 50  # runs of the likelihood at a start until one is positive


@dataclass(frozen=True)
class Run:
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
class Point:
    """w (d,), theta (P,), log_density = log prior + log Jacobian, the run, and what the proposal
    knows at this point."""

    w: np.ndarray
    theta: np.ndarray
    log_density: float
    run: Run
    local: Any = None


class Likelihood(Protocol):
    """Where log-likelihoods come from."""

    def run(self, theta: np.ndarray, before: Run | None, stream: np.ndarray) -> Run | None:
        """A run at theta, from the run of the current point; None where it is zero, or is none:
        infinite."""

    def kept(self, point: Point, stream: np.ndarray) -> dict[str, np.ndarray]:
        """What a kept draw has besides theta: path_<i>, increment_<i>."""


class Proposal(Protocol):
    """How a point moves; `tuning` is what adaptation changes."""

    def local(self, w: np.ndarray, run: Run) -> Any:
        """What the proposal goes by at a point, made once for it."""

    def propose(
        self, point: Point, tuning: Any, generator: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """A new w, and the standard normals behind it."""

    def log_ratio(self, old: Point, new: Point, tuning: Any) -> float:
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

    point: Point
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
        run = Run(
            -np.inf,
            tuple(np.zeros((e.steps, d)) for e in problem.experiments),
            tuple(np.full(e.steps, -np.inf) for e in problem.experiments),
        )
    point = Point(w, theta, log_density, run, kernel.proposal.local(w, run))
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
    return state, Block(
        {k: np.array(v) for k, v in draws.items()}, {k: np.array(v) for k, v in stats.items()}
    )


def _iterate(kernel: Metropolis, state: WalkState) -> tuple[WalkState, float]:
    old, generator = state.point, state.generator
    w, normals = kernel.proposal.propose(old, state.tuning, generator)
    theta, log_density = kernel.coordinates.parameters(w)
    new, probability = None, 0.0
    if log_density > -np.inf:
        run = kernel.likelihood.run(theta, old.run, state.stream)
        if run is not None:
            new = Point(w, theta, log_density, run, kernel.proposal.local(w, run))
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


@dataclass(frozen=True)
class RandomWalk:
    """w' = w + S e. `tuning` is S (d, d), a Cholesky factor."""

    def local(self, w: np.ndarray, run: Run) -> None:
        return None

    def propose(
        self, point: Point, tuning: np.ndarray, generator: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        normals = generator.standard_normal(len(point.w))
        return point.w + tuning @ normals, normals

    def log_ratio(self, old: Point, new: Point, tuning: np.ndarray) -> float:
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
