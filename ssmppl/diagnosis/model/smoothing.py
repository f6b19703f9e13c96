"""One pass over the data: log-likelihood, smoothed scores row by row, predictions.

A pass (`Smoother`) has exact draws of the trajectories where the model is linear and Gaussian, else
a particle filter, twisted where the model allows it, with fixed-lag smoothing over its genealogy;
see `codegen/kernels/particle/scored_filters.py`.

A model can predict one row well and drift away from reality in ten, as one-step predictions are
corrected by every observation. So the filtered states of some rows are simulated on, and the
continuous ranked probability score (CRPS) of what they give at each horizon is a statistic like the
others, whose distribution comes from simulated data sets.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtr

from ssmppl.analysis.density import Missing
from ssmppl.codegen.modules.filter_variants import compile_row_scores
from ssmppl.codegen.modules.gaussian import GaussianApproximation
from ssmppl.codegen.modules.program import Program, compile_trace
from ssmppl.codegen.native.loading import Loaded
from ssmppl.compiling import once_property
from ssmppl.data import Experiment
from ssmppl.diagnosis.model.score_columns import ScoreExpressions
from ssmppl.errors import ArgumentError, NotApplicable
from ssmppl.expressions.batched.call import OP, gathered, thriftily
from ssmppl.expressions.expr import topological
from ssmppl.inference.batched.extended import Extended, extended_model
from ssmppl.inference.exact.kalman import KalmanModel, KalmanMoments, kalman_model
from ssmppl.inference.particles.backward import ParticleSystem, particle_system
from ssmppl.inference.particles.filtering import FilterSettings
from ssmppl.inference.run.problem import Problem
from ssmppl.inference.run.seeds import fill_normal, fill_uniform
from ssmppl.inference.verbs.simulate import feeds_back

# Of a pass.
LAG = 40  # rows of the fixed-lag smoother
DRAWS = 64  # exact trajectories of a linear Gaussian model, half of them mirrored at their mean
CALLED = 4  # trajectories where a simulator is called, mirrored too
PREDICTIVE = 128  # draws behind a prediction under the twisted proposal, and of a simulator
PREDICTIVE_CALLED = 32  # likewise, where a simulator gives what is observed

# Of predictions further ahead.
HORIZONS = (1, 10, 100)  # rows
ORIGINS = 40  # rows that are simulated on from, spread evenly
ORIGINS_CALLED = 8  # likewise, where a simulator is called; all far enough from the end
CRPS_DRAWS = 24  # from each
CRPS_DRAWS_CALLED = 8  # likewise, where a simulator is called: the score is fair for any number
FEWEST = 8  # of these rows, without which a horizon is left out (0 in every data set)


@dataclass(frozen=True)
class Settings:
    """Settings of a pass: the filter's particles and proposal, the smoother's lag in rows."""

    particles: int = 1000
    proposal: str = "bootstrap"
    lag: int = LAG


@dataclass(frozen=True)
class Pass:
    """Results of one pass over one experiment (T rows, F columns, K channels).

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

    def __init__(self, columns: ScoreExpressions, missing: Missing, settings: Settings):
        self.columns, self.missing, self.settings = columns, missing, settings

    def __getstate__(self) -> dict:  # another process finds the generated modules in its cache
        generated = ("program", "module", "problem")
        return {k: v for k, v in self.__dict__.items() if k not in generated}

    def with_particles(self, particles: int) -> Smoother:
        """The same with another number of particles; the two share their generated code."""
        out = Smoother(self.columns, self.missing, replace(self.settings, particles=particles))
        vars(out).update(program=self.program, module=self.module, problem=self.problem)
        return out

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
    def extended(self) -> Extended | NotApplicable:
        """The smoother of a model that calls a simulator, for which many particles take long."""
        return extended_model(self.columns.base)

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
        with thriftily(alike=True):
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
            found, weights, ancestors = _as_particles(paths)
        elif isinstance(self.extended, Extended):
            filtered, paths = self.extended.mirrored(e, own, stream, CALLED)
            found, weights, ancestors = _as_particles(paths)
            increments = filtered.increments
            if predicted:
                states, equal = _drawn(
                    filtered.predicted, filtered.predicted_covariance, stream, self._predictive
                )
                self.module.row_predictions_at(given, *data, states, equal, prediction)
                known = _drawn(filtered.mean, filtered.covariance, stream, CRPS_DRAWS_CALLED)
        else:
            system, weights = self.system(e, own, stream)
            found, ancestors, increments = system.particles, system.ancestors, system.log_increments
            if predicted:
                known = self._before_prediction(system, weights, e, own, stream)
                self.module.row_predictions(given, *data, *known, stream, prediction)
        particles = np.zeros((e.steps, len(self.columns.carried.state_symbols), found.shape[2]))
        particles[:, : found.shape[1]] = found

        def derive() -> None:
            if self.columns.follows:
                self.module.complete_rows(given, *data, particles, ancestors)
            self.module.row_scores(
                given, *data, particles, weights, ancestors, self.settings.lag, rows
            )

        if isinstance(self.extended, Extended):
            with gathered():  # a simulator moves the states of all rows at once
                derive()
        derive()
        scores = None
        if ahead and known is not None:
            feedback = feeds_back(self.columns.base)
            origins = spread_evenly(e.steps - 2, ORIGINS)
            if isinstance(self.extended, Extended):
                last = max(e.steps - 1 - max(HORIZONS), e.steps // 2)
                origins = spread_evenly(min(last, e.steps - 2), ORIGINS_CALLED)
            draws = known[1].shape[1] if isinstance(self.extended, Extended) else CRPS_DRAWS
            scores = crps_ahead(
                self.program, e, own, *known, stream, feedback, origins, draws=draws
            )
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
        """Particles (T, D, N) and weights (T, N) of the filtering distribution at each row.

        Of the filter itself; under the twisted proposal, whose particles know what comes later,
        draws from the extended Kalman filter, in pairs mirrored at its mean.
        """
        if self.settings.proposal != "twisted":
            return system.particles, system.weights
        moments = self._gaussian.filtered(theta, e.y, e.seen, e.u)
        if moments is None:
            return system.particles, system.weights
        return _drawn(*moments, stream)

    def filtered_draws(
        self, e: Experiment, theta: np.ndarray, stream: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Particles (T, D, N) and weights (T, N) of x_t given y_{1:t} at theta (P,)."""
        if isinstance(self.kalman, KalmanModel):
            moments = self.kalman.filter(e, theta)
            return _drawn(moments.mean, moments.covariance, stream)
        if isinstance(self.extended, Extended):
            found = self.extended.filter(e, theta)
            return _drawn(found.mean, found.covariance, stream, CRPS_DRAWS_CALLED)
        return self._before_prediction(*self.system(e, theta, stream), e, theta, stream)

    @once_property
    def _predictive(self) -> int:
        """Draws behind a prediction of a model that calls a simulator."""
        sites = self.columns.base.observations.values()
        roots = [e for s in sites for e in s.distribution.expressions()]
        called = any(n.op == OP for n in topological(roots))
        return PREDICTIVE_CALLED if called else PREDICTIVE

    @property
    def _gaussian(self) -> GaussianApproximation:
        found = self.program.gaussian
        assert isinstance(found, GaussianApproximation)
        return found


def _as_particles(paths: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Paths (N, T, D) as particles (T, D, N) with weights (T, N) and ancestors (T, N)."""
    n, steps = paths.shape[:2]
    ancestors = np.broadcast_to(np.arange(n, dtype=np.int32), (steps, n)).copy()
    return np.moveaxis(paths, 0, 2), np.full((steps, n), 1.0 / n), ancestors


def _drawn(
    mean: np.ndarray, covariance: np.ndarray, stream: np.ndarray, n: int = PREDICTIVE
) -> tuple[np.ndarray, np.ndarray]:
    """Particles (T, D, N), in pairs mirrored at the mean, and weights (T, N) of normal
    distributions with these moments (T, D), (T, D, D)."""
    # Rows before a flat start is known have none: what is drawn there is NaN, as their mean is.
    values, vectors = np.linalg.eigh(np.where(np.isfinite(covariance), covariance, 0.0))
    root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    normals = np.empty(mean.size * (n // 2))
    fill_normal(stream, normals)
    away = root @ normals.reshape(*mean.shape, -1)
    drawn = mean[:, :, None] + np.concatenate([away, -away], axis=2)
    return drawn, np.full((len(mean), n), 1.0 / n)


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


def crps(samples: np.ndarray, observed: np.ndarray) -> np.ndarray:
    """(T,) continuous ranked probability score of predictive samples (T, M), smaller is better.

    mean |x_i - y| - sum_{i<j} |x_i - x_j| / (M (M - 1)): fair, i.e. unbiased for the score of the
    distribution that the M samples come from (Gneiting and Raftery 2007; Zamo and Naveau 2018,
    equation 6). NaN where nothing was observed, or a sample is infinite.
    """
    x, y = np.sort(np.asarray(samples, float), axis=-1), np.asarray(observed, float)
    m = x.shape[-1]
    if m < 2 or x.shape[:-1] != y.shape:
        raise ArgumentError(
            f"predictive samples of shape {x.shape} for observations of shape {y.shape}",
            fix="give (T, M) samples, M at least 2, and (T,) observations",
        )
    with np.errstate(invalid="ignore", over="ignore"):
        pairs = x @ (2.0 * np.arange(1, m + 1) - m - 1.0)  # sum over pairs, by the order statistics
        score = np.mean(np.abs(x - y[..., None]), axis=-1) - pairs / (m * (m - 1.0))
    return np.where(np.isfinite(x).all(axis=-1), score, np.nan)


def spread_evenly(last: int, most: int) -> np.ndarray:
    """Rows from 0 to `last`, as many as `most`."""
    return np.unique(np.linspace(0, max(last, 0), most).astype(int))


def crps_ahead(
    program: Program, e: Experiment, theta: np.ndarray, particles: np.ndarray, weights: np.ndarray,
    stream: np.ndarray, feedback: bool, origins: np.ndarray | None = None,
    horizons: Sequence[int] = HORIZONS, draws: int = CRPS_DRAWS,
) -> np.ndarray:  # fmt: skip
    """(O, H, K) CRPS of each channel at each horizon, from the rows `origins` (O,) on, by
    default `ORIGINS` of them; NaN where nothing was observed, or the record ends before.

    particles (T, D, N), weights (T, N) : of x_t given y_{1:t}. feedback : as of `samples_ahead`.
    """
    steps, channels = e.y.shape
    if origins is None:
        origins = spread_evenly(steps - 2, ORIGINS)
    if steps < 2:
        return np.full((len(origins), len(horizons), channels), np.nan)
    at = np.array(horizons) - 1
    samples = samples_ahead(
        program, e, theta, particles, weights, stream, feedback, origins, max(horizons), draws, at
    )
    rows = origins[:, None] + np.array(horizons)
    inside = np.minimum(rows, steps - 1)
    measured = (rows < steps)[..., None] & (e.seen[inside] == 1.0)
    return crps(samples, np.where(measured, e.y[inside], np.nan))


def samples_ahead(
    program: Program, e: Experiment, theta: np.ndarray, particles: np.ndarray, weights: np.ndarray,
    stream: np.ndarray, feedback: bool, origins: np.ndarray, reach: int, draws: int,
    kept: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """(O, H, K, draws) observations simulated from the filtered states of the rows `origins` (O,)
    on, up to `reach` rows further, with the recorded inputs: those of the rows `kept` (H,) ahead,
    counted from 0. NaN behind the end of the record.

    particles (T, D, N), weights (T, N) : of x_t given y_{1:t}. feedback : a transition names
    observations; rows that lack one are then not simulated on from.
    """
    simulate, (steps, channels) = program.entry("simulate_on"), e.y.shape
    levels = np.empty(1)
    samples = np.full((len(origins), len(kept), channels, draws), np.nan)
    known = np.isfinite(particles[origins]).all(axis=(1, 2))  # not a flat start before it is
    for o, t in enumerate(origins.tolist()):
        if not known[o] or (feedback and not np.all(e.seen[t] == 1.0)):
            continue
        fill_uniform(stream, levels)
        chosen = _systematic(weights[t], float(levels[0]), draws)
        rows = min(reach, steps - 1 - t)
        states = np.empty((rows, particles.shape[1], draws))
        drawn = np.empty((rows, channels, draws))
        start = np.ascontiguousarray(particles[t][:, chosen])
        y = e.y.copy() if feedback else e.y
        simulate(theta, y, e.seen, e.u, t + 1, start, stream, states, drawn, feedback)
        inside = kept < rows
        samples[o, inside] = drawn[kept[inside]]
    return samples


def _systematic(weights: np.ndarray, level: float, draws: int) -> np.ndarray:
    """Indices of so many particles, drawn by their weights with one uniform."""
    cumulative = np.cumsum(weights)
    points = (np.arange(draws) + level) / draws * cumulative[-1]
    return np.minimum(np.searchsorted(cumulative, points), len(weights) - 1)


def mean_scores(
    scores: Sequence[np.ndarray], channels: Sequence[str]
) -> dict[str, dict[str, float]]:
    """Statistics by channel: the mean CRPS at each horizon over all rows and experiments; 0 where
    there are too few."""
    together = np.concatenate([np.empty((0, len(HORIZONS), len(channels))), *scores])
    out: dict[str, dict[str, float]] = {}
    for k, channel in enumerate(channels):
        own = out[channel] = {}
        for h, horizon in enumerate(HORIZONS):
            known = together[:, h, k]
            known = known[np.isfinite(known)]
            rows = "row" if horizon == 1 else "rows"
            own[f"CRPS {horizon} {rows} ahead"] = (
                float(known.mean()) if len(known) >= FEWEST else 0.0
            )
    return out
