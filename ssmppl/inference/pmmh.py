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
from ssmppl.inference.coordinates import Coordinates, coordinates
from ssmppl.inference.curvature import fitted_covariance
from ssmppl.inference.filtering import FilterSettings, check_count
from ssmppl.inference.methods import PMMH, MetropolisHastings
from ssmppl.inference.particle_likelihood import ParticleLikelihood, run_filters
from ssmppl.inference.pilot import (
    SCALE_REPEATS,
    Pilot,
    averaged_density,
    dispersed,
    find_mode,
    tune_particles,
)
from ssmppl.inference.proposal_choice import choose
from ssmppl.inference.sampling import Sampler, Setup
from ssmppl.inference.walk import Metropolis, RandomWalk, metropolis_block, start_chain

__all__ = ["prepare", "run_filters"]

STRETCH = 2.562  # of a random walk's steps, over sqrt(d): Sherlock et al. (2015)


def prepare(setup: Setup, method: PMMH) -> Sampler:
    """Find a mode, choose proposal and number of particles there, and start the chains."""
    problem, space = setup.problem, setup.space
    if method.particles is not None:
        check_count("particles", method.particles, 1)
    where = coordinates(space, method.scale, method.transform)
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
    d = len(where)
    target = method.target_acceptance or (0.25 if d <= 1 else 0.2 if d == 2 else 0.15)
    kernel = Metropolis(
        where, ParticleLikelihood(problem, settings), RandomWalk(), setup.warmup,
        setup.warmup if adapts(method) else 0, target, setup.thin,
    )  # fmt: skip
    factor = walk_factor(setup, method, where, pilot, "bootstrap")
    states = []
    for chain, z in enumerate(dispersed(space, pilot, setup.chains, setup.root, "bootstrap")):
        generator, stream = setup.streams(chain)
        states.append(start_chain(kernel, where.at(z), factor, generator, stream))
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
    covariance = pilot_covariance(setup, where, pilot, proposal)
    return np.linalg.cholesky(covariance) * STRETCH / np.sqrt(max(len(where), 1))


def pilot_covariance(setup: Setup, where: Coordinates, pilot: Pilot, proposal: str) -> np.ndarray:
    """The inverse information at the pilot's mode, (d, d) in the coordinates."""
    w = where.at(pilot.z)
    repeats = SCALE_REPEATS if len(w) <= 4 else SCALE_REPEATS // 2
    density = averaged_density(where, setup.root, proposal, repeats)
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
