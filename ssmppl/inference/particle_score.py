"""Score and observed information by particle smoothing.

Fisher's identity: the score is the smoothed mean of the complete-data score S (Fisher 1925; Schön
et al. 2015, section on direct optimisation); Louis' identity: the observed information is
E[-H] - Cov(S), H the second derivatives of the complete-data log density (Louis 1982; Poyiadjis,
Doucet and Singh 2011). Trajectories come from backward simulation, several independent runs give
the Monte Carlo error, and their means the square of E[S] without bias by noise. What remains is the
bias of the smoother, of order 1 / N.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial

import numpy as np

from ssmppl.inference.backward import backward_draws
from ssmppl.inference.complete_score import CompleteScores
from ssmppl.inference.filtering import FilterSettings, random_state
from ssmppl.inference.runner import run_tasks


@dataclass(frozen=True)
class Smoothing:
    """How trajectories are drawn: the filter, their number M, the backward kernel."""

    settings: FilterSettings
    trajectories: int
    kernel: str = "auto"


@dataclass(frozen=True)
class Run:
    """One run: log Z, mean (P,) and mean square (P, P) of S, mean (P, P) of H or None."""

    log_z: float
    mean: np.ndarray
    square: np.ndarray
    hessian: np.ndarray | None


@dataclass(frozen=True)
class ParticleScore:
    """What runs say together (P parameters).

    log_likelihood and its standard error. gradient : (P,); gradient_covariance : (P, P), of its
    Monte Carlo error. information, information_error : (P, P), the standard errors entry by entry;
    None where second derivatives were not asked for.
    """

    log_likelihood: float
    log_likelihood_error: float
    gradient: np.ndarray
    gradient_covariance: np.ndarray
    information: np.ndarray | None
    information_error: np.ndarray | None


def one_run(
    scores: CompleteScores, theta: np.ndarray, smoothing: Smoothing, second: bool,
    seed: np.random.SeedSequence, number: int,
) -> Run:  # fmt: skip
    """A run of the filter and the backward pass; `number` tells the runs of one seed apart.

    Raises
    ------
    SamplingError : all weights vanish, or some density is NaN.
    """
    paths, log_z = backward_draws(
        scores.problem, theta, smoothing.settings, smoothing.trajectories,
        random_state(seed, number), smoothing.kernel,
    )  # fmt: skip
    s = scores.gradient(theta, paths)
    hessian = scores.hessian(theta, paths).mean(axis=0) if second else None
    return Run(log_z, s.mean(axis=0), s.T @ s / len(s), hessian)


def several_runs(
    scores: CompleteScores, theta: np.ndarray, smoothing: Smoothing, second: bool,
    seed: np.random.SeedSequence, numbers: Sequence[int], executor: Executor | None = None,
) -> list[Run]:  # fmt: skip
    """Independent runs over an executor."""
    _ = scores.program  # generated once, before threads ask for it
    task = partial(one_run, scores, theta, smoothing, second, seed)
    return run_tasks(task, list(numbers), executor=executor)


def combine(runs: Sequence[Run]) -> ParticleScore:
    """Averages of at least two runs, with their errors."""
    n = len(runs)
    log_z = np.array([r.log_z for r in runs])
    share = np.exp(log_z - log_z.max())
    means = np.stack([r.mean for r in runs])
    information, error = None, None
    if all(r.hessian is not None for r in runs):
        information = _louis(runs)
        if n > 2:  # the jackknife over runs
            without = np.stack([_louis([*runs[:k], *runs[k + 1 :]]) for k in range(n)])
            error = np.sqrt((n - 1) * without.var(axis=0))
    return ParticleScore(
        float(log_z.max() + np.log(share.mean())),
        float(share.std(ddof=1) / share.mean() / np.sqrt(n)),
        means.mean(axis=0),
        np.atleast_2d(np.cov(means, rowvar=False)) / n,
        information,
        error,
    )


def _louis(runs: Sequence[Run]) -> np.ndarray:
    """E[-H] - E[SS'] + E[S]E[S]', the last one from pairs of different runs."""
    n = len(runs)
    total = sum((r.mean for r in runs), np.zeros_like(runs[0].mean))
    own = sum((np.outer(r.mean, r.mean) for r in runs), np.zeros_like(runs[0].square))
    product = (np.outer(total, total) - own) / (n * (n - 1))
    inside = sum(-r.hessian - r.square for r in runs if r.hessian is not None) / n
    return inside + product
