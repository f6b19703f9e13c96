"""The ends of several noisy climbs: which is the highest, and which agree with it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from ssmppl.errors import NotApplicable, SamplingError
from ssmppl.inference.maximum.ascent import Setup
from ssmppl.inference.methods import IF2
from ssmppl.inference.particles.filtering import (
    FilterSettings,
    log_of_mean,
    repeated_estimates,
)
from ssmppl.inference.particles.proposal_choice import choose
from ssmppl.inference.problem import Problem
from ssmppl.inference.tasks import run_tasks

HALF_INTERVAL = 1.92  # half of the 0.95 quantile of chi-square with one degree of freedom


@dataclass(frozen=True)
class Summit:
    """The best of S ends, or the mean of those that agree with it.

    z : (F,) the estimate. value, noise : log-likelihood there and its standard error. values,
    errors : (S,) those of the ends. near : (S,) which ends agree. pooled : whether z is their mean.
    """

    z: np.ndarray
    value: float
    noise: float
    values: np.ndarray
    errors: np.ndarray
    best: int
    near: np.ndarray
    pooled: bool


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
    z, value, noise, pooled = ends[best], values[best], errors[best], False
    if near.sum() > 1:
        middle = ends[near].mean(axis=0)
        (own,), (own_noise,) = evaluate(setup, method, middle[None], len(ends))
        if own + prior(middle) >= heights[best]:
            z, value, noise, pooled = middle, own, own_noise, True
    return Summit(z, float(value), float(noise), values, errors, best, near, pooled)


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
