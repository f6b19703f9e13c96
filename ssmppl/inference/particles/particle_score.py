"""Score and observed information by particle smoothing.

Fisher's identity: the score is the smoothed mean of the complete-data score S (Fisher 1925; Schön
et al. 2015, section on direct optimisation); Louis' identity: the observed information is
E[-H] - Cov(S), H the second derivatives of the complete-data log density (Louis 1982; Poyiadjis,
Doucet and Singh 2011). Trajectories come from backward simulation; several independent runs give
the Monte Carlo error, and pairs of them E[S]E[S]' without bias by noise.

The mean over a run's trajectories has a bias of order 1 / N. Times that run's estimate of the
likelihood it is unbiased for the smoothed mean times the likelihood (P. Del Moral, A. Doucet and
S. S. Singh, "A backward particle interpretation of Feynman-Kac formulae", *ESAIM: M2AN* 44, 2010),
so the runs are weighted by those estimates, and the bias falls to order 1 / (N runs); not where
the estimates scatter so much that few runs would be left.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial

import numpy as np

from ssmppl.data import spelled
from ssmppl.errors import SamplingError
from ssmppl.inference.particles.backward import backward_draws
from ssmppl.inference.particles.complete_score import CompleteScores
from ssmppl.inference.particles.filtering import FilterSettings, random_state
from ssmppl.inference.tasks import run_tasks

LEAST_SHARE = 0.3  # of the runs, in effective number, that their weights must leave
LEAST_RUNS = 1.1  # of one run alone nothing is known about products of different ones


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
    SamplingError : all weights vanish, some density is NaN, or the log joint density has no finite
        derivative on a trajectory.
    """
    paths, log_z = backward_draws(
        scores.problem, theta, smoothing.settings, smoothing.trajectories,
        random_state(seed, number), smoothing.kernel,
    )  # fmt: skip
    if log_z == -np.inf:
        raise SamplingError(
            "the densities of the data are too small for their logarithms to be added up, at "
            f"{spelled(scores.problem.trace, theta)}",
            fix="give parameters under which the data are possible, or look for outliers in them",
        )
    s = scores.gradient(theta, paths)
    if not np.all(np.isfinite(s)):
        names = scores.problem.trace.parameter_symbols
        bad = [repr(n) for n, c in zip(names, s.T, strict=True) if not np.all(np.isfinite(c))]
        raise SamplingError(
            f"the log joint density has no finite derivative in {', '.join(bad)} on a trajectory "
            f"drawn at {spelled(scores.problem.trace, theta)}",
            fix="keep parameters and states off the edges where a law's density is 0 or infinite",
        )
    hessian = scores.hessian(theta, paths).mean(axis=0) if second else None
    with np.errstate(over="ignore", invalid="ignore"):  # as in `combine`
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
    """Weighted averages of at least two runs, with their errors."""
    with np.errstate(over="ignore", invalid="ignore"):  # the squares of some scores have no number
        return _combined(runs)


def _combined(runs: Sequence[Run]) -> ParticleScore:
    n = len(runs)
    log_z = np.array([r.log_z for r in runs])
    share = np.exp(log_z - log_z.max())
    w = run_weights(log_z)
    means = np.stack([r.mean for r in runs])
    gradient = w @ means
    off = w[:, None] * (means - gradient)
    information, error = None, None
    if all(r.hessian is not None for r in runs):
        information = _louis(runs, w)
        if n > 2:  # the jackknife over runs
            others = [[j for j in range(n) if j != k] for k in range(n)]
            without = np.stack([_louis([runs[j] for j in o], w[o] / w[o].sum()) for o in others])
            error = np.sqrt((n - 1) * without.var(axis=0))
    return ParticleScore(
        float(log_z.max() + np.log(share.mean())),
        float(share.std(ddof=1) / share.mean() / np.sqrt(n)),
        gradient,
        off.T @ off * n / (n - 1),
        information,
        error,
    )


def run_weights(log_z: np.ndarray) -> np.ndarray:
    """(R,) likelihood estimates as weights, or equal ones where those would leave few runs."""
    w = np.exp(log_z - log_z.max())
    w /= w.sum()
    least = max(LEAST_SHARE * len(w), LEAST_RUNS)
    return w if 1.0 / (w @ w) >= least else np.full(len(w), 1.0 / len(w))


def _louis(runs: Sequence[Run], w: np.ndarray) -> np.ndarray:
    """E[-H] - E[SS'] + E[S]E[S]', the last one from pairs of different runs."""
    means = np.stack([r.mean for r in runs])
    total = w @ means
    own = (means * (w**2)[:, None]).T @ means
    product = (np.outer(total, total) - own) / (1.0 - w @ w)
    inside = [-r.hessian - r.square for r in runs if r.hessian is not None]
    return np.tensordot(w, np.stack(inside), axes=1) + product
