"""Approximate log-likelihoods of a problem: Laplace's, and the extended Kalman filter's."""

from __future__ import annotations

import numpy as np

from ssmppl.codegen.modules.gaussian import GaussianApproximation, Mode
from ssmppl.codegen.native.loading import Loaded
from ssmppl.errors import ArgumentError, NotApplicable
from ssmppl.inference.run.problem import Problem

APPROXIMATE = ("laplace", "extended")  # the names under which verbs know them


class LaplaceLikelihood:
    """Laplace's log p(y | theta), summed over the experiments.

    The modes at the last theta are where the search for the next ones begins, so that a climb costs
    a few passes a point. From elsewhere the search ends at the same mode, within its tolerance,
    unless there are several.
    """

    def __init__(self, problem: Problem, approximation: GaussianApproximation):
        self.problem, self.approximation = problem, approximation
        self.modes: list[Mode | None] = []
        self.forget()

    def forget(self) -> None:
        """Begin the next search from nothing."""
        self.modes = [None] * len(self.problem.experiments)

    def __call__(self, theta: np.ndarray) -> float:
        """At theta (P,); -inf where there is no mode."""
        total = 0.0
        for i, (e, mode) in enumerate(zip(self.problem.experiments, self.modes, strict=True)):
            found = self.approximation.laplace(
                theta, e.y, e.seen, e.u, None if mode is None else mode.e
            )
            if found is None:
                return -np.inf
            self.modes[i] = found
            total += found.log_likelihood
        return total

    @property
    def differentiable(self) -> bool:
        """Whether there is an exact gradient."""
        return isinstance(self.approximation.by_adjoint, Loaded)

    def score(self, theta: np.ndarray) -> tuple[float, np.ndarray]:
        """(value, its gradient in theta (P,)); NaN where there is none of it."""
        value, gradient = self(theta), np.full(len(theta), np.nan)
        if value == -np.inf:
            return value, gradient
        total = np.zeros(len(theta))
        for e, mode in zip(self.problem.experiments, self.modes, strict=True):
            assert mode is not None
            one = self.approximation.laplace_gradient(theta, e.y, e.seen, e.u, mode)
            if one is None:
                return value, gradient
            total += one
        return value, total


def laplace_approximation(problem: Problem) -> GaussianApproximation | NotApplicable:
    """What gives Laplace's, or why the model has none."""
    found = problem.program.gaussian
    if isinstance(found, GaussianApproximation) and isinstance(found.by_mode, NotApplicable):
        return found.by_mode
    return found


def approximation_of(problem: Problem, kind: str) -> GaussianApproximation:
    """What gives "laplace" or "extended".

    Raises
    ------
    ArgumentError : the model has no such approximation; says why.
    """
    found = laplace_approximation(problem) if kind == "laplace" else problem.program.gaussian
    if isinstance(found, NotApplicable):
        raise ArgumentError(
            f"proposal={kind!r} does not apply: {found}", fix='use proposal="auto" or "bootstrap"'
        )
    return found


def approximate_log_likelihood(
    problem: Problem, theta: np.ndarray, found: GaussianApproximation, kind: str
) -> float:
    """log p(y | theta) by "laplace" or "extended"; -inf where it comes to no number."""
    if kind == "laplace":
        return LaplaceLikelihood(problem, found)(theta)
    return sum(found.extended_log_likelihood(theta, e.y, e.seen, e.u) for e in problem.experiments)
