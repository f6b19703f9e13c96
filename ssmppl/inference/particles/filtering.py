"""Runs of the particle filter: log-likelihood, moments, quantiles, ESS and one-step predictions.

Algorithm 2 of Schön et al. (2015); see `codegen/kernels/particle/particle_filter.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from ssmppl.codegen.kernels.data_sets.each import filter_each
from ssmppl.codegen.kernels.particle.resampling import MULTINOMIAL, RESIDUAL, STRATIFIED, SYSTEMATIC
from ssmppl.codegen.kernels.particle.weights import ALL_ZERO, INFINITE, NAN, OK
from ssmppl.codegen.modules.twisted import Guided
from ssmppl.codegen.native.entries import ByAddress, over_data_sets
from ssmppl.counts import check_count, check_number
from ssmppl.data import Experiment, spelled
from ssmppl.data.times import label_text
from ssmppl.errors import ArgumentError, Location, SamplingError, listing
from ssmppl.inference.methods.settings import rescue_factor
from ssmppl.inference.particles.blocks import LEAST, run_in_blocks
from ssmppl.inference.particles.on_device import run_on_device
from ssmppl.inference.run.invalid_laws import (
    DOMAIN,
    law_without_density_at,
    out_of_range,
    total_of,
    trials_of_a_continuous_state,
)
from ssmppl.inference.run.problem import Problem
from ssmppl.inference.run.seeds import random_state

SCHEMES = {
    "systematic": SYSTEMATIC,
    "stratified": STRATIFIED,
    "residual": RESIDUAL,
    "multinomial": MULTINOMIAL,
}
Arrays = tuple[np.ndarray, ...]
Moments = tuple[np.ndarray | Arrays, ...]
_WHAT = {
    ALL_ZERO: "all weights are zero",
    NAN: "a weight is nan",
    INFINITE: "a weight is infinite",
}


@dataclass(frozen=True)
class FilterSettings:
    """How a particle filter runs.

    particles : N. proposal : name of a derived proposal. scheme : code of the resampling scheme.
    ess_threshold : resample when the effective sample size is below this share of N; 1: always.
    rescue : how many times N particles a row may take until N + 1 have a positive weight, by the
        alive particle filter; 0: N, whatever they weigh.
    device : "cpu" or "cuda".
    """

    particles: int
    proposal: str
    scheme: int = SYSTEMATIC
    ess_threshold: float = 1.0
    rescue: int = 0
    device: str = "cpu"


def filter_settings(
    particles: Any, proposal: str, resampling: str, ess_threshold: float, rescue: Any = 0
) -> FilterSettings:
    """The settings of a call, checked.

    Raises
    ------
    ArgumentError : naming the argument, its value and the valid options.
    """
    if not isinstance(resampling, str) or resampling not in SCHEMES:
        raise ArgumentError(
            f"resampling={resampling!r} is unknown",
            fix=f"use one of: {listing(str(resampling), SCHEMES)}",
        )
    check_count("particles", particles, 1)
    check_number(
        "ess_threshold", ess_threshold, lambda v: 0.0 <= v <= 1.0,
        "give a share of the particles, from 0 (never resample) to 1 (always)",
    )  # fmt: skip
    rescue_factor("rescue", rescue)
    if rescue and (resampling not in ("systematic", "multinomial") or ess_threshold < 1.0):
        raise ArgumentError(
            f"rescue={rescue} together with resampling={resampling!r}, ess_threshold="
            f"{ess_threshold}: the alive particle filter draws an ancestor for each particle by "
            "itself, at every row",
            fix="leave resampling= and ess_threshold= out",
        )
    if proposal == "tempered" and (rescue or resampling != "systematic" or ess_threshold < 1.0):
        raise ArgumentError(
            f"proposal='tempered' together with resampling={resampling!r}, ess_threshold="
            f"{ess_threshold}, rescue={rescue}: it resamples systematically at every temperature",
            fix="leave the others out",
        )
    return FilterSettings(
        int(particles), proposal, SCHEMES[resampling], float(ess_threshold), int(rescue)
    )


def run_filter(
    problem: Problem, theta: np.ndarray, settings: FilterSettings, experiment: Experiment,
    rng: np.ndarray, log_increments: np.ndarray, ess: np.ndarray, moments: Moments | None = None,
    kept: Arrays | None = None, guided: np.ndarray | None = None,
) -> tuple[int, int]:  # fmt: skip
    """Run the filter over one experiment; (status, t), t the step at which it stopped.

    log_increments, ess : (T,), written. moments, kept : as of the kernel `particle_filter`.
    guided : inputs with the guide at theta (T, U + G), of a twisted filter that need not look for
        it.
    """
    if settings.device == "cuda":
        return run_on_device(
            problem, theta, settings.proposal, settings.particles, experiment, rng,
            log_increments, ess,
        )  # fmt: skip
    data = theta, experiment.y, experiment.seen, experiment.u, settings.particles
    out = log_increments, ess, moments, kept
    if settings.rescue:
        alive = problem.program.entry(f"alive_filter_{settings.proposal}")
        return alive(*data, settings.rescue * settings.particles, rng, *out)
    scheme = None if settings.scheme == SYSTEMATIC and moments is None else settings.scheme
    plain = settings.scheme == SYSTEMATIC and moments is None and kept is None
    if plain and settings.particles >= LEAST and problem.program.apart(settings.proposal):
        return run_in_blocks(
            problem, theta, settings.proposal, settings.particles, settings.ess_threshold,
            experiment, rng, log_increments, ess,
        )  # fmt: skip
    run = problem.program.entry(f"filter_{settings.proposal}")
    if guided is not None and isinstance(run, Guided):
        run, data = run.run, (theta, experiment.y, experiment.seen, guided, settings.particles)
    return run(*data, scheme, settings.ess_threshold, rng, *out)


def guides_at(problem: Problem, theta: np.ndarray, settings: FilterSettings) -> np.ndarray | None:
    """Inputs with the guide at theta, of all experiments end to end (R, U + G), for several runs of
    a twisted filter there; None where the filter is another one."""
    if settings.rescue or settings.device != "cpu":
        return None
    run = problem.program.entry(f"filter_{settings.proposal}")
    if not isinstance(run, Guided):
        return None
    return run.gaussian.guides(theta, *problem.end_to_end.data, horizon=run.horizon).rows


def log_likelihood_estimate(
    problem: Problem, theta: np.ndarray, settings: FilterSettings, rng: np.ndarray,
    guided: np.ndarray | None = None,
) -> float:  # fmt: skip
    """One estimate of log p(y | theta), summed over the experiments; -inf where it is zero.

    guided : of `guides_at`, where it is known.

    Raises
    ------
    SamplingError : the weights are NaN or infinite for some particles only.
    """
    one = None if settings.rescue else problem.program.entry(f"filter_{settings.proposal}")
    several, small = len(problem.experiments) > 1, settings.particles < LEAST
    if several and small and settings.device == "cpu" and isinstance(one, ByAddress | Guided):
        return _estimate_of_all(problem, theta, settings, rng, one, guided)
    total = 0.0
    rows: list[np.ndarray] | list[None] = [None] * len(problem.experiments)
    if guided is not None:
        rows = problem.end_to_end.split(guided)
    for experiment, own in zip(problem.experiments, rows, strict=True):
        increments, ess = np.empty(experiment.steps), np.empty(experiment.steps)
        status, t = run_filter(
            problem, theta, settings, experiment, rng, increments, ess, guided=own
        )
        if status == ALL_ZERO:
            return -np.inf
        if status != OK:
            raise failure(problem, theta, status, t, experiment)
        total += total_of(increments)
    return total


def _estimate_of_all(
    problem: Problem, theta: np.ndarray, settings: FilterSettings, rng: np.ndarray,
    one: Callable[..., Any], guided: np.ndarray | None,
) -> float:  # fmt: skip
    """As `log_likelihood_estimate`, in one compiled pass; one : the filter of a data set."""
    every, scheme = problem.end_to_end, None if settings.scheme == SYSTEMATIC else settings.scheme
    increments, ess = np.empty(problem.rows), np.empty(problem.rows)
    y, seen, u, first = every.data
    if isinstance(one, Guided):
        if guided is None:
            guided = guides_at(problem, theta, settings)
        assert guided is not None
        one, u = one.run, guided
    status, t, e = over_data_sets(filter_each, one)(
        theta, y, seen, u, first, settings.particles, scheme, settings.ess_threshold, rng,
        increments, ess,
    )  # fmt: skip
    if status == ALL_ZERO:
        return -np.inf
    if status != OK:
        raise failure(problem, theta, status, t, problem.experiments[e])
    total = 0.0
    with np.errstate(over="ignore"):  # as of `total_of`
        for part in every.split(increments):
            total += float(np.add.reduce(part))
    return total


def repeated_estimates(
    problem: Problem,
    theta: np.ndarray,
    settings: FilterSettings,
    seed: np.random.SeedSequence,
    repeats: range,
) -> np.ndarray:
    """Independent estimates, one for each number in `repeats`; the same whatever the split."""
    guided = guides_at(problem, theta, settings)  # the same for all
    return np.array([
        log_likelihood_estimate(problem, theta, settings, random_state(seed, r), guided)
        for r in repeats
    ])  # fmt: skip


def log_of_mean(log_z: np.ndarray) -> tuple[float, float]:
    """log of the mean of independent estimates Z, (R,) logs, and its standard error.

    -inf where all are zero; the error of a single one is nan.
    """
    top = np.max(log_z)
    if not top > -np.inf:
        return -np.inf, np.nan
    share = np.exp(log_z - top)
    error = share.std(ddof=1) / share.mean() / np.sqrt(len(share)) if len(share) > 1 else np.nan
    return float(top + np.log(share.mean())), float(error)


@dataclass(frozen=True)
class FilterRun:
    """Results of one run of the filter for one experiment (T steps, D states, K channels).

    log_increments, ess : (T,). mean : (T, D). covariance : (T, D, D). quantiles : (T, P, D).
    prediction : (T, 4, K): mean, variance, P(Y <= y) and P(Y < y) of the one-step prediction.
    predicted_quantiles : (T, P, K), of the same, NaN where it has none.
    history : particles (T, D, N), weights (T, N) and ancestors (T, N), where they were asked for.
    """

    log_increments: np.ndarray
    ess: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray
    quantiles: np.ndarray
    prediction: np.ndarray
    predicted_quantiles: np.ndarray
    history: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None


def full_run(
    problem: Problem,
    experiment: Experiment,
    theta: np.ndarray,
    settings: FilterSettings,
    rng: np.ndarray,
    probabilities: np.ndarray,
    stream: np.ndarray,
    history: bool = False,
) -> FilterRun:
    """Run the filter and keep its moments, quantiles and predictions.

    stream : of the observations that are drawn for the quantiles of the predictions.
    history : whether to keep the particles, too, with their weights and ancestors.

    Raises
    ------
    SamplingError : all weights vanish, or are NaN; names the step, the user's line, the parameters.
    """
    d, k = len(problem.trace.state_symbols), len(problem.trace.observation_symbols)
    steps, p, n = experiment.steps, len(probabilities), settings.particles
    kept = None
    if history:
        ancestors = np.tile(np.arange(n, dtype=np.int32), (steps, 1))  # those of row 0: themselves
        kept = np.empty((steps, d, n)), np.empty((steps, n)), ancestors
    out = FilterRun(
        np.empty(steps), np.empty(steps), np.empty((steps, d)), np.empty((steps, d, d)),
        np.empty((steps, p, d)), np.empty((steps, 4, k)), np.empty((steps, p, k)), kept,
    )  # fmt: skip
    predicted = out.prediction, probabilities, out.predicted_quantiles, stream
    moments = probabilities, out.mean, out.covariance, out.quantiles, predicted
    status, t = run_filter(
        problem, theta, settings, experiment, rng, out.log_increments, out.ess, moments, kept
    )
    if status != OK:
        raise failure(problem, theta, status, t, experiment)
    return out


def failure(
    problem: Problem, theta: np.ndarray, status: int, t: int, experiment: Experiment
) -> SamplingError:
    """The error of a run that stopped at step t (from 0)."""
    label = "" if experiment.time is None else f" (time {label_text(experiment.time[t])})"
    row = ", ".join(
        f"{name} = {np.array2string(np.asarray(values[t]), precision=6)}"
        for name, values in experiment.observed.items()
    )
    laws = [site.distribution for site in problem.trace.observations.values()]
    where: Location = laws[0].location
    fix = {
        ALL_ZERO: "no particle can have produced this row under these parameters: check the row "
        "for an outlier, give the observation heavier tails, use more particles, or draw until "
        "some survive (rescue=100; of log_likelihood, particle_filter, FFBSi and PMMH)",
    }.get(status, DOMAIN)
    why = ""
    if status == NAN:
        known = dict(zip(problem.trace.parameter_symbols, theta, strict=True))
        for law in laws:
            if found := out_of_range(law, known):
                (why, fix), where = found, law.location
                break
    none = law_without_density_at(problem.trace, theta)
    if not why and (none := none or trials_of_a_continuous_state(problem.trace)):
        why, fix, where = none
    return SamplingError(
        f"{_WHAT.get(status, 'the filter failed')} at t={t + 1}{label}, where {row}; "
        f"parameters: {spelled(problem.trace, theta)}" + (why and f"; {why}"),
        fix=fix,
        where=where,
    )


def estimates_task(
    problem: Problem,
    theta: np.ndarray,
    settings: FilterSettings,
    seed: np.random.SeedSequence,
) -> partial:
    """A function of a range of repeats, to be run by an executor."""
    return partial(repeated_estimates, problem, theta, settings, seed)
