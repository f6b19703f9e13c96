"""Derivatives of a function that takes a batch, by differences, in one call.

The points of all derivatives that are asked for go to the function together. A first derivative
takes x +- h with h of the third root of the floating-point precision, which balances truncation
(of order h^2) against rounding (of order 1 / h); a second one its fourth root, and for two
different arguments the seven points f(+h, +k), f(-h, -k), f(+-h), f(+-k), f (Abramowitz and Stegun
1964, formula 25.3.27). h is relative to the larger of |x| and the argument's scale.

Where half the digits do (`few`), a first derivative takes the points of the second one in the same
argument where that is wanted too, and else one point beside x, with h the square root of the
precision. A value, slopes in three arguments and second derivatives in two of them take 6 points
in place of 11.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

Index = tuple[int, ...]  # the arguments in which a derivative is taken, in order; () is the value
PRECISION = float(np.finfo(float).eps)
FIRST, SECOND = PRECISION ** (1 / 3), PRECISION ** (1 / 4)
ONE_SIDED = PRECISION ** (1 / 2)
HIGHEST = 2  # derivatives


@dataclass(frozen=True)
class Stencil:
    """Where a function is evaluated, and how derivatives follow.

    shifts : (P, 1, K) of each point, relative to the scale of each argument. place : of a point by
    (kind, shifts). wanted : the derivatives.
    """

    wanted: tuple[Index, ...]
    shifts: np.ndarray
    place: dict[tuple[float, Index], int]

    @classmethod
    def of(cls, wanted: Sequence[Index], arguments: int, few: bool = False) -> Stencil:
        """For these derivatives of a function of so many arguments. few : whether as few points as
        give half the digits."""
        place: dict[tuple[float, Index], int] = {}
        bent = {j for index in wanted if len(index) == 2 for j in index}

        def add(size: float, *moved: int) -> None:
            place.setdefault((size, moved), len(place))

        for index in wanted:
            if not index:
                add(0.0)
            elif len(index) == 1 and few:
                add(0.0)
                if index[0] not in bent:
                    add(ONE_SIDED, index[0] + 1)
            elif len(index) == 1:
                add(FIRST, index[0] + 1)
                add(FIRST, -index[0] - 1)
            elif len(index) == 2:
                add(0.0)
                for j in dict.fromkeys(index):
                    add(SECOND, j + 1)
                    add(SECOND, -j - 1)
                if index[0] != index[1]:
                    add(SECOND, index[0] + 1, index[1] + 1)
                    add(SECOND, -index[0] - 1, -index[1] - 1)
            else:
                raise ValueError(f"a derivative of order {len(index)}")
        shifts = np.zeros((len(place), 1, arguments))
        for (size, moved), p in place.items():
            for j in moved:
                shifts[p, 0, abs(j) - 1] = np.sign(j) * size
        return cls(tuple(wanted), shifts, place)

    def derivatives(
        self, function: Callable[[np.ndarray], np.ndarray], x: np.ndarray, scales: np.ndarray,
        known: dict[tuple[float, Index], np.ndarray] | None = None,
    ) -> np.ndarray:  # fmt: skip
        """(len(wanted), outputs, B) at x (B, K) of a function (P, K) -> (P, outputs).

        known : place -> the function's values (B, outputs) there, where other derivatives at x
            have asked for them; takes those that are new.
        """
        size, k = x.shape
        points = x + self.shifts * np.maximum(np.abs(x), scales)
        known = {} if known is None else known
        new = {at: p for at, p in self.place.items() if at not in known}
        if new:
            asked = points if len(new) == len(points) else points[list(new.values())]
            found = function(asked.reshape(-1, k)).reshape(len(new), size, -1)
            known |= dict(zip(new, found, strict=True))
        values = np.stack([known[at] for at in self.place])
        out = np.empty((len(self.wanted), values.shape[2], size))
        for w, index in enumerate(self.wanted):
            if not index:
                out[w] = values[self.place[0.0, ()]].T
            elif len(index) == 1:
                out[w] = self._first(index[0], points, values, x).T
            else:
                out[w] = self._second(index, points, values, x).T
        return out

    def _first(self, j: int, points: np.ndarray, values: np.ndarray, x: np.ndarray) -> np.ndarray:
        """(B, outputs); on one side where the other has no value, as beyond the end of a range."""
        if (ONE_SIDED, (j + 1,)) in self.place:
            up, middle = self.place[ONE_SIDED, (j + 1,)], self.place[0.0, ()]
            return (values[up] - values[middle]) / (points[up, :, j] - x[:, j])[:, None]
        size = FIRST if (FIRST, (j + 1,)) in self.place else SECOND
        up, down = self.place[size, (j + 1,)], self.place[size, (-j - 1,)]
        a, b = values[up], values[down]
        slope = (a - b) / (points[up, :, j] - points[down, :, j])[:, None]
        if (0.0, ()) in self.place and not np.isfinite(slope).all():
            middle = values[self.place[0.0, ()]]
            above = (a - middle) / (points[up, :, j] - x[:, j])[:, None]
            below = (middle - b) / (x[:, j] - points[down, :, j])[:, None]
            slope = np.where(np.isfinite(slope), slope, np.where(np.isfinite(a), above, below))
        return slope

    def _second(
        self, index: Index, points: np.ndarray, values: np.ndarray, x: np.ndarray
    ) -> np.ndarray:
        """(B, outputs)."""
        i, j = index
        middle = values[self.place[0.0, ()]]

        def both(k: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            up, down = self.place[SECOND, (k + 1,)], self.place[SECOND, (-k - 1,)]
            width = 0.5 * (points[up, :, k] - points[down, :, k])[:, None]
            return values[up], values[down], width

        a, b, h = both(i)
        if i == j:
            return ((a - middle) - (middle - b)) / h**2
        c, d, k = both(j)
        e = values[self.place[SECOND, (i + 1, j + 1)]]
        f = values[self.place[SECOND, (-i - 1, -j - 1)]]
        return ((e - a - c + middle) + (f - b - d + middle)) / (2.0 * h * k)
