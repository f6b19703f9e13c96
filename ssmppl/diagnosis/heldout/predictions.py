"""Held-out evidence: one-step predictive densities and free runs of fitted models."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import numpy as np

from ssmppl.data import Experiment
from ssmppl.diagnosis.fitting.fit import FROM_NEARBY, Fit, Fitter
from ssmppl.diagnosis.heldout.row_split import RowSplit
from ssmppl.diagnosis.model.smoothing import Pass
from ssmppl.diagnosis.run.seeds import Stream
from ssmppl.inference.batched.extended import Extended
from ssmppl.inference.run.seeds import random_state
from ssmppl.inference.run.tasks import run_tasks

RUNS = 8  # of the particle filter
FREE_RUNS = 100  # simulations behind a free run
STRETCH, MOST_STRETCHES = 5, 40  # rows, number: as finely as held-out rows are resolved


@dataclass(frozen=True)
class Predictions:
    """One-step predictions of the rows that count, all experiments in a row (T rows, K channels).

    log_density : (R, T) of R runs. mean, variance : (T, K), over the runs. observed : (T, K), NaN
    where missing. starts : first row of each experiment that has rows that count. covariance : (T,
    K, K) of the channels of a row, where it is exact.
    """

    log_density: np.ndarray
    mean: np.ndarray
    variance: np.ndarray
    observed: np.ndarray
    starts: tuple[int, ...]
    covariance: np.ndarray | None = None


def predict(
    fitter: Fitter, fit: Fit, experiments: Sequence[Experiment], counts: Sequence[np.ndarray],
    seed: np.random.SeedSequence, executor: Executor | None = None,
) -> Predictions:  # fmt: skip
    """Filter all rows from the first with the fitted parameters, and keep those that count.

    Experiments without any are left out. executor : for the runs.
    """
    held = [i for i, c in enumerate(counts) if c.any()] or [0]
    experiments, counts = [experiments[i] for i in held], [counts[i] for i in held]
    repeats = 1 if fitter.exact or _called(fitter) else RUNS
    one = partial(_one_run, fitter, fit, experiments, counts, seed)
    passes = run_tasks(one, range(repeats), executor=executor if repeats > 1 else None)

    def kept(values: list[np.ndarray]) -> np.ndarray:
        return np.concatenate([v[c] for v, c in zip(values, counts, strict=True)])

    density = np.stack([kept([p.log_increments for p in ps]) for ps in passes])
    means = np.stack([kept([p.prediction[:, 0] for p in ps]) for ps in passes])
    spread = np.stack([kept([p.prediction[:, 1] for p in ps]) for ps in passes])
    y = kept([np.where(e.seen == 1.0, e.y, np.nan) for e in experiments])
    lengths = [int(c.sum()) for c in counts]
    starts = tuple(np.cumsum([0, *lengths[:-1]]).tolist())
    if repeats < RUNS:  # exact: no spread between runs
        density = np.repeat(density, RUNS, axis=0)
    together = [p.covariance for p in passes[0] if p.covariance is not None]
    covariance = kept(together) if len(together) == len(counts) else None
    return Predictions(density, means.mean(axis=0), spread.mean(axis=0), y, starts, covariance)


def _called(fitter: Fitter) -> bool:
    """Whether its increments are those of a filter that calls a simulator, of each row."""
    return isinstance(fitter.smoother.extended, Extended)


def _one_run(
    fitter: Fitter, fit: Fit, experiments: Sequence[Experiment], counts: Sequence[np.ndarray],
    seed: np.random.SeedSequence, r: int,
) -> list[Pass]:  # fmt: skip
    stream = random_state(seed, Stream.PREDICTIONS, r)
    passes = fitter.smoother.run(experiments, fit.theta, stream)
    for p in passes:
        p.log_increments[:1] += fitter.log_correction
    if fitter.exact or _called(fitter) or fitter.settings.proposal != "twisted":
        return passes
    return [
        replace(p, log_increments=stretches(fitter, fit, e, c, stream))
        for p, e, c in zip(passes, experiments, counts, strict=True)
    ]


def predicted_later(
    fitter: Fitter, start: Mapping[str, np.ndarray], split: RowSplit, seed: np.random.SeedSequence,
    executor: Executor | None = None,
) -> float:  # fmt: skip
    """Log predictive density of the rows of `train` that come later, fitted to the first ones.

    Raises
    ------
    SSMError : it cannot be fitted, or predicts nothing.
    """
    fit = fitter.fit(split.reference_train, seed, dict(start), FROM_NEARBY)
    found = predict(fitter, fit, split.train, split.reference_validation, seed, executor)
    return float(found.log_density.sum(axis=1).mean())


def stretches(
    fitter: Fitter, fit: Fit, e: Experiment, counts: np.ndarray, stream: np.ndarray
) -> np.ndarray:
    """(T,) log predictive densities of stretches of the rows that count, spread evenly over those
    of each that have data.

    The twisted filter tells log p(y_{1:t}) well for the t up to which it looks ahead, and for no
    other: so it is run up to the end of every stretch.
    """
    out = np.zeros(e.steps)
    length = max(STRETCH, -(-int(counts.sum()) // MOST_STRETCHES))
    edges = np.flatnonzero(np.diff(np.concatenate([[False], counts, [False]])))
    for first, last in edges.reshape(-1, 2):
        ends = [*range(first, last, length), last]
        log_z = [fitter.estimate(_until(e, end), fit.theta, stream) if end else 0.0
                 for end in ends]  # fmt: skip
        for (a, b), gained in zip(pairwise(ends), np.diff(log_z), strict=True):
            measured = np.flatnonzero(e.seen[a:b].any(axis=1))
            own = a + (measured if len(measured) else np.arange(1))
            out[own] = gained / len(own)
    return out


def _until(e: Experiment, end: int) -> list[Experiment]:
    return [replace(e, y=e.y[:end], seen=e.seen[:end], u=e.u[:end], steps=int(end))]


def gain_of_mean(base: Predictions, other: Predictions) -> float:
    """Nats that the predictive means gain under the base model's variances: the mean's share.

    NaN where several channels were measured at once and it is not known how they vary together.
    """
    errors = np.stack([base.observed - base.mean, other.observed - other.mean])
    with np.errstate(all="ignore"):  # NaN where missing, or before a flat start is known
        scaled = errors / np.sqrt(base.variance)
    known = np.isfinite(scaled).all(axis=0)
    scaled = np.where(known, scaled, 0.0)
    if base.covariance is None:
        if np.any(known.sum(axis=1) > 1):
            return float("nan")
        squares = np.sum(scaled**2, axis=(1, 2))
    else:
        sd = np.sqrt(np.where(known, base.variance, 1.0))
        both = known[:, :, None] & known[:, None, :]
        alike = np.where(
            both, base.covariance / (sd[:, :, None] * sd[:, None, :]), np.eye(sd.shape[1])
        )
        squares = np.einsum("rtj,tjk,rtk->r", scaled, np.linalg.pinv(alike, hermitian=True), scaled)
    return float(0.5 * (squares[0] - squares[1]))


@dataclass(frozen=True)
class FreeRun:
    """Simulations from the first row on, not looking at the data: mean, low, high (T, K) each."""

    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray


def free_run(fitter: Fitter, fit: Fit, e: Experiment, seed: np.random.SeedSequence) -> FreeRun:
    """Mean and central 95% of simulated observations with the experiment's inputs."""
    draws = fitter.simulator.observations(
        e, fit.theta, random_state(seed, Stream.FREE_RUN), FREE_RUNS
    )
    with np.errstate(all="ignore"):
        known = not np.any(np.isnan(draws))  # nanquantile goes row by row
        quantile = np.quantile if known else np.nanquantile
        low, high = quantile(draws, (0.025, 0.975), axis=2)
        return FreeRun(draws.mean(axis=2), low, high)


def rmse(
    runs: Sequence[FreeRun], experiments: Sequence[Experiment], counts: Sequence[np.ndarray]
) -> float:
    """Root mean square error of free runs over the rows that count of all experiments, channels in
    their own units pooled by their standard deviations; NaN where nothing was measured."""
    y = np.concatenate([np.where(e.seen == 1.0, e.y, np.nan)[c]
                        for e, c in zip(experiments, counts, strict=True)])  # fmt: skip
    mean = np.concatenate([r.mean[c] for r, c in zip(runs, counts, strict=True)])
    known = ~np.all(np.isnan(y), axis=0)
    if not known.any():
        return float("nan")
    y, mean = y[:, known], mean[:, known]
    scale = np.nanstd(y, axis=0)
    scale = np.where(scale > 0.0, scale, 1.0)
    with np.errstate(all="ignore"):
        error = np.sqrt(np.nanmean(((y - mean) / scale) ** 2))
    return float(error * np.mean(scale))
