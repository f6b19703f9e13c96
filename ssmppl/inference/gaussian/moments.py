"""Approximate moments and draws of the states: filters and smoothers of the Gaussian approximation.

"extended" and "unscented" are filters, and smooth as Rauch, Tung and Striebel (1965) do, with what
each filter made linear (Särkkä 2008, "Unscented Rauch-Tung-Striebel smoother", *IEEE Transactions
on Automatic Control* 53). "laplace" is the Gaussian distribution round the mode of all states
together; as a filter it is that of the data up to each row, so that T rows cost T (T + 1) / 2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssmppl.codegen.modules.gaussian import FilterMoments, GaussianApproximation, Mode
from ssmppl.data import Experiment, spelled
from ssmppl.errors import ArgumentError, NotApplicable, SamplingError
from ssmppl.inference.exact.kalman import KalmanMoments
from ssmppl.inference.exact.kalman_matrices import SmoothedMoments
from ssmppl.inference.run.problem import Problem

NAMES = {
    "laplace": "Laplace's approximation", "extended": "extended Kalman filter",
    "unscented": "unscented Kalman filter",
}  # fmt: skip
ROUNDING = 1e-12  # of an eigenvalue of a covariance, as a correlation, below which it is none


@dataclass(frozen=True)
class ApproximateKalman:
    """Filter, smoother and draws of one kind: "laplace", "extended" or "unscented"."""

    problem: Problem
    approximation: GaussianApproximation
    kind: str

    def filter(self, e: Experiment, theta: np.ndarray) -> KalmanMoments:
        """The filter's moments and predictions at theta (P,), of one experiment.

        Raises
        ------
        ArgumentError : predictions need moments of the observations, which some distribution has
            not.
        SamplingError : the approximation is not finite.
        """
        given = theta, e.y, e.seen, e.u
        if self.kind == "unscented":
            found = self.approximation.unscented(*given)
            if found is None:
                raise self._nowhere(theta)
            moments, y_mean, y_covariance = found
        else:
            if isinstance(self.approximation.by_points, NotApplicable):
                why = self.approximation.by_points
                raise ArgumentError(
                    f"there are no predictions to tell: {why.reason}", where=why.where,
                    fix="use ssm.smooth, or ssm.particle_filter",
                )  # fmt: skip
            moments = self._extended(e, theta) if self.kind == "extended" else self._laplace(
                e, theta
            )  # fmt: skip
            y_mean, y_covariance = self.approximation.predictions(
                *given, moments.predicted, moments.predicted_covariance
            )
        return KalmanMoments(
            moments.increments, moments.mean, moments.covariance, moments.predicted,
            moments.predicted_covariance, y_mean, y_covariance,
        )  # fmt: skip

    def smooth(
        self, e: Experiment, theta: np.ndarray, filtered: FilterMoments | None = None
    ) -> SmoothedMoments:
        """Moments given all data at theta (P,), of one experiment; `filtered` where known.

        Raises
        ------
        SamplingError : the approximation is not finite.
        """
        if self.kind == "laplace":
            mode = self._mode(e, theta)
            covariance, cross = self.approximation.laplace_moments(mode)
            return SmoothedMoments(mode.x, covariance, cross, mode.log_likelihood)
        found = filtered or self.filtered(e, theta)
        mean, covariance = found.mean.copy(), found.covariance.copy()
        cross = np.zeros_like(covariance)
        gains = _gains(found)
        for t in range(e.steps - 2, -1, -1):
            gain = gains[t + 1]
            off = covariance[t + 1] - found.predicted_covariance[t + 1]
            mean[t] += gain @ (mean[t + 1] - found.predicted[t + 1])
            covariance[t] += gain @ off @ gain.T
            cross[t + 1] = covariance[t + 1] @ gain.T
        return SmoothedMoments(mean, covariance, cross, float(np.sum(found.increments)))

    def draw(
        self, e: Experiment, theta: np.ndarray, rng: np.random.Generator, draws: int,
        filtered: FilterMoments | None = None,
    ) -> tuple[float, np.ndarray]:  # fmt: skip
        """The log-likelihood, and draws (draws, T, D) of the trajectory, of one experiment;
        `filtered` where known.

        Raises
        ------
        SamplingError : the approximation is not finite.
        """
        steps, d = e.steps, len(self.problem.trace.state_symbols)
        out = np.empty((draws, steps, d))
        if self.kind == "laplace":
            mode = self._mode(e, theta)
            model = self.approximation.found
            r = len(model.initial.noise), len(model.transition.noise)
            off = np.zeros((draws, d))
            for t in range(steps):
                n = r[1] if t else r[0]
                noise = np.linalg.solve(
                    mode.root[t, :n, :n].T, rng.standard_normal((n, draws))
                ).T - (off @ mode.gain[t, :n].T if t else 0.0)
                off = noise @ mode.spread[t, :, :n].T + (off @ mode.jacobian[t].T if t else 0.0)
                out[:, t] = mode.x[t] + off
            return mode.log_likelihood, out
        found = filtered or self.filtered(e, theta)
        gains, left = _gains(found), found.covariance.copy()
        left[:-1] -= gains[1:] @ found.cross[1:].transpose(0, 2, 1)
        noise = rng.standard_normal((steps, draws, d)) @ _roots(left)[::-1].transpose(0, 2, 1)
        for t in range(steps - 1, -1, -1):
            mean = found.mean[t][None]
            if t + 1 < steps:
                mean = mean + (out[:, t + 1] - found.predicted[t + 1]) @ gains[t + 1].T
            out[:, t] = mean + noise[steps - 1 - t]
        return float(np.sum(found.increments)), out

    def filtered(self, e: Experiment, theta: np.ndarray) -> FilterMoments:
        """The filter's moments, of "extended" and "unscented".

        Raises
        ------
        SamplingError : they are not finite.
        """
        if self.kind == "extended":
            return self._extended(e, theta)
        found = self.approximation.unscented(theta, e.y, e.seen, e.u)
        if found is None:
            raise self._nowhere(theta)
        return found[0]

    def _extended(self, e: Experiment, theta: np.ndarray) -> FilterMoments:
        found = self.approximation.extended(theta, e.y, e.seen, e.u)
        if found is None:
            raise self._nowhere(theta)
        return found

    def _mode(self, e: Experiment, theta: np.ndarray) -> Mode:
        return self._mode_to(e, theta, e.seen, None)

    def _mode_to(
        self, e: Experiment, theta: np.ndarray, seen: np.ndarray, noise: np.ndarray | None
    ) -> Mode:
        """Of the first rows, as many as `seen` has."""
        n = len(seen)
        mode = self.approximation.laplace(theta, e.y[:n], seen, e.u[:n], noise)
        if mode is None:
            raise self._nowhere(theta)
        return mode

    def _laplace(self, e: Experiment, theta: np.ndarray) -> FilterMoments:
        """The distribution of x_t round the mode given the data up to t, for each t."""
        steps, d = e.steps, len(self.problem.trace.state_symbols)
        out = FilterMoments(
            np.empty(steps), np.empty((steps, d)), np.empty((steps, d, d)), np.empty((steps, d)),
            np.empty((steps, d, d)), np.zeros((steps, d, d)),
        )  # fmt: skip
        before, noise = 0.0, None
        seen = e.seen.copy()
        for t in range(steps):
            seen[t] = 0.0  # the law of x_t before y_t is looked at
            ahead = self._mode_to(e, theta, seen[: t + 1], noise)
            covariance, _ = self.approximation.laplace_moments(ahead)
            out.predicted[t], out.predicted_covariance[t] = ahead.x[t], covariance[t]
            seen[t] = e.seen[t]
            mode = self._mode_to(e, theta, seen[: t + 1], ahead.e)
            covariance, _ = self.approximation.laplace_moments(mode)
            out.mean[t], out.covariance[t] = mode.x[t], covariance[t]
            out.increments[t], before = mode.log_likelihood - before, mode.log_likelihood
            noise = np.vstack([mode.e, np.zeros_like(mode.e[:1])])
        return out

    def _nowhere(self, theta: np.ndarray) -> SamplingError:
        where = next(iter(self.problem.trace.transition.values())).distribution.location
        at = spelled(self.problem.trace, theta)
        return SamplingError(
            f"{NAMES[self.kind]} is not finite (NaN or infinite); parameters: {at}",
            fix="look whether the parameters are plausible; ssm.particle_filter does without it",
            where=where,
        )


def _gains(found: FilterMoments) -> np.ndarray:
    """Gains (T, D, D): how x_{t-1} goes with x_t less its prediction; 0 in the first row."""
    out = np.zeros_like(found.cross)
    covariance = found.predicted_covariance[1:]
    scale = np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0.0))
    scale[scale == 0.0] = 1.0
    both = scale[:, :, None] * scale[:, None, :]
    alike = np.linalg.pinv(covariance / both, ROUNDING, hermitian=True)
    out[1:] = (found.cross[1:] / scale[:, None, :]) @ alike / scale[:, None, :]
    return out


def _roots(covariance: np.ndarray) -> np.ndarray:
    """Roots (T, D, D) of covariances that are positive semidefinite up to rounding."""
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.transpose(0, 2, 1)))
    root: np.ndarray = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    return root
