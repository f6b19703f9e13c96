"""Where sum_i C_i s_i(block) of a family is largest: the closed forms of the M-step.

The functions s_i are those of `families.py`. What is maximised is the sum as it stands, on the
block's own scale (for statistics that hold a prior: the mode of the conditional, not that of its
logarithm). Bounds are respected: a maximum beyond one lies just inside of it, as supports are
open, by the share `MARGIN` of their width (of the bound's size where the other is infinite).

Normal-Gamma: v > 0 only scales the quadratic form in theta, so theta is found first, whatever the
bounds are; so it is with a Normal matrix and the covariance of its columns, without bounds. A
quadratic form under bounds is a least-squares problem with bounds, solved exactly by the active
sets of Stark and Parker (1995), "Bounded-variable least-squares".
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import scipy

from ssmppl.analysis.families import (
    Beta,
    Dirichlet,
    Family,
    Gamma,
    Normal,
    NormalGamma,
)
from ssmppl.analysis.families_matrix import (
    MatrixNormalWishart,
    Values,
    lower_values,
)

MARGIN = 1e-9
FLAT = 1e-12  # relative curvature below which a direction counts as flat
LEAST_SHARE = 1e-12
Limits = Sequence[tuple[float, float]]


def mode(
    family: Family, c: Sequence[float], limits: Limits, present: np.ndarray
) -> np.ndarray | None:
    """The block's values at the maximum, in the order of its components.

    Parameters
    ----------
    c : the statistics C_i, with a 0 at the end for functions that are absent.
    limits : (lower, upper) of each component.
    present : kept along directions in which the sum is flat.

    Returns
    -------
    None where the sum has no maximum within the limits.
    """
    if not np.all(np.isfinite(c)):
        return None
    if isinstance(family, Gamma):
        v = _power(c[family.log], c[family.pow], family.power, limits[0])
        return None if v is None else np.array([v])
    if isinstance(family, Normal):
        return _quadratic(*family.parameters(c), limits, present)
    if isinstance(family, NormalGamma):
        return _normal_gamma(family, c, limits, present)
    if isinstance(family, Beta):
        return _beta(c[family.first], c[family.second], limits[0])
    if isinstance(family, Dirichlet):
        return _dirichlet(np.asarray(c)[np.array(family.logs)])
    if isinstance(family, MatrixNormalWishart):
        return _matrix_normal(family, c, limits)
    value = _wishart(family.parameters(c)[1], c[family.log], family.inverse)
    return None if value is None else np.array(value)


def inside(value: float, low: float, high: float) -> float:
    """The value, or where it lies outside of (low, high), the nearest one just inside."""
    width = high - low
    margin = MARGIN * width if math.isfinite(width) else 0.0
    if value <= low:
        return low + (margin or MARGIN * max(abs(low), MARGIN))
    if value >= high:
        return high - (margin or MARGIN * max(abs(high), MARGIN))
    return value


def _power(a: float, b: float, k: float, limits: tuple[float, float]) -> float | None:
    """The v > 0 that maximises a log v + b v**k."""
    low, high = max(limits[0], 0.0), limits[1]
    if b > 0.0 or (a == 0.0 and b == 0.0):
        return None
    if b < 0.0 and a / k > 0.0:
        return inside(math.exp(math.log(-a / (k * b)) / k), low, high)
    rising = a > 0.0 or (a == 0.0 and k < 0.0)  # monotone in v
    if rising:
        return inside(math.inf, low, high) if high < math.inf else None
    return inside(-math.inf, low, high) if low > 0.0 else None


def _quadratic(
    h: np.ndarray, precision: np.ndarray, limits: Limits, present: np.ndarray
) -> np.ndarray | None:
    """The theta within the limits that maximises h' theta - theta' H theta / 2."""
    values, vectors = np.linalg.eigh(precision)
    largest = float(np.abs(values).max())
    curved = values > FLAT * largest
    if not largest > 0.0 or values.min() < -FLAT * largest:
        return None
    slope = h - precision @ present
    along = vectors.T @ slope
    if np.any(np.abs(along[~curved]) > 1e-9 * (np.abs(h).max() + largest)):
        return None  # rises for ever in a direction without curvature
    root = vectors[:, curved] * np.sqrt(values[curved])
    target = along[curved] / np.sqrt(values[curved])
    theta = present + vectors[:, curved] @ (target / np.sqrt(values[curved]))
    if all(low < x < high for x, (low, high) in zip(theta, limits, strict=True)):
        return theta
    low, high = (np.array(b) for b in zip(*limits, strict=True))
    found = scipy.optimize.lsq_linear(
        root.T, target, bounds=(low - present, high - present), method="bvls"
    )
    moved = present + found.x
    return np.array([inside(x, *b) for x, b in zip(moved, limits, strict=True)])


def _normal_gamma(
    family: NormalGamma, c: Sequence[float], limits: Limits, present: np.ndarray
) -> np.ndarray | None:
    h, precision = family.normal.parameters(c)
    theta = _quadratic(h, precision, limits[:-1], present[:-1])
    if theta is None:
        return None
    level = c[family.pow] + float(h @ theta - 0.5 * theta @ precision @ theta)
    v = _power(c[family.log], level, family.power, limits[-1])
    return None if v is None else np.array([*theta, v])


def _beta(a: float, b: float, limits: tuple[float, float]) -> np.ndarray | None:
    """The p that maximises a log p + b log(1 - p)."""
    low, high = max(limits[0], 0.0), min(limits[1], 1.0)
    if a >= 0.0 and b >= 0.0 and a + b > 0.0:
        return np.array([inside(a / (a + b), low, high)])
    return None


def _dirichlet(c: np.ndarray) -> np.ndarray | None:
    if np.any(c < 0.0) or not c.sum() > 0.0:
        return None
    p = np.maximum(c / c.sum(), LEAST_SHARE)
    return p / p.sum()


def _wishart(matrix: np.ndarray, log: float, inverse: bool) -> Values | None:
    """P = 2 c S^-1 of c log det P - tr(S P) / 2; the inverse's C = S / (-2 c)."""
    values = np.linalg.eigvalsh(matrix)
    if not values[0] > FLAT * values[-1]:
        return None
    if inverse:
        return lower_values(matrix / (-2.0 * log)) if log < 0.0 else None
    return lower_values(2.0 * log * np.linalg.inv(matrix)) if log > 0.0 else None


def _matrix_normal(
    family: MatrixNormalWishart, c: Sequence[float], limits: Limits
) -> np.ndarray | None:
    """A = S_yz K^-1 whatever the matrix is, and that from what A leaves of S_yy."""
    solved = family.solve(c)
    if solved is None:
        return None
    _, matrix, mean, _ = solved
    value = _wishart(matrix, c[family.wishart.log], family.wishart.inverse)
    a = family.entries(mean)
    inside = all(low < x < high for x, (low, high) in zip(a, limits, strict=False))
    return np.array([*a, *value]) if value is not None and inside else None
