"""The catalogue's terms as columns of numbers, for the rivals, and the residuals they explain.

Plain first-order forms, each with one or two usual shapes, evaluated at smoothed states and
measured inputs. Written apart from `ssmppl.diagnosis`, so that the rivals stand on their own.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from bench.gap.truth.forms import lagged, play

PERIODS = (5, 10, 20, 50, 120)


@dataclass(frozen=True)
class Residuals:
    """Of a fitted model, T rows.

    states : smoothed means by name. integrals : which of them only integrate another (Dirac).
    steps : x_{t+1} - f(x_t, u_t) at smoothed means, (T - 1,), of the equations with noise.
    errors : standardised one-step prediction errors of each channel, (T,). predicted : the
    predictions. inputs : as measured.
    """

    states: dict[str, np.ndarray]
    integrals: tuple[str, ...]
    steps: dict[str, np.ndarray]
    errors: dict[str, np.ndarray]
    predicted: dict[str, np.ndarray]
    inputs: dict[str, np.ndarray]


@dataclass(frozen=True)
class Term:
    """One column beside the target that it may explain; `residual` names that target's series.
    z : standardised statistic that takes the place of their correlation, if it is none."""

    effect: str
    equation: str
    residual: str
    target: np.ndarray
    column: np.ndarray
    moment: str = "mean"
    z: float | None = None


def library(r: Residuals) -> list[Term]:
    """Every term of every equation that has a residual."""
    return [*_transitions(r), *_inputs(r), *_channels(r)]


def _transitions(r: Residuals) -> Iterator[Term]:
    for name, target in r.steps.items():
        rows = len(target)
        v = r.states[name][:rows]
        others = {k: x[:rows] for k, x in r.states.items() if k != name}
        positions = {k: x for k, x in others.items() if k in r.integrals} or {name: v}
        for effect, column in _of_state(v, positions, others, r.inputs, rows):
            yield Term(effect, name, name, target, column)


Series = dict[str, np.ndarray]


def _of_state(
    v: np.ndarray, positions: Series, others: Series, inputs: Series, rows: int
) -> Iterator[tuple[str, np.ndarray]]:
    s, tau = v.std() or 1.0, np.linspace(-0.5, 0.5, rows)
    sign = np.tanh(v / (0.1 * s))
    yield "coulomb friction", sign
    yield "stribeck", np.exp(-((v / (0.4 * s)) ** 2)) * sign
    yield "asymmetric friction", np.abs(v)
    yield "quadratic drag", v * np.abs(v)
    for x in positions.values():
        low, high = np.quantile(x, [0.1, 0.9])
        yield "cubic stiffness", x**3
        yield "quadratic stiffness", x**2
        yield "state-dependent damping", x**2 * v
        yield "hard stop", np.maximum(x - high, 0)
        yield "hard stop", np.maximum(low - x, 0)
        yield "gravity", np.sin(x)
    for x in others.values():
        yield "cross-coupling", x
        yield "cross-coupling", x * v
    if v.min() > 0:
        yield "extra loss", np.sqrt(v)
        yield "extra loss", v**2
        yield "extra loss", v**4
    for u in inputs.values():
        yield "load-dependent friction", np.abs(u[:rows]) * sign
    yield "constant load", np.ones(rows)
    for period in PERIODS:
        yield "periodic forcing", np.cos(2 * np.pi * np.arange(rows) / period)
        yield "periodic forcing", np.sin(2 * np.pi * np.arange(rows) / period)
    for x in (v, *others.values(), *(u[:rows] for u in inputs.values())):
        yield "parameter drift", tau * x
        for date in (-0.17, 0.0, 0.17):
            yield "parameter break", (tau > date) * x


def _inputs(r: Residuals) -> Iterator[Term]:
    for name, target in r.steps.items():
        rows = len(target)
        for key, whole in r.inputs.items():
            u = whole[:rows]
            low, high = np.quantile(np.abs(u), [0.25, 0.75])
            columns = [
                ("input saturation", np.clip(u, -high, high) - u),
                ("dead zone", np.clip(u, -low, low)),
                ("input asymmetry", u**2),
                ("input asymmetry", np.abs(u)),
                ("backlash", play(u, 0.5 * u.std()) - u),
                ("actuator lag", lagged(u, 5.0) - u),
                *(("input delay", _shifted(u, k) - u) for k in (1, 2, 4)),
            ]
            for effect, column in columns:
                yield Term(effect, key, name, target, column)


def _channels(r: Residuals) -> Iterator[Term]:
    for name, whole in r.errors.items():
        ok = np.isfinite(whole)
        e, h = whole[ok], r.predicted[name][ok]
        tau = np.linspace(-0.5, 0.5, len(whole))[ok]
        low, high = np.quantile(h, [0.2, 0.8])
        g = h - h.mean()
        for effect, column in (
            ("sensor bias", np.ones(len(e))),
            ("sensor drift", tau),
            ("sensor gain nonlinearity", g**2),
            ("sensor gain nonlinearity", g**3),
            ("sensor clipping", np.maximum(h - high, 0)),
            ("sensor clipping", np.maximum(low - h, 0)),
            ("sensor rectification", np.abs(h)),
            ("sensor lag", lagged(h, 5.0) - h),
            ("sensor delay", _shifted(h, 1) - h),
            ("coloured noise", _shifted(e, 1)),
        ):
            yield Term(effect, name, f"channel {name}", e, column)
        for column in (np.abs(g), *(np.abs(u[ok]) for u in r.inputs.values())):
            yield Term("heteroscedastic noise", name, f"{name}^2", e**2 - 1, column, "scale")
        kurtosis = float(np.sqrt(len(e) / 24) * np.mean(e**4 - 6 * e**2 + 3))
        yield Term("outliers", name, f"{name}^4", e, e, "tails", kurtosis)


def _shifted(u: np.ndarray, k: int) -> np.ndarray:
    return np.concatenate([np.full(k, u[0]), u[:-k]])
