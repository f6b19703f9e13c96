"""Sums of products: coefficients times monomials in functions of a block of symbols."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import (
    Expr,
    constant,
    substitute,
    symbol,
    symbols_of,
    to_text,
    topological,
)

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


def cancels(parts: list[Expr]) -> bool:
    """Whether the summands add to zero: at random points, and in all cases of their conditions.

    Random numbers alone would not do, as they never equal the value that a condition asks for.
    """
    bound, conditions = _conditions_as_symbols(parts)
    return _vanishes(parts) and (not conditions or _vanishes(bound, conditions))


def _vanishes(parts: list[Expr], conditions: Sequence[Expr] = ()) -> bool:
    """Whether the sum is zero at three random points, each in many cases of the conditions."""
    rng = np.random.default_rng(20150)
    free = sorted(symbols_of(parts) - set(conditions), key=to_text)
    cases = _cases(len(conditions), rng)
    size = 3 * cases.shape[1]
    points = {s: np.tile(rng.uniform(0.3, 1.7, 3), cases.shape[1]) for s in free}
    points |= {s: np.repeat(row, 3) for s, row in zip(conditions, cases, strict=True)}
    values = np.array([np.broadcast_to(v, size) for v in evaluate(parts, points)])
    scale = np.abs(values).sum(0)
    return bool(np.all(np.isfinite(scale)) and np.all(np.abs(values.sum(0)) <= 1e-12 * scale))


def _cases(conditions: int, rng: np.random.Generator) -> np.ndarray:
    """0/1 for each condition, (conditions, cases): none, one, two and all true, and 64 random ones.

    One or two at a time, as a state equals one value at most: a term may count in one case alone.
    """
    true = [(), tuple(range(conditions))]
    true += [c for k in (1, 2) for c in itertools.combinations(range(conditions), k)]
    out = np.zeros((conditions, len(true)))
    for column, chosen in enumerate(true):
        out[list(chosen), column] = 1.0
    return np.hstack([out, rng.integers(0, 2, (conditions, 64)).astype(float)])


def _conditions_as_symbols(parts: list[Expr]) -> tuple[list[Expr], list[Expr]]:
    """(the summands with a symbol for each condition, these symbols)."""
    names: dict[Expr, Expr] = {}
    leaves: dict[Expr, Expr] = {}

    def named(node: Expr) -> Expr:
        return names.setdefault(node, symbol("condition", str(len(names))))

    waiting = [n.args[0] for n in topological(parts) if n.op == "where"]
    while waiting:
        node = waiting.pop()
        if node.op in ("and", "or", "not"):
            waiting += node.args
        elif node.op == "ne":
            leaves[node] = 1.0 - named(Expr("eq", node.args))
        elif node.op == "le":  # a <= b is not b < a
            leaves[node] = 1.0 - named(Expr("lt", node.args[::-1]))
        elif node.op != "const":
            leaves[node] = named(node)
    return substitute(parts, leaves), list(names.values())


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
