"""The exact filter of linear Gaussian models (Kalman 1960), and what follows from it.

Applies where `structure.linear_gaussian` does. The matrices are evaluated by the interpreter, all
time steps at once, and handed to the compiled filter of `codegen/kernels/kalman.py`; the smoother
and the sampler are in `kalman_moments.py`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from ssmppl.analysis.structure import LinearGaussian, linear_gaussian
from ssmppl.codegen.exact import exact_entry
from ssmppl.codegen.kernels.kalman import OK
from ssmppl.codegen.kernels.kalman_steps import Matrices
from ssmppl.codegen.program import Program
from ssmppl.data import Experiment
from ssmppl.errors import ArgumentError, NotApplicable
from ssmppl.inference.exact import kalman_matrices
from ssmppl.inference.exact.kalman_diffuse import check_agreement, diffuse_filter, start_of
from ssmppl.inference.exact.kalman_moments import (
    Disturbances,
    SmoothedMoments,
    Stopped,
    drawn,
    smoothed,
)
from ssmppl.inference.exact.kalman_score import Slopes, check_free, score, slopes
from ssmppl.inference.exact.scored import Scored
from ssmppl.inference.totals import total_of
from ssmppl.language.traced import Trace, once_per_trace

__all__ = [
    "Disturbances",
    "KalmanModel",
    "KalmanMoments",
    "Matrices",
    "SmoothedMoments",
    "kalman_filter",
    "kalman_log_likelihood",
    "kalman_model",
]


@dataclass(frozen=True)
class KalmanMoments:
    """What the exact filter tells about one experiment (T steps, D states, K components of y).

    log_increments : (T,) log p(y_t | y_{1:t-1}), 0 where nothing was measured.
    mean, covariance : (T, D), (T, D, D) of x_t given y_{1:t}; states in the trace's order.
    mean_predicted, covariance_predicted : those of x_t given y_{1:t-1}.
    observation_mean, observation_covariance : (T, K), (T, K, K) of y_t given y_{1:t-1}.
    """

    log_increments: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray
    mean_predicted: np.ndarray
    covariance_predicted: np.ndarray
    observation_mean: np.ndarray
    observation_covariance: np.ndarray

    @property
    def log_likelihood(self) -> float:
        return total_of(self.log_increments)


@dataclass(frozen=True)
class KalmanModel(Scored):
    """A traced model as a linear Gaussian one, and its filter."""

    form: LinearGaussian

    def matrices(self, experiment: Experiment, theta: np.ndarray) -> Matrices:
        """The matrices at theta (P,), for the rows of one experiment."""
        return kalman_matrices.matrices(self.trace, self.form, experiment, theta)

    def log_likelihood(self, experiments: Iterable[Experiment], theta: np.ndarray) -> float:
        """log p(y | theta), summed over experiments; -inf where it does not exist at theta.

        A Flat component of x_1 counts with density 1.

        Raises
        ------
        SamplingError : the data do not tell the start of a Flat component.
        """
        d, k = len(self.trace.state_symbols), len(self.trace.observation_symbols)
        nothing = (
            np.empty((0, d)), np.empty((0, d, d)), np.empty((0, d)), np.empty((0, d, d)),
            np.empty((0, k)), np.empty((0, k, k)),
        )  # fmt: skip
        total = 0.0
        for e in experiments:
            model, increments = self.matrices(e, theta), np.empty(e.steps)
            if self.form.flat:
                try:
                    total += start_of(self.trace, self.form.flat, model, e).log_density(np.nan)
                except Stopped:
                    return -np.inf
                continue
            exact_entry("kalman_filter")(*model, e.y, e.seen, increments, *nothing)
            total += total_of(increments)
        return total

    def filter(self, experiment: Experiment, theta: np.ndarray) -> KalmanMoments:
        """The filter's moments and predictions.

        While the data do not tell a Flat component of x_1, what depends on it has variance inf and
        mean NaN; the increments of the log-likelihood of those steps have a meaning in sum only.

        Raises
        ------
        SamplingError : the laws have no density at theta; names the step and the parameters.
        """
        d, k, steps = (
            len(self.trace.state_symbols), len(self.trace.observation_symbols), experiment.steps
        )  # fmt: skip
        out = KalmanMoments(
            np.empty(steps), np.empty((steps, d)), np.empty((steps, d, d)),
            np.empty((steps, d)), np.empty((steps, d, d)),
            np.empty((steps, k)), np.empty((steps, k, k)),
        )  # fmt: skip
        model, arrays = self.matrices(experiment, theta), vars(out).values()
        if self.form.flat:
            try:
                diffuse_filter(model, self.form.flat, experiment, *arrays)
            except Stopped as stop:
                raise kalman_matrices.failure(self.trace, theta, stop.status, stop.t) from None
            return out
        status, t = exact_entry("kalman_filter")(*model, experiment.y, experiment.seen, *arrays)
        if status != OK:
            raise kalman_matrices.failure(self.trace, theta, status, t)
        return out

    def smooth(self, experiment: Experiment, theta: np.ndarray) -> SmoothedMoments:
        """Moments of all states given all data (Rauch, Tung and Striebel 1965).

        Raises
        ------
        SamplingError : the laws have no density at theta; names the step and the parameters.
        """
        return self._smooth(experiment, theta)[0]

    def disturbances(self, experiment: Experiment, theta: np.ndarray) -> Disturbances:
        """Moments of the noises of states and observations given all data (Koopman 1993).

        Raises
        ------
        SamplingError : as of `smooth`.
        """
        found = self._smooth(experiment, theta, noises=True)[1]
        assert found is not None
        return found

    def draw(
        self, experiment: Experiment, theta: np.ndarray, stream: np.ndarray, draws: int = 1
    ) -> np.ndarray:
        """Independent draws of x_{1:T} given y_{1:T}, (draws, T, D), by backward sampling.

        stream : state of the kernels' random numbers, (4,) uint64, advanced in place.

        Raises
        ------
        SamplingError : as of `smooth`.
        """
        model = self.matrices(experiment, theta)
        try:
            start = start_of(self.trace, self.form.flat, model, experiment)
            log_given, out = drawn(model, start.columns, experiment, stream, draws)
        except Stopped as stop:
            raise kalman_matrices.failure(self.trace, theta, stop.status, stop.t) from None
        check_agreement(self.trace, start, log_given)
        return out

    def score(
        self, experiments: Iterable[Experiment], theta: np.ndarray, free: np.ndarray | None = None
    ) -> tuple[float, np.ndarray]:
        """log p(y | theta) and its gradient (P,), summed over experiments, exact.

        free : (P,) bool, the parameters that matter; the gradient is 0 in the others. None: all.
        Where the density does not exist at theta: -inf, and NaN for the gradient.

        Raises
        ------
        ArgumentError : a matrix has no derivative in a free parameter; names it and the reason.
        """
        wanted = np.ones(len(theta), dtype=bool) if free is None else np.asarray(free, dtype=bool)
        found = _slopes(self.trace)
        check_free(self.trace, found, wanted)
        total, gradient = 0.0, np.zeros(len(theta))
        for e in experiments:
            model = self.matrices(e, theta)
            try:
                start = start_of(self.trace, self.form.flat, model, e)
                log_given, slope = score(self.trace, found, model, start.columns, e, theta)
            except Stopped:
                return -np.inf, np.where(wanted, np.nan, 0.0)
            check_agreement(self.trace, start, log_given)
            total, gradient = total + start.log_density(log_given), gradient + slope
        return total, np.where(wanted, gradient, 0.0)

    def _smooth(
        self, experiment: Experiment, theta: np.ndarray, noises: bool = False
    ) -> tuple[SmoothedMoments, Disturbances | None]:
        model = self.matrices(experiment, theta)
        try:
            start = start_of(self.trace, self.form.flat, model, experiment)
            found, noise = smoothed(model, start.columns, experiment, noises)
        except Stopped as stop:
            raise kalman_matrices.failure(self.trace, theta, stop.status, stop.t) from None
        check_agreement(self.trace, start, found.log_likelihood)
        return replace(found, log_likelihood=start.log_density(found.log_likelihood)), noise


_form = once_per_trace(linear_gaussian)


def kalman_model(source: Trace | Program) -> KalmanModel | NotApplicable:
    """The linear Gaussian form of a traced model, derived once; or the reason why it has none."""
    trace = source.trace if isinstance(source, Program) else source
    form = _form(trace)
    return form if isinstance(form, NotApplicable) else KalmanModel(trace, form)


@once_per_trace
def _slopes(trace: Trace) -> Slopes:
    """The derivatives of a linear Gaussian model's matrices."""
    form = _form(trace)
    assert not isinstance(form, NotApplicable)
    return slopes(trace, form)


def _applicable(source: Trace | Program) -> KalmanModel:
    model = kalman_model(source)
    if isinstance(model, NotApplicable):
        raise ArgumentError(
            f"the model is not linear and Gaussian: {model.reason}",
            fix='use a particle filter, proposal="auto"',
            where=model.where,
        )
    return model


def kalman_log_likelihood(
    source: Trace | Program, experiments: Iterable[Experiment], theta: np.ndarray
) -> float:
    """Exact log p(y | theta), theta (P,), summed over experiments; -inf where there is none.

    Raises
    ------
    ArgumentError : the model is not linear and Gaussian; gives the reason and the line.
    """
    return _applicable(source).log_likelihood(experiments, theta)


def kalman_filter(
    source: Trace | Program, experiment: Experiment, theta: np.ndarray
) -> KalmanMoments:
    """Everything that the exact filter tells about one experiment at theta (P,).

    Raises
    ------
    ArgumentError : the model is not linear and Gaussian.
    SamplingError : the laws have no density at theta.
    """
    return _applicable(source).filter(experiment, theta)
