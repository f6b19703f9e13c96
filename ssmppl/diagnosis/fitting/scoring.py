"""Climbs by Fisher's scoring: increments of compiled models with the predictions they come from.

Newton's climb takes second differences, F^2 values a step of F numbers. The extended Kalman filter
predicts every row, and the slopes of its predictions tell the expected information (`parts`) for
the F values that a gradient takes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ssmppl.codegen.modules.gaussian import GaussianApproximation
from ssmppl.data import Experiment
from ssmppl.diagnosis.fitting.densities import densities_of
from ssmppl.inference.batched.observed import (
    GaussianObservation,
    gaussian_observation,
    predictions_of_rows,
)
from ssmppl.inference.optimisation.batched_newton import climb_together
from ssmppl.inference.optimisation.newton import Top
from ssmppl.inference.optimisation.parts import Increments, Predictions
from ssmppl.inference.preparation.space import Space
from ssmppl.language.model.trace import Trace, once_per_trace

MOST = 2e7  # numbers of the predictions at all points of a step


def climb_by_scoring(
    space: Space, gaussian: GaussianApproximation, z: np.ndarray, shift: float
) -> Top | None:
    """The top near z (F,) of the extended filter's likelihood with the prior, to within a hundredth
    of a nat, with the expected information there. None of observations that are not Gaussian, of
    too many channels, and where there is no value. shift : nats for each data set."""
    trace, data = space.problem.trace, space.problem.experiments
    increments = increments_with_predictions(trace, gaussian, data, len(z), shift)
    if increments is None:
        return None
    found = climb_together(densities_of(space, increments), z[None], precise=False)
    return found.top if found is not None else None


def increments_with_predictions(
    trace: Trace, gaussian: GaussianApproximation, data: Sequence[Experiment], free: int,
    shift: float = 0.0,
) -> Increments | None:  # fmt: skip
    """Increments of the log-likelihood, and the predictions that they come from; None of
    observations that are not Gaussian, and of too many channels. free : numbers of a climb."""
    (observation,) = _observed(trace)
    rows, channels = sum(e.steps for e in data), len(trace.observation_symbols)
    if observation is None or (1 + 2 * free) * rows * channels**2 > MOST:
        return None

    def values(theta: np.ndarray) -> tuple[np.ndarray, Predictions]:
        rows, errors, covariances = [], [], []
        for e in data:
            found = gaussian.extended_at(theta, e.y, e.seen, e.u)
            found.increments[:, 0] += shift
            error, covariance = predictions_of_rows(
                observation, trace, e, theta, found.predicted, found.predicted_covariance
            )
            none = found.increments[:, 0] == -np.inf
            error[none], covariance[none] = 0.0, 0.0
            rows.append(found.increments)
            errors.append(error)
            covariances.append(covariance)
        return np.concatenate(rows, axis=1), Predictions(
            np.concatenate(errors, axis=1), np.concatenate(covariances, axis=1)
        )

    return values


@once_per_trace
def _observed(trace: Trace) -> tuple[GaussianObservation | None]:
    return (gaussian_observation(trace, np.arange(len(trace.state_symbols))),)
