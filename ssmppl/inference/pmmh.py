"""Particle Metropolis-Hastings (Andrieu, Doucet and Holenstein 2010, section 2.4.2).

The random walk moves on the unconstrained scale, its covariance adapts during warmup by the robust
adaptive Metropolis algorithm (Vihola 2012, algorithm 1) and is then held fixed, so that the kept
draws are those of one Markov chain.
"""

from __future__ import annotations

import copy
from dataclasses import asdict, dataclass, replace
from functools import partial

import numpy as np

from ssmppl.codegen.kernels.weights import ALL_ZERO, OK
from ssmppl.inference.filtering import FilterSettings, check_count, failure
from ssmppl.inference.methods import PMMH
from ssmppl.inference.pilot import Space, dispersed, find_mode, tune_particles
from ssmppl.inference.proposal_choice import choose
from ssmppl.inference.runner import Block
from ssmppl.inference.sampling import Sampler, Setup

ADAPTATION_POWER = 0.66


def prepare(setup: Setup, method: PMMH) -> Sampler:
    """Find a mode, choose proposal and number of particles there, and start the chains."""
    problem, space = setup.problem, setup.space
    if method.particles is not None:
        check_count("particles", method.particles, 1)
    pilot = find_mode(space, setup.root)
    theta, _ = space.parameters(pilot.z)
    choice = choose(problem, theta, kalman=False) if method.proposal == "auto" else None
    proposal = choice.name if choice else method.proposal
    problem.proposal(proposal)
    particles, tuned = method.particles, None
    if particles is None:
        tuned = tune_particles(problem, theta, proposal, method.target_sd, setup.root)
        particles = tuned.particles
    settings = FilterSettings(int(particles), proposal)
    d = len(pilot.z)
    target = method.target_acceptance or (0.25 if d <= 1 else 0.2 if d == 2 else 0.15)
    states = []
    for chain, z in enumerate(dispersed(space, pilot, setup.chains, setup.root, "bootstrap")):
        generator, stream = setup.streams(chain)
        states.append(start_chain(space, z, pilot.scale, settings, generator, stream))
    report = {
        "particles": settings.particles,
        "proposal": str(choice or proposal),
        "settings": asdict(method),
        "pilot_mode": setup.by_name(theta),
    }
    if tuned is not None:
        report["pilot_sd_of_log_likelihood"] = tuned.sd
    step = partial(pmmh_block, space, settings, setup.warmup, target, setup.thin)
    return Sampler(step, states, report)


@dataclass(frozen=True)
class PMMHState:
    """Where a chain stands; everything that its future depends on.

    z (free,), theta (P,); log_density = log prior + log Jacobian; paths, increments : of the
    filter run that was accepted, one per experiment; factor : Cholesky factor of the walk.
    """

    z: np.ndarray
    theta: np.ndarray
    log_density: float
    log_likelihood: float
    paths: tuple[np.ndarray, ...]
    increments: tuple[np.ndarray, ...]
    factor: np.ndarray
    iteration: int
    generator: np.random.Generator
    stream: np.ndarray


def run_filters(
    space: Space, theta: np.ndarray, settings: FilterSettings, stream: np.ndarray
) -> tuple[float, tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
    """(log Z, paths, increments) of all experiments; -inf where the estimate is zero."""
    problem = space.problem
    run = problem.program.entry(f"filtered_path_{settings.proposal}")
    total, paths, increments = 0.0, [], []
    for e in problem.experiments:
        path = np.empty((e.steps, len(problem.trace.state_symbols)))
        increment = np.empty(e.steps)
        status, t, log_z = run(theta, e.y, e.seen, e.u, settings.particles, stream, path, increment)
        if status == ALL_ZERO:
            return -np.inf, (), ()
        if status != OK:
            raise failure(problem, theta, status, t, e)
        total += log_z
        paths.append(path)
        increments.append(increment)
    return total, tuple(paths), tuple(increments)


def start_chain(
    space: Space, z: np.ndarray, scale: np.ndarray, settings: FilterSettings,
    generator: np.random.Generator, stream: np.ndarray,
) -> PMMHState:  # fmt: skip
    """A chain at z, with a walk of the usual length for the given scales."""
    theta, log_density = space.parameters(z)
    stream = stream.copy()
    log_likelihood = -np.inf
    paths: tuple[np.ndarray, ...] = ()
    increments: tuple[np.ndarray, ...] = ()
    for _ in range(50):
        log_likelihood, paths, increments = run_filters(space, theta, settings, stream)
        if log_likelihood > -np.inf:
            break
    if not paths:
        paths = tuple(
            np.zeros((e.steps, len(space.problem.trace.state_symbols)))
            for e in space.problem.experiments
        )
        increments = tuple(np.full(e.steps, -np.inf) for e in space.problem.experiments)
    factor = np.diag(scale) * 2.4 / np.sqrt(max(len(z), 1))
    return PMMHState(
        z, theta, log_density, log_likelihood, paths, increments, factor, 0, generator, stream
    )


def pmmh_block(
    space: Space, settings: FilterSettings, warmup: int, target: float, thin: int,
    state: PMMHState, n: int,
) -> tuple[PMMHState, Block]:  # fmt: skip
    """n draws of one chain, each after `thin` iterations (warmup draws are not thinned)."""
    state = replace(
        state, generator=copy.deepcopy(state.generator), stream=state.stream.copy(),
    )  # fmt: skip
    draws: dict[str, list[np.ndarray | float]] = {"theta": [], "log_likelihood": [], "lp": []}
    draws["acceptance_rate"] = []
    for i in range(len(space.problem.experiments)):
        draws[f"path_{i}"], draws[f"increment_{i}"] = [], []
    for _ in range(n):
        accepted, iterations = 0.0, thin if state.iteration >= warmup else 1
        for _ in range(iterations):
            state, rate = _iterate(space, settings, warmup, target, state)
            accepted += rate / iterations
        draws["theta"].append(state.theta)
        draws["log_likelihood"].append(float(state.log_likelihood))
        draws["lp"].append(float(state.log_likelihood + state.log_density))
        draws["acceptance_rate"].append(accepted)
        for i, (path, increment) in enumerate(zip(state.paths, state.increments, strict=True)):
            draws[f"path_{i}"].append(path)
            draws[f"increment_{i}"].append(increment)
    stacked = {k: np.array(v) for k, v in draws.items()}
    stats = ("log_likelihood", "lp", "acceptance_rate")
    block = Block(
        {k: v for k, v in stacked.items() if k not in stats}, {k: stacked[k] for k in stats}
    )
    return state, block


def _iterate(
    space: Space, settings: FilterSettings, warmup: int, target: float, state: PMMHState
) -> tuple[PMMHState, float]:
    direction = state.generator.standard_normal(len(state.z))
    z = state.z + state.factor @ direction
    theta, log_density = space.parameters(z)
    probability = 0.0
    log_likelihood = -np.inf
    paths: tuple[np.ndarray, ...] = ()
    increments: tuple[np.ndarray, ...] = ()
    if log_density > -np.inf:
        log_likelihood, paths, increments = run_filters(space, theta, settings, state.stream)
        change = log_likelihood + log_density - state.log_likelihood - state.log_density
        if log_likelihood > -np.inf:
            probability = 1.0 if not change < 0.0 else float(np.exp(change))
    accept = state.generator.uniform() < probability
    factor = state.factor
    if state.iteration < warmup and len(z):
        factor = _adapt(factor, direction, probability - target, state.iteration)
    if accept:
        state = replace(
            state, z=z, theta=theta, log_density=log_density, log_likelihood=log_likelihood,
            paths=paths, increments=increments,
        )  # fmt: skip
    return replace(state, factor=factor, iteration=state.iteration + 1), float(accept)


def _adapt(factor: np.ndarray, direction: np.ndarray, excess: float, iteration: int) -> np.ndarray:
    """S S' <- S (I + gain * excess * u u' / |u|^2) S' (Vihola 2012, equation 1)."""
    d = len(direction)
    gain = min(1.0, d * (iteration + 1.0) ** -ADAPTATION_POWER)
    unit = direction / np.linalg.norm(direction)
    middle = np.eye(d) + gain * excess * np.outer(unit, unit)
    return np.linalg.cholesky(factor @ middle @ factor.T)
