"""The M-step over trajectories where their density does not separate: its mean climbed as it is.

Newton's method on the unconstrained scale, from the parameters of the iteration before, with the
complete-data scores and second derivatives summed over the trajectories in compiled passes; EM
moves by little, so that two or three steps are enough. BFGS where there are no second derivatives
in closed form.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from ssmppl.analysis.climber import LONGEST_STEP, uphill
from ssmppl.errors import SamplingError
from ssmppl.inference.maximum.chart import ELSEWHERE, Chart, Point
from ssmppl.inference.particles.complete_score import CompleteScores

STEPS, HALVINGS, BFGS_STEPS = 30, 20, 50
LAST_STEP = 1e-6  # squared length, in standard errors of the complete data; what is left after it
# is about the step's square, where the noise of M trajectories is 1 / sqrt(M)


@dataclass(frozen=True)
class _Height:
    """The mean log density at a point: its value, its slope in z (F,) and in theta (P,)."""

    point: Point
    value: float
    slope: np.ndarray
    gradient: np.ndarray


def climbed(
    chart: Chart, scores: CompleteScores, paths: Sequence[np.ndarray], weights: np.ndarray,
    z: np.ndarray, posterior: bool,
) -> np.ndarray:  # fmt: skip
    """theta (P,) where the weighted mean of log p(x, y | theta) has its top, going up from z (F,).

    paths : for each experiment (M, T, D). weights : (M,). posterior : whether the prior counts.
    """
    mean = _Mean(chart, scores, paths, weights, posterior)
    return chart.at(mean.newton(z) if scores.twice else mean.bfgs(z)).theta


class _Mean:
    """The weighted mean of the log density over trajectories, as a function of z."""

    def __init__(
        self, chart: Chart, scores: CompleteScores, paths: Sequence[np.ndarray],
        weights: np.ndarray, posterior: bool,
    ):  # fmt: skip
        self.chart, self.scores, self.posterior = chart, scores, posterior
        self.paths, self.weights = paths, weights

    def at(self, z: np.ndarray) -> _Height | None:
        """None outside of the support, or where nothing is finite."""
        point = self.chart.at(z)
        if point.log_prior == -np.inf:
            return None
        values, gradients = self.scores.value_and_gradient(point.theta, self.paths)
        value, gradient = float(self.weights @ values), self.weights @ gradients
        slope = point.pull(gradient)
        if self.posterior:
            value, slope = value + point.log_prior, slope + point.d_log_prior
        finite = np.isfinite(value) and np.all(np.isfinite(slope))
        return _Height(point, value, slope, gradient) if finite else None

    def first(self, z: np.ndarray) -> _Height | None:
        """`at` where a climb begins.

        Raises
        ------
        SamplingError : there is a value, and no slope.
        """
        here = self.at(z)
        if here is None:
            point = self.chart.at(z)
            values, gradients = self.scores.value_and_gradient(point.theta, self.paths)
            value, gradient = float(self.weights @ values), self.weights @ gradients
            if reason := self.chart.without_slope(value, point.theta, gradient):
                raise SamplingError(
                    f"the log density of the states cannot be climbed: {reason}", fix=ELSEWHERE
                )
        return here

    def curvature(self, z: np.ndarray, height: _Height) -> np.ndarray:
        """Second derivatives in z, (F, F)."""
        j = height.point.jacobian
        second = np.tensordot(
            self.weights, self.scores.hessian(height.point.theta, self.paths), axes=1
        )
        bent = self.chart.curvature(z, height.gradient)
        out = j.T @ second @ j + bent.theta
        return out + bent.log_prior if self.posterior else out

    def newton(self, z: np.ndarray) -> np.ndarray:
        """The top by Newton's steps, halved until the mean rises; see `analysis/climber.py`."""
        here = self.first(z)
        if here is None:
            return z
        for _ in range(STEPS):
            curvature = self.curvature(z, here)
            if not np.all(np.isfinite(curvature)):
                return self.bfgs(z)
            step = uphill(here.slope, curvature)
            if float(here.slope @ step) < LAST_STEP:
                return z + step
            step *= min(1.0, LONGEST_STEP / float(np.linalg.norm(step)))
            higher = self._higher(z, step, here.value)
            if higher is None:
                break
            z, here = higher
        return z

    def _higher(
        self, z: np.ndarray, step: np.ndarray, value: float
    ) -> tuple[np.ndarray, _Height] | None:
        """The first point above `value` at z + step, z + step / 2, ...; None where none is."""
        for k in range(HALVINGS):
            point = z + 0.5**k * step
            there = self.at(point)
            if there is not None and there.value > value:
                return point, there
        return None

    def bfgs(self, z: np.ndarray) -> np.ndarray:
        """The top by BFGS."""

        def negative(z: np.ndarray) -> tuple[float, np.ndarray]:
            height = self.at(z)
            if height is None:
                return np.inf, np.zeros(len(z))
            return -height.value, -height.slope

        self.first(z)
        found = scipy.optimize.minimize(
            negative, z, jac=True, method="BFGS", options={"maxiter": BFGS_STEPS}
        )
        return found.x if found.fun <= negative(z)[0] else z
