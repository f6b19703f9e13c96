"""The gradient of one expression in many symbols at once, by reverse accumulation over the graph.

It costs a few times the expression, however many the symbols, where `calculus.differentiate` costs
that for each of them (Griewank and Walther 2008, chapter 3). Matrix nodes follow Giles (2008). It
does without the care that `differentiate` takes of products of zero and infinity, except for what
a condition leaves out: where a gradient comes to no number, the caller has to do without.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ssmppl.expressions.arrays import ExprArray, array, inverse
from ssmppl.expressions.calculus import (
    CHOICES,
    FLAT,
    PARTIALS,
    NotDifferentiable,
    Slope,
    as_told,
    lower_inverse,
)
from ssmppl.expressions.expr import Expr, apply, as_expr, constant, dependent, topological

_ZERO = constant(0.0)


def reverse_gradient(expression: Expr, symbols: Sequence[Expr]) -> list[Expr]:
    """First derivatives of one expression in each symbol.

    Raises
    ------
    NotDifferentiable : as `calculus.differentiate`.
    """
    order = topological([expression], dependent([expression], symbols))
    involved = set(symbols)  # what moves with them
    for node in order:
        moving = node.args[1:] if node.op == "where" else node.args
        if node.op not in FLAT and not involved.isdisjoint(moving):
            involved.add(node)
    slopes: dict[Expr, Slope] = {expression: Slope(constant(1.0))}
    entries: dict[Expr, ExprArray] = {}  # slopes in the entries of matrix nodes

    def add(node: Expr, slope: Slope) -> None:
        if node in involved:
            slopes[node] = slopes[node].plus(slope) if node in slopes else slope

    for node in reversed(order):
        if node not in involved:
            continue
        if node.op in ("cholesky", "inverse"):
            if node in entries:
                for argument, value in zip(node.args, _of_matrix(node, entries[node]), strict=True):
                    add(argument, Slope(value))
            continue
        if node not in slopes or _is_zero(slopes[node].value):
            continue
        if node.op == "item":
            matrix = node.args[0]
            n = matrix.data
            here = entries.setdefault(matrix, array(np.full((n, n), _ZERO, dtype=object)))
            here[node.data] = here[node.data] + slopes[node].whole()
        else:
            for argument, slope in _of_arguments(node, slopes[node], involved):
                add(argument, slope)
    return [slopes[s].whole() if s in slopes else _ZERO for s in symbols]


def _of_arguments(node: Expr, slope: Slope, involved: set[Expr]) -> list[tuple[Expr, Slope]]:
    """What a node's slope makes in its arguments."""
    if node.op == "symbol":
        return []
    if node.op == "where" or node.op in CHOICES:
        first, second = node.args[-2:]
        condition = node.args[0] if node.op == "where" else CHOICES[node.op](*node.args)
        return [(first, slope.only(condition)), (second, slope.only(apply("not", condition)))]
    if node.op in ("logdet", "det"):
        n = node.data
        value = inverse(array(node.args).reshape(n, n)).T * slope.whole()
        value = value * node if node.op == "det" else value
        return list(zip(node.args, map(Slope, array(value).ravel()), strict=True))
    if node.op not in PARTIALS:
        raise NotDifferentiable(f"{as_told(node)} has no derivative in closed form")
    out = []
    for argument, partial in zip(node.args, PARTIALS[node.op](node, *node.args), strict=True):
        if argument not in involved:
            continue
        if partial is None:
            raise NotDifferentiable(f"{as_told(node)} has no derivative in {as_told(argument)}")
        out.append((argument, Slope(slope.value * as_expr(partial), slope.moves)))
    return out


def _of_matrix(node: Expr, slope: ExprArray) -> list[Expr]:
    """The slopes in the entries of A, row by row, from those in the entries of A^-1 or of its
    lower Cholesky factor, which reads the lower half of A only."""
    n = node.data
    item = np.array([[Expr("item", (node,), (i, j)) for j in range(n)] for i in range(n)])
    if node.op == "inverse":
        x = array(item)
        return list(array(-(x.T @ slope @ x.T)).ravel())
    lower = array(np.tril(array(item)))
    middle = array(np.tril(lower.T @ array(np.tril(slope))) * (1.0 - 0.5 * np.eye(n)))
    inv = lower_inverse(lower)
    whole = inv.T @ middle @ inv
    # d A symmetric from its lower half: both entries off the diagonal count for the lower one
    return list(array(np.tril(whole) + np.tril(whole.T, -1)).ravel())


def _is_zero(node: Expr) -> bool:
    return node.op == "const" and node.data == 0.0
