"""Models that call a simulator, by the extended Kalman filter: an approximation that stands where
exact likelihoods do, and is called one everywhere.

Values at one parameter vector come from the compiled filter. Gradients and second derivatives are
central differences of the log-likelihood, whose parameter vectors are all moved together
(`filter.py`): one call of the simulator a row.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from ssmppl.analysis.density import Missing
from ssmppl.analysis.structure import simulators
from ssmppl.codegen.modules.gaussian import FilterMoments, GaussianApproximation
from ssmppl.codegen.modules.program import compile_trace
from ssmppl.data import Experiment
from ssmppl.errors import NotApplicable
from ssmppl.inference.batched.filter import BatchedFilter, Moments, batched_filter
from ssmppl.inference.exact.derivatives import Scored
from ssmppl.inference.exact.kalman import KalmanMoments
from ssmppl.inference.exact.kalman_matrices import SmoothedMoments
from ssmppl.inference.gaussian.moments import ApproximateKalman
from ssmppl.inference.optimisation.parts import Predictions
from ssmppl.inference.run.problem import Problem, missing_of
from ssmppl.language.model.trace import Trace, once_per_trace

STEP = 1e-4  # of the differences for slopes, relative to the parameter
LEAST = 1e-6  # parameters nearer to zero count as this large
TELLING = 1e-6  # nats that a second difference has to be, above the rounding of differences
LONGER, ATTEMPTS = 10.0, 6  # by which a step grows that tells less, and how often
CURVE_STEP = 0.05  # of the differences for curvatures, in standard deviations
ROUNDING = 1e-12  # of an eigenvalue of a correlation matrix, below which it is none


@dataclass(frozen=True)
class Extended(Scored):
    """A traced model with a simulator, and its extended Kalman filter."""

    def log_likelihood(self, experiments: Iterable[Experiment], theta: np.ndarray) -> float:
        """log p(y | theta), summed over experiments; -inf where it is not finite."""
        data, total = tuple(experiments), 0.0
        found = self._approximation(data)
        theta = np.ascontiguousarray(theta, dtype=float)
        for e in data:
            total += found.extended_log_likelihood(theta, e.y, e.seen, e.u)
        return total

    def log_likelihoods(self, experiments: Iterable[Experiment], theta: np.ndarray) -> np.ndarray:
        """(B,) likewise, of each row of theta (B, P), with one call of a simulator a row."""
        data = tuple(experiments)
        return self._filter(data).log_likelihoods(data, theta)

    def increments(self, experiments: Iterable[Experiment], theta: np.ndarray) -> np.ndarray:
        """(B, R) likewise, of each of the rows of all experiments, whose sum that is."""
        data = tuple(experiments)
        return self._filter(data).increments(data, theta)

    def increments_and_predictions(
        self, experiments: Iterable[Experiment], theta: np.ndarray
    ) -> tuple[np.ndarray, Predictions | None]:
        """The increments, and the Gaussian predictions whose log densities they are, about; None
        where observations are not Gaussian."""
        data = tuple(experiments)
        return self._filter(data).increments_and_predictions(data, theta)

    def trajectories(
        self, experiment: Experiment, theta: np.ndarray, rng: np.random.Generator
    ) -> np.ndarray:
        """(B, T, D) a draw of x_{1:T} given y_{1:T} for each row of theta (B, P), by backward
        sampling (Rauch, Tung and Striebel's gains); NaN where the filter is not finite."""
        rows: list[Moments] = []
        data = (experiment,)
        value = self._filter(data).log_likelihoods(data, theta, rows)
        steps, (lanes, d) = len(rows), rows[0].mean.shape
        out = np.full((lanes, experiment.steps, d), np.nan)
        for t in range(steps - 1, -1, -1):
            mean, covariance = rows[t].mean, rows[t].covariance
            if t + 1 < steps:
                later = rows[t + 1]
                gain = later.cross @ _pseudoinverse(later.predicted_covariance)
                off = (out[:, t + 1] - later.predicted)[:, :, None]
                mean = mean + (gain @ off)[:, :, 0]
                covariance = covariance - gain @ later.cross.transpose(0, 2, 1)
            noise = rng.standard_normal((lanes, d, 1))
            out[:, t] = mean + (_roots(covariance) @ noise)[:, :, 0]
        out[~(value > -np.inf)] = np.nan
        return out

    def filter(self, experiment: Experiment, theta: np.ndarray) -> KalmanMoments:
        """The filter's moments and predictions.

        Raises
        ------
        SamplingError : they are not finite.
        """
        return self._kalman(experiment).filter(experiment, theta)

    def smooth(self, experiment: Experiment, theta: np.ndarray) -> SmoothedMoments:
        """Moments of all states given all data.

        Raises
        ------
        SamplingError : they are not finite.
        """
        return self._kalman(experiment).smooth(experiment, theta)

    def draw(
        self, experiment: Experiment, theta: np.ndarray, stream: np.ndarray, draws: int = 1
    ) -> np.ndarray:
        """Draws (draws, T, D) of x_{1:T} given y_{1:T}, by backward sampling; `stream` moves on."""
        return self._kalman(experiment).draw(experiment, theta, _advanced(stream), draws)[1]

    def mirrored(
        self, experiment: Experiment, theta: np.ndarray, stream: np.ndarray, draws: int
    ) -> tuple[FilterMoments, np.ndarray]:
        """The filter's moments, and draws as of `draw`, half of them mirrored at the smoothed
        mean, from one pass of the filter.

        Raises
        ------
        SamplingError : they are not finite.
        """
        kalman = self._kalman(experiment)
        found = kalman.filtered(experiment, theta)
        _, drawn = kalman.draw(experiment, theta, _advanced(stream), draws // 2, found)
        mean = kalman.smooth(experiment, theta, found).mean
        return found, np.concatenate([drawn, 2.0 * mean - drawn])

    def score(
        self, experiments: Iterable[Experiment], theta: np.ndarray, free: np.ndarray | None = None
    ) -> tuple[float, np.ndarray]:
        """log p(y | theta) and its gradient (P,), by central differences.

        free : (P,) bool, the parameters that matter; the gradient is 0 in the others. None: all.
        Where it is not finite at theta: -inf, and NaN for the gradient.
        """
        data, theta = tuple(experiments), np.asarray(theta, dtype=float)
        wanted = np.ones(len(theta), dtype=bool) if free is None else np.asarray(free, dtype=bool)
        value, first, _ = self._differences(data, theta, np.flatnonzero(wanted))
        gradient = np.where(wanted, np.nan, 0.0)
        if value > -np.inf:
            gradient[wanted] = first
        return value, gradient

    def information(
        self, experiments: Iterable[Experiment], theta: np.ndarray, free: np.ndarray | None = None
    ) -> np.ndarray:
        """Minus the second derivatives of the log-likelihood, (P, P), by differences at two steps,
        extrapolated; NaN where there are none."""
        data, theta = tuple(experiments), np.asarray(theta, dtype=float)
        wanted = np.ones(len(theta), dtype=bool) if free is None else np.asarray(free, dtype=bool)
        index = np.flatnonzero(wanted)
        out = np.zeros((len(theta), len(theta)))
        value, _, bent = self._differences(data, theta, index)
        out[np.ix_(index, index)] = np.nan
        if not (value > -np.inf and np.all(np.isfinite(bent))):
            return out
        with np.errstate(divide="ignore"):
            width = np.where(bent != 0.0, 1.0 / np.sqrt(np.abs(bent)), np.inf)
        step = CURVE_STEP * np.minimum(width, np.maximum(np.abs(theta[index]), LEAST) / CURVE_STEP)
        out[np.ix_(index, index)] = -self._curvature(data, theta, index, step)
        return out

    # -- differences
    def _differences(
        self, data: Sequence[Experiment], theta: np.ndarray, index: np.ndarray
    ) -> tuple[float, np.ndarray, np.ndarray]:
        """The value, and first and second derivatives (F,) in these parameters, with steps that
        grow until the likelihood bends by more than it rounds."""
        step = STEP * np.maximum(np.abs(theta[index]), LEAST)
        first, second = np.full(len(index), np.nan), np.full(len(index), np.nan)
        waiting, value = np.arange(len(index)), np.nan
        for attempt in range(ATTEMPTS):
            points = [theta]
            for k in waiting:
                for sign in (1.0, -1.0):
                    points.append(theta.copy())
                    points[-1][index[k]] += sign * step[k]
            found = self.log_likelihoods(data, np.array(points))
            if attempt == 0:
                value = float(found[0])
                if not value > -np.inf:
                    break
            up, down = found[1::2], found[2::2]
            again = []
            for k, a, b, above, below in zip(
                waiting, up, down, points[1::2], points[2::2], strict=True
            ):
                i = index[k]
                with np.errstate(invalid="ignore"):
                    first_new = (a - b) / (above[i] - below[i])
                    bend = a - 2.0 * value + b
                if attempt and not np.isfinite(bend):
                    continue  # the shorter step was the longest
                if not np.isfinite(bend):
                    side, there = (a, above[i]) if np.isfinite(a) else (b, below[i])
                    first[k] = (side - value) / (there - theta[i])
                    continue
                first[k], second[k] = first_new, bend / step[k] ** 2
                if abs(bend) < TELLING:
                    again.append(k)
            waiting = np.array(again, dtype=int)
            if not len(waiting):
                break
            step[waiting] *= LONGER
        return value, first, second

    def _curvature(
        self, data: Sequence[Experiment], theta: np.ndarray, index: np.ndarray, step: np.ndarray
    ) -> np.ndarray:
        """(F, F) second derivatives."""
        n, points, place = len(index), [theta], {}

        def add(k: int, i: int, a: float, j: int, b: float) -> None:
            moved = theta.copy()
            moved[index[i]] += a * step[i]
            moved[index[j]] += b * step[j] if i != j else 0.0
            place[k, i, j, np.sign(a)] = len(points)
            points.append(moved)

        for k in (1, 2):
            for i in range(n):
                for sign in (1, -1):
                    add(k, i, sign * k, i, 0.0)
                    for j in range(i):
                        add(k, i, sign * k, j, sign * k)
        found = self.log_likelihoods(data, np.array(points))
        levels = []
        with np.errstate(invalid="ignore"):
            for k in (1, 2):
                h = k * step
                out = np.empty((n, n))
                value = {key: found[p] for key, p in place.items() if key[0] == k}
                alone = [value[k, i, i, 1] - 2.0 * found[0] + value[k, i, i, -1] for i in range(n)]
                for i in range(n):
                    out[i, i] = alone[i] / h[i] ** 2
                    for j in range(i):
                        both = value[k, i, j, 1] - 2.0 * found[0] + value[k, i, j, -1]
                        out[i, j] = (both - alone[i] - alone[j]) / (2.0 * h[i] * h[j])
                        out[j, i] = out[i, j]
                levels.append(out)
            whole = (4.0 * levels[0] - levels[1]) / 3.0
        return np.where(np.isfinite(whole), whole, levels[0])

    # -- the pieces
    def _filter(self, data: Sequence[Experiment]) -> BatchedFilter:
        kept, missing = _kept(self.trace), missing_of(data)
        if missing not in kept:
            found = batched_filter(self.trace, missing)
            assert not isinstance(found, NotApplicable), found
            kept[missing] = found
        return kept[missing]

    def _approximation(self, data: Sequence[Experiment]) -> GaussianApproximation:
        found = compile_trace(self.trace, missing_of(data)).gaussian
        assert isinstance(found, GaussianApproximation), found
        return found

    def _kalman(self, e: Experiment) -> ApproximateKalman:
        problem = Problem(self.trace, (e,), compile_trace(self.trace, missing_of([e])))
        return ApproximateKalman(problem, self._approximation([e]), "extended")


def _advanced(stream: np.ndarray) -> np.random.Generator:
    """A generator that the stream's state seeds; the stream moves on."""
    rng = np.random.default_rng([int(word) for word in stream])
    stream[:] = rng.integers(1, 2**63, len(stream), dtype=np.uint64)
    return rng


def _pseudoinverse(covariance: np.ndarray) -> np.ndarray:
    """(L, D, D) of covariances that may be singular, by their correlations."""
    scale = np.sqrt(np.maximum(np.einsum("lii->li", covariance), 0.0))
    scale = np.where(scale > 0.0, scale, 1.0)
    both = scale[:, :, None] * scale[:, None, :]
    alike = np.where(np.isfinite(covariance), covariance / both, 0.0)
    found: np.ndarray = np.linalg.pinv(alike, ROUNDING, hermitian=True) / both
    return found


def _roots(covariance: np.ndarray) -> np.ndarray:
    """(L, D, D) of covariances that are positive semidefinite up to rounding."""
    fine = np.where(np.isfinite(covariance), covariance, 0.0)
    values, vectors = np.linalg.eigh(0.5 * (fine + fine.transpose(0, 2, 1)))
    found: np.ndarray = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    return found


@once_per_trace
def _kept(trace: Trace) -> dict[Missing, BatchedFilter]:
    return {}


@once_per_trace
def extended_model(trace: Trace) -> Extended | NotApplicable:
    """The filter of a model that calls a simulator; why it has none, or needs none."""
    if not simulators(trace):
        return NotApplicable("the model calls no simulator")
    found = compile_trace(trace, Missing(none=True)).gaussian if trace.observations else None
    if found is None:
        return NotApplicable("there is no observation")
    return found if isinstance(found, NotApplicable) else Extended(trace)
