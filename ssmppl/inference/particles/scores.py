"""Score and observed information by particle smoothing.

Fisher's identity: the score is the smoothed mean of the complete-data score S (Fisher 1925; Schön
et al. 2015, section on direct optimisation), the derivatives of log p(x, y | theta) along a
trajectory; Louis' identity: the observed information is E[-H] - Cov(S), H the second derivatives of
the complete-data log density (Louis 1982; Poyiadjis, Doucet and Singh 2011). Trajectories come from
backward simulation; several independent runs give the Monte Carlo error, and pairs of them
E[S]E[S]' without bias by noise.

The mean over a run's trajectories has a bias of order 1 / N. Times that run's estimate of the
likelihood it is unbiased for the smoothed mean times the likelihood (P. Del Moral, A. Doucet and
S. S. Singh, "A backward particle interpretation of Feynman-Kac formulae", *ESAIM: M2AN* 44, 2010),
so the runs are weighted by those estimates, and the bias falls to order 1 / (N runs); not where
the estimates scatter so much that few runs would be left.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial

import numpy as np

from ssmppl.analysis.score import CompleteScore
from ssmppl.codegen.modules.trajectory_sums import ScoreProgram, compile_score
from ssmppl.compiling import once_property
from ssmppl.data import spelled
from ssmppl.errors import ArgumentError, SamplingError
from ssmppl.inference.methods.requirements import need_density
from ssmppl.inference.particles.backward import backward_draws
from ssmppl.inference.particles.filtering import FilterSettings
from ssmppl.inference.run.problem import Problem
from ssmppl.inference.run.seeds import random_state
from ssmppl.inference.run.tasks import run_tasks

FIRST, SECOND = 6e-6, 1e-4  # steps of central differences, relative to the parameter
LEAST = 1e-3  # parameters nearer to zero count as this large for a step

Function = Callable[[np.ndarray, list[np.ndarray]], np.ndarray]
LEAST_SHARE = 0.3  # of the runs, in effective number, that their weights must leave
LEAST_RUNS = 1.1  # of one run alone nothing is known about products of different ones


class CompleteScores:
    """First and second derivatives of the complete-data log density, prior excluded.

    Closed forms where there are, else central differences of log p(x, y | theta) along the
    trajectory with its noisy components held; `differences` says which and why.
    P parameters, D states, M trajectories, T steps.
    """

    def __init__(self, problem: Problem, derived: CompleteScore):
        self.problem, self.derived = problem, derived
        place = {s: i for i, s in enumerate(problem.trace.parameter_symbols)}
        self.where = np.array([place[p] for p in derived.parameters], dtype=int)

    @once_property
    def program(self) -> ScoreProgram:
        return compile_score(self.derived)

    def of(self, problem: Problem) -> CompleteScores:
        """The same derivatives for other data of the same model."""
        other = CompleteScores(problem, self.derived)
        other.program = self.program
        return other

    def __getstate__(self) -> dict:  # another process finds the generated module in its cache
        return {k: v for k, v in self.__dict__.items() if k != "program"}

    @property
    def twice(self) -> bool:
        """Whether second derivatives have a closed form."""
        return "curvature" in self.program.widths

    @property
    def differences(self) -> dict[str, str]:
        """What is computed by central differences ("score", "curvature"), with the reason."""
        return self.program.missing

    def gradient(self, theta: np.ndarray, paths: Sequence[np.ndarray]) -> np.ndarray:
        """(M, P) scores of M trajectories at theta (P,), summed over experiments.

        paths : for each experiment (M, T, D). Zero in parameters that were left out.
        """
        if not len(self.where) or "score" in self.program.widths:
            return self.value_and_gradient(theta, paths)[1]
        gradient = np.zeros((len(paths[0]), len(theta)))
        gradient[:, self.where] = self._slopes(self.log_density, theta, paths, FIRST)
        return gradient

    def value_and_gradient(
        self, theta: np.ndarray, paths: Sequence[np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray]:
        """`log_density` (M,) and `gradient` (M, P), in one pass where the score is compiled."""
        f = len(self.where)
        if f and "score" not in self.program.widths:
            return self.log_density(theta, paths), self.gradient(theta, paths)
        gradient = np.zeros((len(paths[0]), len(theta)))
        if not f:
            return self.log_density(theta, paths), gradient
        sums = self._sums("score", f + 1, theta, paths)
        gradient[:, self.where] = sums[:, :f]
        return sums[:, f], gradient

    def hessian(self, theta: np.ndarray, paths: Sequence[np.ndarray]) -> np.ndarray:
        """(M, P, P) second derivatives, as `gradient`."""
        f, p = len(self.where), len(theta)
        if not f:
            return np.zeros((len(paths[0]), p, p))
        lower = np.tril_indices(f)
        if "curvature" in self.program.widths:
            values = self._sums("curvature", len(lower[0]), theta, paths)
            square = np.zeros((len(values), f, f))
            square[:, lower[0], lower[1]] = square[:, lower[1], lower[0]] = values
        elif "score" in self.program.widths:
            square = self._slopes(self.gradient, theta, paths, FIRST)[:, self.where]
        else:
            square = self._slopes(
                lambda v, x: self._slopes(self.log_density, v, x, SECOND), theta, paths, SECOND
            )
        out = np.zeros((len(square), p, p))
        out[:, self.where[:, None], self.where] = 0.5 * (square + np.swapaxes(square, 1, 2))
        return out

    def log_density(self, theta: np.ndarray, paths: Sequence[np.ndarray]) -> np.ndarray:
        """(M,) log p(x, y | theta) of the noisy components and the observations."""
        run, part = self.problem.program.entry("log_joint"), np.empty(1)
        total = np.zeros(len(paths[0]))
        theta = np.ascontiguousarray(theta, dtype=float)
        for e, group in zip(self.problem.experiments, paths, strict=True):
            for m, path in enumerate(group):
                run(theta, e.y, e.seen, e.u, np.array(path, order="C"), part)
                total[m] += part[0]
        return total

    def _sums(
        self, name: str, size: int, theta: np.ndarray, paths: Sequence[np.ndarray]
    ) -> np.ndarray:
        """(M, size) totals of a generated function, over experiments."""
        run = getattr(self.program.module, name)
        total = np.zeros((len(paths[0]), size))
        theta = np.ascontiguousarray(theta, dtype=float)
        for e, group in zip(self.problem.experiments, paths, strict=True):
            wide = np.zeros((e.steps, self.program.widths[name]))
            run(theta, e.y, e.seen, e.u, np.ascontiguousarray(group), wide, total)
        return total

    def _slopes(
        self, function: Function, theta: np.ndarray, paths: Sequence[np.ndarray], step: float
    ) -> np.ndarray:
        """Central differences of a function (theta, paths) -> (M, ...), (M, ..., F)."""
        out = []
        for i in self.where:
            h = step * max(abs(theta[i]), LEAST)
            up, down = theta.copy(), theta.copy()
            up[i], down[i] = theta[i] + h, theta[i] - h
            out.append(
                (function(up, list(paths)) - function(down, list(paths))) / (up[i] - down[i])
            )
        return np.stack(out, axis=-1)


def complete_scores(problem: Problem, fixed: Collection[str] = ()) -> CompleteScores:
    """The complete-data score of a problem, in all parameters but the fixed ones.

    Raises
    ------
    ArgumentError : Fisher's identity does not hold in some parameter, as the support of a
        distribution, or the distribution by steps, depends on it; names the line.
    """
    need_density(problem.trace, "the score by particles", "score")
    symbols = [s for s in problem.trace.parameter_symbols if s.data[1] not in fixed]
    derived = CompleteScore(problem.trace, symbols, problem.program.missing)
    for s in symbols:
        reason = derived.obstacle(s)
        if reason is not None:
            raise ArgumentError(
                f"the score in {s!r} is not the mean of complete-data scores: {reason.reason}",
                fix=f"fix {s.data[1]!r}, write the distribution so that it changes smoothly with "
                "it, or use a method without scores",
                where=reason.where,
            )
    return CompleteScores(problem, derived)


@dataclass(frozen=True)
class Smoothing:
    """How trajectories are drawn: the filter, their number M, the backward kernel."""

    settings: FilterSettings
    trajectories: int
    kernel: str = "auto"


@dataclass(frozen=True)
class SmootherRun:
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
) -> SmootherRun:  # fmt: skip
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
            fix="keep parameters and states off the edges where a distribution's density is 0 or "
            "infinite",
        )
    hessian = scores.hessian(theta, paths).mean(axis=0) if second else None
    with np.errstate(over="ignore", invalid="ignore"):  # as in `combine`
        return SmootherRun(log_z, s.mean(axis=0), s.T @ s / len(s), hessian)


def several_runs(
    scores: CompleteScores, theta: np.ndarray, smoothing: Smoothing, second: bool,
    seed: np.random.SeedSequence, numbers: Sequence[int], executor: Executor | None = None,
) -> list[SmootherRun]:  # fmt: skip
    """Independent runs over an executor."""
    _ = scores.program  # generated once, before threads ask for it
    task = partial(one_run, scores, theta, smoothing, second, seed)
    return run_tasks(task, list(numbers), executor=executor)


def combine(runs: Sequence[SmootherRun]) -> ParticleScore:
    """Weighted averages of at least two runs, with their errors."""
    with np.errstate(over="ignore", invalid="ignore"):  # the squares of some scores have no number
        return _combined(runs)


def _combined(runs: Sequence[SmootherRun]) -> ParticleScore:
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


def _louis(runs: Sequence[SmootherRun], w: np.ndarray) -> np.ndarray:
    """E[-H] - E[SS'] + E[S]E[S]', the last one from pairs of different runs."""
    means = np.stack([r.mean for r in runs])
    total = w @ means
    own = (means * (w**2)[:, None]).T @ means
    product = (np.outer(total, total) - own) / (1.0 - w @ w)
    inside = [-r.hessian - r.square for r in runs if r.hessian is not None]
    return np.tensordot(w, np.stack(inside), axes=1) + product
