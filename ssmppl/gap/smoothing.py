"""One pass over the data: log-likelihood, smoothed scores row by row, one-step predictions.

Exact draws of the trajectories where the model is linear and Gaussian, else a particle filter,
twisted where the model allows it, with fixed-lag smoothing over its genealogy; see
`codegen/kernels/row_scores.py`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from ssmppl.analysis.density import Missing
from ssmppl.codegen.kernels.random import fill_normal, fill_uniform
from ssmppl.codegen.loading import Loaded
from ssmppl.codegen.program import Program, compile_trace
from ssmppl.codegen.row_scores import compile_row_scores
from ssmppl.codegen.twisted import TwistedFilter
from ssmppl.compiling import once_property
from ssmppl.data import Experiment
from ssmppl.errors import NotApplicable
from ssmppl.gap.ahead import crps_ahead
from ssmppl.gap.columns import Columns
from ssmppl.inference.exact.kalman import KalmanModel, KalmanMoments, kalman_model
from ssmppl.inference.particles.backward import ParticleSystem, particle_system
from ssmppl.inference.particles.filtering import FilterSettings
from ssmppl.inference.problem import Problem
from ssmppl.inference.simulation import feeds_back

LAG = 40
DRAWS = 64  # exact trajectories of a linear Gaussian model, half of them mirrored at their mean
PREDICTIVE = 128  # draws behind a prediction under the twisted proposal


@dataclass(frozen=True)
class Settings:
    """particles : N of the filter. proposal : of the filter. lag : of the smoother, in rows."""

    particles: int = 1000
    proposal: str = "bootstrap"
    lag: int = LAG


@dataclass(frozen=True)
class Pass:
    """What one pass tells of one experiment (T rows, F columns, K channels).

    log_increments : (T,) log p(y_t | y_{1:t-1}). rows : (T, F) smoothed scores, row by row.
    prediction : (T, 4, K) mean, variance, P(Y <= y), P(Y < y) given y_{1:t-1}.
    ahead : (O, H, K) CRPS of predictions further ahead (`crps_ahead`), where it was asked for.
    covariance : (T, K, K) of the prediction, where it is exact.
    """

    log_increments: np.ndarray
    rows: np.ndarray
    prediction: np.ndarray
    ahead: np.ndarray | None = None
    covariance: np.ndarray | None = None


class Smoother:
    """Runs passes for a set of columns; the generated code is made when first asked for."""

    def __init__(self, columns: Columns, missing: Missing, settings: Settings):
        self.columns, self.missing, self.settings = columns, missing, settings

    def __getstate__(self) -> dict:  # another process finds the generated modules in its cache
        generated = ("program", "module", "problem")
        return {k: v for k, v in self.__dict__.items() if k not in generated}

    @once_property
    def program(self) -> Program:
        return compile_trace(self.columns.base, self.missing)

    @once_property
    def module(self) -> Loaded:
        c = self.columns
        return compile_row_scores(c.given, c.base, c.initial, c.later, self.missing, c.follows)

    @once_property
    def kalman(self) -> KalmanModel | NotApplicable:
        return kalman_model(self.columns.base)

    @once_property
    def problem(self) -> Problem:
        return Problem(self.columns.base, (), self.program)

    def run(
        self, experiments: Sequence[Experiment], theta: np.ndarray, stream: np.ndarray,
        *, predicted: bool = True, ahead: bool = False,
    ) -> list[Pass]:  # fmt: skip
        """A pass over each experiment at theta, the values of `columns.given`'s parameters.

        The stream is advanced in place. predicted : whether the predictions are wanted, which are
        NaN where they are not and cost something; ahead : likewise those of more than one row.

        Raises
        ------
        SamplingError : all weights vanish, or are NaN; names the step and the parameters.
        """
        return [self._one(e, theta, stream, predicted or ahead, ahead) for e in experiments]

    def _one(
        self, e: Experiment, theta: np.ndarray, stream: np.ndarray, predicted: bool, ahead: bool
    ) -> Pass:
        given, data = theta, (e.y, e.seen, e.u)
        own = given[: len(self.columns.base.parameter_symbols)]
        rows = np.empty((e.steps, len(self.columns.later)))
        prediction = np.full((e.steps, 4, e.y.shape[1]), np.nan)
        known: tuple[np.ndarray, np.ndarray] | None = None
        together = None
        if isinstance(self.kalman, KalmanModel):
            moments = self.kalman.filter(e, own)
            increments, together = _exact(moments, e, prediction), moments.observation_covariance
            if ahead:
                known = _drawn(moments.mean, moments.covariance, stream)
            # Antithetic: scores that are linear in the states come out exact.
            paths = self.kalman.draw(e, own, stream, DRAWS // 2)
            paths = np.concatenate([paths, 2.0 * self.kalman.smooth(e, own).mean - paths])
            found = np.moveaxis(paths, 0, 2)
            weights = np.full((e.steps, DRAWS), 1.0 / DRAWS)
            ancestors = np.broadcast_to(np.arange(DRAWS, dtype=np.int32), weights.shape).copy()
        else:
            system, weights = self.system(e, own, stream)
            found, ancestors, increments = system.particles, system.ancestors, system.log_increments
            if predicted:
                known = self._before_prediction(system, weights, e, own, stream)
                self.module.row_predictions(given, *data, *known, stream, prediction)
        particles = np.zeros((e.steps, len(self.columns.carried.state_symbols), found.shape[2]))
        particles[:, : found.shape[1]] = found
        if self.columns.follows:
            self.module.complete_rows(given, *data, particles, ancestors)
        self.module.row_scores(given, *data, particles, weights, ancestors, self.settings.lag, rows)
        scores = None
        if ahead and known is not None:
            feedback = feeds_back(self.columns.base)
            scores = crps_ahead(self.program, e, own, *known, stream, feedback)
        return Pass(increments, rows, prediction, scores, together)

    def system(
        self, e: Experiment, theta: np.ndarray, stream: np.ndarray
    ) -> tuple[ParticleSystem, np.ndarray]:
        """All particles of one run at theta (P,), and weights (T, N) for smoothing.

        Under the twisted proposal those by which the next generation was drawn, which know all the
        data: the filter's own tell what was known at a row, and few particles matter to them.
        """
        settings = FilterSettings(self.settings.particles, self.settings.proposal)
        system = particle_system(self.problem, theta, settings, e, stream)
        if self.settings.proposal != "twisted":
            return system, system.weights
        n = settings.particles
        offspring = [np.bincount(a, minlength=n) / n for a in system.ancestors[1:]]
        return system, np.array([*offspring, system.weights[-1]])

    def _before_prediction(
        self, system: ParticleSystem, weights: np.ndarray, e: Experiment, theta: np.ndarray,
        stream: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
        """Particles (T, D, N) and weights (T, N) that tell what was known at each row.

        Of the filter itself; under the twisted proposal, whose particles know what comes later,
        draws from the extended Kalman filter, in pairs mirrored at its mean.
        """
        if self.settings.proposal != "twisted":
            return system.particles, system.weights
        moments = self._twisted.filtered(theta, e.y, e.seen, e.u)
        if moments is None:
            return system.particles, system.weights
        return _drawn(*moments, stream)

    @property
    def _twisted(self) -> TwistedFilter:
        found = self.program.twisted
        assert isinstance(found, TwistedFilter)
        return found


def _drawn(
    mean: np.ndarray, covariance: np.ndarray, stream: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Particles (T, D, N), in pairs mirrored at the mean, and weights (T, N) of normal laws with
    these moments (T, D), (T, D, D)."""
    # Rows before a flat start is known have none: what is drawn there is NaN, as their mean is.
    values, vectors = np.linalg.eigh(np.where(np.isfinite(covariance), covariance, 0.0))
    root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    normals = np.empty(mean.size * (PREDICTIVE // 2))
    fill_normal(stream, normals)
    away = root @ normals.reshape(*mean.shape, -1)
    drawn = mean[:, :, None] + np.concatenate([away, -away], axis=2)
    return drawn, np.full((len(mean), PREDICTIVE), 1.0 / PREDICTIVE)


def _exact(found: KalmanMoments, e: Experiment, prediction: np.ndarray) -> np.ndarray:
    """Fill the predictions of a linear Gaussian model; returns the increments (T,)."""
    variance = np.diagonal(found.observation_covariance, axis1=1, axis2=2)
    prediction[:, 0], prediction[:, 1] = found.observation_mean, variance
    with np.errstate(all="ignore"):
        below = ndtr((e.y - found.observation_mean) / np.sqrt(variance))
    prediction[:, 2] = prediction[:, 3] = below
    return found.log_increments


def probability_transforms(
    passes: Sequence[Pass], experiments: Sequence[Experiment], stream: np.ndarray
) -> list[np.ndarray]:
    """PIT values (T, K) of one-step predictions, randomised where a channel is discrete.

    NaN where a value is missing (Czado, Gneiting and Held 2009 for counts).
    """
    out = []
    for p, e in zip(passes, experiments, strict=True):
        upper, lower = p.prediction[:, 2], p.prediction[:, 3]
        uniforms = np.empty(upper.size)
        fill_uniform(stream, uniforms)
        value = lower + uniforms.reshape(upper.shape) * (upper - lower)
        out.append(np.where(e.seen == 1.0, value, np.nan))
    return out
