"""Algebraic forms of an `Expr` in chosen symbols: separable, polynomial, affine, quadratic."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from ssmppl.errors import NotApplicable
from ssmppl.expressions.arrays import ExprArray, array
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import (
    Expr,
    constant,
    dependent,
    split_constant,
    symbols_of,
    to_text,
)
from ssmppl.expressions.separation import Separation, separate
from ssmppl.expressions.terms import ONE, Monomial, monomial_expr
from ssmppl.expressions.zero import wide_points

POINTS = 64  # at which a form is held against what it was made of

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
    if _splits(expression, symbols) and not _holds(expression, separation, symbols):
        names = ", ".join(sorted({s.data[1] for s in symbols_of(expression) & set(symbols)}))
        return NotApplicable(
            f"{to_text(expression)} is {to_text(separation.assemble())} only where its roots and "
            f"logarithms are of positive numbers, whatever the sign of {names}"
        )
    return out


def _splits(expression: Expr, symbols: Sequence[Expr]) -> bool:
    """Whether roots (of matrices too) or logarithms were split as for positive factors."""
    return any(
        n.op in ("sqrt", "cholesky", "log", "log1p")
        or (n.op == "pow" and not (n.args[1].op == "const" and float(n.args[1].data).is_integer()))
        for n in dependent([expression], symbols)
    )


def _holds(expression: Expr, separation: Separation, symbols: Sequence[Expr]) -> bool:
    """Whether the separated form is the expression for symbols of both signs and many sizes."""
    rng = np.random.default_rng(20151)
    others = sorted(symbols_of(expression) - set(symbols), key=to_text)
    moderate = {s: rng.uniform(0.3, 1.7, POINTS) for s in others}
    terms = [function * coefficient for function, coefficient in separation.items()]
    for known in (moderate, wide_points(others, POINTS, rng)):
        at = known | wide_points(symbols, POINTS, rng)
        with np.errstate(all="ignore"):
            whole, *parts = (np.broadcast_to(v, POINTS) for v in evaluate([expression, *terms], at))
            size = np.abs(parts).sum(axis=0)
            off = np.abs(whole - np.sum(parts, axis=0)) > 1e-8 * size
        finite = np.isfinite(whole)
        if known is moderate and finite.any() and np.any(np.isfinite(size) & ~finite):
            return False  # it has no value where its form has one
        if np.any(off & finite & np.isfinite(size)):
            return False
    return True


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
