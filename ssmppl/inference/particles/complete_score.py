"""Derivatives of log p(x, y | theta) along trajectories, in numbers."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence

import numpy as np

from ssmppl.analysis.score import CompleteScore
from ssmppl.codegen.score import ScoreProgram, compile_score
from ssmppl.compiling import once_property
from ssmppl.errors import ArgumentError
from ssmppl.inference.problem import Problem
from ssmppl.inference.singular import need_density

__all__ = ["CompleteScores", "complete_scores"]

FIRST, SECOND = 6e-6, 1e-4  # steps of central differences, relative to the parameter
LEAST = 1e-3  # parameters nearer to zero count as this large for a step

Function = Callable[[np.ndarray, list[np.ndarray]], np.ndarray]


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
        for e, group in zip(self.problem.experiments, paths, strict=True):
            for m, path in enumerate(group):
                run(theta, e.y, e.seen, e.u, np.array(path), part)
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


def complete_scores(problem: Problem, held: Collection[str] = ()) -> CompleteScores:
    """The complete-data score of a problem, in all parameters but those held fixed.

    Raises
    ------
    ArgumentError : Fisher's identity does not hold in some parameter, as the support of a law, or
        the law by steps, depends on it; names the line.
    """
    need_density(problem.trace, "the score by particles", "score")
    symbols = [s for s in problem.trace.parameter_symbols if s.data[1] not in held]
    derived = CompleteScore(problem.trace, symbols, problem.program.missing)
    for s in symbols:
        reason = derived.obstacle(s)
        if reason is not None:
            raise ArgumentError(
                f"the score in {s!r} is not the mean of complete-data scores: {reason.reason}",
                fix=f"fix {s.data[1]!r}, write the law so that it changes smoothly with it, or use "
                "a method without scores",
                where=reason.where,
            )
    return CompleteScores(problem, derived)
