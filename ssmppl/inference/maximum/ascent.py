"""What the methods of maximum likelihood share: the question that they are set, and the answer.

The module of each method has `climb(setup, method) -> Ascent`. A climb that is interrupted by
Ctrl-C (KeyboardInterrupt) returns the best that it has, marked so, and lets the interrupt pass
where it has nothing yet.
"""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from ssmppl.errors import ArgumentError, NotApplicable
from ssmppl.inference.exact.kalman import KalmanModel, kalman_model
from ssmppl.inference.exact.models import ExactModel, exact_model
from ssmppl.inference.maximum.chart import Chart
from ssmppl.inference.particles.pilot import (
    Pilot,
    Space,
    at,
    explained,
    find_mode,
    finite_point,
)
from ssmppl.inference.problem import Problem


@dataclass(frozen=True)
class Ascent:
    """Where a climb came to (P components of theta, K iterates).

    theta : (P,). log_likelihood : there, where the method knows it exactly, else None.
    iterates : (K, P), the last one not necessarily theta. report : what is to be told of the run,
    `converged` above all. information : (P, P), minus the second derivatives of the log-likelihood
    in theta, where the method has them. error : (P, P), the Monte Carlo covariance of theta itself.
    Of several starts the iterates are (starts, K, P); figures : what else is known of each iterate,
    (K,) or (starts, K), by name. no_information : why no information is to be looked for, where
    that is so.
    """

    theta: np.ndarray
    log_likelihood: float | None
    iterates: np.ndarray
    report: dict[str, Any] = field(default_factory=dict)
    information: np.ndarray | None = None
    error: np.ndarray | None = None
    interrupted: bool = False
    figures: dict[str, np.ndarray] = field(default_factory=dict)
    no_information: str = ""


@dataclass(frozen=True)
class Setup:
    """The question: a problem, its free parameters, and what is to be maximised.

    objective : "likelihood", or "posterior" for log likelihood + log prior density of theta.
    held : values of the fixed parameters; near : those to start from, by name.
    """

    problem: Problem
    space: Space
    objective: str
    held: dict[str, np.ndarray]
    near: dict[str, np.ndarray]
    root: np.random.SeedSequence
    executor: Executor | None = None
    progress: bool = False

    @cached_property
    def chart(self) -> Chart:
        """Derivatives through the unconstrained scale."""
        return Chart(self.space)

    @cached_property
    def exact(self) -> ExactModel | NotApplicable:
        """The exact filter, or why there is none."""
        return exact_model(self.problem.trace)

    @cached_property
    def kalman(self) -> KalmanModel | NotApplicable:
        """The exact filter of a linear Gaussian model, or why it is none."""
        return kalman_model(self.problem.trace)

    @property
    def with_prior(self) -> bool:
        return self.objective == "posterior"

    @cached_property
    def pilot(self) -> Pilot:
        """A mode found by a particle filter from the space's own point."""
        return find_mode(self.space, self.root)

    @cached_property
    def start(self) -> np.ndarray:
        """(F,) where to begin, on the unconstrained scale.

        The user's own point where `start` gives every free parameter; where the likelihood is exact
        moderate values at which it is finite; else the pilot's mode.
        """
        z = self.space.z[self.space.where]
        free = set(self.problem.trace.parameters) - set(self.held)
        if free <= set(self.near) or not len(z):
            return z
        if isinstance(self.exact, NotApplicable):
            return self.pilot.z
        try:
            return finite_point(z, self.exact_at, np.random.default_rng(self.root))
        except ArgumentError as error:
            raise explained(error, self.space) from None

    def exact_objective(self, z: np.ndarray) -> float:
        """What is maximised, at z (F,); -inf where there is nothing, or no exact likelihood."""
        value = self.exact_at(z)
        if self.with_prior and value > -np.inf:
            value += self.chart.at(z).log_prior
        return value

    def space_at(self, theta: np.ndarray) -> np.ndarray:
        """(F,) the unconstrained place of theta (P,)."""
        moved = at(self.space, theta)
        return moved.z[moved.where]

    def natural(self, z: np.ndarray, information: np.ndarray) -> np.ndarray:
        """(P, P) minus the second derivatives in theta, from those in z (F, F) at a maximum.

        The gradient of the likelihood is zero there, or minus that of the log prior.
        """
        point = self.chart.at(z)
        inverse = point.inverse()
        if self.with_prior:
            slope = -inverse.T @ point.d_log_prior
            information = information + self.chart.curvature(z, slope).theta
        with np.errstate(over="ignore", invalid="ignore"):  # as far out as floating point goes
            return inverse.T @ information @ inverse

    def exact_at(self, z: np.ndarray) -> float:
        """The exact log-likelihood at z (F,); -inf off the support, and where there is none."""
        theta, log_prior = self.space.parameters(z)
        if log_prior == -np.inf or isinstance(self.exact, NotApplicable):
            return -np.inf
        return self.exact.log_likelihood(self.problem.experiments, theta)

    def seed(self, *path: int) -> np.random.SeedSequence:
        """A seed for one part of a climb."""
        key = (*self.root.spawn_key, 17, *path)
        return np.random.SeedSequence(self.root.entropy, spawn_key=key)
