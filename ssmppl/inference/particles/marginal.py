"""Runs of the Rao-Blackwellised particle filter, told in the model's own states.

The filter carries the states x that are sampled and the moments of the linear ones, z
(`analysis/marginal.py`). What is known of z_t is a mixture of Gaussians, one of each particle: its
mean and covariance are exact given the particles, its quantiles come from one draw of each. Given
a path of x, z is drawn by the backward sampler of the Kalman filter.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ssmppl.codegen.kernels.kalman_steps import Matrices
from ssmppl.codegen.kernels.random import fill_normal
from ssmppl.codegen.kernels.summaries import summarise
from ssmppl.codegen.kernels.weights import OK
from ssmppl.codegen.marginal import NAMES, MarginalFilter
from ssmppl.data import Experiment
from ssmppl.errors import NotApplicable
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import Expr
from ssmppl.inference.exact import kalman_matrices
from ssmppl.inference.exact.kalman_moments import Stopped, drawn
from ssmppl.inference.particles.filtering import FilterRun, FilterSettings, failure, run_filter
from ssmppl.inference.problem import Problem
from ssmppl.language.traced import previous, seen

MOST_VALUES = 100_000  # particles times steps whose moments are computed at a time


def is_marginal(proposal: str) -> bool:
    """Whether a proposal's name is one of a Rao-Blackwellised filter."""
    return proposal in NAMES


def marginal_of(problem: Problem) -> MarginalFilter:
    """The Rao-Blackwellised filters of a problem that has them."""
    found = problem.program.marginal
    assert not isinstance(found, NotApplicable)
    return found


@dataclass(frozen=True)
class Columns:
    """Where the model's states stand.

    sampled : of each state that is sampled, its index among the model's states and in the filter.
    linear : indices among the model's states of z. coupled : of the coupled x, in the filter.
    channels : indices of the components of y that tell of z.
    """

    sampled: tuple[tuple[int, int], ...]
    linear: tuple[int, ...]
    coupled: tuple[int, ...]
    channels: tuple[int, ...]


def columns_of(problem: Problem) -> Columns:
    """The places of the states of a problem."""
    trace, found = problem.trace, marginal_of(problem).found
    place = {s: i for i, s in enumerate(found.trace.state_symbols)}
    own = {s: i for i, s in enumerate(trace.state_symbols)}
    y = {s: i for i, s in enumerate(trace.observation_symbols)}
    return Columns(
        tuple((i, place[s]) for s, i in own.items() if s in place),
        tuple(own[s] for s in found.split.linear),
        tuple(place[s] for s in found.split.coupled),
        tuple(y[s] for s in found.channels),
    )


def marginal_run(
    problem: Problem, experiment: Experiment, theta: np.ndarray, settings: FilterSettings,
    rng: np.ndarray, probabilities: np.ndarray, stream: np.ndarray,
) -> FilterRun:  # fmt: skip
    """As `full_run` of the other filters, with the means and covariances of z exact given x.

    Raises
    ------
    SamplingError : all weights vanish, or are NaN; names the step, the user's line, the parameters.
    """
    found, n = marginal_of(problem), settings.particles
    d, k = len(found.found.trace.state_symbols), len(problem.trace.observation_symbols)
    steps, nothing = experiment.steps, np.empty(0)
    particles, weights = np.empty((steps, d, n)), np.empty((steps, n))
    increments, ess = np.empty(steps), np.empty(steps)
    size, p = len(problem.trace.state_symbols), len(probabilities)
    predicted = np.empty((steps, 4, k)), np.empty((steps, p, k))
    told = predicted[0], probabilities, predicted[1], stream
    moments = nothing, np.empty((steps, d)), np.empty((steps, d, d)), np.empty((steps, 0, d))
    kept = particles, weights, np.zeros((steps, n), dtype=np.int32)
    status, t = run_filter(
        problem, theta, settings, experiment, rng, increments, ess, (*moments, told), kept
    )
    if status != OK:
        raise failure(problem, theta, status, t, experiment)
    out = FilterRun(
        increments, ess, np.empty((steps, size)), np.empty((steps, size, size)),
        np.empty((steps, p, size)), *predicted,
    )  # fmt: skip
    chunk = max(1, MOST_VALUES // n)
    for first in range(0, steps, chunk):
        rows = slice(first, min(first + chunk, steps))
        _summarise(problem, experiment, theta, rows, particles, weights, probabilities, rng, out)
    return out


def _summarise(
    problem: Problem, experiment: Experiment, theta: np.ndarray, rows: slice,
    particles: np.ndarray, weights: np.ndarray, probabilities: np.ndarray, rng: np.ndarray,
    out: FilterRun,
) -> None:  # fmt: skip
    """Moments and quantiles of some rows."""
    columns = columns_of(problem)
    mean, covariance = filtered_moments(problem, experiment, theta, rows, particles)
    size, z = out.mean.shape[1], list(columns.linear)
    for t in range(rows.start, rows.stop):
        own, w = np.empty((size, particles.shape[2])), weights[t]
        m, v = mean[t - rows.start], covariance[t - rows.start]  # (n, N), (n, n, N)
        for i, j in columns.sampled:
            own[i] = particles[t, j]
        own[z] = m
        summarise(own, w, np.empty(0), out.mean[t], out.covariance[t], np.empty((0, size)))
        out.covariance[t][np.ix_(z, z)] += np.where(w > 0.0, v, 0.0) @ w
        if len(probabilities):
            normals = np.empty(m.size)
            fill_normal(rng, normals)
            sd = np.sqrt(np.maximum(np.diagonal(v).T, 0.0))
            own[z] = m + sd * normals.reshape(m.shape)
            summarise(
                own, w, probabilities, np.empty(size), np.empty((size, size)), out.quantiles[t]
            )


def filtered_moments(
    problem: Problem, experiment: Experiment, theta: np.ndarray, rows: slice, particles: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Means (R, n, N) and covariances (R, n, n, N) of z_t given y_t too, for R rows."""
    found = marginal_of(problem).found
    values = {s: at_rows(v, rows) for s, v in values_of(problem, experiment, theta).items()}
    for i, s in enumerate(found.trace.state_symbols):
        values[s] = particles[rows, i]
    flat = [*found.filtered_mean, *found.filtered_covariance.ravel()]
    shape = (rows.stop - rows.start, particles.shape[2])
    with np.errstate(invalid="ignore", divide="ignore"):  # where(measured, ..., 0) computes both
        found_values = [np.broadcast_to(v, shape) for v in evaluate(flat, values)]
    n = len(found.mean)
    mean = np.stack(found_values[:n], axis=1)
    return mean, np.stack(found_values[n:], axis=1).reshape(shape[0], n, n, shape[1])


def at_rows(value: np.ndarray, rows: slice) -> np.ndarray:
    """A number as it is, a column's rows as (R, 1)."""
    return value if np.ndim(value) == 0 else np.asarray(value)[rows, None]


def values_of(
    problem: Problem, experiment: Experiment, theta: np.ndarray
) -> dict[Expr, np.ndarray]:
    """Values of every symbol but those of states, numbers or one for each row."""
    values = kalman_matrices.values_of(problem.trace, experiment, theta)
    for s, column, measured in zip(
        problem.trace.observation_symbols, experiment.y.T, experiment.seen.T, strict=True
    ):
        values[s] = column
        values[seen(s)] = measured
    return values


def draw_given(
    problem: Problem, experiment: Experiment, theta: np.ndarray, paths: np.ndarray,
    stream: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Paths (M, T, D) of all states, those of z drawn given those of x.

    paths : (M, T, D') of the filter, of which the sampled states are read. stream : advanced in
        place.

    Raises
    ------
    SamplingError : the laws of z have no density given some path.
    """
    m, steps, _ = paths.shape
    width = max(1, MOST_VALUES // steps)
    out = np.empty((m, steps, len(problem.trace.state_symbols)))
    for first in range(0, m, width):
        part = slice(first, first + width)
        _draw_part(problem, experiment, theta, paths[part], stream, out[part])
    return out


def _draw_part(
    problem: Problem, experiment: Experiment, theta: np.ndarray, paths: np.ndarray,
    stream: np.ndarray, out: np.ndarray,
) -> None:  # fmt: skip
    columns, found = columns_of(problem), marginal_of(problem).found
    values = values_of(problem, experiment, theta)
    before = np.maximum(np.arange(paths.shape[1]) - 1, 0)
    for i, s in enumerate(found.trace.state_symbols):
        values[s], values[previous(s)] = paths[:, :, i], paths[:, before, i]
    fields = [getattr(found.given, name) for name in Matrices._fields]
    flat = iter(evaluate([e for f in fields for e in f.ravel()], values))
    entries = [np.empty((*paths.shape[:2], *f.shape)) for f in fields]
    for f, entry in zip(fields, entries, strict=True):
        for place in np.ndindex(f.shape):
            entry[:, :, *place] = next(flat)
    c, exact = list(columns.channels), list(columns.coupled)
    known = np.ones((paths.shape[1], len(exact)))
    seen_rows = np.ascontiguousarray(np.hstack([experiment.seen[:, c], known]))
    for i, path in enumerate(paths):
        model = Matrices(entries[0][i, 0], entries[1][i, 0], *(e[i] for e in entries[2:]))
        y = np.ascontiguousarray(np.hstack([experiment.y[:, c], path[:, exact]]))
        stacked = replace(experiment, y=y, seen=seen_rows)
        try:
            _, z = drawn(model, np.ascontiguousarray(model.m[:, None]), stacked, stream, 1)
        except Stopped as stop:
            raise kalman_matrices.failure(problem.trace, theta, stop.status, stop.t) from None
        out[i][:, list(columns.linear)] = z[0][:, len(exact) :]
    for own, theirs in columns.sampled:
        out[:, :, own] = paths[:, :, theirs]
