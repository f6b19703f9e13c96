"""Direct optimisation over a likelihood that is continuous in the parameters.

The particle filter of Malik and Pitt (2011; see `codegen/kernels/smooth_filter.py`) with common
random numbers: one continuous function for each seed. Several are averaged, as likelihoods, which
takes away most of the bias of log Z; slopes are central differences over a small share of the
likelihood's own width, and the scatter of the seeds' slopes at the top gives the estimate's Monte
Carlo error.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import numpy as np
import scipy

from ssmppl.codegen.kernels.weights import OK
from ssmppl.codegen.smooth import compile_smooth_filter
from ssmppl.compiling import once_property
from ssmppl.errors import SamplingError
from ssmppl.inference.maximum.ascent import Ascent, Setup
from ssmppl.inference.methods import DirectOptimization
from ssmppl.inference.particles.filtering import random_state
from ssmppl.inference.problem import Problem
from ssmppl.inference.totals import total_of

SLOPE_STEP = 0.03  # of the differences for slopes, in standard deviations of the likelihood
CURVE_STEP = 0.5  # of those for second derivatives
FAR = 1e30
CLOSE = 0.05  # standard deviations from the top: where the climb has arrived; counted in the error


class SmoothLikelihood:
    """log Z of S seeds as continuous functions of theta (P,)."""

    def __init__(self, problem: Problem, particles: int, seeds: int, root: np.random.SeedSequence):
        self.problem, self.particles = problem, particles
        self.states = [
            [random_state(root, k, i) for i in range(len(problem.experiments))]
            for k in range(seeds)
        ]

    @once_property
    def run(self) -> Any:
        return compile_smooth_filter(self.problem.trace, self.problem.program.missing)

    def one(self, theta: np.ndarray, seed: int) -> float:
        """log Z of one seed, over the experiments; -inf where it does not exist."""
        total = 0.0
        for e, state in zip(self.problem.experiments, self.states[seed], strict=True):
            increments = np.empty(e.steps)
            status, _ = self.run(
                theta, e.y, e.seen, e.u, self.particles, state.copy(), increments
            )  # fmt: skip
            if status != OK:
                return -np.inf
            total += total_of(increments)
        return total


class SmoothClimb:
    """Ascent of the averaged likelihood, in units of its own width."""

    def __init__(self, setup: Setup, method: DirectOptimization, pool: ThreadPoolExecutor):
        self.setup, self.method, self.pool = setup, method, pool
        self.likelihood = SmoothLikelihood(
            setup.problem, method.particles, method.averages, setup.seed(3)
        )
        self.best, self.best_value = np.empty(0), -np.inf
        self.unit = np.empty(0)
        self.iterates: list[np.ndarray] = []
        self.evaluations = 0

    def run(self) -> Ascent:
        """Climb from the start, look at the top, and once more where it is not there yet."""
        restarts = self.method.restarts or 0
        interrupted, gap, error, information = False, np.inf, None, None
        try:
            start, self.unit = self.setup.start, self.setup.pilot.scale
            for k in range(restarts + 1):
                self._quasi_newton(start)
                rng = np.random.default_rng(self.setup.seed(k))
                centre = self.best if len(self.best) else self.setup.start
                start = centre + 3.0 * self.unit * rng.standard_normal(len(centre))
            for _ in range(3 if len(self.best) else 0):
                gap, information, error = self._top()
                if gap < CLOSE or not np.isfinite(gap):
                    break
                self._quasi_newton(self.best)
        except KeyboardInterrupt:
            if not len(self.best):
                raise
            interrupted = True
        if not len(self.best):
            raise SamplingError(
                "the likelihood of the continuous particle filter is zero at the start",
                fix="give start={name: value} near plausible values, or more particles",
            )
        theta = self.setup.chart.at(self.best).theta
        report = {
            "converged": bool(gap < CLOSE), "evaluations": self.evaluations,
            "likelihood": f"particle filter continuous in the parameters (Malik and Pitt 2011), "
            f"{self.method.particles} particles, averaged over {self.method.averages} seeds",
            "restarts": restarts,
        }  # fmt: skip
        return Ascent(
            theta, None, np.array(self.iterates), report,
            self._natural(information), self._natural_error(error), interrupted,
        )  # fmt: skip

    def log_z(self, z: np.ndarray) -> np.ndarray:
        """(S,) at z (F,); -inf where there is nothing."""
        self.evaluations += 1
        seeds = range(self.method.averages)
        theta, log_prior = self.setup.space.parameters(z)
        if log_prior == -np.inf:
            return np.full(len(seeds), -np.inf)
        return np.array(list(self.pool.map(partial(self.likelihood.one, theta), seeds)))

    def value(self, z: np.ndarray) -> float:
        """The objective: log of the mean likelihood, with the prior where it counts."""
        value = _log_mean(self.log_z(z)) + self._prior(z)
        if value > self.best_value:
            self.best, self.best_value = np.array(z), value
        return value

    def _prior(self, z: np.ndarray) -> float:
        return self.setup.chart.at(z).log_prior if self.setup.with_prior else 0.0

    def _slope(self, function: Any, z: np.ndarray) -> np.ndarray:
        """Central differences in units of the width, last axis F."""
        steps = SLOPE_STEP * np.diag(self.unit)
        with np.errstate(invalid="ignore"):
            slopes = [(function(z + s) - function(z - s)) / (2.0 * SLOPE_STEP) for s in steps]
        return np.stack(slopes, axis=-1)

    def _quasi_newton(self, start: np.ndarray) -> None:
        def downhill(v: np.ndarray) -> tuple[float, np.ndarray]:
            z = start + self.unit * v
            value = self.value(z)
            slope = self._slope(self.value, z) if value > -np.inf else np.full(len(v), np.nan)
            if not np.all(np.isfinite(slope)):
                return FAR, np.zeros(len(v))
            return -value, -slope

        def remember(v: np.ndarray) -> None:
            self.iterates.append(self.setup.space.parameters(start + self.unit * v)[0].copy())

        remember(np.zeros(len(start)))
        scipy.optimize.minimize(
            downhill, np.zeros(len(start)), jac=True, method="L-BFGS-B", callback=remember,
            options={"maxiter": self.method.steps, "ftol": 1e-9, "gtol": 3e-3},
        )  # fmt: skip

    def _top(self) -> tuple[float, np.ndarray | None, np.ndarray | None]:
        """(distance to the top in standard deviations, information and error in z) at the best."""
        z, n, units = self.best, len(self.best), CURVE_STEP * np.diag(self.unit)
        middle = _log_mean(self.log_z(z))
        curvature = np.empty((n, n))
        for i in range(n):
            for j in range(i + 1):
                a, b = units[i], units[j]
                if i == j:
                    total = self._at(z + a) - 2.0 * middle + self._at(z - a)
                else:
                    total = 0.25 * (self._at(z + a + b) - self._at(z + a - b)
                                    - self._at(z - a + b) + self._at(z - a - b))  # fmt: skip
                curvature[i, j] = curvature[j, i] = -total / CURVE_STEP**2
        slopes = self._slope(self.log_z, z)  # (S, F)
        whole_slope = self._slope(lambda v: _log_mean(self.log_z(v)) + self._prior(v), z)
        if not (np.all(np.isfinite(curvature)) and np.all(np.isfinite(slopes))):
            return np.inf, None, None
        scale = np.outer(self.unit, self.unit)
        information = curvature / scale
        whole = curvature if not self.setup.with_prior else curvature - scale * self._prior_curve(z)
        if np.linalg.eigvalsh(whole)[0] <= 0.0:
            return np.inf, information, None
        step = np.linalg.solve(whole, whole_slope)
        log_z = self.log_z(z)
        w = np.exp(log_z - log_z.max())
        w /= w.sum()
        off = w[:, None] * (slopes - w @ slopes)
        noise = off.T @ off * len(w) / (len(w) - 1)
        inverse = np.linalg.inv(whole)
        error = inverse @ noise @ inverse + np.outer(step, step)
        return float(np.sqrt(whole_slope @ step)), information, error * scale

    def _at(self, z: np.ndarray) -> float:
        return _log_mean(self.log_z(z))

    def _prior_curve(self, z: np.ndarray) -> np.ndarray:
        """Second derivatives of the log prior in z."""
        return self.setup.chart.curvature(z, np.zeros(len(self.setup.space.theta))).log_prior

    def _natural(self, information: np.ndarray | None) -> np.ndarray | None:
        return None if information is None else self.setup.natural(self.best, information)

    def _natural_error(self, error: np.ndarray | None) -> np.ndarray | None:
        jacobian = self.setup.chart.at(self.best).jacobian
        with np.errstate(over="ignore", invalid="ignore"):  # as far out as floating point goes
            return None if error is None else jacobian @ error @ jacobian.T


def _log_mean(log_z: np.ndarray) -> float:
    top = float(np.max(log_z))
    return top if not np.isfinite(top) else top + float(np.log(np.mean(np.exp(log_z - top))))


def climb(setup: Setup, method: DirectOptimization) -> Ascent:
    """Maximise over the continuous filter, on threads: it runs without Python's lock."""
    with ThreadPoolExecutor() as pool:
        return SmoothClimb(setup, method, pool).run()
