"""Sums of products: coefficients times monomials in functions of a block of symbols."""

from __future__ import annotations

import numpy as np

from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import Expr, constant, symbols_of, to_text

Monomial = frozenset  # of (atom: Expr, exponent: float)
ONE: Monomial = frozenset()
Terms = dict[Monomial, list[Expr]]  # coefficient as a list of summands


def monomial_expr(monomial: Monomial) -> Expr:
    """The product of powers as an expression; atoms in the order of their text."""
    total = constant(1.0)
    for atom, exponent in sorted(monomial, key=lambda p: to_text(p[0])):
        total = total * atom**exponent
    return total


def gathered(terms: Terms) -> dict[Monomial, Expr]:
    """Coefficients as one expression each; without those that are, or cancel to, zero."""
    out = {}
    for monomial, parts in terms.items():
        parts = [p for p in parts if not (p.op == "const" and p.data == 0.0)]
        if parts and not (len(parts) > 1 and _cancels(parts)):
            total = summed(parts)
            if not (total.op == "const" and total.data == 0.0):
                out[monomial] = total
    return out


def _cancels(parts: list[Expr]) -> bool:
    """Whether the summands add to zero, at three random points of their symbols."""
    rng = np.random.default_rng(20150)
    symbols = sorted(symbols_of(parts), key=to_text)
    values = np.array(
        [
            np.broadcast_to(v, 3)
            for v in evaluate(parts, {s: rng.uniform(0.3, 1.7, 3) for s in symbols})
        ]
    )
    scale = np.abs(values).sum(0)
    return bool(np.all(np.isfinite(scale)) and np.all(np.abs(values.sum(0)) <= 1e-12 * scale))


def summed(parts: list[Expr]) -> Expr:
    """The sum of a coefficient's summands."""
    total = parts[0]
    for p in parts[1:]:
        total = total + p
    return total


def added(a: Terms, b: Terms) -> Terms:
    """a + b."""
    out = {m: list(c) for m, c in a.items()}
    for m, c in b.items():
        out.setdefault(m, []).extend(c)
    return out


def scaled(a: Terms, factor: Expr) -> Terms:
    """a times a factor free of the block."""
    return {m: [factor * p for p in c] for m, c in a.items()}


def split_constant(e: Expr) -> tuple[float, Expr]:
    """e = number * core."""
    number, one = 1.0, constant(1.0)
    while True:
        if e.op == "const":
            return number * e.data, one
        if e.op == "neg":
            number, e = -number, e.args[0]
        elif e.op == "mul" and e.args[0].op == "const":
            number, e = number * e.args[0].data, e.args[1]
        elif e.op == "mul" and e.args[1].op == "const":
            number, e = number * e.args[1].data, e.args[0]
        elif e.op == "div" and e.args[1].op == "const":
            number, e = number / e.args[1].data, e.args[0]
        else:
            return number, e
