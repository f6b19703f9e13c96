"""Algebraic forms of an `Expr` in chosen symbols: separable, polynomial, affine, quadratic."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from ssmppl.errors import NotApplicable
from ssmppl.expressions.arrays import ExprArray, array
from ssmppl.expressions.expr import Expr, constant, symbols_of, to_text
from ssmppl.expressions.separation import Separation, separate
from ssmppl.expressions.terms import ONE, Monomial, monomial_expr, split_constant

__all__ = [
    "ONE",
    "Monomial",
    "Separation",
    "affine",
    "monomial_expr",
    "polynomial",
    "quadratic",
    "separate",
    "split_constant",
]


def polynomial(
    expression: Expr, symbols: Sequence[Expr], degree: int
) -> dict[tuple[Expr, ...], Expr] | NotApplicable:
    """Coefficients by monomial (the symbols of it, in the order given, repeated by power)."""
    separation = separate(expression, symbols)
    if not isinstance(separation, Separation):
        return separation
    rank = {s: i for i, s in enumerate(symbols)}
    out = {}
    for monomial, coefficient in separation.terms.items():
        key: list[Expr] = []
        for atom, exponent in monomial:
            if atom not in rank or exponent != int(exponent) or exponent < 0:
                names = ", ".join(sorted({s.data[1] for s in symbols_of(atom)}))
                text = to_text(monomial_expr(monomial))
                return NotApplicable(f"{text} is not a polynomial in {names}")
            key += [atom] * int(exponent)
        if len(key) > degree:
            text = to_text(monomial_expr(monomial))
            return NotApplicable(f"{text} is of degree {len(key)}, above {degree}")
        out[tuple(sorted(key, key=rank.__getitem__))] = coefficient
    return out


def affine(
    expressions: Iterable[Expr], symbols: Sequence[Expr]
) -> tuple[ExprArray, ExprArray] | NotApplicable:
    """(A, b) with expressions = A @ symbols + b, A of shape (len(expressions), len(symbols))."""
    rows, offsets = [], []
    zero = constant(0.0)
    for e in expressions:
        form = polynomial(e, symbols, 1)
        if isinstance(form, NotApplicable):
            return form
        rows.append([form.get((s,), zero) for s in symbols])
        offsets.append(form.get((), zero))
    matrix = array(array(rows).reshape(len(rows), len(symbols)))
    return matrix, array(offsets)


def quadratic(
    expression: Expr, symbols: Sequence[Expr]
) -> tuple[ExprArray, ExprArray, Expr] | NotApplicable:
    """(H, g, c) with expression = -x' H x / 2 + g' x + c, H symmetric (a precision)."""
    form = polynomial(expression, symbols, 2)
    if isinstance(form, NotApplicable):
        return form
    n, zero = len(symbols), constant(0.0)
    h = np.empty((n, n), dtype=object)
    for i, a in enumerate(symbols):
        for j, b in enumerate(symbols):
            c = form.get((a, b) if i <= j else (b, a), zero)
            h[i, j] = -2.0 * c if i == j else -c
    return array(h), array([form.get((s,), zero) for s in symbols]), form.get((), zero)
