"""What the covariance of a traced MvNormal is made of: independent components, or too few noises.

One with zeros off its diagonal is a Normal law of each component, and is taken as such. One whose
rank is less than its size (q G G', one noise that drives several states) has no density; draws need
a root of it, found by the Cholesky recursion in the given order, whose pivots of zero leave columns
of zeros (Higham 2002, "Accuracy and stability of numerical algorithms", section 10.3).
"""

from __future__ import annotations

import numpy as np

from ssmppl.expressions.arrays import ExprArray, array
from ssmppl.expressions.arrays import elementwise as ew
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import Expr, constant, symbols_of
from ssmppl.language.continuous import Normal
from ssmppl.language.distribution import Distribution
from ssmppl.language.multivariate import MvNormal

POINTS = 4  # random values of the symbols at which a pivot has to be zero
ZERO = 1e-10  # of the largest variance: what is zero in floating point
LARGEST = 12  # components; the root of more is not written out in symbols


def independent(law: Distribution) -> Distribution:
    """A Normal law of each component in place of an MvNormal one with zeros off its diagonal."""
    if not isinstance(law, MvNormal):
        return law
    matrix = law.parameters[law.spread].view(np.ndarray)
    zero = constant(0.0)
    if any((matrix[i, j] is zero) == (i == j) for i, j in np.ndindex(matrix.shape)):
        return law
    name = {"covariance": "variance", "precision": "precision", "cholesky": "sd"}[law.spread]
    spread: dict[str, ExprArray] = {name: array(np.diagonal(matrix))}
    normal = Normal(law.mean_, **spread)  # type: ignore[arg-type]
    normal.location = law.location
    return normal


def find_root(law: Distribution) -> None:
    """Give an MvNormal law of singular covariance its root."""
    if not isinstance(law, MvNormal) or law.spread != "covariance":
        return
    matrix = law.parameters["covariance"]
    if len(matrix) <= LARGEST:
        law.root = _singular_root(matrix)


def _singular_root(matrix: ExprArray) -> ExprArray | None:
    """Lower triangular L, (d, d), with L L' = the matrix; None where its rank is full, or it is
    no covariance at the points that are tried."""
    points = _points(matrix)
    if np.linalg.matrix_rank(_numbers(matrix, points)[0], hermitian=True) == len(matrix):
        return None
    n, zero = len(matrix), constant(0.0)
    left = np.array(matrix.view(np.ndarray), dtype=object)
    root = np.full((n, n), zero, dtype=object)
    largest = np.max(np.abs(_numbers(matrix, points)), axis=(1, 2))
    rank = 0
    for k in range(n):
        values = _numbers(array(left[k:, k:]), points)
        small = np.abs(values[:, :, 0]) <= ZERO * largest[:, None]  # (points, rows below)
        if small[:, 0].all():
            if not small.all():
                return None
            continue
        if not np.all(values[:, 0, 0] > ZERO * largest):
            return None
        pivot = ew("sqrt", left[k, k])
        for i in range(k, n):
            if not small[:, i - k].all():
                root[i, k] = pivot if i == k else left[i, k] / pivot
        for i in range(k + 1, n):
            for j in range(k + 1, n):
                left[i, j] = left[i, j] - root[i, k] * root[j, k]
        rank += 1
    return array(root) if rank < n else None


def _points(matrix: ExprArray) -> list[dict[Expr, float]]:
    """Values of the matrix's symbols, drawn where most parameters may be."""
    rng = np.random.default_rng(20)
    symbols = list(symbols_of(list(matrix.ravel())))
    return [dict(zip(symbols, rng.uniform(0.2, 0.9, len(symbols)), strict=True))
            for _ in range(POINTS)]  # fmt: skip


def _numbers(matrix: ExprArray, points: list[dict[Expr, float]]) -> np.ndarray:
    """The matrix at each point, (points, rows, columns); zeros where it is not finite."""
    with np.errstate(all="ignore"):
        values = [np.array(evaluate(list(matrix.ravel()), p), dtype=float) for p in points]
    return np.nan_to_num(np.array(values)).reshape(len(points), *matrix.shape)
