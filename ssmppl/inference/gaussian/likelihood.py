"""Approximate log-likelihoods of a problem: Laplace's, and the extended Kalman filter's."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssmppl.codegen.modules.gaussian import GaussianApproximation
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
        self.noise: list[np.ndarray | None] = [None] * len(problem.experiments)

    def __call__(self, theta: np.ndarray) -> float:
        """At theta (P,); -inf where there is no mode."""
        total = 0.0
        for i, e in enumerate(self.problem.experiments):
            found = self.approximation.laplace(theta, e.y, e.seen, e.u, self.noise[i])
            if found is None:
                return -np.inf
            self.noise[i] = found.e
            total += found.log_likelihood
        return total


@dataclass(frozen=True)
class Approximated:
    """An approximate log p(y | theta), -inf where it comes to no number; with noise (T, R') of each
    experiment, where it is known: of the likeliest trajectory, or near it. at_mode : which."""

    log_likelihood: float
    noise: tuple[np.ndarray, ...] | None = None
    at_mode: bool = False


@dataclass(frozen=True)
class ApproximateLikelihood:
    """An approximate log p(y | theta) that is a function of theta alone, as chains need it.

    kind : of `APPROXIMATE`. noise : (T, R') of each experiment, from where every search for
    modes begins; None: from the extended Kalman filter. Where Laplace's comes to no number, the
    extended filter's stands in for it.
    """

    problem: Problem
    kind: str
    noise: tuple[np.ndarray, ...] | None = None

    def at(self, theta: np.ndarray) -> Approximated:
        """At theta (P,)."""
        found = approximation_of(self.problem, self.kind)
        total, noise = 0.0, []
        for i, e in enumerate(self.problem.experiments if self.kind == "laplace" else ()):
            begin = None if self.noise is None else self.noise[i]
            mode = found.laplace(theta, e.y, e.seen, e.u, begin)
            if mode is None:
                break
            noise.append(mode.e)
            total += mode.log_likelihood
        if len(noise) == len(self.problem.experiments):
            return Approximated(total, tuple(noise), at_mode=True)
        value = approximate_log_likelihood(self.problem, theta, found, "extended")
        return Approximated(value, self.noise)


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
