"""Maps that are affine in what they move: x' = J x + c, where J and c do not depend on x.

After k times x is J^k x_0 + (1 + J + ... + J^(k-1)) c: two matrices, which are loops of their own
where J is not numbers, and linear in x_0 and c. So a model whose small steps are linear stays
linear Gaussian, and linear in what its inputs and parameters add.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from ssmppl.expressions.calculus import NotDifferentiable, bends, differentiate
from ssmppl.expressions.expr import (
    Expr,
    apply,
    as_expr,
    constant,
    depends_on,
    substitute,
    topological,
)
from ssmppl.expressions.loops.loop import fresh, repeated

Matrix = np.ndarray  # of nodes
TERMS = 16  # of the series of an exponential
MOST_HALVINGS = 60.0
NAME = "expm"  # of its loops


def affine_form(
    update: Sequence[Expr], symbols: Sequence[Expr]
) -> tuple[Matrix, list[Expr]] | None:
    """(J (n, n), c (n,)) with update = J symbols + c; None where it is not affine."""
    n = len(symbols)
    rows = np.full((len(update), n), constant(0.0), dtype=object)
    for k, s in enumerate(symbols):
        try:
            rows[:, k] = differentiate(list(update), s)
        except NotDifferentiable:
            return None
    if any(depends_on(e, symbols) for e in rows.ravel()):
        return None
    if any(
        bends(n) and depends_on(n, symbols) for n in topological(list(update))
    ):  # a step is flat too, and has another value elsewhere
        return None
    return rows, substitute(list(update), dict.fromkeys(symbols, constant(0.0)))


def numbers_of(matrix: Matrix) -> np.ndarray | None:
    """The matrix where it is one of numbers."""
    if all(e.op == "const" for e in matrix.ravel()):
        return np.array([e.data for e in matrix.ravel()], dtype=float).reshape(matrix.shape)
    return None


def power_and_sum(
    name: str, rows: Matrix, times: Expr, columns: Sequence[int]
) -> tuple[Matrix, Matrix]:
    """J^k (n, n), and the columns of 1 + J + ... + J^(k-1) that are asked for (n, columns)."""
    n = len(rows)
    known = numbers_of(rows)
    if known is not None and times.op == "const":
        power, total = np.eye(n), np.zeros((n, n))
        for _ in range(int(times.data)):
            power, total = known @ power, known @ total + np.eye(n)
        return _nodes(power), _nodes(total[:, list(columns)])
    power = moved(name, rows, _nodes(np.eye(n)), _nodes(np.zeros((n, n))), times)
    added = _nodes(np.eye(n)[:, list(columns)])
    return power, moved(name, rows, _nodes(np.zeros_like(added, dtype=float)), added, times)


def moved(name: str, rows: Matrix, first: Matrix, added: Matrix, times: Expr) -> Matrix:
    """X (n, m) after X <- J X + added, so many times."""
    shape = first.shape
    symbols = fresh(first.size)
    x = np.array(symbols, dtype=object).reshape(shape)
    update = dot(rows, x)
    values = repeated(name, symbols, list(first.ravel()), list((update + added).ravel()), times)
    return array_of(values, shape)


def dot(a: Matrix, b: Matrix) -> Matrix:
    """Matrix product of nodes, zeros left out."""
    out = np.full((a.shape[0], b.shape[1]), constant(0.0), dtype=object)
    for i in range(a.shape[0]):
        for j in range(b.shape[1]):
            total = constant(0.0)
            for k in range(a.shape[1]):
                total = total + a[i, k] * b[k, j]
            out[i, j] = total
    return out


def array_of(values: Sequence[Expr], shape: tuple[int, ...]) -> Matrix:
    """The nodes as a plain array of objects."""
    out = np.empty(len(values), dtype=object)
    out[:] = values
    return out.reshape(shape)


def _nodes(numbers: np.ndarray) -> Matrix:
    return array_of([as_expr(float(v)) for v in numbers.ravel()], numbers.shape)


def applied(
    power: Matrix, state: Sequence[Expr], sums: Matrix, added: Sequence[Expr]
) -> list[Expr]:
    """power state + sums added, (n,)."""
    out = dot(power, array_of(list(state), (len(state), 1)))
    if len(added):
        out = out + dot(sums, array_of(list(added), (len(added), 1)))
    return list(out.ravel())


def exponential(matrix: Matrix) -> Matrix:
    """exp(A) (n, n), by scaling, Taylor's series and squaring.

    A / 2^j has a norm of 1/2 at most; 16 terms of its series leave less than 1e-19 of it, and j
    squarings give exp(A) (Moler and Van Loan 2003, "Nineteen dubious ways to compute the
    exponential of a matrix, twenty-five years later", method 3).
    """
    n = len(matrix)
    known = numbers_of(matrix)
    if known is not None:
        from scipy.linalg import expm

        return _nodes(expm(known))
    if n == 1:
        return array_of([apply("exp", matrix[0, 0])], (1, 1))
    norm = constant(0.0)
    for column in matrix.T:
        size = constant(0.0)
        for e in column:
            size = size + apply("abs", e)
        norm = apply("maximum", norm, size)
    halvings = apply("ceil", apply("log", apply("maximum", norm, 1e-300)) / np.log(2.0) + 1.0)
    halvings = apply("minimum", apply("maximum", halvings, 0.0), MOST_HALVINGS)
    scaled = matrix * array_of([apply("pow", 2.0, -halvings)], (1,))[0]
    total = _series(scaled)
    symbols = fresh(n * n)
    x = array_of(symbols, (n, n))
    values = repeated(NAME, symbols, list(total.ravel()), list(dot(x, x).ravel()), halvings)
    return array_of(values, (n, n))


def scaling_of_exponentials(roots: Iterable[Expr]) -> set[Expr]:
    """The loops of exponentials of matrices, and what says how often they are halved and squared.
    It jumps, and they do not: any number gives the same matrix, to rounding."""
    loops = [n for n in topological(roots) if n.op == "loop" and n.data.name == NAME]
    return {*loops, *topological([n.args[-1] for n in loops])}


def _series(scaled: Matrix) -> Matrix:
    """1 + A (1 + A/2 (1 + A/3 (...))), from within; the last symbol counts the terms down."""
    n = len(scaled)
    symbols = fresh(n * n + 1)
    x, k = array_of(symbols[:-1], (n, n)), symbols[-1]
    product = dot(scaled, x)
    update = [e / k + (1.0 if i % (n + 1) == 0 else 0.0) for i, e in enumerate(product.ravel())]
    first = [*_nodes(np.eye(n)).ravel(), constant(float(TERMS))]
    values = repeated(NAME, symbols, first, [*update, k - 1.0], constant(float(TERMS)))
    return array_of(values[:-1], (n, n))
