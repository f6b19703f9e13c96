"""How well observations are predicted several rows ahead: the CRPS of simulations from what the
filter knows.

A model can predict one row well and drift away from reality in ten, as one-step predictions are
corrected by every observation. So the filtered states of some rows are simulated on, and the
continuous ranked probability score of what they give at each horizon is a statistic like the
others, whose law comes from simulated data sets (`detect`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ssmppl.codegen.kernels.random import fill_uniform
from ssmppl.codegen.program import Program
from ssmppl.data import Experiment
from ssmppl.errors import ArgumentError

HORIZONS = (1, 10, 100)  # rows
ORIGINS = 40  # rows that are simulated on from, spread evenly
DRAWS = 24  # from each
FEWEST = 8  # of these rows, without which a horizon is left out (0 in every data set)


def crps(samples: np.ndarray, observed: np.ndarray) -> np.ndarray:
    """(T,) continuous ranked probability score of predictive samples (T, M), smaller is better.

    mean |x_i - y| - sum_{i<j} |x_i - x_j| / (M (M - 1)): fair, i.e. unbiased for the score of the
    law that the M samples come from (Gneiting and Raftery 2007; Zamo and Naveau 2018, equation 6).
    NaN where nothing was observed, or a sample is infinite.
    """
    x, y = np.sort(np.asarray(samples, float), axis=-1), np.asarray(observed, float)
    m = x.shape[-1]
    if m < 2 or x.shape[:-1] != y.shape:
        raise ArgumentError(
            f"predictive samples of shape {x.shape} for observations of shape {y.shape}",
            fix="give (T, M) samples, M at least 2, and (T,) observations",
        )
    with np.errstate(invalid="ignore", over="ignore"):
        apart = x @ (2.0 * np.arange(1, m + 1) - m - 1.0)  # sum over pairs, by the order statistics
        score = np.mean(np.abs(x - y[..., None]), axis=-1) - apart / (m * (m - 1.0))
    return np.where(np.isfinite(x).all(axis=-1), score, np.nan)


def crps_ahead(
    program: Program, e: Experiment, theta: np.ndarray, particles: np.ndarray, weights: np.ndarray,
    stream: np.ndarray, feedback: bool, horizons: Sequence[int] = HORIZONS,
) -> np.ndarray:  # fmt: skip
    """(O, H, K) CRPS of each channel at each horizon, from O rows on; NaN where nothing was
    observed, or the record ends before.

    particles (T, D, N), weights (T, N) : of x_t given y_{1:t}. feedback : a transition names
    observations; rows that lack one are then not simulated on from.
    """
    simulate, (steps, channels) = program.entry("simulate_on"), e.y.shape
    origins = np.unique(np.linspace(0, max(steps - 2, 0), ORIGINS).astype(int))
    if steps < 2:
        return np.full((len(origins), len(horizons), channels), np.nan)
    levels = np.empty(1)
    samples = np.full((len(origins), len(horizons), channels, DRAWS), np.nan)
    known = np.isfinite(particles[origins]).all(axis=(1, 2))  # not a flat start before it is
    for o, t in enumerate(origins.tolist()):
        if not known[o] or (feedback and not np.all(e.seen[t] == 1.0)):
            continue
        fill_uniform(stream, levels)
        chosen = _systematic(weights[t], float(levels[0]))
        reach = min(max(horizons), steps - 1 - t)
        states = np.empty((reach, particles.shape[1], DRAWS))
        drawn = np.empty((reach, channels, DRAWS))
        start = np.ascontiguousarray(particles[t][:, chosen])
        y = e.y.copy() if feedback else e.y
        simulate(theta, y, e.seen, e.u, t + 1, start, stream, states, drawn, feedback)
        for h, horizon in enumerate(horizons):
            if horizon <= reach:
                samples[o, h] = drawn[horizon - 1]
    rows = origins[:, None] + np.array(horizons)
    inside = np.minimum(rows, steps - 1)
    measured = (rows < steps)[..., None] & (e.seen[inside] == 1.0)
    return crps(samples, np.where(measured, e.y[inside], np.nan))


def _systematic(weights: np.ndarray, level: float) -> np.ndarray:
    """Indices of `DRAWS` particles, drawn by their weights with one uniform."""
    cumulative = np.cumsum(weights)
    points = (np.arange(DRAWS) + level) / DRAWS * cumulative[-1]
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
