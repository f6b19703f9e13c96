"""Approximate log-likelihoods of a problem: Laplace's, and the extended and unscented Kalman
filters'.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssmppl.codegen.modules.gaussian import GaussianApproximation, Mode
from ssmppl.codegen.native.loading import Loaded
from ssmppl.errors import ArgumentError, NotApplicable
from ssmppl.inference.run.problem import Problem

APPROXIMATE = ("laplace", "extended", "unscented")  # the names under which verbs know them


class LaplaceLikelihood:
    """Laplace's log p(y | theta), summed over the experiments.

    The modes at the last theta are where the search for the next ones begins, so that a climb costs
    a few passes a point. From elsewhere the search ends at the same mode, within its tolerance,
    unless there are several.
    """

    title, jumps = "Laplace's approximation", False

    def __init__(self, problem: Problem, approximation: GaussianApproximation):
        self.problem, self.approximation = problem, approximation
        self.modes: list[Mode | None] = []
        self.forget()

    def forget(self) -> None:
        """Begin the next search from nothing."""
        self.modes = [None] * len(self.problem.experiments)

    def __call__(self, theta: np.ndarray) -> float:
        """The approximate log-likelihood at theta (P,); -inf where there is no mode."""
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


class ExtendedLikelihood:
    """The extended Kalman filter's log p(y | theta), summed over the experiments; without a
    gradient and modes, and where a filtered mean meets a corner of the model it may jump."""

    title, jumps = "the extended Kalman filter's approximation", True
    differentiable = False

    def __init__(self, problem: Problem, approximation: GaussianApproximation):
        self.problem, self.approximation = problem, approximation
        self.modes: list[Mode | None] = [None] * len(problem.experiments)

    def forget(self) -> None:
        """It remembers nothing."""

    def __call__(self, theta: np.ndarray) -> float:
        """The approximate log-likelihood at theta (P,); -inf where it is not finite."""
        return approximate_log_likelihood(self.problem, theta, self.approximation, "extended")

    def score(self, theta: np.ndarray) -> tuple[float, np.ndarray]:
        """(value, NaN (P,)): it has no gradient."""
        return self(theta), np.full(len(theta), np.nan)


def use_mode(problem: Problem, theta: np.ndarray) -> None:
    """The search for a mode at theta (P,), so that it is compiled: from no noise, without what a
    search usually begins with."""
    found, e = problem.program.gaussian, problem.experiments[0]
    assert isinstance(found, GaussianApproximation)
    noises = max(len(found.found.initial.noise), len(found.found.transition.noise))
    found.laplace(theta, e.y, e.seen, e.u, np.zeros((e.steps, noises)))


@dataclass(frozen=True)
class Approximated:
    """An approximate log p(y | theta), -inf where it is not finite; with noise (T, R') of each
    experiment, where it is known: of the likeliest trajectory, or near it. at_mode : which."""

    log_likelihood: float
    noise: tuple[np.ndarray, ...] | None = None
    at_mode: bool = False


@dataclass(frozen=True)
class ApproximateLikelihood:
    """An approximate log p(y | theta) that is a function of theta alone, as chains need it.

    kind : of `APPROXIMATE`. noise : (T, R') of each experiment, from where every search for
    modes begins; None: from the extended Kalman filter. Where Laplace's is not finite, the
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


def approximation_of(
    problem: Problem, kind: str, instead: str | None = None
) -> GaussianApproximation:
    """What gives "laplace", "extended" or "unscented"; instead : what to do where nothing
    does; None: as for any proposal.

    Raises
    ------
    ArgumentError : the model has no such approximation; says why.
    """
    found = laplace_approximation(problem) if kind == "laplace" else problem.program.gaussian
    if kind == "unscented" and isinstance(found, GaussianApproximation):
        points = found.by_points
        found = points if isinstance(points, NotApplicable) else found
    if isinstance(found, NotApplicable):
        raise ArgumentError(
            f"proposal={kind!r} does not apply: {found.reason}",
            fix=problem.instead if instead is None else instead,
            where=found.where,
        )
    return found


def approximate_log_likelihood(
    problem: Problem, theta: np.ndarray, found: GaussianApproximation, kind: str
) -> float:
    """log p(y | theta) by one of `APPROXIMATE`; -inf where it is not finite."""
    if kind == "laplace":
        return LaplaceLikelihood(problem, found)(theta)
    total = 0.0
    for e in problem.experiments:
        given = theta, e.y, e.seen, e.u
        if kind == "extended":
            total += found.extended_log_likelihood(*given)
        else:
            told = found.unscented(*given)
            total += -np.inf if told is None else float(np.sum(told[0].increments))
    return total
