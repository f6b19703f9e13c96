"""What the methods of maximum likelihood share: the question that they are set, and the answer.

The module of each method has `climb(setup, method) -> Ascent`, which `verbs/maximize.py` registers.
A climb that is interrupted by Ctrl-C (KeyboardInterrupt) returns the best that it has, marked so,
and lets the interrupt pass where it has nothing yet.

Climbs are on the unconstrained scale z (`UnconstrainedTransform`): theta, log prior and log
Jacobian are differentiated once, as expressions, from `language/model/transforms.py`. For a
function l of theta with gradient g (P,) and Hessian H (P, P)

    dl/dz = J' g,    d2l/dz2 = J' H J + sum_p g_p d2 theta_p / dz2,    J = d theta / dz.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from ssmppl.analysis.density import terms
from ssmppl.data import spelled
from ssmppl.errors import ArgumentError, NotApplicable
from ssmppl.expressions.calculus import NotDifferentiable, differentiate
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import Expr, constant, substitute
from ssmppl.inference.exact.kalman import KalmanModel, kalman_model
from ssmppl.inference.preparation.exact_models import ExactModel, exact_model
from ssmppl.inference.preparation.exact_score import ExactScore, exact_score
from ssmppl.inference.preparation.pilot import Pilot, explained, find_mode, finite_point
from ssmppl.inference.preparation.space import Space, at
from ssmppl.inference.run.problem import Problem
from ssmppl.language.model.transforms import unconstrained

# What to do where a function has no slope to climb.
ELSEWHERE = "give start={name: value} where it has one, or use ssm.IF2(), which needs no slopes"
STEP = 1e-5  # of the central differences where a prior has no derivative in closed form


@dataclass(frozen=True)
class TransformedPoint:
    """A place on the unconstrained scale: P parameters, F free numbers.

    theta : (P,). log_prior : log density of theta on its own scale; -inf outside the support, or
    where theta is not finite. log_jacobian : log |d theta / dz|. jacobian : (P, F).
    d_log_prior, d_log_jacobian : (F,) their derivatives in z.
    """

    theta: np.ndarray
    log_prior: float
    log_jacobian: float
    jacobian: np.ndarray
    d_log_prior: np.ndarray
    d_log_jacobian: np.ndarray

    def pull(self, gradient: np.ndarray) -> np.ndarray:
        """The gradient in z, (..., F), of what has this gradient in theta, (..., P)."""
        with np.errstate(all="ignore"):  # at the edge of what floating point can hold
            return gradient @ self.jacobian

    def inverse(self) -> np.ndarray:
        """(F, P) d z / d theta along the free directions; NaN where the Jacobian is not finite."""
        if not np.all(np.isfinite(self.jacobian)):
            return np.full(self.jacobian.T.shape, np.nan)
        return np.linalg.pinv(self.jacobian)


@dataclass(frozen=True)
class Curvature:
    """Second derivatives in z, each (F, F).

    theta : sum_p g_p d2 theta_p for the weights g that were asked for.
    """

    theta: np.ndarray
    log_prior: np.ndarray
    log_jacobian: np.ndarray


class UnconstrainedTransform:
    """The map from z to theta of a `Space`, with its derivatives."""

    def __init__(self, space: Space):
        self.space = space
        trace = space.problem.trace
        self.symbols = trace.parameter_symbols
        found = unconstrained(trace, space.free)
        self.z, value, log_jacobian = list(found.z), found.values, found.log_jacobian
        log_prior = constant(0.0)
        for term in terms(trace, "prior", guard=False):
            log_prior = log_prior + term.log_density
        self.theta = [value.get(s, s) for s in self.symbols]
        self.log_prior, self.log_jacobian = substitute([log_prior], value)[0], log_jacobian
        self._jacobian = _table(self.theta, self.z)
        self._d_log_jacobian = _table([log_jacobian], self.z)[0]
        self._d_log_prior: list[Expr] | None = None
        with contextlib.suppress(NotDifferentiable):
            self._d_log_prior = _table([self.log_prior], self.z)[0]
        self._second: list[list[list[Expr]]] | None = None
        self._second_prior: list[list[Expr]] | None = None

    def at(self, z: np.ndarray) -> TransformedPoint:
        """Values and first derivatives at z (F,)."""
        z = np.asarray(z, dtype=float)
        theta, total = self.space.parameters(z)
        values = self._values(z)
        with np.errstate(all="ignore"):
            jacobian = _numbers(self._jacobian, values)
            slope = _numbers([self._d_log_jacobian], values)[0]
            if self._d_log_prior is not None:
                d_log_prior = _numbers([self._d_log_prior], values)[0]
            else:
                d_log_prior = _differences(self._log_prior_at, z)
            log_jacobian = float(evaluate(self.log_jacobian, values))
        log_prior = total - log_jacobian if total > -np.inf else -np.inf
        return TransformedPoint(theta.copy(), log_prior, log_jacobian, jacobian, d_log_prior, slope)

    def without_slope(self, value: float, theta: np.ndarray, gradient: np.ndarray) -> str:
        """Says in what a function of theta (P,) that has a value there has no slope (P,); else
        empty."""
        names = [repr(s) for s, g in zip(self.symbols, gradient, strict=True) if not np.isfinite(g)]
        if not names or not np.isfinite(value) or not np.all(np.isfinite(theta)):
            return ""
        here = spelled(self.space.problem.trace, theta)
        return f"it has a value and no finite slope in {' and '.join(names)} at {here}"

    def curvature(self, z: np.ndarray, weights: np.ndarray) -> Curvature:
        """Second derivatives at z (F,); weights (P,) of the components of theta."""
        z = np.asarray(z, dtype=float)
        values, n = self._values(z), len(self.z)
        if self._second is None:
            rows = [*self._jacobian, self._d_log_jacobian]
            self._second = [_table(row, self.z) for row in rows]
            with contextlib.suppress(NotDifferentiable):
                if self._d_log_prior is not None:
                    self._second_prior = _table(self._d_log_prior, self.z)
        theta = np.zeros((n, n))
        with np.errstate(all="ignore"):
            for weight, table in zip(weights, self._second[:-1], strict=True):
                if weight != 0.0:
                    theta += weight * _numbers(table, values)
            slope = _numbers(self._second[-1], values)
            if self._second_prior is not None:
                prior = _numbers(self._second_prior, values)
            else:
                prior = _differences(lambda v: self.at(v).d_log_prior, z)
        return Curvature(theta, 0.5 * (prior + prior.T), slope)

    def _values(self, z: np.ndarray) -> dict[Expr, float]:
        values = dict(zip(self.symbols, self.space.theta.tolist(), strict=True))
        return values | dict(zip(self.z, z.tolist(), strict=True))

    def _log_prior_at(self, z: np.ndarray) -> float:
        return float(evaluate(self.log_prior, self._values(z)))


def _table(roots: list[Expr], symbols: list[Expr]) -> list[list[Expr]]:
    """Derivatives of each root (rows) in each symbol (columns)."""
    columns = [differentiate(roots, s) for s in symbols]
    return [[column[i] for column in columns] for i in range(len(roots))]


def _numbers(table: list[list[Expr]], values: dict[Expr, float]) -> np.ndarray:
    """The table in numbers, float64 (rows, columns)."""
    flat = evaluate([e for row in table for e in row], values)
    return np.array(flat, dtype=float).reshape(len(table), -1 if flat else 0)


def _differences(function: Callable[[np.ndarray], float | np.ndarray], z: np.ndarray) -> np.ndarray:
    """Central differences of a function of z (F,), the last axis that of z."""
    out = [
        (np.asarray(function(z + step)) - np.asarray(function(z - step))) / (2.0 * STEP)
        for step in STEP * np.eye(len(z))
    ]
    return np.stack(out, axis=-1)


@dataclass(frozen=True)
class Edges:
    """Which parameters are at an edge of their support.

    z : (F,) an estimate inside the support. kept : (F,) bool, the numbers that are not held there.
    components : index of each component of theta at an edge -> the value of that edge.
    moving : those of them whose edge is where other free parameters put it.
    """

    z: np.ndarray
    kept: np.ndarray
    components: dict[int, float]
    moving: frozenset[int] = frozenset()


@dataclass(frozen=True)
class Ascent:
    """Where a climb came to (P components of theta, K iterates).

    theta : (P,). log_likelihood : there, where the method knows it exactly, else None.
    iterates : (K, P), the last one not necessarily theta. report : notes on the run,
    `converged` above all. information : (P, P), minus the second derivatives of the log-likelihood
    in theta, where the method has them. error : (P, P), the Monte Carlo covariance of theta itself.
    Of several starts the iterates are (starts, K, P); figures : what else is known of each iterate,
    (K,) or (starts, K), by name. no_information : why no information is to be looked for, where
    that is so. held : what the climb found to be at an edge; None: nothing, or it did not look.
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
    held: Edges | None = None


@dataclass(frozen=True)
class Maximization:
    """The question: a problem, its free parameters, and what is to be maximised.

    objective : "likelihood", or "posterior" for log likelihood + log prior density of theta.
    fixed : values of the fixed parameters; near : those to start from, by name.
    """

    problem: Problem
    space: Space
    objective: str
    fixed: dict[str, np.ndarray]
    near: dict[str, np.ndarray]
    root: np.random.SeedSequence
    executor: Executor | None = None
    progress: bool = False

    @cached_property
    def transform(self) -> UnconstrainedTransform:
        """Derivatives through the unconstrained scale."""
        return UnconstrainedTransform(self.space)

    @cached_property
    def exact(self) -> ExactModel | NotApplicable:
        """The exact filter, or why there is none."""
        return exact_model(self.problem.trace)

    def exact_score(self, free: np.ndarray) -> ExactScore:
        """Score and information of the exact likelihood in these components, free (P,) bool."""
        assert not isinstance(self.exact, NotApplicable), self.exact
        key = free.tobytes()
        if key not in self._scores:
            data, theta = self.problem.experiments, self.space.theta
            self._scores[key] = exact_score(self.exact, data, free, theta)
        return self._scores[key]

    @cached_property
    def _scores(self) -> dict[bytes, ExactScore]:
        return {}

    @cached_property
    def kalman(self) -> KalmanModel | NotApplicable:
        """The exact filter of a linear Gaussian model, or why it is none."""
        return kalman_model(self.problem.trace)

    @property
    def with_prior(self) -> bool:
        return self.objective == "posterior"

    def log_prior(self, z: np.ndarray) -> float:
        """What the prior adds to the objective at z (F,)."""
        return self.transform.at(z).log_prior if self.with_prior else 0.0

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
        z = self.space.z[self.space.positions]
        free = set(self.problem.trace.parameters) - set(self.fixed)
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
        return value + self.log_prior(z) if value > -np.inf else value

    def space_at(self, theta: np.ndarray) -> np.ndarray:
        """(F,) the unconstrained place of theta (P,)."""
        moved = at(self.space, theta)
        return moved.z[moved.positions]

    def natural(self, z: np.ndarray, information: np.ndarray) -> np.ndarray:
        """(P, P) minus the second derivatives in theta, from those in z (F, F) at a maximum.

        The gradient of the likelihood is zero there, or minus that of the log prior.
        """
        point = self.transform.at(z)
        inverse = point.inverse()
        if self.with_prior:
            slope = -inverse.T @ point.d_log_prior
            information = information + self.transform.curvature(z, slope).theta
        with np.errstate(over="ignore", invalid="ignore"):  # as far out as floating point goes
            return inverse.T @ information @ inverse

    def natural_error(self, z: np.ndarray, error: np.ndarray) -> np.ndarray:
        """(P, P) the covariance of an estimate in theta, from that in z (F, F)."""
        jacobian = self.transform.at(z).jacobian
        with np.errstate(over="ignore", invalid="ignore"):  # as far out as floating point goes
            return jacobian @ error @ jacobian.T

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
