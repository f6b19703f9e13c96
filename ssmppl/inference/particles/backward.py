"""Backward simulation: trajectories from the joint smoothing distribution.

A particle filter whose whole particle system is kept, and trajectories drawn from it backwards in
time (FFBSi: Godsill, Doucet and West 2004; Schön et al. 2015, section 5). Moments of the draws have
a bias of order 1 / N; N is the number of particles.

The kernel says how the index of x_t is drawn given x_{t+1}:

* "exact": with all N weights;
* "rejection": by rejection sampling with early stopping, the same distribution (Douc et al. 2011;
Taghavi et
  al. 2013), where the transition density is bounded;
* "mcmc": by Metropolis-Hastings steps from the filter's own ancestor (Bunch and Godsill 2013);
* "genealogy": the filter's own ancestors (Kitagawa 1996): one pass, but all paths soon meet in one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssmppl.analysis.proposals.upper_bounds import transition_upper_bound
from ssmppl.analysis.structure import deterministic_memory
from ssmppl.codegen.kernels.particle.backward import ABOVE_BOUND
from ssmppl.codegen.kernels.particle.conditional_smc import JOINING
from ssmppl.codegen.kernels.particle.weights import ALL_ZERO, INFINITE, OK
from ssmppl.counts import check_count
from ssmppl.data import Experiment, spelled
from ssmppl.data.times import label_text
from ssmppl.errors import ArgumentError, NotApplicable, SamplingError, listing
from ssmppl.inference.particles.filtering import FilterSettings, failure, run_filter
from ssmppl.inference.run.invalid_laws import law_without_density_at, total_of
from ssmppl.inference.run.problem import Problem
from ssmppl.inference.run.seeds import fill_uniform

__all__ = [
    "KERNELS",
    "ParticleSystem",
    "backward_draws",
    "choose_kernel",
    "draw_paths",
    "genealogy",
    "particle_system",
]

KERNELS = ("exact", "rejection", "mcmc", "genealogy")
MOVES = 20  # Metropolis-Hastings steps of the kernel "mcmc"
MOST_WEIGHTS = 2e10  # densities that "auto" lets the exact kernel evaluate: about a minute
MANY = 100  # particles from which rejection pays


@dataclass(frozen=True)
class ParticleSystem:
    """All that a particle filter went through (T steps, D states, N particles).

    particles : (T, D, N). weights : (T, N), normalised. ancestors : (T, N), row 0 without meaning.
    log_increments : (T,), whose sum is log Z. ess : (T,).
    """

    particles: np.ndarray
    weights: np.ndarray
    ancestors: np.ndarray
    log_increments: np.ndarray
    ess: np.ndarray

    @property
    def log_Z(self) -> float:
        return total_of(self.log_increments)


def particle_system(
    problem: Problem, theta: np.ndarray, settings: FilterSettings, experiment: Experiment,
    stream: np.ndarray,
) -> ParticleSystem:  # fmt: skip
    """Run the filter over one experiment, and keep every particle.

    stream : state of the kernels' generator, advanced in place.

    Raises
    ------
    SamplingError : all weights vanish, or are NaN; names the step, the user's line, the parameters.
    """
    steps, n = experiment.steps, settings.particles
    out = ParticleSystem(
        np.empty((steps, len(problem.program.carried(settings.proposal)), n)), np.empty((steps, n)),
        np.zeros((steps, n), dtype=np.int32), np.empty(steps), np.empty(steps),
    )  # fmt: skip
    kept = out.particles, out.weights, out.ancestors
    status, t = run_filter(
        problem, theta, settings, experiment, stream, out.log_increments, out.ess, kept=kept
    )
    if status != OK:
        raise failure(problem, theta, status, t, experiment)
    return out


def choose_kernel(
    problem: Problem, settings: FilterSettings, trajectories: int, kernel: str = "auto",
    passes: int = 1,
) -> tuple[str, str]:  # fmt: skip
    """(kernel, why): "auto" resolved, and what does not apply refused.

    passes : how many times a climb draws that many trajectories.

    Raises
    ------
    ArgumentError : no kernel has this name, or it does not apply; gives the reason and the line.
    """
    if kernel not in ("auto", *KERNELS):
        raise ArgumentError(
            f"kernel={kernel!r} is unknown",
            fix=f"use one of: {listing(str(kernel), ['auto', *KERNELS])}",
        )
    height = transition_upper_bound(problem.trace)
    if kernel == "rejection" and isinstance(height, NotApplicable):
        raise ArgumentError(
            f'kernel="rejection" needs a bound of the transition density over the state before: '
            f"{height.reason}",
            fix='use kernel="exact", which has the same distribution, or "auto"',
            where=height.where,
        )
    if kernel != "auto":
        return kernel, "asked for"
    never = deterministic_memory(problem.trace) is None
    steps = [e.steps for e in problem.experiments]
    pairs = sum(t * (t + 1) / 2 for t in steps) if never else sum(steps)
    if never and settings.particles * trajectories * passes * pairs > MOST_WEIGHTS:
        return "mcmc", (
            "deterministic components change all later densities with each index, which makes the "
            "exact kernel too expensive for so many steps"
        )
    if not isinstance(height, NotApplicable) and settings.particles >= MANY:
        return (
            "rejection",
            "the transition density has a bound, and the distribution is that of the exact",
        )
    if isinstance(height, NotApplicable):
        return "exact", f"no rejection: {height.reason}"
    return "exact", "with few particles rejection does not pay"


def backward_draws(
    problem: Problem, theta: np.ndarray, settings: FilterSettings, trajectories: int,
    stream: np.ndarray, kernel: str = "auto", moves: int = MOVES,
) -> tuple[list[np.ndarray], float]:  # fmt: skip
    """Trajectories from the joint smoothing distribution p(x_{1:T} | y_{1:T}, theta).

    Parameters
    ----------
    theta : (P,) values of all parameters.
    settings : of the particle filter; its proposal may be any but "kalman".
    trajectories : number M. stream : state of the kernels' generator, advanced in place.
    kernel : "auto", "exact", "rejection", "mcmc" or "genealogy"; see `choose_kernel`.
    moves : Metropolis-Hastings steps of the kernel "mcmc".

    Returns
    -------
    For each experiment an array (M, T, D), states in the trace's order, and the filter's log Z,
    summed over experiments.

    Raises
    ------
    ArgumentError : the kernel is unknown or does not apply.
    SamplingError : the filter's weights vanish, or some density is NaN; names step and parameters.
    """
    check_count("trajectories", trajectories, 1)
    kernel, _ = choose_kernel(problem, settings, trajectories, kernel)
    paths, log_z = [], 0.0
    for e in problem.experiments:
        system = particle_system(problem, theta, settings, e, stream)
        paths.append(draw_paths(problem, theta, e, system, trajectories, stream, kernel, moves))
        log_z += system.log_Z
    return paths, log_z


def draw_paths(
    problem: Problem, theta: np.ndarray, experiment: Experiment, system: ParticleSystem,
    trajectories: int, stream: np.ndarray, kernel: str, moves: int = MOVES,
) -> np.ndarray:  # fmt: skip
    """Trajectories (M, T, D) from a particle system, by a kernel that applies."""
    if kernel == "genealogy":
        return genealogy(system, trajectories, stream)
    steps, d, _ = system.particles.shape
    paths = np.empty((steps, d, trajectories))
    run = problem.program.entry(f"backward_{kernel}")
    given = (
        theta, experiment.y, experiment.seen, experiment.u, stream,
        system.particles, system.weights,
    )  # fmt: skip
    if kernel == "mcmc":
        status, t = run(*given, system.ancestors, moves, paths)
    elif kernel == "rejection":
        status, t = run(*given, paths, np.zeros(2))
    else:
        status, t = run(*given, paths)
    if status != OK:
        raise pair_failure(problem, theta, status, t, experiment)
    return np.ascontiguousarray(np.moveaxis(paths, 2, 0))


def genealogy(system: ParticleSystem, trajectories: int, stream: np.ndarray) -> np.ndarray:
    """Ancestral paths (M, T, D) of particles drawn by the last weights."""
    steps, d, _ = system.particles.shape
    index = draw_particles(system.weights[-1], trajectories, stream)
    paths = np.empty((trajectories, steps, d))
    for t in range(steps - 1, -1, -1):
        paths[:, t] = system.particles[t][:, index].T
        if t > 0:
            index = system.ancestors[t, index]
    return paths


def draw_particles(weights: np.ndarray, draws: int, stream: np.ndarray) -> np.ndarray:
    """Indices (draws,) of particles with these weights (N,), independent."""
    uniforms = np.empty(draws)
    fill_uniform(stream, uniforms)
    cumulative = np.cumsum(weights)
    return np.searchsorted(cumulative, uniforms * cumulative[-1], side="right")


def sweep_failure(
    problem: Problem, theta: np.ndarray, status: int, t: int, experiment: Experiment
) -> SamplingError:
    """The error of a conditional particle filter that stopped at step t (from 0)."""
    if status >= JOINING:
        return pair_failure(problem, theta, status - JOINING, t - 1, experiment)
    return failure(problem, theta, status, t, experiment)


def pair_failure(
    problem: Problem, theta: np.ndarray, status: int, t: int, experiment: Experiment
) -> SamplingError:
    """The error of a density from a particle at step t (from 0) to a later state."""
    label = "" if experiment.time is None else f" (time {label_text(experiment.time[t + 1])})"
    site = next(iter(problem.trace.transition.values()))
    what = "is not a number for some particle"
    fix = "some parameter, state or input leads outside the domain of an operation"
    if status == ALL_ZERO:
        what, fix = "is zero from every particle", "use more particles"
    elif status == INFINITE:
        what = "is infinite for some particle"
    elif status == ABOVE_BOUND:
        what = "lies above the bound that was derived for it"
        fix = 'a fault of ssmppl: use kernel="exact", and report the model'
    where, why = site.distribution.location, ""
    if none := law_without_density_at(problem.trace, theta):
        why, fix, where = none
    return SamplingError(
        f"the transition density into t={t + 2}{label} {what}; "
        f"parameters: {spelled(problem.trace, theta)}" + (why and f"; {why}"),
        fix=fix,
        where=where,
    )
