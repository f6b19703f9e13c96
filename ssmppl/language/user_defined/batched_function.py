"""A user's function that moves a batch, called with care.

What it is handed are copies, so that it may write into them; what it gives is checked for shape and
type, and copied. The first call is made several times over, to see whether the function keeps
something from call to call, or from one point of a batch to the next: then nothing computed with it
would mean anything.
"""

from __future__ import annotations

import itertools
import threading
import time
import traceback
from collections.abc import Callable
from typing import Any

import numpy as np

from ssmppl.errors import Location, SimulatorError, warn

Call = Callable[[np.ndarray, np.ndarray, np.ndarray], Any]

SAMPLE = 4  # points with which it is tried
MOVED = 1e-3  # by which these differ, where they are copies of one
SAME = 1e-8  # relative to the largest value of an output: rounding, and no more
LOOKED_INTO = 64  # points of a batch that are tried one by one after an error
_numbers = itertools.count()


class BatchedFunction:
    """One of a simulator's two functions, as a node of the expression core calls it.

    Attributes
    ----------
    title : of the simulator. name : unique in this process.
    arguments : names (K,) of states, inputs and parameters, then the row. moving : whether each has
        derivatives. scales : (K,) of the steps of differences.
    calls, points, seconds : of the user's function so far.
    undefined : points that gave NaN.
    """

    def __init__(
        self, title: str, function: Call, sizes: tuple[int, int, int], arguments: tuple[str, ...],
        results: tuple[str, ...], scales: np.ndarray, where: Location | None,
    ):  # fmt: skip
        self.title, self.function, self.sizes = title, function, sizes
        self.name = f"{_identifier(title)}_{next(_numbers)}"
        self.arguments, self.results, self.outputs = arguments, results, len(results)
        self.moving = (*(True for _ in arguments), False)
        self.scales = np.append(scales, 1.0)
        self.where = where
        self.simulator: Any = None  # whose it is
        self.calls = self.points = self.undefined = 0
        self.seconds = 0.0
        self._checked = False
        self._lock = threading.RLock()

    def __repr__(self) -> str:
        return self.title

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:  # with its simulator
        return _of_simulator, (self.simulator, self is self.simulator.moves)

    def at(self, points: np.ndarray) -> np.ndarray:
        """(B, outputs) at points (B, K + 1): states, inputs, parameters, row.

        Raises
        ------
        SimulatorError : the function raises, or what it gives is no such array; or it keeps
            something between calls.
        """
        with self._lock:  # users' functions seldom can be called by two threads at once
            if not self._checked:
                self._check(points)
                self._checked = True
            return self._called(points)

    def seconds_of(self, points: int) -> float:
        """About how long a call with so many points takes; 0 before the first."""
        if not self.calls:
            return 0.0
        each = self.seconds / self.calls
        return each * max(1.0, points * self.calls / max(self.points, 1)) ** 0.5

    # -- one call
    def _called(self, points: np.ndarray) -> np.ndarray:
        if not np.isfinite(points).all():
            fine = np.isfinite(points).all(axis=1)
            values = np.full((len(points), self.outputs), np.nan)
            if fine.any():
                values[fine] = self._called(points[fine])
            return values
        begun = time.perf_counter()
        try:
            found = self.function(*self._parts(points))
        except Exception as error:
            raise self._raised(error, points) from None
        self.seconds += time.perf_counter() - begun
        self.calls, self.points = self.calls + 1, self.points + len(points)
        values = self._array(found, len(points))
        if np.isnan(values).any():
            bad = np.isnan(values).any(axis=1)
            self.undefined += int(bad.sum())
            if self.undefined == bad.sum():  # the first ones
                k = int(np.argmax(bad))
                lost = ", ".join(np.array(self.results)[np.isnan(values[k])])
                warn(
                    f"the simulator {self.title} gives NaN for {lost} at "
                    f"{self._point_text(points[k])}{self._reason(points[k])}; where it does the "
                    "likelihood is zero"
                )
        return values

    def _reason(self, point: np.ndarray) -> str:
        """Why there is no value at a point (K + 1,), where the function can tell."""
        owner = getattr(self.function, "__self__", self.function)
        tell = getattr(owner, "reason", None)
        said = tell(*(part[0] for part in self._parts(point[None]))) if callable(tell) else ""
        return f": {said}" if said else ""

    def _parts(self, points: np.ndarray) -> list[np.ndarray]:
        """States, inputs and parameters, each an array of its own."""
        n, m, p = self.sizes
        ends = (0, n, n + m, n + m + p)
        return [points[:, a:b].copy() for a, b in itertools.pairwise(ends)]

    def _array(self, found: Any, size: int) -> np.ndarray:
        wanted = f"an array ({size}, {self.outputs}) of float64, a row for each of {size} points"
        try:
            values = np.asarray(found)
        except Exception as error:
            raise self._error(
                f"gives {type(found).__name__}: {error}", f"return {wanted}"
            ) from None
        if values.dtype.kind == "f" and values.dtype.itemsize < 8:
            raise self._error(
                f"gives {values.dtype}, too few digits for derivatives by differences",
                'compute in double precision (in JAX: jax.config.update("jax_enable_x64", True))',
            )
        if values.dtype.kind not in "fiub":
            raise self._error(f"gives an array of {values.dtype}", f"return {wanted}")
        if values.shape != (size, self.outputs):
            columns = f"; its columns are {', '.join(self.results)}" if self.outputs else ""
            raise self._error(
                f"gives an array of shape {values.shape} for {size} points",
                f"return {wanted}{columns}",
            )
        return np.array(values, dtype=float)

    # -- whether it is a function
    def _check(self, points: np.ndarray) -> None:
        sample = np.array(points[: min(SAMPLE, len(points))])
        while len(sample) < SAMPLE:
            moved = sample[0] + MOVED * len(sample) * np.maximum(np.abs(sample[0]), self.scales)
            moved[-1] = sample[0, -1]
            sample = np.vstack([sample, moved])
        first = self._called(sample)
        again = self._called(sample)
        if not np.array_equal(first, again, equal_nan=True):
            raise self._differs(
                first,
                again,
                sample,
                "called twice with the same arguments it gives",
                "keeps something between calls, or draws random numbers",
                "reset what it keeps at the beginning of each call (a warm start, a clock, a "
                "generator); noise belongs into the model's distributions",
            )
        turned = self._called(sample[::-1])[::-1]
        if not self._alike(first, turned):
            raise self._differs(
                first,
                turned,
                sample,
                "with the same points in another order it gives",
                "does not move each point by itself",
                "compute each row of the result from the same row of the arguments alone; an "
                "adaptive step size for the whole batch needs a tighter tolerance, or fixed steps",
            )
        alone = self._called(sample[:1])
        if not self._alike(first[:1], alone):
            raise self._differs(
                first[:1],
                alone,
                sample,
                "with one point of a batch alone it gives",
                "does not move each point by itself",
                "compute each row of the result from the same row of the arguments alone",
            )

    def _alike(self, a: np.ndarray, b: np.ndarray) -> bool:
        with np.errstate(invalid="ignore"):
            size = np.nanmax(np.abs(a), axis=0, initial=1e-300)
            close = np.abs(a - b) <= SAME * size
        return bool(np.all(close | (a == b) | (np.isnan(a) & np.isnan(b))))

    def _differs(
        self, a: np.ndarray, b: np.ndarray, points: np.ndarray, when: str, what: str, fix: str
    ) -> SimulatorError:
        k, j = np.unravel_index(int(np.argmax(~((a == b) | (np.isnan(a) & np.isnan(b))))), a.shape)
        return self._error(
            f"{what}: {when} {self.results[j]} = {b[k, j]:.9g} where it gave {a[k, j]:.9g} before, "
            f"at {self._point_text(points[k])}",
            fix,
        )

    # -- words
    def _raised(self, error: Exception, points: np.ndarray) -> SimulatorError:
        point = points[0]
        if 1 < len(points) <= LOOKED_INTO:
            for k in range(len(points)):
                try:
                    self.function(*self._parts(points[k : k + 1]))
                except Exception as own:
                    point, error = points[k], own
                    break
        frames = traceback.extract_tb(error.__traceback__)
        while frames and frames[0].filename == __file__:
            frames.pop(0)
        lines = [*traceback.format_list(frames), *traceback.format_exception_only(error)]
        trace = "".join(lines).rstrip()
        return self._error(
            f"raised {type(error).__name__} at {self._point_text(point)}\n{trace}",
            "mend the function, or return NaN where it has no value",
        )

    def _error(self, what: str, fix: str) -> SimulatorError:
        return SimulatorError(f"the simulator {self.title} {what}", fix=fix, where=self.where)

    def _point_text(self, point: np.ndarray) -> str:
        pairs = [f"{n} = {v:.6g}" for n, v in zip(self.arguments, point, strict=False)]
        row = f"row {int(point[-1])}: " if point[-1] > 0 else ""
        return row + ", ".join(pairs)


def _of_simulator(simulator: Any, moves: bool) -> BatchedFunction:
    found: BatchedFunction = simulator.moves if moves else simulator.senses
    return found


def _identifier(title: str) -> str:
    word = "".join(c if c.isascii() and (c.isalnum() or c == "_") else "_" for c in title)
    return word.strip("_") or "simulator"
