"""A linear Gaussian model in numbers: its matrices, and what the kernels make of them, smoothed
moments, disturbances and draws (`codegen/kernels/kalman/smoother.py`); and what to say where its
distributions have no density.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ssmppl.codegen.kernels.kalman import square_root as kernel
from ssmppl.codegen.kernels.kalman.square_root import OK
from ssmppl.codegen.kernels.kalman.steps import Matrices
from ssmppl.codegen.modules.exact import exact_entry
from ssmppl.data import Experiment, spelled
from ssmppl.errors import SamplingError
from ssmppl.expressions.expr import Expr, symbol
from ssmppl.inference.run.invalid_laws import law_without_density_at, total_of
from ssmppl.inference.run.problem import EndToEnd
from ssmppl.language.model.trace import Trace, previous

MOST_KEPT = 4_000_000  # numbers of all roots, which the quick kernel for one draw keeps

CAUSE = {
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


def values_of(trace: Trace, experiment: Experiment, theta: np.ndarray) -> dict[Expr, np.ndarray]:
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


def failure(trace: Trace, theta: np.ndarray, status: int, t: int) -> SamplingError:
    """The error of a filter that stopped with this status at step t (from 0)."""
    found, fix = CAUSE[status]
    where = next(iter((trace.transition if t else trace.initial).values())).distribution.location
    why = ""
    if none := law_without_density_at(trace, theta):
        why, fix, where = none
    return SamplingError(
        f"{found} at t={t + 1}; parameters: {spelled(trace, theta)}" + (why and f"; {why}"),
        fix=fix,
        where=where,
    )


class Stopped(Exception):
    """A pass of the filter stopped at step t (from 0) with a status of the kernels."""

    def __init__(self, status: int, t: int):
        super().__init__(status, t)
        self.status, self.t = status, t


@dataclass(frozen=True)
class SmoothedMoments:
    """Moments of the states given all data (T steps, D states in the trace's order).

    mean (T, D), covariance (T, D, D) of x_t given y_{1:T}; cross (T, D, D): cross[t] =
    Cov(x_t, x_{t-1} | y_{1:T}), row 0 zero. log_likelihood : log p(y_{1:T}).
    """

    mean: np.ndarray
    covariance: np.ndarray
    cross: np.ndarray
    log_likelihood: float


@dataclass(frozen=True)
class Disturbances:
    """Moments of the noises given all data (T steps, D states, K components of y).

    state_mean (T, D), state_covariance (T, D, D): of x_t - A_t x_{t-1} - b_t; row 0: of x_1 - m.
    observation_mean (T, K), observation_covariance (T, K, K): of y_t - C_t x_t - d_t, missing
    components too.
    """

    state_mean: np.ndarray
    state_covariance: np.ndarray
    observation_mean: np.ndarray
    observation_covariance: np.ndarray


def smoothed(
    model: Matrices, start: np.ndarray, experiment: Experiment, noises: bool = False
) -> tuple[SmoothedMoments, Disturbances | None]:
    """The smoother's moments, and those of the noises on demand; start (D, F) as of the kernel."""
    d, (steps, k) = len(model.m), experiment.y.shape
    increments = np.empty(steps)
    moments = np.empty((steps, d)), np.empty((steps, d, d)), np.empty((steps, d, d))
    disturbances = None
    if noises:
        disturbances = Disturbances(
            np.empty((steps, d)), np.empty((steps, d, d)),
            np.empty((steps, k)), np.empty((steps, k, k)),
        )  # fmt: skip
    rest = vars(disturbances).values() if disturbances else [None] * 4
    status, t = exact_entry("smooth")(
        model, start, experiment.y, experiment.seen, increments, *moments, *rest
    )
    if status != OK:
        raise Stopped(status, t)
    return SmoothedMoments(*moments, total_of(increments)), disturbances


def drawn_by_correction(
    model: Matrices, start: np.ndarray, experiments: Sequence[Experiment], stream: np.ndarray
) -> list[np.ndarray] | None:
    """One draw (1, T, D) from p(x_{1:T} | y_{1:T}) of each experiment, which share the model; None
    where the quick kernel has none: `drawn` then has it, or says why there is none."""
    if max(e.steps for e in experiments) * len(model.m) ** 2 > MOST_KEPT:
        return None
    every = EndToEnd.of(experiments)
    out = np.empty((len(every.y), len(model.m)))
    status, _ = exact_entry("draws_by_correction")(
        model, start, every.y, every.seen, every.first, stream, out
    )
    return [x[None] for x in every.split(out)] if status == OK else None


def log_likelihoods(model: Matrices, experiments: Sequence[Experiment]) -> float:
    """log p(y), summed over experiments that share the model, whose start is known."""
    every = EndToEnd.of(experiments)
    increments, start = np.empty(len(every.y)), model.m[:, None].copy()
    exact_entry("log_likelihoods")(model, start, every.y, every.seen, every.first, increments)
    return total_of(increments)


def drawn(
    model: Matrices, start: np.ndarray, experiment: Experiment, stream: np.ndarray, draws: int
) -> tuple[float, np.ndarray]:
    """Log density of column 0, and draws (draws, T, D) from p(x_{1:T} | y_{1:T})."""
    steps = experiment.steps
    out, increments = np.empty((draws, steps, len(model.m))), np.empty(steps)
    status, t = exact_entry("draw")(
        model, start, experiment.y, experiment.seen, stream, increments, out
    )
    if status != OK:
        raise Stopped(status, t)
    return total_of(increments), out
