"""Sums of products: coefficients times monomials in functions of a block of symbols."""

from __future__ import annotations

from ssmppl.expressions.expr import Expr, constant, to_text
from ssmppl.expressions.zero import cancels

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
        if parts and not (len(parts) > 1 and cancels(parts)):
            total = summed(parts)
            if not (total.op == "const" and total.data == 0.0):
                out[monomial] = total
    return out


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
