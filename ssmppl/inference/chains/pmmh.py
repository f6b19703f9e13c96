"""Particle Metropolis-Hastings (Andrieu, Doucet and Holenstein 2010, section 2.4.2).

The random walk moves on the unconstrained scale or one of the user's choice, starts from the
inverse information at a mode that a pilot finds, and adapts during warmup by the robust adaptive
Metropolis algorithm (Vihola 2012, algorithm 1).
"""

from __future__ import annotations

from dataclasses import asdict
from functools import partial
from typing import Any

import numpy as np

from ssmppl.errors import ArgumentError
from ssmppl.inference.chains.coordinates import Coordinates, coordinates
from ssmppl.inference.chains.curvature import fitted_covariance
from ssmppl.inference.chains.langevin import Langevin
from ssmppl.inference.chains.particle_likelihood import (
    CorrelatedLikelihood,
    MarginalLikelihood,
    ParticleLikelihood,
    ScoredLikelihood,
    run_filters,
)
from ssmppl.inference.chains.sampling import Sampler, Setup
from ssmppl.inference.chains.walk import (
    Likelihood,
    Metropolis,
    Proposal,
    RandomWalk,
    metropolis_block,
    start_chain,
)
from ssmppl.inference.methods import PMMH, MetropolisHastings
from ssmppl.inference.particles.filtering import FilterSettings, random_state
from ssmppl.inference.particles.marginal import is_marginal
from ssmppl.inference.particles.pilot import (
    SCALE_REPEATS,
    TUNING_REPEATS,
    Pilot,
    Tuning,
    averaged_density,
    dispersed,
    find_mode,
    particles_for,
    tune_particles,
)
from ssmppl.inference.particles.proposal_choice import choose

__all__ = ["prepare", "run_filters"]

STRETCH = 2.562  # of a random walk's steps, over sqrt(d): Sherlock et al. (2015)


def prepare(setup: Setup, method: PMMH) -> Sampler:
    """Find a mode, choose proposal and number of particles there, and start the chains.

    Raises
    ------
    ArgumentError : a setting does not apply to the model; gives the reason.
    """
    problem, space = setup.problem, setup.space
    where = coordinates(space, method.scale, method.transform)
    if method.covariance is not None:
        given_factor(method.covariance, len(where))  # refused now, not after the pilot
    pilot = setup.once("pilot", lambda: find_mode(space, setup.root, rescue=method.rescue))
    theta, _ = space.parameters(pilot.z)
    plain = method.order == 0 and not method.correlation  # others know no guide
    choice = None
    if method.proposal == "auto":
        temper = plain and not method.rescue
        choice = setup.once(
            "proposal",
            lambda: choose(
                problem, theta, exact=False, whole=plain, integrate=plain, temper=temper
            ),
        )
    proposal = choice.name if choice else method.proposal
    problem.proposal(proposal, integrate=plain)
    particles, tuned = method.particles, None
    if particles is None:
        tuned = setup.once("tuning", lambda: _tuned(setup, method, theta, proposal))
        particles = tuned.particles
    settings = FilterSettings(int(particles), proposal, rescue=int(method.rescue))
    d = len(where)
    factor = walk_factor(setup, method, where, pilot, "bootstrap")
    tuning: Any = factor
    move: Proposal = RandomWalk()
    usual = 0.25 if d <= 1 else 0.2 if d == 2 else 0.15
    if method.order:
        if method.covariance is None:
            factor = factor * np.sqrt(max(d, 1)) / STRETCH  # steps of one standard deviation
        move, tuning, usual = Langevin(where, factor, method.order == 2), 0.0, 0.25
    elif method.correlation:
        usual = 0.3
    kernel = Metropolis(
        where, _likelihood(setup, method, settings), move, setup.warmup,
        setup.warmup if adapts(method) else 0,
        usual if method.target_acceptance is None else method.target_acceptance, setup.thin,
    )  # fmt: skip
    states = []
    starts = setup.once(
        "starts",
        lambda: dispersed(space, pilot, setup.chains, setup.root, "bootstrap", method.rescue),
    )
    for chain, z in enumerate(starts):
        generator, stream = setup.streams(chain)
        states.append(start_chain(kernel, where.at(z), tuning, generator, stream))
    report = {
        "particles": settings.particles,
        "proposal": str(choice or proposal),
        "settings": settings_of(method),
        "pilot_mode": setup.by_name(theta),
        "walk_covariance": (factor @ factor.T).tolist(),
    }
    if tuned is not None:
        report["pilot_sd_of_log_likelihood"] = tuned.sd
    return Sampler(partial(metropolis_block, kernel), states, report)


def _likelihood(setup: Setup, method: PMMH, settings: FilterSettings) -> Likelihood:
    """The particle filter in the form that the method needs, compiled to find out if it applies."""
    problem = setup.problem
    if method.correlation:
        correlated = CorrelatedLikelihood(problem, settings, method.correlation, setup.states)
        _ = correlated.filter
        return correlated
    if method.order:
        held = [n not in setup.held for n, s in problem.trace.parameters.items()
                for _ in s.components]  # fmt: skip
        wanted = tuple(np.flatnonzero(held).tolist())
        second = method.order == 2
        scored = ScoredLikelihood(problem, settings, method.lag, wanted, second, setup.states)
        _ = scored.filter
        return scored
    if is_marginal(settings.proposal):
        return MarginalLikelihood(problem, settings, setup.states)
    return ParticleLikelihood(problem, settings, setup.states)


def _tuned(setup: Setup, method: PMMH, theta: np.ndarray, proposal: str) -> Tuning:
    """The number of particles by the spread of log Z, or of the difference of correlated ones."""
    if not method.correlation:
        return tune_particles(
            setup.problem, theta, proposal, method.target_sd, setup.root, method.rescue
        )

    def spread(particles: int) -> float:
        settings = FilterSettings(particles, proposal)
        likelihood = CorrelatedLikelihood(setup.problem, settings, method.correlation)
        stream, run, log_z = random_state(setup.root, 9), None, []
        for _ in range(TUNING_REPEATS):
            run = likelihood.run(theta, run, stream)
            log_z.append(-np.inf if run is None else run.log_likelihood)
        change = np.diff(log_z)
        return float(np.std(change) / np.sqrt(2.0)) if np.all(np.isfinite(change)) else np.inf

    return particles_for(spread, method.target_sd)


def adapts(method: PMMH | MetropolisHastings) -> bool:
    """Whether the walk adapts: as it was asked for, else unless a covariance was given."""
    return method.covariance is None if method.adapt is None else method.adapt


def walk_factor(
    setup: Setup, method: PMMH | MetropolisHastings, where: Coordinates, pilot: Pilot,
    proposal: str,
) -> np.ndarray:  # fmt: skip
    """Cholesky factor (d, d) of the walk's covariance, as given or from the pilot.

    Raises
    ------
    ArgumentError : the given covariance has the wrong shape, or is no covariance.
    """
    if method.covariance is not None:
        return given_factor(method.covariance, len(where))
    rescue = method.rescue if isinstance(method, PMMH) else 0
    covariance = setup.once(
        "covariance", lambda: pilot_covariance(setup, where, pilot, proposal, rescue)
    )
    return np.linalg.cholesky(covariance) * STRETCH / np.sqrt(max(len(where), 1))


def pilot_covariance(
    setup: Setup, where: Coordinates, pilot: Pilot, proposal: str, rescue: int = 0
) -> np.ndarray:
    """The inverse information at the pilot's mode, (d, d) in the coordinates."""
    w = where.at(pilot.z)
    repeats = SCALE_REPEATS if len(w) <= 4 else SCALE_REPEATS // 2
    density = averaged_density(where, setup.root, proposal, repeats, rescue)
    rng = np.random.default_rng(np.random.SeedSequence(setup.root.entropy, spawn_key=(8,)))
    return fitted_covariance(density, w, scales(where, pilot), rng)


def scales(where: Coordinates, pilot: Pilot) -> np.ndarray:
    """The pilot's scales of z carried over to the coordinates, by the change over one scale."""
    out = np.empty(len(where))
    if len(out) != len(pilot.z):
        raise AssertionError("coordinates and unconstrained numbers are one to one")
    for i, step in enumerate(np.diag(pilot.scale)):
        out[i] = 0.5 * np.abs(where.at(pilot.z + step) - where.at(pilot.z - step))[i]
    return out


def given_factor(covariance: Any, d: int) -> np.ndarray:
    """Cholesky factor of a covariance that the user gave."""
    matrix = np.atleast_2d(np.asarray(covariance, dtype=float))
    if matrix.shape != (d, d) or not np.allclose(matrix, matrix.T, rtol=1e-8, atol=0.0):
        raise ArgumentError(
            f"covariance has shape {matrix.shape}" if matrix.shape != (d, d)
            else "covariance is not symmetric",
            fix=f"give a symmetric {d} x {d} matrix, the free parameters in the order declared",
        )  # fmt: skip
    try:
        return np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        raise ArgumentError(
            "covariance is not positive definite", fix="give the covariance of the walk's steps"
        ) from None


def settings_of(method: Any) -> dict[str, Any]:
    """The settings as plain values, for the attributes."""
    settings = asdict(method)
    if settings.get("covariance") is not None:
        settings["covariance"] = np.asarray(settings["covariance"], dtype=float).tolist()
    if settings.get("transform") is not None:
        settings["transform"] = dict(settings["transform"])
    return settings
