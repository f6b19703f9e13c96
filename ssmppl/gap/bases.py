"""Smooth bounded functions of states and inputs, in which a missing term is written.

Polynomials in s = tanh(z / `BEND`), z the standardised variable, orthonormal over its values: next
to polynomials in z where the data are, and level beyond them. (Hermite functions, which vanish
there, leave a third of a quadratic drag over normal values unexplained.) Written with NumPy's
functions alone: the same object is called on numbers and on symbols of a model.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ssmppl.errors import ArgumentError

BEND = 2.0  # standard deviations at which the functions begin to level off


@dataclass(frozen=True)
class Smooth:
    """Polynomial in tanh((x - centre) / width) by its coefficients, the constant first."""

    centre: float
    width: float
    coefficients: tuple[float, ...]

    @property
    def order(self) -> int:
        """Degree of the polynomial."""
        return len(self.coefficients) - 1

    def __call__(self, x: Any) -> Any:
        s = np.tanh((x - self.centre) / self.width)
        value: Any = self.coefficients[-1] + 0.0 * s
        for c in self.coefficients[-2::-1]:
            value = value * s + c
        return value


def bases(x: Any, count: int = 6) -> tuple[Smooth, ...]:
    """The constant and `count - 1` functions of one variable, orthonormal over its values.

    Fewer where the variable takes fewer values than that.

    Parameters
    ----------
    x : values (any shape; NaN left out), or (centre, sd) as a tuple of two numbers: the functions
        are then orthonormal under a normal law.

    Raises
    ------
    ArgumentError : no finite value, or all the same.
    """
    if isinstance(x, tuple):
        centre, sd = float(x[0]), float(x[1])
        nodes, weights = np.polynomial.hermite_e.hermegauss(60)
        values, weights = centre + sd * nodes, weights / weights.sum()
    else:
        values = np.asarray(x, float).ravel()
        values = values[np.isfinite(values)]
        centre, sd = (float(values.mean()), float(values.std())) if values.size else (0.0, 0.0)
        weights = np.full(values.shape, 1.0 / max(values.size, 1))
    if not sd > 1e-12 * abs(centre):
        raise ArgumentError(
            f"a variable with centre {centre:g} and standard deviation {sd:g}",
            fix="leave a variable that does not vary out of the basis",
        )
    powers = np.tanh((values - centre) / (BEND * sd))[:, None] ** np.arange(count)
    _, r = np.linalg.qr(powers * np.sqrt(weights)[:, None])
    distinct = int(np.sum(np.abs(np.diagonal(r)) > 1e-8))
    signs = np.sign(np.diagonal(r))[:distinct]
    # powers = Q r, so that Q = powers r^-1: column n holds the coefficients of the n-th function.
    mixed = np.linalg.inv(r[:distinct, :distinct]) * signs
    return tuple(Smooth(centre, BEND * sd, tuple(mixed[: n + 1, n].tolist()))
                 for n in range(distinct))  # fmt: skip
