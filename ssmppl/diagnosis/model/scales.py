"""Scales of the variables of a model, which shapes of effects are given relative to."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ssmppl.diagnosis.effects.effect import Grid
from ssmppl.diagnosis.model.changed_laws import values_on_its_scale
from ssmppl.diagnosis.model.equations import label_of
from ssmppl.language.model.trace import Trace

LEVELS = (
    0.01, 0.02, 0.05, 0.1, 0.2, 0.25, 0.3, 0.4, 0.5, 0.6, 0.7, 0.75, 0.8, 0.9, 0.95, 0.98, 0.99
)  # fmt: skip
DIGITS = 4  # of the numbers that shapes are given in, at least, and of the spread about them


@dataclass(frozen=True)
class VariableScale:
    """The scale of one variable: quantiles of its values and of their sizes at `LEVELS`.

    first : the first of its values.
    """

    mean: float
    sd: float
    first: float
    quantiles: tuple[float, ...]
    sizes: tuple[float, ...]

    @classmethod
    def of(cls, values: Any) -> VariableScale:
        """The scale of an array of any shape; NaN is missing."""
        v = np.asarray(values, dtype=float).ravel()
        v = v[np.isfinite(v)]
        v = v if v.size else np.zeros(1)
        at = [tuple(map(float, np.quantile(a, LEVELS))) for a in (v, np.abs(v))]
        size = float(np.abs(v).max()) or 1.0  # squares of numbers beyond 1e154 have none
        return cls(
            size * float((v / size).mean()), size * float((v / size).std()), float(v[0]), *at
        )

    def quantile(self, level: float) -> float:
        """Quantile of the value, by linear interpolation between `LEVELS`."""
        return float(np.interp(level, LEVELS, self.quantiles))

    def size(self, level: float) -> float:
        """Quantile of the absolute value."""
        return float(np.interp(level, LEVELS, self.sizes))


@dataclass(frozen=True)
class Scales:
    """The scale of each state component, channel and input, by label, and the number of rows."""

    scale: Mapping[str, VariableScale]
    rows: int

    @classmethod
    def of(cls, trace: Trace, states: Any, observations: Any, inputs: Any, rows: int) -> Scales:
        """Scales from arrays whose last axis runs over the trace's symbols of each; others are
        pooled.

        states : (..., D), smoothed or drawn. observations : (..., K). inputs : (..., L).
        """
        out = {}
        groups = ((trace.state_symbols, states), (trace.observation_symbols, observations),
                  (trace.input_symbols, inputs))  # fmt: skip
        for group, values in groups:
            for i, s in enumerate(group):
                label, own = label_of(*s.data[1:]), np.asarray(values)[..., i]
                if s.data[0] == "observation":  # what acts on it sees it so
                    own = values_on_its_scale(trace.observations[s.data[1]].distribution, own)
                out[label] = VariableScale.of(own)
        return cls(out, rows)


def value_of(grid: Grid, v: float, scale: VariableScale | None, n: int) -> float:
    """One value of a shape parameter's grid as a number; n the number of rows."""
    if grid.unit == "rows":
        return float(max(1, round(v * n)))
    if grid.unit == "number" or scale is None:
        return float(v)
    meaning = {
        "sd": lambda: v * scale.sd,
        "mean": lambda: v * scale.mean,
        "first": lambda: v * scale.first,
        "quantile": lambda: scale.quantile(v),
        "size": lambda: scale.size(v),
    }
    found = meaning[grid.unit]()
    return _rounded(found, scale.sd) if math.isfinite(found) else 0.0


def _rounded(value: float, spread: float) -> float:
    """A number rounded to `DIGITS` digits of itself or, if that is finer, of the spread: far from
    zero, as of pressures about 101325, its own would not tell quantiles apart."""
    sizes = [v for v in (abs(value), spread) if 0.0 < v < math.inf]
    if not sizes:
        return value
    return round(value, DIGITS - 1 - math.floor(math.log10(min(sizes))))
