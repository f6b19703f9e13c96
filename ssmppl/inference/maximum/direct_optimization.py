"""Direct optimisation: quasi-Newton ascent of the log-likelihood on the unconstrained scale.

Schön et al. (2015), section on direct optimisation. On linear Gaussian models, on those of
finitely many states and on those without noise in their states the likelihood and its score are
exact, and Newton steps with the observed information polish the result; for one scalar state see
`smooth_likelihood.py`.
"""

from __future__ import annotations

import contextlib
from dataclasses import replace
from typing import Any

import numpy as np
import scipy

from ssmppl.analysis.smooth import smooth_filter_applies
from ssmppl.errors import ArgumentError, NotApplicable, SamplingError
from ssmppl.inference.estimate import free_components
from ssmppl.inference.exact.exact_score import exact_score
from ssmppl.inference.exact.models import ExactModel, filter_name
from ssmppl.inference.exact.vanishing import without_maximum
from ssmppl.inference.maximum import smooth_likelihood
from ssmppl.inference.maximum.ascent import Ascent, Setup
from ssmppl.inference.maximum.chart import ELSEWHERE
from ssmppl.inference.maximum.edges import AT_MOST, FLAT, INWARDS, edges
from ssmppl.inference.methods import DirectOptimization
from ssmppl.inference.progress import announced

NEWTON_STEPS = 8
GRADIENT = 1e-9  # relative to the root of the curvature: where Newton's steps are at an end
FAR = 1e30  # what the minimiser sees where the likelihood is zero
EXACT_RESTARTS = 2
FLATS = 3  # that a climb leaves


def climb(setup: Setup, method: DirectOptimization) -> Ascent:
    """Maximise; see the module.

    Raises
    ------
    ArgumentError : the model is neither linear Gaussian nor one of a single scalar state.
    """
    if isinstance(setup.exact, NotApplicable):
        reason = smooth_filter_applies(setup.problem.trace)
        if reason is not None:
            raise ArgumentError(
                f"DirectOptimization needs a linear Gaussian model, or one scalar state: "
                f"{setup.exact.reason}; {reason.reason}",
                fix="use ssm.ScoreAscent(), ssm.PSAEM() or ssm.ParticleEM()",
                where=reason.where or setup.exact.where,
            )
    with announced("DirectOptimization", "climbing the likelihood", shown=setup.progress):
        if isinstance(setup.exact, NotApplicable):
            return smooth_likelihood.climb(setup, method)
        return ExactClimb(setup, setup.exact, method).run()


class _WithoutMaximum(Exception):
    """The likelihood grows without bound, which ends the climb; says why."""


class ExactClimb:
    """Ascent of an exact log-likelihood with its exact score."""

    def __init__(self, setup: Setup, model: ExactModel, method: DirectOptimization):
        self.setup, self.model, self.method = setup, model, method
        self.experiments = setup.problem.experiments
        free = free_components(setup.problem.trace, setup.held)
        self.exact = exact_score(model, self.experiments, free, setup.space.theta)
        self.best, self.best_value = np.empty(0), -np.inf
        self.without_slope = ""  # at the last point of that kind
        self.iterates: list[np.ndarray] = []
        self.values: list[float] = []
        self.evaluations = 0
        self.known: dict[bytes, float] = {}  # objective at the points since the last iterate

    def run(self) -> Ascent:
        """All climbs, and Newton's steps from the best point."""
        restarts = self.method.restarts
        restarts = EXACT_RESTARTS if restarts is None else restarts
        interrupted, stopped, unbounded, gap = False, "", "", np.inf
        try:
            for k in range(restarts + 1):
                start = self.setup.start
                if k:
                    rng = np.random.default_rng(self.setup.seed(k))
                    centre = self.best if len(self.best) else self.setup.start
                    start = centre + rng.standard_normal(len(start))
                stopped = self._quasi_newton(start)
                if len(self.best):
                    self._check(self.setup.chart.at(self.best).theta)
            if len(self.best):
                self._leave_flats()
                gap = self._polish()
        except KeyboardInterrupt:
            if not np.isfinite(self.best_value):
                raise
            interrupted = True
        except _WithoutMaximum as reason:
            unbounded = stopped = str(reason)
        if not np.isfinite(self.best_value):
            if self.without_slope:
                raise ArgumentError(
                    f"the likelihood cannot be climbed: {self.without_slope}", fix=ELSEWHERE
                )
            raise ArgumentError(
                "the likelihood is zero at every point that was tried",
                fix="give start={name: value} near plausible values",
            )
        if not np.isfinite(gap) and not (interrupted or unbounded):
            stopped = "the climb ran to the edge of what the parameters can be: no maximum inside"
        point = self.setup.chart.at(self.best)
        report = {
            "converged": bool(gap < 1e-4), "stopped": stopped, "evaluations": self.evaluations,
            "likelihood": f"exact, by {filter_name(self.model)}", "restarts": restarts,
        }  # fmt: skip
        if unbounded:
            report["without_maximum"] = True
        if self.exact.differences:
            report["central_differences"] = self.exact.differences
        return Ascent(
            point.theta, self.model.log_likelihood(self.experiments, point.theta),
            np.array(self.iterates), report, interrupted=interrupted,
            figures={"objective": np.array(self.values)},
        )  # fmt: skip

    def value(self, z: np.ndarray) -> tuple[float, np.ndarray]:
        """The objective and its gradient (F,) at z; -inf and zeros where there is none."""
        self.evaluations += 1
        nothing = -np.inf, np.zeros(len(z))
        point = self.setup.chart.at(z)
        if point.log_prior == -np.inf:
            return nothing
        try:
            value, gradient = self.exact.score(point.theta)
        except SamplingError:
            self._check(point.theta)
            raise
        slope = point.pull(gradient)
        if self.setup.with_prior:
            value, slope = value + point.log_prior, slope + point.d_log_prior
        if not np.isfinite(value) or not np.all(np.isfinite(slope)):
            self.without_slope = (
                self.setup.chart.without_slope(value, point.theta, gradient) or self.without_slope
            )
            return nothing
        self.known[z.tobytes()] = value
        if value > self.best_value:
            self.best, self.best_value = np.array(z), value
        return value, slope

    def _check(self, theta: np.ndarray) -> None:
        reason = without_maximum(self.model, self.experiments, theta)
        if reason is not None:
            raise _WithoutMaximum(reason.reason)

    def _quasi_newton(self, start: np.ndarray) -> str:
        def downhill(z: np.ndarray) -> tuple[float, np.ndarray]:
            value, slope = self.value(z)
            return (-value, -slope) if value > -np.inf else (FAR, slope)

        self._remember(start)
        found: Any = scipy.optimize.minimize(
            downhill, start, jac=True, method="L-BFGS-B", callback=self._remember,
            options={"maxiter": self.method.steps, "ftol": 1e-13, "gtol": 1e-7},
        )  # fmt: skip
        return str(found.message)

    def _leave_flats(self) -> None:
        """Climb again from the other side of a flat stretch: a spread that is a millionth of the
        others counts for nothing, and nothing tells that it should be larger."""
        for _ in range(FLATS):
            z, before = self.best, self.best_value
            curvature = np.diagonal(_curvature(self.setup, self.exact, z))
            for j in np.flatnonzero(curvature < FLAT):
                for step in (sign * s for s in INWARDS for sign in (-1.0, 1.0)):
                    there = z.copy()
                    there[j] += step
                    with contextlib.suppress(SamplingError, _WithoutMaximum):
                        if self.setup.exact_objective(there) > self.best_value:  # no slope yet
                            self.value(there)
            if not self.best_value > before + AT_MOST:
                break
            self._quasi_newton(self.best)

    def _polish(self) -> float:
        """Newton's steps while they climb; how far the quadratic says that the top still is.

        Parameters whose maximum is at an edge of their support stay where the climb left them.
        """
        gap = np.inf
        theta = self.setup.chart.at(self.best).theta
        found = edges(self.setup, theta, self.exact.information(theta))
        kept = np.ones(len(self.best), dtype=bool) if found is None else found.kept
        free = self.exact.free.copy()
        free[list(found.components) if found is not None else []] = False
        if not kept.any():
            return 0.0
        exact = replace(self.exact, free=free)
        for _ in range(NEWTON_STEPS):
            value, slope = self.value(self.best)
            curvature = _curvature(self.setup, exact, self.best)[np.ix_(kept, kept)]
            if not np.all(np.isfinite(curvature)) or _lowest(curvature) <= 0.0:
                return np.inf
            slope, step = slope[kept], np.zeros(len(kept))
            step[kept] = np.linalg.solve(curvature, slope)
            gap = float(np.sqrt(max(float(slope @ step[kept]), 0.0)))
            if gap < GRADIENT:
                break
            z, size = self.best, 1.0
            new, _ = self.value(z + step)
            while new < value and size > 1e-3:
                size *= 0.5
                new, _ = self.value(z + size * step)
            if not new > value:
                if gap < 1e-5:  # a gain below the rounding of the likelihood: the step is right
                    self.best = z + step
                break
            self._remember(self.best)
        return gap

    def _remember(self, z: np.ndarray) -> None:
        """z is one of the iterates."""
        if z.tobytes() not in self.known:
            self.value(z)
        self.iterates.append(self.setup.space.parameters(z)[0].copy())
        self.values.append(self.known.get(z.tobytes(), -np.inf))
        self.known.clear()


def observed_information(setup: Setup, model: ExactModel, z: np.ndarray) -> np.ndarray:
    """Minus the second derivatives of the objective in z (F,), (F, F), by the exact score."""
    free = free_components(setup.problem.trace, setup.held)
    theta = setup.chart.at(z).theta
    return _curvature(setup, exact_score(model, setup.problem.experiments, free, theta), z)


def _curvature(setup: Setup, exact: Any, z: np.ndarray) -> np.ndarray:
    point = setup.chart.at(z)
    _, gradient = exact.score(point.theta)
    second = setup.chart.curvature(z, gradient)
    out = point.jacobian.T @ exact.information(point.theta) @ point.jacobian - second.theta
    return out - second.log_prior if setup.with_prior else out


def _lowest(matrix: np.ndarray) -> float:
    return float(np.linalg.eigvalsh(matrix)[0])
