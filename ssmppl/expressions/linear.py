"""Linear algebra on small matrices of symbols: factorisations, inverses, determinants, norms.

Diagonal matrices are worked out entry by entry, matrices of numbers by NumPy; all others become
matrix nodes (`MATRIX_OPS`), which generated code evaluates by one call each.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ssmppl.expressions.arrays import ExprArray, array, elementwise, plain, reduced, refuse
from ssmppl.expressions.expr import Expr, apply, as_expr, constant, item, matrix_op


def square_matrix(a: Any, what: str) -> np.ndarray:
    """`a` as a plain object array, refused unless it is a square matrix."""
    a = plain(a)
    if a.ndim != 2 or a.shape[0] != a.shape[1]:
        refuse(f"{what} of shape {a.shape}", "pass one square matrix")
    return a


def _constants(a: np.ndarray) -> np.ndarray | None:
    """The matrix as numbers where it holds no symbols."""
    exprs = [as_expr(e) for e in a.flat]
    if any(e.op != "const" for e in exprs):
        return None
    return np.array([e.data for e in exprs]).reshape(a.shape)


def _matrix(op: str, a: Any) -> ExprArray:
    a = square_matrix(a, f"linalg {op}")
    n, numbers = len(a), _constants(a)
    if numbers is not None:
        try:
            return array((np.linalg.inv if op == "inverse" else np.linalg.cholesky)(numbers))
        except np.linalg.LinAlgError as error:
            refuse(f"{op} of {numbers.tolist()}: {error}", "check the matrix's entries")
    node = matrix_op(op, a.flat, n)
    zero = constant(0.0)
    return array([[zero if op == "cholesky" and j > i else item(node, i, j) for j in range(n)]
                  for i in range(n)])  # fmt: skip


def _is_diagonal(a: Any) -> bool:
    return all(
        a[i] == 0 if not isinstance(a[i], Expr) else a[i].op == "const" and a[i].data == 0
        for i in np.ndindex(a.shape)
        if i[0] != i[1]
    )


def cholesky(a: Any, upper: bool = False) -> ExprArray:
    """Lower Cholesky factor of a symmetric positive definite matrix (its lower half is read).

    upper : the upper factor, of which the upper half is read.
    """
    if upper:
        return array(plain(cholesky(square_matrix(a, "linalg.cholesky").T)).T)
    a = square_matrix(a, "linalg.cholesky")
    if _is_diagonal(a):
        return array(np.diag(array([apply("sqrt", d) for d in np.diagonal(a)])))
    return _matrix("cholesky", a)


def squared(root: Any) -> ExprArray | None:
    """The matrix whose Cholesky factor, made by `cholesky`, this is; None if it is no such."""
    a = plain(root)
    first = as_expr(a.flat[0]) if a.size else constant(0.0)
    if first.op != "item" or first.args[0].op != "cholesky":
        return None
    node, n, zero = first.args[0], len(a), constant(0.0)
    if node.data != n or any(
        as_expr(a[i, j]) is not (item(node, i, j) if j <= i else zero) for i, j in np.ndindex(n, n)
    ):
        return None
    return array(np.array(node.args, dtype=object).reshape(n, n))


def inverse(a: Any) -> ExprArray:
    """Inverse of a square matrix."""
    a = square_matrix(a, "linalg inverse")
    if _is_diagonal(a):
        return array(np.diag(array([1.0 / as_expr(d) for d in np.diagonal(a)])))
    return _matrix("inverse", a)


def log_determinant(a: Any) -> Expr:
    """log det a of a positive definite matrix."""
    a = square_matrix(a, "linalg log determinant")
    if _is_diagonal(a):
        return reduced("add", [apply("log", d) for d in np.diagonal(a)])
    numbers = _constants(a)
    if numbers is not None:
        return constant(np.linalg.slogdet(numbers)[1])
    return matrix_op("logdet", a.flat, len(a))


def det(a: Any) -> Expr:
    """Determinant of a square matrix."""
    a = square_matrix(a, "linalg.det")
    if _is_diagonal(a):
        return reduced("mul", list(np.diagonal(a)))
    return matrix_op("det", a.flat, len(a))


class Slogdet(NamedTuple):
    """What np.linalg.slogdet gives."""

    sign: Expr
    logabsdet: Expr


def slogdet(a: Any) -> Slogdet:
    """Sign of det a and log |det a|."""
    a = square_matrix(a, "linalg.slogdet")
    if _is_diagonal(a):
        size = reduced("add", [apply("log", apply("abs", d)) for d in np.diagonal(a)])
    else:
        size = log_determinant(a)
    return Slogdet(apply("sign", det(a)), size)


def norm(x: Any, ord: Any = None, axis: Any = None, keepdims: bool = False) -> Any:
    """Euclidean norm, of a vector, along an axis, or of all entries."""
    along = axis is None or np.ndim(axis) == 0
    euclidean = ord is None or (isinstance(ord, (int, float)) and ord == 2)
    if not along or not euclidean or (ord == 2 and axis is None and plain(x).ndim != 1):
        refuse("np.linalg.norm other than the Euclidean norm of vectors", "write it out")
    return elementwise("sqrt", reduced("add", elementwise("mul", x, x), axis, keepdims))
