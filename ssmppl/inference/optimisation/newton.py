"""Newton's ascent of a smooth function: by its gradient, or where it has none by its differences.

With a gradient, BFGS goes near the top (`quasi_newton`), and Newton's steps with differences of the
gradient end there. Without one, coordinates are measured in widths, over which the function changes
by about one, so that parameters of any unit are alike. Where the function is not concave,
eigenvalues count by their size, so that a step climbs (Nocedal and Wright 2006, sections 3.4 and
8.1; Dauphin et al. 2014). For functions that take a millisecond and few coordinates, as a Kalman
filter's log-likelihood: F^2 + F calls a step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ssmppl.inference.optimisation.quasi_newton import quasi_newton

FINE = 0.05  # of a width: differences at the end of a climb, far above rounding
CHANGE = (0.05, 5.0)  # of the function over one width, between which that is a width
WIDEST, FIRST, TIMES = 4.0, 0.1, 4.0  # of a width in z; where the search for it begins; its factor
TRIES = 24
STEPS = 40
KEPT = 2  # steps for which the mixed second differences are kept, while whole steps climb
FARTHEST = 2.0  # of a first step in any coordinate, in units of it where it is larger than one
SHARES = (1.0, 0.5, 0.2, 0.05, 0.01)  # of a step that are tried
GOOD = 1e-3  # that the quadratic still expects where a climb is at its end
LITTLE = 0.01  # that two steps in a row gain where it is, too: on the way to a bound at infinity
CONVEX = 0.05  # minus an eigenvalue, in widths, beyond which the place is no top whatever its slope
LEAST = 1e-3  # of the eigenvalues of the second derivatives as correlations
FLAT = 1e-10  # second derivative in widths that is rounding
NO_VALUE = 1e100  # size from which a value is none: of a model that runs away, to overflow next

QUASI_NEWTON_STEPS = 200
GAIN = 1e-7  # of one of them, relative, from where on Newton's are quicker
LAST_STEPS = 8  # of Newton's, behind BFGS
ARRIVED = 1e-7  # that the quadratic still expects to gain, from where on there is none
NEAR = 1e-4  # a first step in z for the differences of a gradient
LONGEST = 0.1  # of these at most
WIDTH_TRIES, NEARER = 4, 30.0  # of their sizes; by how much they may be off

Function = Callable[[np.ndarray], float]
Slope = Callable[[np.ndarray], tuple[float, np.ndarray]]  # value and gradient (F,)


@dataclass(frozen=True)
class Top:
    """Where a climb ended.

    z : (F,). value : there. information : (F, F) minus the second derivatives, symmetric, not
    always positive definite. distance : what a quadratic still expects to gain.
    """

    z: np.ndarray
    value: float
    information: np.ndarray
    distance: float

    @property
    def is_top(self) -> bool:
        """Whether the function falls on all sides, as far as its second derivatives tell."""
        return bool(
            np.all(np.isfinite(self.information))
            and (not len(self.z) or np.linalg.eigvalsh(self.information)[0] > 0.0)
        )


def climb(function: Function, z: np.ndarray) -> Top | None:
    """The top near z (F,); None where the function has no value there. -inf is no value."""
    function = _with_values(function)
    z = np.array(z, dtype=float)
    value = function(z)
    if not np.isfinite(value):
        return None
    if not len(z):
        return Top(z, value, np.zeros((0, 0)), 0.0)
    width = np.full(len(z), FIRST)
    information, distance, reach, gained = np.eye(len(z)), np.inf, FARTHEST, np.inf
    together, age = None, 0  # how the curvatures of two coordinates go together, and for how long
    for _ in range(STEPS):
        width = widths(function, z, value, width)
        slope, coarse, curvature = _derivatives(function, z, value, width, together)
        step, distance, lowest = _step(slope, curvature)
        if together is not None and distance < GOOD:  # not on the word of an old matrix
            slope, coarse, curvature = _derivatives(function, z, value, width)
            step, distance, lowest = _step(slope, curvature)
            together = None
        information = curvature / np.outer(width, width)
        if distance < GOOD and lowest > -CONVEX:
            break
        if together is None:
            scale = np.sqrt(np.maximum(np.abs(np.diagonal(curvature)), FLAT))
            together, age = np.clip(curvature / np.outer(scale, scale), -1.0, 1.0), 0
        # On a rough function the differences over half a width may know better than the fine ones.
        found = None
        for move in (step * width, _step(coarse, curvature)[0] * width, coarse * width):
            size = float(np.max(np.abs(move) / np.maximum(1.0, np.abs(z))))
            move = move * min(1.0, reach / max(size, 1e-300))
            found = _further(function, z, value, move)
            if found is not None:
                break
        if found is None:
            break
        at, new, share = found
        if size > reach or share < 1.0:
            reach = max(FARTHEST, 2.0 * reach if share == 1.0 else share * reach)
        age += 1
        if age >= KEPT or share < 1.0:
            together = None
        before, gained = gained, new - value
        z, value = at, new
        if max(before, gained) < LITTLE:
            break
    return Top(z, value, information, distance)


def climb_by_slope(function: Slope, z: np.ndarray) -> Top | None:
    """The top near z (F,) of a function with its gradient; None where it has no value there.

    -inf is no value, and a gradient that is not finite is none: the climb ends there.
    """
    z = np.array(z, dtype=float)
    value, slope = function(z)
    if not np.isfinite(value):
        return None
    if not len(z):
        return Top(z, value, np.zeros((0, 0)), 0.0)

    iterates: list[np.ndarray] = []

    def climbed(z: np.ndarray) -> tuple[float, np.ndarray]:
        value, slope = function(z)
        there = np.isfinite(value) and bool(np.all(np.isfinite(slope)))
        return (value, slope) if there else (-np.inf, np.zeros(len(z)))

    quasi_newton(climbed, z, QUASI_NEWTON_STEPS, iterates.append, GAIN)
    z = iterates[-1]
    value, slope = function(z)
    information, distance = np.full((len(z), len(z)), np.nan), np.inf
    for _ in range(LAST_STEPS):
        information = information_by_slope(function, z)
        if not (np.all(np.isfinite(information)) and np.all(np.isfinite(slope))):
            return Top(z, value, information, np.inf)
        step = newton_step(slope, information)
        distance = 0.5 * float(slope @ step)
        if distance < ARRIVED:
            break
        step *= min(1.0, FARTHEST / float(np.max(np.abs(step) / np.maximum(1.0, np.abs(z)))))
        higher = _further(lambda z: function(z)[0], z, value, step)
        if higher is None:
            break
        z, value = higher[0], higher[1]
        slope = function(z)[1]
    return Top(z, value, information, distance)


def information_by_slope(function: Slope, z: np.ndarray) -> np.ndarray:
    """(F, F) minus the second derivatives at z (F,), by central differences of the gradient over a
    small share of each width; NaN where there is none."""
    n = len(z)
    out = np.full((n, n), np.nan)
    longest = LONGEST * np.maximum(1.0, np.abs(z))
    size = NEAR * np.maximum(1.0, np.abs(z))
    for _ in range(WIDTH_TRIES):
        for i in range(n):
            up, down = (function(_moved(z, i, s * size[i]))[1] for s in (1.0, -1.0))
            out[i] = (down - up) / (2.0 * size[i])
        with np.errstate(divide="ignore", invalid="ignore"):
            wanted = FINE / np.sqrt(np.abs(np.diagonal(out)))
        # Where the gradient is none so far out, nearer.
        wanted = np.where(np.isfinite(wanted), np.minimum(wanted, longest), size / NEARER)
        if np.all(np.isfinite(out)) and np.all(np.abs(np.log(wanted / size)) < np.log(NEARER)):
            break
        size = wanted
    return 0.5 * (out + out.T)


def information_at(function: Function, z: np.ndarray) -> np.ndarray:
    """(F, F) minus the second derivatives at z (F,), by differences over a small share of a width;
    NaN where there is a point without a value."""
    function = _with_values(function)
    z = np.array(z, dtype=float)
    nothing = np.full((len(z), len(z)), np.nan)
    value = function(z)
    if not len(z) or not np.isfinite(value):
        return nothing
    width = widths(function, z, value, np.full(len(z), FIRST))
    seen: list[float] = []

    def kept(z: np.ndarray) -> float:
        seen.append(function(z))
        return seen[-1]

    _, _, curvature = _derivatives(kept, z, value, width, half=FINE)
    return curvature / np.outer(width, width) if np.all(np.isfinite(seen)) else nothing


def _with_values(function: Function) -> Function:
    """The function with -inf where it is as large as `NO_VALUE`, of whatever sign."""

    def of(z: np.ndarray) -> float:
        value = function(z)
        return value if abs(value) < NO_VALUE else -np.inf

    return of


def _further(
    function: Function, z: np.ndarray, value: float, move: np.ndarray
) -> tuple[np.ndarray, float, float] | None:
    """A higher point along a move, its value, and the share of the move; None for none."""
    for share in SHARES:
        at = z + share * move
        new = function(at)
        if new > value:
            return at, new, share
    return None


def widths(function: Function, z: np.ndarray, value: float, first: np.ndarray) -> np.ndarray:
    """(F,) steps over which the function falls or rises by about one, either way; `first` (F,)
    where to begin."""
    out = np.array(first)
    for i in range(len(z)):
        low, high, step = 0.0, np.inf, float(first[i])  # steps that are too short, too long
        widest = WIDEST * max(1.0, abs(z[i]))
        for _ in range(TRIES):
            change = max(abs(function(_moved(z, i, s * step)) - value) for s in (-1.0, 1.0))
            if CHANGE[0] <= change <= CHANGE[1] or (change < CHANGE[0] and step >= widest):
                break
            if change < CHANGE[0]:
                low = step
                step = min(step * TIMES, widest) if high == np.inf else np.sqrt(low * high)
            else:
                high = step
                step = step / TIMES if low == 0.0 else np.sqrt(low * high)
        out[i] = step
    return out


def _moved(z: np.ndarray, i: int, by: float) -> np.ndarray:
    out = z.copy()
    out[i] += by
    return out


def _derivatives(
    function: Function, z: np.ndarray, value: float, width: np.ndarray,
    together: np.ndarray | None = None, half: float = 0.5,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """(F,) slope, fine and over half a width, and (F, F) minus second differences, in widths; 0
    where there are none, the slope one-sided next to where there is no value.

    together : (F, F) in place of the mixed differences, which then are not taken: these over the
    roots of the two pure ones.
    """
    n, h = len(z), half
    ends = np.array([[function(_moved(z, i, s * size * width[i])) for s in (1.0, -1.0)]
                     for size in (FINE, h) for i in range(n)])  # fmt: skip
    fine, (plus, minus) = ends[:n], ends[n:].T
    with np.errstate(invalid="ignore"):
        slope = (fine[:, 0] - fine[:, 1]) / (2.0 * FINE)
        one_sided = np.where(np.isfinite(fine[:, 0]), fine[:, 0] - value, value - fine[:, 1]) / FINE
    slope = np.where(np.isfinite(slope), slope, one_sided)
    out = np.zeros((n, n))
    with np.errstate(invalid="ignore"):
        for i in range(n):
            out[i, i] = -(plus[i] - 2.0 * value + minus[i]) / h**2
            for j in range(i if together is None else 0):
                up, down = (
                    function(_moved(_moved(z, i, s * h * width[i]), j, s * h * width[j]))
                    for s in (1.0, -1.0)
                )
                twice = up - plus[i] - plus[j] + 2.0 * value - minus[i] - minus[j] + down
                out[i, j] = out[j, i] = -twice / (2.0 * h**2)
        if together is not None:
            scale = np.sqrt(np.abs(np.diagonal(out)))
            out += (together - np.diag(np.diagonal(together))) * np.outer(scale, scale)
        coarse = (plus - minus) / (2.0 * h)
    slope, coarse, out = (np.where(np.isfinite(a), a, 0.0) for a in (slope, coarse, out))
    return slope, coarse, out


def _step(slope: np.ndarray, curvature: np.ndarray) -> tuple[np.ndarray, float, float]:
    """(F,) a step that climbs, in widths, what a quadratic expects of it, the least eigenvalue."""
    lowest = float(np.linalg.eigvalsh(curvature)[0])
    step = newton_step(slope, curvature)
    return step, 0.5 * float(slope @ step), lowest


def newton_step(slope: np.ndarray, information: np.ndarray, flat: float = FLAT) -> np.ndarray:
    """(F,) information^-1 slope, the eigenvalues of the information, scaled to a diagonal of one,
    by their size and none next to zero. flat : what on the diagonal is none."""
    scale = np.sqrt(np.maximum(np.abs(np.diagonal(information)), flat))
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    values = np.maximum(np.abs(values), LEAST)
    return (vectors @ ((vectors.T @ (slope / scale)) / values)) / scale


def bfgs_update(h: np.ndarray, s: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Damped BFGS: H (F, F) such that H s is about y, positive definite still (Nocedal and Wright,
    *Numerical Optimization*, 2nd edition, procedure 18.2)."""
    hs = h @ s
    curvature, along = float(s @ hs), float(s @ y)
    if along < 0.2 * curvature:
        y = (weight := 0.8 * curvature / (curvature - along)) * y + (1.0 - weight) * hs
        along = float(s @ y)
    return h - np.outer(hs, hs) / curvature + np.outer(y, y) / along
