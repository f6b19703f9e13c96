"""Smoothed moments, disturbances and draws of a linear Gaussian model; the kernels' results.

See `codegen/kernels/kalman_smoother.py` for the methods.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssmppl.codegen.exact import exact_entry
from ssmppl.codegen.kernels.kalman import OK
from ssmppl.codegen.kernels.kalman_steps import Matrices
from ssmppl.data import Experiment
from ssmppl.inference.totals import total_of


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
