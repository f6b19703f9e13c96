"""What follows from an exact score, whichever algorithm gives it.

Derivatives of a smooth function by extrapolated central differences.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from ssmppl.data import Experiment, spelled
from ssmppl.errors import SamplingError
from ssmppl.language.model.trace import Trace

LEVELS = 7
SHRINK = 1.6
STEP = 0.01  # of the differences of a score, in units of 1 / sqrt(information)
# What the square of a step may add to a difference, in units of sqrt(I_ii I_jj): of two steps,
# extrapolated, the square of that is left, and it is above the rounding errors of a score.
CURVED = 1e-4


def jacobian(
    function: Callable[[np.ndarray], np.ndarray], x: np.ndarray, step: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives J[i, j] = d f_i / d x_j, (F, X), and an estimate of the error of each.

    Central differences at a sequence of shrinking steps, extrapolated to zero by Richardson's
    tableau; each entry takes the corner of the tableau that has settled best (Ridders 1982,
    "Accurate computation of F'(x) and F'(x) F''(x)", Advances in Engineering Software 4).

    step : (X,), the largest step in each direction; halved until the function is finite there.
    Entries are NaN where it is finite at no step.
    """
    columns, errors = zip(
        *(_derivative(function, x, j, step[j]) for j in range(len(x))), strict=True
    )
    return np.array(columns).T, np.array(errors).T


def _derivative(
    function: Callable[[np.ndarray], np.ndarray], x: np.ndarray, j: int, step: float
) -> tuple[np.ndarray, np.ndarray]:
    def central(h: float) -> np.ndarray:
        return _central(function, x, j, h)

    first = central(step)
    for _ in range(40):
        if np.isfinite(first).all():
            break
        step *= 0.5
        first = central(step)
    row = [first]
    best, error = np.full(first.shape, np.nan), np.full(first.shape, np.inf)
    for level in range(1, LEVELS):
        step /= SHRINK
        new = [central(step)]
        for k in range(level):
            weight = SHRINK ** (2 * (k + 1))
            new.append(new[k] + (new[k] - row[k]) / (weight - 1.0))
            change = np.maximum(abs(new[k + 1] - new[k]), abs(new[k + 1] - row[k]))
            better = change < error
            best, error = np.where(better, new[k + 1], best), np.where(better, change, error)
        row = new
    return best, error


def observed_information(
    gradient: Callable[[np.ndarray], np.ndarray], theta: np.ndarray, free: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Minus the derivatives of a score, (P, P), symmetric, and the error of each entry.

    gradient : theta (P,) -> (P,), NaN where there is none. free : (P,) bool; rows and columns of
    the others are zero. Central differences at two steps, extrapolated: four scores a parameter,
    and two or more that look for the step. Where the score bends too much for these, `jacobian`.
    """
    index = np.flatnonzero(free)

    def inner(part: np.ndarray) -> np.ndarray:
        full = theta.copy()
        full[index] = part
        return gradient(full)[index]

    x = theta[index]
    slope, error = _differences(inner, x)
    scale = np.sqrt(abs(np.diagonal(slope)))
    wild = np.flatnonzero(~(error <= CURVED * np.outer(scale, scale)).all(axis=0))
    error = error**2 / np.where(error > 0.0, np.outer(scale, scale), 1.0)
    for j in wild.tolist():
        column, spread = _derivative(inner, x, j, _step(inner, x, j))
        slope[:, j], error[:, j] = column, spread
    error = np.maximum(error, abs(slope - slope.T) / 2.0)
    matrix, spread = np.zeros((len(theta),) * 2), np.zeros((len(theta),) * 2)
    matrix[np.ix_(index, index)] = -(slope + slope.T) / 2.0
    spread[np.ix_(index, index)] = np.maximum(error, error.T)
    return matrix, spread


def _differences(
    function: Callable[[np.ndarray], np.ndarray], x: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives (F, X) by two central differences each, extrapolated to zero step, and how far
    the one at the smaller step was from that; NaN where no step was found."""
    columns, errors = [], []
    for j in range(len(x)):
        step = 1e-2 * max(abs(x[j]), 1e-6)
        fine, curvature = _central(function, x, j, step), 0.0
        for _ in range(6):
            curvature = abs(fine[j])
            if not np.isfinite(curvature) or curvature == 0.0:
                break
            wanted = STEP / np.sqrt(curvature)
            if 0.2 * wanted <= step <= 1.5 * wanted:
                break
            step = min(wanted, 100.0 * step)
            fine = _central(function, x, j, step)
        coarse = _central(function, x, j, 2.0 * step)
        change = (fine - coarse) / 3.0
        columns.append(fine + change)
        errors.append(abs(change))
    return np.array(columns).T, np.array(errors).T


def _central(
    function: Callable[[np.ndarray], np.ndarray], x: np.ndarray, j: int, step: float
) -> np.ndarray:
    up, down = x.copy(), x.copy()
    up[j] += step
    down[j] -= step
    return (function(up) - function(down)) / (up[j] - down[j])


def _step(function: Callable[[np.ndarray], np.ndarray], x: np.ndarray, j: int) -> float:
    """A third of 1 / sqrt(curvature), found from differences at growing steps: there differences of
    a score are far above its rounding errors."""
    step = 1e-2 * max(abs(x[j]), 1e-6)
    for _ in range(6):
        curvature = abs(_central(function, x, j, step)[j])
        if not np.isfinite(curvature) or curvature == 0.0:
            return step if curvature != 0.0 else 1.0
        scale = 1.0 / (3.0 * np.sqrt(curvature))
        if step > 0.03 * scale:
            return min(scale, 30.0 * step)
        step = min(scale, 100.0 * step)
    return step


@dataclass(frozen=True)
class Scored(ABC):
    """An exact model with the gradient of its log-likelihood."""

    trace: Trace

    @abstractmethod
    def draw(
        self, experiment: Experiment, theta: np.ndarray, stream: np.ndarray, draws: int = 1
    ) -> np.ndarray:
        """Independent draws of x_{1:T} given y_{1:T}, (draws, T, D)."""

    def draw_each(
        self, experiments: Sequence[Experiment], theta: np.ndarray, streams: Sequence[np.ndarray],
        draws: int = 1,
    ) -> list[np.ndarray]:  # fmt: skip
        """As `draw`, of each experiment with its own stream, or one and the same."""
        pairs = zip(experiments, streams, strict=True)
        return [self.draw(e, theta, stream, draws) for e, stream in pairs]

    @abstractmethod
    def score(
        self, experiments: Iterable[Experiment], theta: np.ndarray, free: np.ndarray | None = None
    ) -> tuple[float, np.ndarray]:
        """log p(y | theta) and its gradient (P,), summed over experiments, exact.

        free : (P,) bool, the parameters that matter; the gradient is 0 in the others. None: all.
        Where the density does not exist at theta: -inf, and NaN for the gradient.
        """

    def information(
        self, experiments: Iterable[Experiment], theta: np.ndarray, free: np.ndarray | None = None
    ) -> np.ndarray:
        """The observed information -d^2 log p(y | theta), (P, P), by differences of the score.

        Extrapolated to zero step: errors of about 1e-8 of sqrt(I_ii I_jj), mostly far less. free :
        as in `score`; rows and columns of the others are zero.

        Raises
        ------
        ArgumentError : as of `score`.
        SamplingError : theta lies at the edge of where the density exists.
        """
        data = list(experiments)
        wanted = np.ones(len(theta), dtype=bool) if free is None else np.asarray(free, dtype=bool)
        matrix, _ = observed_information(lambda v: self.score(data, v, wanted)[1], theta, wanted)
        if not np.isfinite(matrix).all():
            raise SamplingError(
                f"the log-likelihood has no second derivative at {spelled(self.trace, theta)}",
                fix="the parameters lie at the edge of where the model has a density: fix the one "
                "that is at its bound by fixed={...}",
            )
        return matrix
