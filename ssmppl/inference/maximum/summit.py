"""The ends of several noisy climbs: which is the highest, which agree with it, how curved it is."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from ssmppl.errors import NotApplicable, SamplingError
from ssmppl.inference.chains.curvature import fitted_information
from ssmppl.inference.maximum.ascent import Setup
from ssmppl.inference.methods import IF2
from ssmppl.inference.particles.filtering import (
    FilterSettings,
    log_of_mean,
    repeated_estimates,
)
from ssmppl.inference.particles.pilot import scale_of
from ssmppl.inference.particles.proposal_choice import choose
from ssmppl.inference.problem import Problem
from ssmppl.inference.tasks import run_tasks

HALF_INTERVAL = 1.92  # half of the 0.95 quantile of chi-square with one degree of freedom
INFORMATION_RUNS = 16  # filters behind each point of the quadratic
SCALE_RUNS = 2  # and behind the points that tell how far to scatter those, which is a guess


@dataclass(frozen=True)
class Summit:
    """The best of S ends, or the mean of those that agree with it.

    z : (F,) the estimate. value, noise : log-likelihood there and its standard error. values,
    errors : (S,) those of the ends. near : (S,) which ends agree. pooled : whether z is their mean.
    spread : (F, F) Monte Carlo covariance of z, from how the ends that agree differ.
    """

    z: np.ndarray
    value: float
    noise: float
    values: np.ndarray
    errors: np.ndarray
    best: int
    near: np.ndarray
    pooled: bool
    spread: np.ndarray | None


def summit(setup: Setup, method: IF2, ends: np.ndarray) -> Summit:
    """Where the likelihood is highest out of the ends (S, F) of the swarms and their mean.

    Ends agree where their log-likelihoods differ by less than half the width of a 0.95 interval of
    a profile, and two standard errors.
    """

    def prior(z: np.ndarray) -> float:
        return setup.chart.at(z).log_prior if setup.with_prior else 0.0

    values, errors = evaluate(setup, method, ends, 0)
    heights = values + np.array([prior(z) for z in ends])
    best = int(np.argmax(heights))
    with np.errstate(invalid="ignore"):  # none is near where all likelihoods are zero
        near = heights[best] - heights <= HALF_INTERVAL + 2.0 * np.hypot(errors, errors[best])
    z, value, noise, spread, pooled = ends[best], values[best], errors[best], None, False
    if near.sum() > 1:
        spread = np.atleast_2d(np.cov(ends[near].T))
        middle = ends[near].mean(axis=0)
        (own,), (own_noise,) = evaluate(setup, method, middle[None], len(ends))
        if own + prior(middle) >= heights[best]:
            z, value, noise, pooled = middle, own, own_noise, True
            spread = spread / near.sum()
    return Summit(z, float(value), float(noise), values, errors, best, near, pooled, spread)


def evaluate(
    setup: Setup, method: IF2, ends: np.ndarray, first: int
) -> tuple[np.ndarray, np.ndarray]:
    """(log-likelihood, its standard error) at each end (S, F), numbered from `first`; exact where
    that can be. An end at which the filter fails has -inf.
    """
    problem, thetas = setup.problem, [setup.space.parameters(z)[0].copy() for z in ends]
    if not isinstance(setup.exact, NotApplicable):
        exact = [setup.exact.log_likelihood(problem.experiments, theta) for theta in thetas]
        return np.array(exact), np.zeros(len(ends))
    task = partial(_estimates, problem, method.particles, method.evaluations)
    pieces = [(theta, setup.seed(7, first + k)) for k, theta in enumerate(thetas)]
    found = run_tasks(task, pieces, executor=setup.executor)
    failed = [e for e in found if isinstance(e, SamplingError)]
    if len(failed) == len(found):
        raise failed[0]
    pairs = [(-np.inf, np.nan) if isinstance(e, SamplingError) else log_of_mean(e) for e in found]
    values, errors = np.array(pairs).T
    return values, np.nan_to_num(errors)


def _estimates(
    problem: Problem, particles: int, repeats: int, piece: tuple[np.ndarray, np.random.SeedSequence]
) -> np.ndarray | SamplingError:
    theta, seed = piece
    try:
        settings = FilterSettings(particles, choose(problem, theta, exact=False).name)
        return repeated_estimates(problem, theta, settings, seed, range(repeats))
    except SamplingError as error:
        return error


def fitted_curvature(setup: Setup, method: IF2, z: np.ndarray) -> np.ndarray:
    """(P, P) observed information by what iterated filtering itself needs, no density of the
    transition: minus the curvature of a quadratic fitted to estimates of the log-likelihood round
    z (F,), as in Monte Carlo profiles (Ionides, Bretó, Park, Smith and King 2017)."""
    problem, seed = setup.problem, setup.seed(8)
    theta, _ = setup.space.parameters(z)
    settings = FilterSettings(method.particles, choose(problem, theta.copy(), exact=False).name)

    def log_likelihood(z: np.ndarray, runs: int = INFORMATION_RUNS) -> float:
        theta, log_prior = setup.space.parameters(z)
        if log_prior == -np.inf:
            return -np.inf
        try:
            log_z = repeated_estimates(problem, theta, settings, seed, range(runs))
        except SamplingError:
            return -np.inf
        return log_of_mean(log_z)[0]

    scale = scale_of(z, partial(log_likelihood, runs=SCALE_RUNS))
    inner = fitted_information(log_likelihood, z, np.diag(scale), np.random.default_rng(seed))
    return setup.natural(z, inner / np.outer(scale, scale))
