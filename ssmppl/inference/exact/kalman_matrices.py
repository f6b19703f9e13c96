"""A linear Gaussian model in numbers, and what to say where its laws have no density."""

from __future__ import annotations

import numpy as np

from ssmppl.analysis.structure import LinearGaussian
from ssmppl.codegen.kernels import kalman as kernel
from ssmppl.codegen.kernels.kalman_steps import Matrices
from ssmppl.data import Experiment, spelled
from ssmppl.errors import SamplingError
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import Expr, symbol
from ssmppl.inference.ranges import without_density
from ssmppl.language.traced import Trace, previous

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


def matrices(
    trace: Trace, form: LinearGaussian, experiment: Experiment, theta: np.ndarray
) -> Matrices:
    """The matrices at theta (P,), for the rows of one experiment."""
    values = values_of(trace, experiment, theta)
    fields = [getattr(form, name) for name in Matrices._fields]
    flat = iter(evaluate([e for field in fields for e in field.ravel()], values))
    rows = [_by_row([next(flat) for _ in range(f.size)], f.shape) for f in fields]
    return Matrices(rows[0][0], rows[1][0], *rows[2:])


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


def _by_row(entries: list[np.ndarray], shape: tuple[int, ...]) -> np.ndarray:
    """Entries, each a number or one for each row, as an array (T or 1, *shape)."""
    columns = np.broadcast_arrays(*(np.atleast_1d(e) for e in entries))
    return np.ascontiguousarray(np.stack(columns, axis=-1), dtype=float).reshape(-1, *shape)


def failure(trace: Trace, theta: np.ndarray, status: int, t: int) -> SamplingError:
    """The error of a filter that stopped with this status at step t (from 0)."""
    found, fix = CAUSE[status]
    where = next(iter((trace.transition if t else trace.initial).values())).distribution.location
    why = ""
    if none := without_density(trace, theta):
        why, fix, where = none
    return SamplingError(
        f"{found} at t={t + 1}; parameters: {spelled(trace, theta)}" + (why and f"; {why}"),
        fix=fix,
        where=where,
    )
