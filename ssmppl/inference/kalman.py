"""The exact filter of linear Gaussian models (Kalman 1960).

Applies where `structure.linear_gaussian` does. The matrices are evaluated by the interpreter, all
time steps at once, and handed to the compiled filter of `codegen/kernels/kalman.py`.
"""

from __future__ import annotations

import weakref
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ssmppl.analysis.structure import LinearGaussian, linear_gaussian
from ssmppl.codegen.kernels import kalman as kernel
from ssmppl.codegen.program import Program
from ssmppl.data import Experiment, unpack_parameters
from ssmppl.errors import ArgumentError, NotApplicable, SamplingError
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import Expr, symbol
from ssmppl.language.trace import Trace, previous

__all__ = [
    "KalmanModel",
    "KalmanMoments",
    "Matrices",
    "kalman_filter",
    "kalman_log_likelihood",
    "kalman_model",
]


class Matrices(NamedTuple):
    """A linear Gaussian model in numbers, in the order of the kernel's arguments.

    m (D,), P (D, D): law of x_1. A, Q (T or 1, D, D), b (T or 1, D): into row t, row 0 without
    meaning. C (T or 1, K, D), d (T or 1, K), R (T or 1, K, K): at row t.
    """

    m: np.ndarray
    P: np.ndarray
    A: np.ndarray
    b: np.ndarray
    Q: np.ndarray
    C: np.ndarray
    d: np.ndarray
    R: np.ndarray


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
        return float(self.log_increments.sum())


_CAUSE = {
    kernel.NOT_COVARIANCE: (
        "a covariance is not positive semidefinite",
        "restrict the parameters, by their priors, to values that give variances",
    ),
    kernel.SINGULAR: (
        "the prediction of the observation has no spread",
        "give the observation noise of its own",
    ),
    kernel.NOT_FINITE: (
        "the prediction of the observation is not finite",
        "some parameter or input leads outside the domain of an operation",
    ),
}


@dataclass(frozen=True)
class KalmanModel:
    """A traced model as a linear Gaussian one, and its filter."""

    trace: Trace
    form: LinearGaussian

    def matrices(self, experiment: Experiment, theta: np.ndarray) -> Matrices:
        """The matrices at theta (P,), for the rows of one experiment."""
        values = _values(self.trace, experiment, theta)
        fields = [getattr(self.form, name) for name in Matrices._fields]
        flat = iter(evaluate([e for field in fields for e in field.ravel()], values))
        rows = [_by_row([next(flat) for _ in range(f.size)], f.shape) for f in fields]
        return Matrices(rows[0][0], rows[1][0], *rows[2:])

    def log_likelihood(self, experiments: Iterable[Experiment], theta: np.ndarray) -> float:
        """log p(y | theta), summed over experiments; -inf where it does not exist at theta."""
        d, k = len(self.trace.state_symbols), len(self.trace.observation_symbols)
        nothing = (
            np.empty((0, d)), np.empty((0, d, d)), np.empty((0, d)), np.empty((0, d, d)),
            np.empty((0, k)), np.empty((0, k, k)),
        )  # fmt: skip
        total = 0.0
        for e in experiments:
            increments = np.empty(e.steps)
            kernel.kalman_filter(*self.matrices(e, theta), e.y, e.seen, increments, *nothing)
            total += float(increments.sum())
        return total

    def filter(self, experiment: Experiment, theta: np.ndarray) -> KalmanMoments:
        """The filter's moments and predictions.

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
        status, t = kernel.kalman_filter(
            *self.matrices(experiment, theta), experiment.y, experiment.seen,
            out.log_increments, out.mean, out.covariance, out.mean_predicted,
            out.covariance_predicted, out.observation_mean, out.observation_covariance,
        )  # fmt: skip
        if status != kernel.OK:
            found, fix = _CAUSE[status]
            parameters = ", ".join(
                f"{name} = {np.array2string(np.asarray(value), precision=6)}"
                for name, value in unpack_parameters(self.trace, theta).items()
            )
            site = next(iter((self.trace.transition if t else self.trace.initial).values()))
            raise SamplingError(
                f"{found} at t={t + 1}; parameters: {parameters}",
                fix=fix,
                where=site.distribution.location,
            )
        return out


def _values(trace: Trace, experiment: Experiment, theta: np.ndarray) -> dict[Expr, np.ndarray]:
    """Values of every symbol that a matrix may depend on: numbers, or one for each row."""
    t = np.arange(experiment.steps)
    before = np.maximum(t - 1, 0)
    values: dict[Expr, np.ndarray] = dict(zip(trace.parameter_symbols, theta, strict=True))
    values[symbol("time", "t")], values[symbol("time_prev", "t")] = t + 1.0, t + 0.0
    for s, column in zip(trace.input_symbols, experiment.u.T, strict=True):
        values[s], values[previous(s)] = column, column[before]
    for s, column in zip(trace.observation_symbols, experiment.y.T, strict=True):
        values[previous(s)] = column[before]
    return values


def _by_row(entries: list[np.ndarray], shape: tuple[int, ...]) -> np.ndarray:
    """Entries, each a number or one for each row, as an array (T or 1, *shape)."""
    columns = np.broadcast_arrays(*(np.atleast_1d(e) for e in entries))
    return np.ascontiguousarray(np.stack(columns, axis=-1), dtype=float).reshape(-1, *shape)


_forms: dict[int, tuple[weakref.ref[Trace], LinearGaussian | NotApplicable]] = {}


def kalman_model(source: Trace | Program) -> KalmanModel | NotApplicable:
    """The linear Gaussian form of a traced model, derived once; or the reason why it has none."""
    trace = source.trace if isinstance(source, Program) else source
    key = id(trace)
    if key not in _forms:
        reference = weakref.ref(trace, lambda _: _forms.pop(key, None))
        _forms[key] = reference, linear_gaussian(trace)
    form = _forms[key][1]
    return form if isinstance(form, NotApplicable) else KalmanModel(trace, form)


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
