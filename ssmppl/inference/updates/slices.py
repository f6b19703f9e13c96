"""Slice sampling of what fits no family, one coordinate of an unconstrained scale at a time.

Neal (2003), "Slice sampling", Annals of Statistics 31: stepping out by doubling (figure 4), the
acceptance test that doubling asks for (figure 6), shrinkage (figure 5). No tuning is needed, and
the step leaves the conditional exactly invariant whatever the width.

Coordinates: a number with one bound by the log of its distance from it; on an interval as it is,
with the interval as the first slice; a simplex by log ratios to its last entry; a positive
definite matrix by its Cholesky factor with the log of the diagonal; a correlation matrix by the
inverse hyperbolic tangents of partial correlations. Their Jacobians are included.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from ssmppl.analysis.conjugacy.matrix_families import lower_half, symmetric
from ssmppl.language.model.transforms import free_correlations

Density = Callable[[Sequence[float]], float]
_DOUBLINGS = 60
_SHRINKS = 200


def comparable(log_density: float) -> float:
    """A log density as it is compared with others: -inf where it is NaN or +inf.

    A point where a density is infinite has no probability, and every step from it to another is
    refused: whoever takes it for the best of all stays there. It is a single point, as of a scale
    of zero, or the work of rounding, as where a square underflowed.
    """
    return log_density if log_density < math.inf else -math.inf


def slice_step(
    log_density: Callable[[float], float], x: float, rng: np.random.Generator,
    lower: float = -math.inf, upper: float = math.inf, width: float = 1.0,
) -> float:  # fmt: skip
    """One draw that leaves exp(log_density) on (lower, upper) invariant.

    Returns x unmoved where the density at x is not positive and finite: there is no slice to draw
    from. Nowhere else is a point taken at which it is not.
    """

    def at(point: float) -> float:
        return comparable(log_density(point))

    level = at(x)
    if not level > -math.inf:
        return x
    level -= rng.standard_exponential()
    finite = math.isfinite(lower) and math.isfinite(upper)
    if finite:
        left, right = lower, upper
    else:
        left = x - width * rng.random()
        right = left + width
        low, high = at(left), at(right)
        for _ in range(_DOUBLINGS):
            if not (low > level or high > level):
                break
            if rng.random() < 0.5:
                left -= right - left
                low = at(left)
            else:
                right += right - left
                high = at(right)
    a, b = left, right
    for _ in range(_SHRINKS):
        proposal = a + rng.random() * (b - a)
        if at(proposal) > level and (
            finite or _acceptable(at, x, proposal, level, left, right, width)
        ):
            return proposal
        if proposal < x:
            a = proposal
        else:
            b = proposal
    return x  # the slice is narrower than the spacing of floating point numbers


def _acceptable(
    log_density: Callable[[float], float], x: float, new: float, level: float, left: float,
    right: float, width: float,
) -> bool:  # fmt: skip
    """Whether doubling started from `new` could have given the same interval."""
    differ = False
    while right - left > 1.1 * width:
        middle = 0.5 * (left + right)
        if not left < middle < right:  # no number between them: far out, where the width is none
            break
        differ = differ or (x < middle) != (new < middle)
        if new < middle:
            right = middle
        else:
            left = middle
        if differ and not (log_density(left) > level or log_density(right) > level):
            return False
    return True


def sweep_real(
    log_density: Density, values: Sequence[float], bounds: Sequence[tuple[float, float]],
    rng: np.random.Generator,
) -> list[float]:  # fmt: skip
    """Slice steps over the components of a vector, each within its own bounds."""
    v = list(values)
    for i, (lower, upper) in enumerate(bounds):

        def at(x: float, i: int = i) -> float:
            old, v[i] = v[i], x
            out = log_density(v)
            v[i] = old
            return out

        v[i] = _bounded_step(at, v[i], lower, upper, rng)
    return v


def _bounded_step(
    at: Callable[[float], float], x: float, lower: float, upper: float, rng: np.random.Generator
) -> float:
    if math.isfinite(lower) == math.isfinite(upper):
        return slice_step(at, x, rng, lower, upper)
    sign, end = (1.0, lower) if math.isfinite(lower) else (-1.0, upper)

    def log_scale(z: float) -> float:
        if z > 700.0 or z < -740.0:
            return -math.inf
        return at(end + sign * math.exp(z)) + z

    distance = sign * (x - end)
    if not distance > 0.0:
        return x
    return end + sign * math.exp(slice_step(log_scale, math.log(distance), rng))


def sweep_simplex(
    log_density: Density, values: Sequence[float], rng: np.random.Generator
) -> list[float]:
    """Slice steps over the log ratios to the last entry; the Jacobian is prod_k p_k."""

    def probabilities(z: np.ndarray) -> np.ndarray:
        full = np.append(z, 0.0)
        weights = np.exp(full - full.max())
        return weights / weights.sum()

    def at(z: Sequence[float]) -> float:
        p = probabilities(np.array(z))
        if not np.all(p > 0.0):
            return -math.inf
        return log_density(p.tolist()) + float(np.sum(np.log(p)))

    logs = np.log(np.maximum(np.asarray(values), 1e-300))
    start = (logs[:-1] - logs[-1]).tolist()
    free = [(-math.inf, math.inf)] * len(start)
    return probabilities(np.array(sweep_real(at, start, free, rng))).tolist()


def sweep_matrix(
    log_density: Density, values: Sequence[float], size: int, rng: np.random.Generator
) -> list[float]:
    """Slice steps over the Cholesky factor L, the diagonal by its log.

    dP = 2^p prod_i L_ii^(p - i + 1) dL (i from 1), and dL_ii = L_ii d log L_ii.
    """
    cells = lower_half(size)

    def matrix(z: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
        root = np.zeros((size, size))
        for (i, j), x in zip(cells, z, strict=True):
            root[i, j] = math.exp(x) if i == j else x
        return root @ root.T, np.diagonal(root)

    def at(z: Sequence[float]) -> float:
        if any(abs(x) > 300.0 for (i, j), x in zip(cells, z, strict=True) if i == j):
            return -math.inf
        value, diagonal = matrix(z)
        if not _kept(value, diagonal):
            return -math.inf
        weights = size + 1.0 - np.arange(size)
        jacobian = float(weights @ np.log(diagonal))
        return log_density([value[c] for c in cells]) + jacobian

    root = np.linalg.cholesky(symmetric(values, size))
    start = [math.log(root[c]) if c[0] == c[1] else float(root[c]) for c in cells]
    value, _ = matrix(sweep_real(at, start, [(-math.inf, math.inf)] * len(cells), rng))
    return [value[c] for c in cells]


def sweep_correlations(
    log_density: Density, values: Sequence[float], size: int, rng: np.random.Generator
) -> list[float]:
    """Slice steps over the inverse hyperbolic tangents of partial correlations."""
    cells = lower_half(size)

    def at(z: Sequence[float]) -> float:
        root, log_jacobian = correlations_at(z, size)
        value = root @ root.T
        if not _kept(value, np.diagonal(root)):
            return -math.inf
        return log_density([1.0 if i == j else value[i, j] for i, j in cells]) + log_jacobian

    start = free_correlations(symmetric(values, size)).tolist()
    root, _ = correlations_at(
        sweep_real(at, start, [(-math.inf, math.inf)] * len(start), rng), size
    )
    value = root @ root.T
    return [1.0 if i == j else float(value[i, j]) for i, j in cells]


def correlations_at(z: Sequence[float], size: int) -> tuple[np.ndarray, float]:
    """The Cholesky factor (p, p) of the correlation matrix whose partial correlations, of row i and
    column j given the columns before j, are tanh z_ij; and the log Jacobian.

    dR = prod_ij cosh(z_ij)^-(p - j) dz (j from 0): Lewandowski, Kurowicka and Joe (2009).
    """
    root, log_jacobian, given = np.zeros((size, size)), 0.0, iter(z)
    for i in range(size):
        left = 1.0
        for j in range(i):
            s = next(given)
            root[i, j] = left * math.tanh(s)
            log_cosh = float(np.logaddexp(s, -s)) - math.log(2.0)
            left *= math.exp(-log_cosh)
            log_jacobian -= (size - j) * log_cosh
        root[i, i] = left
    return root, log_jacobian


def _kept(value: np.ndarray, diagonal: np.ndarray) -> bool:
    """Whether rounding has left of L L' enough to find L's diagonal again.

    A matrix that is singular to the last digit has an inverse of rounding errors, of any sign, and
    a density that means nothing.
    """
    try:
        found = np.diagonal(np.linalg.cholesky(value))
    except np.linalg.LinAlgError:
        return False
    return bool(np.all(np.abs(found - diagonal) <= 1e-3 * diagonal))
