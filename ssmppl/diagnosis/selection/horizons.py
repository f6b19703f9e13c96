"""How well a fitted model simulates: errors and predictive densities many rows ahead.

One-step predictions are corrected by every observation, so that a model that only describes what it
does not know, by more noise or by an unknown input that wanders, is good at them. A simulator is
used without that: what counts for it is what it says h rows ahead. So the filtered states of rows
spread over the record are simulated on with the recorded inputs and the noise as fitted. A
mechanism gains at every horizon, an unknown input within its memory, a law of the noise not in the
mean.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ssmppl.data import Experiment
from ssmppl.diagnosis.fitting.fit import Fit, Fitter
from ssmppl.diagnosis.model.smoothing import CRPS_DRAWS_CALLED, samples_ahead
from ssmppl.diagnosis.run.seeds import Stream
from ssmppl.errors import SSMError
from ssmppl.inference.batched.extended import Extended
from ssmppl.inference.run.seeds import random_state
from ssmppl.inference.run.tasks import run_tasks
from ssmppl.inference.verbs.simulate import feeds_back

HORIZONS = (1, 3, 10, 30, 100)  # rows
WINDOW = 0.1  # of the longest record: the rows of a simulation that is looked at by default
LEAST_RECORDS = 8  # of the longest record, as many times as long as a horizon that counts
SETTLING = 0.02  # of a record: the first rows, in which the filter may not know the state yet
ORIGINS = 60  # rows that are simulated on from, of each experiment at most
DRAWS = 128  # from each
LEAST_SQUARE = (
    1e-12  # of an error, and least variance, in squares of the spread of what is measured
)
LARGEST_RATIO = 100.0  # of two mean squares that counts


@dataclass(frozen=True)
class Ahead:
    """Predictions from O origins, up to R rows ahead (all experiments one below the other).

    square : (O, R, K) squared error of the mean of each channel, in units of its standard
    deviation; inf where the simulation is not finite. A mean of M draws adds a share of 1 / M of
    their variance, which is left in: it is small, and taken off it would be noise where that
    variance is large. density : (O, R) log predictive density of all channels, by the first two
    moments of the draws. NaN where nothing counts. unit : mean standard deviation of the channels.
    """

    square: np.ndarray
    density: np.ndarray
    unit: float

    def at(self, horizon: int) -> Scores:
        """So many rows ahead."""
        return self._scores(slice(horizon - 1, horizon))

    def window(self, rows: int) -> Scores:
        """Of all rows up to so many ahead, from origins behind which that many count."""
        return self._scores(slice(0, rows))

    def _scores(self, rows: slice) -> Scores:
        last = self.square[:, rows.stop - 1]
        whole = ~np.all(np.isnan(last), axis=1)
        with np.errstate(all="ignore"):
            square = _mean(self.square[whole, rows], (1, 2))
            density = _mean(self.density[whole, rows], 1)
        return Scores(square, density, self.unit)


@dataclass(frozen=True)
class Scores:
    """Squared errors (O,) and log densities a row (O,) of one horizon, of the origins that have
    them; unit : of an error of 1."""

    square: np.ndarray
    density: np.ndarray
    unit: float

    @property
    def rmse(self) -> float:
        """Root mean square error, in the unit of the data."""
        if not len(self.square):
            return float("nan")
        return self.unit * float(np.sqrt(max(float(np.mean(self.square)), 0.0)))


def look_ahead(
    fitter: Fitter, fit: Fit, experiments: Sequence[Experiment], counts: Sequence[np.ndarray],
    reach: int, seed: np.random.SeedSequence,
) -> Ahead:  # fmt: skip
    """Predictions up to `reach` rows ahead of the rows that count (T,) bool of each experiment.

    Raises
    ------
    SamplingError : the filter fails at the fit.
    """
    called = isinstance(fitter.smoother.extended, Extended)
    feedback = feeds_back(fitter.problem.trace)
    draws, spread = CRPS_DRAWS_CALLED if called else DRAWS, _spread(experiments)
    channels = len(spread)

    def one(i: int) -> tuple[np.ndarray, np.ndarray]:
        e, count, stream = experiments[i], counts[i], random_state(seed, Stream.AHEAD, i)
        rows = np.flatnonzero(count)
        if not len(rows) or e.steps < 2:
            return np.empty((0, reach, channels)), np.empty((0, reach))
        settled = round(SETTLING * e.steps)
        first, last = max(int(rows[0]) - 1, settled), max(int(rows[-1]) - 1, settled)
        origins = np.unique(np.linspace(first, last, ORIGINS).astype(int))
        particles, weights = fitter.smoother.filtered_draws(e, fit.theta, stream)
        samples = samples_ahead(
            fitter.smoother.program, e, fit.theta, particles, weights, stream, feedback, origins,
            reach, draws, np.arange(reach),
        )  # fmt: skip
        at = origins[:, None] + 1 + np.arange(reach)
        inside = np.minimum(at, e.steps - 1)
        known = (at < e.steps) & count[inside]
        seen = known[..., None] & (e.seen[inside] == 1.0)
        return _compared(samples, np.where(seen, e.y[inside], np.nan), spread)

    found = run_tasks(one, range(len(experiments)))
    square, density = (np.concatenate([f[k] for f in found]) for k in (0, 1))
    return Ahead(square, density, float(np.mean(spread)))


def _spread(experiments: Sequence[Experiment]) -> np.ndarray:
    """(K,) standard deviation of each channel over all rows; 1 where it does not vary."""
    y = np.concatenate([np.where(e.seen == 1.0, e.y, np.nan) for e in experiments])
    found = np.array([np.nanstd(c) if np.isfinite(c).any() else 0.0 for c in y.T])
    return np.where(found > 0.0, found, 1.0)


def _compared(
    samples: np.ndarray, observed: np.ndarray, spread: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Squared errors (O, R, K) and log densities (O, R) of samples (O, R, K, M) for observed (O, R,
    K), both NaN where nothing was measured or simulated."""
    # NaN in all draws: not simulated on from. Not finite in some: gone astray.
    simulated = ~np.isnan(samples).all(axis=-1)
    finite = np.isfinite(samples).all(axis=-1)
    with np.errstate(all="ignore"):
        mean, variance = samples.mean(axis=-1) / spread, samples.var(axis=-1, ddof=1) / spread**2
        error = (observed / spread - mean) ** 2
        variance = np.maximum(variance, LEAST_SQUARE)
        density = -0.5 * (error / variance + np.log(2.0 * np.pi * variance)) - np.log(spread)
    measured = np.isfinite(observed) & simulated
    error = np.where(measured, np.where(finite, error, np.inf), np.nan)
    density = np.where(measured, np.where(finite, density, -np.inf), 0.0).sum(axis=-1)
    return error, np.where(measured.any(axis=-1), density, np.nan)


def _mean(values: np.ndarray, axes: int | tuple[int, ...]) -> np.ndarray:
    """The mean of what is not NaN."""
    known = ~np.isnan(values)
    total: np.ndarray = np.where(known, values, 0.0).sum(axis=axes) / known.sum(axis=axes)
    return total


@dataclass(frozen=True)
class SimulationGain:
    """What predictions more than one row ahead gain, in nats; the measure by which fits are ranked
    beside their likelihood.

    At a horizon of h rows about one in h errors of R rows tells something new, and no more than are
    simulated. With their variance unknown the log-likelihood of n errors is -n / 2 log of their
    mean square, which rises by n / 2 log(before / after); these are added over the horizons and the
    channels.

    horizons : that count. window : rows of the simulations that the report leads with. rows : (K,)
    measured rows of each channel. before : (H + 1, K) mean squares of the model as it is, the last
    row those of the windows. seed : of the simulations, the same for all models. origins : of the
    simulations, in all experiments.
    """

    horizons: tuple[int, ...]
    window: int
    rows: np.ndarray
    before: np.ndarray
    seed: np.random.SeedSequence
    origins: int

    @classmethod
    def of(
        cls, fitter: Fitter, fit: Fit, train: Sequence[Experiment], seed: np.random.SeedSequence,
        window: int | None = None,
    ) -> SimulationGain:  # fmt: skip
        longest = max(e.steps for e in train)
        horizons = tuple(h for h in HORIZONS[1:] if LEAST_RECORDS * h <= longest)
        rows = np.sum([(e.seen == 1.0).sum(axis=0) for e in train], axis=0)
        nothing = np.full((len(horizons) + 1, len(rows)), np.nan)
        reach = min(window or max(1, round(WINDOW * longest)), max(longest // 2, 1))
        out = cls(horizons, reach, rows, nothing, seed, ORIGINS * len(train))
        return replace(out, before=out.mean_squares(fitter, fit, train))

    def gain(self, after: np.ndarray) -> float:
        """Nats of a model with these mean squares (H + 1, K), by the horizons."""
        if not self.horizons:
            return 0.0
        before, after = (np.maximum(v[:-1], LEAST_SQUARE) for v in (self.before, after))
        with np.errstate(all="ignore"):
            ratio = before / after
        ratio = np.where(np.isnan(ratio), 1.0, ratio)  # not measured, or astray before and after
        ratio = np.clip(ratio, 1.0 / LARGEST_RATIO, LARGEST_RATIO)
        share = np.minimum(self.rows / np.array(self.horizons)[:, None], self.origins) / 2.0
        return float(np.sum(share * np.log(ratio)))

    def mean_squares(self, fitter: Fitter, fit: Fit, train: Sequence[Experiment]) -> np.ndarray:
        """(H + 1, K) mean squared errors of each channel, in squares of its standard deviation:
        so many rows ahead, then of the windows; inf where the filter fails."""
        try:
            counts = [np.ones(e.steps, dtype=bool) for e in train]
            reach = max((*self.horizons, self.window))
            found = look_ahead(fitter, fit, train, counts, reach, self.seed)
        except SSMError:
            return np.full(self.before.shape, np.inf)
        ended = ~np.all(np.isnan(found.square[:, self.window - 1]), axis=1)
        with np.errstate(all="ignore"):
            return np.stack([
                *(_mean(found.square[:, h - 1], 0) for h in self.horizons),
                _mean(found.square[ended, : self.window], (0, 1)),
            ])  # fmt: skip


def window_error(squares: np.ndarray) -> float:
    """Mean squared error of the windows over the channels, from `SimulationGain.mean_squares`."""
    own = squares[-1]
    return float(np.nanmean(own)) if np.isfinite(own).any() else np.inf
