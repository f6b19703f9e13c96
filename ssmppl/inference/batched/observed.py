"""Expressions of a model at many places at once, and what is observed there.

The places are lanes: points of the parameters at one row (`filter.py`), or the rows of a data set
at one point.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np

from ssmppl.analysis.proposals.twisted import noise_form
from ssmppl.analysis.vectorised import vectorised
from ssmppl.data import Experiment
from ssmppl.errors import NotApplicable
from ssmppl.expressions.calculus import NotDifferentiable, differentiate
from ssmppl.expressions.expr import Expr, depends_on, symbols_of
from ssmppl.language.model.trace import Trace


class Lanes(Protocol):
    """Where expressions are evaluated. count : L."""

    @property
    def count(self) -> int: ...

    def value(self, symbol: Expr) -> Any:
        """A number, or (L,), of a symbol that is no state's."""

    def measured(self) -> tuple[np.ndarray, np.ndarray]:
        """(L, K) readings, and whether there are any."""


Seen = tuple[np.ndarray, np.ndarray]  # of one row, in each lane: as of `Predictions`


class Part:
    """Expressions of one distribution, evaluated for all lanes."""

    def __init__(self, trace: Trace, expressions: Sequence[Expr]):
        self.size = len(expressions)
        self.fixed = np.zeros(self.size)
        self.at: list[int] = []
        moving = []
        for k, e in enumerate(expressions):
            if e.op == "const":
                self.fixed[k] = e.data
            else:
                self.at.append(k)
                moving.append(e)
        known = {s for e in moving for s in symbols_of([e])}
        self.symbols = sorted(known, key=lambda s: repr(s.data))
        self.run: Callable[[Sequence[Any]], list[Any]] = vectorised(moving, self.symbols)
        states = {s.data[1:]: k for k, s in enumerate(trace.state_symbols)}
        self.sources = [(s.data[0], states.get(s.data[1:], s)) for s in self.symbols]

    def __call__(self, lanes: Lanes, x: np.ndarray | None, x_prev: np.ndarray | None) -> np.ndarray:
        """(L, expressions)."""
        given: list[Any] = []
        for (kind, place), symbol in zip(self.sources, self.symbols, strict=True):
            if kind == "state":
                assert x is not None
                given.append(x[:, place])
            elif kind == "state_prev":
                assert x_prev is not None
                given.append(x_prev[:, place])
            else:
                given.append(lanes.value(symbol))
        out = np.empty((lanes.count, self.size))
        out[:] = self.fixed
        for k, value in zip(self.at, self.run(given), strict=True):
            out[:, k] = value
        return out


class GaussianObservation:
    """What is observed, as mean (K,) and noise about it, and by the filter's states (K, N)."""

    def __init__(self, trace: Trace, mean: Sequence[Expr], slope: np.ndarray, spread: np.ndarray):
        self.shape = slope.shape
        self._part = Part(trace, [*mean, *slope.ravel(), *spread.ravel()])

    def __call__(self, lanes: Lanes, rest: np.ndarray, p: np.ndarray) -> Seen:
        """The predictions of a row from the mean (L, D) and covariance (L, N, N) of its states."""
        k, n = self.shape
        values = self._part(lanes, rest, None)
        mean, slope = values[:, :k], values[:, k : k + k * n].reshape(-1, k, n)
        spread = values[:, k + k * n :].reshape(len(values), k, -1)
        covariance = slope @ p @ slope.transpose(0, 2, 1) + spread @ spread.transpose(0, 2, 1)
        y, seen = lanes.measured()
        both = seen[:, :, None] & seen[:, None, :]
        return np.where(seen, y - mean, 0.0), np.where(both, covariance, np.eye(k))


def gaussian_observation(trace: Trace, own: np.ndarray) -> GaussianObservation | None:
    """By the states at `own` (N,); None of observations that are not all driven by Gaussian noise,
    or not by states alone."""
    form = noise_form(list(trace.observations.values()), list(trace.observation_symbols))
    if isinstance(form, NotApplicable):
        return None
    mean, spread = form.at_rest(), form.spread()
    if any(depends_on(e, trace.observation_symbols) for e in [*mean, *spread.ravel()]):
        return None  # a channel by another one of its row
    states = [trace.state_symbols[k] for k in own]
    try:
        slope = np.array([differentiate(list(mean), s) for s in states]).T
    except NotDifferentiable:
        return None
    return GaussianObservation(trace, list(mean), slope, spread)


class RowsOf:
    """The rows of a data set as lanes, at points theta (B, P), one after the other."""

    def __init__(self, trace: Trace, e: Experiment, theta: np.ndarray):
        self.count = len(theta) * e.steps
        self._e, self._points = e, len(theta)
        own = theta[0] if len(theta) == 1 else np.repeat(theta, e.steps, axis=0).T
        self._theta = dict(zip(trace.parameter_symbols, own, strict=True))
        self._columns: dict[tuple[str, Any], int] = {}
        for kind, symbols in (
            ("observation", trace.observation_symbols), ("input", trace.input_symbols),
        ):  # fmt: skip
            self._columns |= {(kind, s.data[1:]): k for k, s in enumerate(symbols)}

    def value(self, symbol: Expr) -> Any:
        """A number, or (B T,)."""
        found = self._theta.get(symbol)
        if found is not None:
            return found
        kind, name, index = symbol.data
        if kind in ("time", "time_prev"):
            values = np.arange(self._e.steps) + (1.0 if kind == "time" else 0.0)
        else:
            base = kind.removesuffix("_prev")
            column = self._columns["observation" if base == "seen" else base, (name, index)]
            e = self._e
            values = {"observation": e.y, "seen": e.seen, "input": e.u}[base][:, column]
            if kind.endswith("_prev"):
                values = np.concatenate([values[:1], values[:-1]])
        return np.tile(values, self._points)

    def measured(self) -> tuple[np.ndarray, np.ndarray]:
        """(B T, K) readings, and whether there are any."""
        return np.tile(self._e.y, (self._points, 1)), np.tile(
            self._e.seen == 1.0, (self._points, 1)
        )


def predictions_of_rows(
    observation: GaussianObservation, trace: Trace, e: Experiment, theta: np.ndarray,
    mean: np.ndarray, covariance: np.ndarray,
) -> Seen:  # fmt: skip
    """Those of all rows at points theta (B, P), (B, T, K) and (B, T, K, K), from the moments (B, T,
    D), (B, T, D, D) that the states are predicted to have."""
    lead, (d,) = mean.shape[:2], mean.shape[2:]
    with np.errstate(all="ignore"):
        error, spread = observation(
            RowsOf(trace, e, theta), mean.reshape(-1, d), covariance.reshape(-1, d, d)
        )
    return error.reshape(*lead, -1), spread.reshape(*lead, *spread.shape[1:])
