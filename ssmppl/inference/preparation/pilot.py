"""What runs before the chains: a mode of the posterior, the scale round it, dispersed starts.

The log likelihood is estimated with common random numbers, so that it is one fixed (if ragged)
function, and climbed on the unconstrained scale by Nelder and Mead's simplex, which takes no
derivatives. The result only starts and scales chains; nothing depends on its accuracy.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy

from ssmppl.analysis.proposals.proposals import Proposal
from ssmppl.analysis.structure import simulators
from ssmppl.data import spelled
from ssmppl.errors import ArgumentError, Location, SamplingError
from ssmppl.inference.particles.filtering import (
    FilterSettings,
    full_run,
    log_likelihood_estimate,
    repeated_estimates,
)
from ssmppl.inference.preparation.exact_models import exact_log_likelihood
from ssmppl.inference.preparation.space import Region, Space
from ssmppl.inference.run.invalid_laws import law_without_density_at
from ssmppl.inference.run.problem import EXACT, Problem
from ssmppl.inference.run.seeds import random_state

PILOT_PARTICLES = 200
# Particles, and these times rows, in search of a row that none of them can have produced.
LOOKED_AT, MOST_LOOKED_AT = 20_000, 40_000_000
TRIES = 200  # random points looked at for one with a finite likelihood
TUNING_REPEATS = 40
SCALE_REPEATS = 8
FALL = 8.0  # how far log p falls where its scale is measured
MOST_STEP = 1e150
FINEST, WIDEST = 1e-2, 5.0  # scales that a climb in steps of one does well with
UNITS = 5  # climbs, each in steps of the scales where the last one ended
MOST_PARTICLES = 1_000_000


@dataclass(frozen=True)
class Pilot:
    """A mode z (free,), the scale (free,) on which log p falls by about one half, log p there."""

    z: np.ndarray
    scale: np.ndarray
    log_density: float


def find_mode(
    space: Space, seed: np.random.SeedSequence, proposal: str = "bootstrap", rescue: int = 0
) -> Pilot:
    """Climb the estimated log posterior from the space's own point, and measure its scale there.

    rescue : of the filters, as in `FilterSettings`; here and in what follows.

    Raises
    ------
    ArgumentError : the likelihood is zero at every point that was tried.
    """
    try:
        best, value = climb_to_mode(space, seed, pilot_likelihood(space.problem, proposal, rescue))
    except ArgumentError as error:
        raise explained(error, space) from None
    if not len(best):
        return Pilot(best, best, value)
    averaged = averaged_density(space, seed, proposal, SCALE_REPEATS, rescue)
    return Pilot(best, scale_of(best, averaged, space.on_the_line), value)


def climb_to_mode(
    space: Space, seed: np.random.SeedSequence,
    estimate: Callable[[np.ndarray, np.random.SeedSequence], float],
) -> tuple[np.ndarray, float]:  # fmt: skip
    """(z (free,), log p there), the top of a log-likelihood (theta, seed) and the prior.

    Raises
    ------
    ArgumentError : the likelihood is zero at every point that was tried.
    """

    def log_density(z: np.ndarray) -> float:
        theta, log_prior = space.parameters(z)
        return -np.inf if log_prior == -np.inf else estimate(theta, seed) + log_prior

    z = space.z[space.positions]
    if not len(z):
        return z, log_density(z)
    z = finite_point(z, log_density, np.random.default_rng(seed))
    best, value = z, log_density(z)
    unit = np.ones(len(z))
    for _ in range(UNITS):
        best, value = _simplex(best, value, unit, log_density)
        # Parameters of the whole line have the units of the data, and may be of any size.
        scale = scale_of(best, log_density, space.on_the_line)
        fitting = np.where((scale < FINEST) | (scale > WIDEST), 2.0 * scale, 1.0)
        if np.all((fitting < 8.0 * unit) & (unit < 8.0 * fitting)):
            break
        unit = fitting
    return best, value


def _simplex(
    z: np.ndarray, value: float, unit: np.ndarray, log_density: Callable[[np.ndarray], float]
) -> tuple[np.ndarray, float]:
    """Nelder and Mead's climb from z, where log p is `value`, in steps of unit (free,)."""
    best, size = z, 1.0
    for _ in range(4):  # restarts, as a simplex may collapse early on a ragged function
        found = scipy.optimize.minimize(
            lambda v, centre=best: min(-log_density(centre + unit * v), 1e300), np.zeros(len(z)),
            method="Nelder-Mead",
            options={"initial_simplex": np.vstack([np.zeros(len(z)), size * np.eye(len(z))]),
                     "maxfev": 80 * len(z), "fatol": 0.1, "xatol": 1e-3},
        )  # fmt: skip
        gain = -found.fun - value
        if gain > 0:
            best, value = best + unit * found.x, -float(found.fun)
        if gain < 1.0:
            break
        size = 0.5
    return best, value


def pilot_likelihood(
    problem: Problem, proposal: str, rescue: int = 0
) -> Callable[[np.ndarray, np.random.SeedSequence], float]:
    """(theta, seed) -> log p(y | theta): exact for those of `EXACT`, else a particle filter's
    estimate.

    -inf where it is zero, or where it does not exist.
    """
    if proposal in EXACT:
        return lambda theta, _: exact_log_likelihood(problem.trace, problem.experiments, theta)
    settings = FilterSettings(PILOT_PARTICLES, _applicable(problem, proposal), rescue=rescue)

    def estimate(theta: np.ndarray, seed: np.random.SeedSequence) -> float:
        try:
            return log_likelihood_estimate(problem, theta, settings, random_state(seed))
        except SamplingError:
            return -np.inf

    return estimate


def _applicable(problem: Problem, proposal: str) -> str:
    """The proposal, or another where an observation without noise rules the transition out."""
    if proposal != "bootstrap" or problem.program.missing.noise is None:
        return proposal
    found = problem.program.proposals
    return next((n for n, p in found.items() if isinstance(p, Proposal)), proposal)


def averaged_density(
    space: Region, seed: np.random.SeedSequence, proposal: str, repeats: int, rescue: int = 0
) -> Callable[[np.ndarray], float]:
    """The log posterior as a function of the coordinates, from the mean of several estimates of the
    likelihood with common random numbers (exact for `EXACT`)."""
    problem = space.problem
    exact = pilot_likelihood(problem, proposal) if proposal in EXACT else None
    settings = FilterSettings(PILOT_PARTICLES, _applicable(problem, proposal), rescue=rescue)

    def averaged(v: np.ndarray) -> float:
        theta, log_prior = space.parameters(v)
        if log_prior == -np.inf:
            return -np.inf
        if exact is not None:
            return exact(theta, seed) + log_prior
        try:
            log_z = repeated_estimates(problem, theta, settings, seed, range(repeats))
        except SamplingError:
            return -np.inf
        return float(np.logaddexp.reduce(log_z) - np.log(len(log_z))) + log_prior

    return averaged


def why_zero(
    problem: Problem, theta: np.ndarray, particles: int | None
) -> tuple[str, str, Location | None] | None:
    """What is known of the cause of a likelihood of zero at theta, what to do about it, and where:
    a distribution that has no density there, or the row at which a bootstrap filter loses its
    particles; None where neither is found. particles : None: not looked at.
    """
    none = law_without_density_at(problem.trace, theta)
    if none is not None or particles is None or problem.program.missing.noise is not None:
        return none  # particles hit no observation without noise, whatever the row is
    stream = random_state(np.random.SeedSequence(0))
    settings = FilterSettings(particles, "bootstrap")
    try:
        for e in problem.experiments:
            full_run(problem, e, theta, settings, stream, np.empty(0), stream.copy())
    except SamplingError as error:
        return error.found, error.fix, None
    return None


def explained(error: ArgumentError, space: Space) -> ArgumentError:
    """The error of `finite_point`, with the distribution that has no density at the space's own
    point, or the row that is impossible there."""
    problem = space.problem
    particles = max(PILOT_PARTICLES, min(LOOKED_AT, MOST_LOOKED_AT // problem.rows))
    # a simulator is called for each of them in each row, which may take hours
    why = why_zero(problem, space.theta, None if simulators(problem.trace) else particles)
    if why is None:
        return error
    found, fix, where = why
    fix += "; or begin with other values of the parameters (start=)"
    if where is not None:  # what a filter says names the parameters
        found, fix = f"{spelled(problem.trace, space.theta)}, {found}", error.fix
    return ArgumentError(f"{error.found}; at the first of them, {found}", fix=fix, where=where)


def finite_point(
    z: np.ndarray, log_density: Callable[[np.ndarray], float], rng: np.random.Generator
) -> np.ndarray:
    """z (free,) itself, or a random point round it, where log p is finite.

    Raises
    ------
    ArgumentError : the likelihood is zero at every point that was tried.
    """
    for attempt in range(TRIES):
        point = z if attempt == 0 else z + (1.0 + attempt / 40.0) * rng.standard_normal(len(z))
        if log_density(point) > -np.inf:
            return point
    raise ArgumentError(
        f"the likelihood is zero at each of {TRIES} points tried for a start",
        fix="give start={name: value} near plausible values, or check the data for rows that the "
        "model cannot produce",
    )


def scale_of(
    z: np.ndarray, log_density: Callable[[np.ndarray], float], on_the_line: np.ndarray | None = None
) -> np.ndarray:
    """Per coordinate the standard deviation of a Gaussian that falls as log p does.

    Measured where log p has fallen by several units, as the estimates are noisy, or where neither
    side has any.

    on_the_line : (d,) which coordinates may be of any size; the others, logarithms and the like,
        are at most 5.
    """
    out, top = np.empty(len(z)), log_density(z)
    anywhere = np.zeros(len(z), dtype=bool) if on_the_line is None else on_the_line
    for i, unit in enumerate(np.eye(len(z))):

        def drop_at(step: float, unit: np.ndarray = unit) -> float:
            ends = np.array([log_density(z + step * unit), log_density(z - step * unit)])
            within = ends > -np.inf  # at an edge of the support the one side has to tell
            return top - float(ends[within].mean()) if within.any() else np.inf

        step, drop = _small_step(drop_at, abs(z[i]))
        while drop < FALL and step < (MOST_STEP if anywhere[i] else 30.0):
            step *= 1.5 if step < 30.0 else 4.0
            drop = drop_at(step)
        while not drop < 4.0 * FALL and step > 45.0:  # the last stride was a long one
            step /= 1.5
            drop = drop_at(step)
        out[i] = step / np.sqrt(2.0 * (drop if FALL <= drop < 4.0 * FALL else FALL))
    return np.clip(out, 0.0, np.where(anywhere, MOST_STEP, 5.0))


def _small_step(drop_at: Callable[[float], float], size: float) -> tuple[float, float]:
    """A step over which log p does not fall far yet, and its fall there."""
    step, drop = 1e-3, drop_at(1e-3)
    while not drop < FALL and step > max(1e-13 * size, 1e-300):
        nearer = drop_at(step / 4.0)
        if nearer > 0.5 * drop and np.isfinite(drop):
            break  # noise of the estimate does not fall with the step
        step, drop = step / 4.0, nearer
    return step, drop


def dispersed(
    space: Space, pilot: Pilot, chains: int, seed: np.random.SeedSequence, proposal: str,
    rescue: int = 0,
    likelihood: Callable[[np.ndarray, np.random.SeedSequence], float] | None = None,
) -> list[np.ndarray]:  # fmt: skip
    """A start for each chain, three scales about the mode, with a finite likelihood.

    likelihood : (theta, seed) -> the log-likelihood; None: as of `pilot_likelihood`.
    """
    estimate = likelihood or pilot_likelihood(space.problem, proposal, rescue)
    starts = []
    for chain in range(chains):
        child = np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, 7, chain))
        rng = np.random.default_rng(child)
        point, spread = pilot.z, 3.0
        for _ in range(TRIES):
            trial = pilot.z + spread * pilot.scale * rng.standard_normal(len(pilot.z))
            theta, log_prior = space.parameters(trial)
            spread *= 0.97
            if log_prior == -np.inf:
                continue
            if estimate(theta, child) > -np.inf:
                point = trial
                break
        starts.append(point)
    return starts


@dataclass(frozen=True)
class TunedParticles:
    """The number of particles and the standard deviation of log Z that it gives."""

    particles: int
    sd: float


def tune_particles(
    problem: Problem, theta: np.ndarray, proposal: str, target: float,
    seed: np.random.SeedSequence, rescue: int = 0,
) -> TunedParticles:  # fmt: skip
    """N at which log Z has about the target's standard deviation: var(log Z) falls as 1 / N."""

    def spread(particles: int) -> float:
        settings = FilterSettings(particles, proposal, rescue=rescue)
        log_z = repeated_estimates(problem, theta, settings, seed, range(TUNING_REPEATS))
        finite = log_z[np.isfinite(log_z)]
        return float(np.std(finite, ddof=1)) if len(finite) > 0.9 * TUNING_REPEATS else np.inf

    return particles_for(spread, target)


def particles_for(spread: Callable[[int], float], target: float) -> TunedParticles:
    """N at which `spread`, a standard deviation that falls as its root, is about the target."""
    particles, sd = 50, np.inf
    for _ in range(8):
        sd = spread(particles)
        if 0.8 * target <= sd <= 1.15 * target or (sd < target and particles <= 50):
            break
        factor = np.clip((sd / target) ** 2, 0.3, 8.0) if np.isfinite(sd) else 8.0
        particles = int(np.clip(round(particles * factor), 10, MOST_PARTICLES))
        if particles >= MOST_PARTICLES:
            break
    return TunedParticles(particles, sd)
