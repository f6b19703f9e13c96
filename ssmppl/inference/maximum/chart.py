"""Derivatives through the unconstrained scale: theta, log prior and log Jacobian as functions of z.

Everything is derived once from `language/transforms.py` by symbolic differentiation. For a function
l of theta with gradient g (P,) and Hessian H (P, P), on the unconstrained scale

    dl/dz = J' g,    d2l/dz2 = J' H J + sum_p g_p d2 theta_p / dz2,    J = d theta / dz.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ssmppl.analysis.density import terms
from ssmppl.data import spelled
from ssmppl.expressions.calculus import NotDifferentiable, differentiate
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import Expr, constant, substitute
from ssmppl.inference.particles.pilot import Space
from ssmppl.language.transforms import unconstrained

# What to do where a function has no slope to climb.
ELSEWHERE = "give start={name: value} where it has one, or use ssm.IF2(), which needs no slopes"
STEP = 1e-5  # of the central differences where a prior has no derivative in closed form


@dataclass(frozen=True)
class Point:
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


class Chart:
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

    def at(self, z: np.ndarray) -> Point:
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
        return Point(theta.copy(), log_prior, log_jacobian, jacobian, d_log_prior, slope)

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
