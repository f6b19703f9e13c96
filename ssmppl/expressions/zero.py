"""Whether a sum of expressions is zero whatever the values of its symbols.

It is decided at random points (Schwartz, *J. ACM* 27 (1980), for polynomials), which needs care:

* A condition never holds at random, nor does a hinge such as max(u - 18, 0) bend where the points
  lie. So conditions are tried in all cases, and what is no rational function of its arguments (a
  maximum, a rounding, a distribution function, ...) is a symbol of its own. Two such symbols are
  equal where they are written alike, and otherwise unrelated; so is exp, but for its sums and
  multiples in the exponent.
* Roots and powers are followed: points of both signs and of many sizes tell sqrt(u**2) from u.
* A small summand is lost in the rounding of large ones. So a sum vanishes only if each summand is
  large enough somewhere to be missed; else the large ones have to vanish by themselves.

What is zero by a rule that is not among these (cosh^2 - sinh^2) is not found to be; nothing else is
found to be.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import (
    MATRIX_OPS,
    Expr,
    apply,
    constant,
    is_tuple,
    rebuilt,
    split_constant,
    substitute,
    symbol,
    symbols_of,
    to_text,
    topological,
)
from ssmppl.expressions.node import SEVERAL
from ssmppl.expressions.properties import affirmed, conditions_of

NEAR = 3  # points of moderate size in each case of the conditions
WIDE = 128  # points of all signs and sizes
SIZES = (0.1, 1.0, 30.0, 1e3, 1e6)
EXACT, LOOSE = 1e-12, 1e-6  # of the summands' sizes: at the near points, and at the wide ones
MISSED = 1e-6  # a summand is seen where it has this share of all
MANY = 200  # summands beyond which products are not multiplied out
MOST = 2000  # products of summands made in all
_FOLLOWED = {"const", "symbol", "add", "sub", "mul", "div", "neg", "sqrt", "log", "sin", "cos",
             "where", "and", "or", "not", "item", *MATRIX_OPS}  # fmt: skip


def cancels(parts: Sequence[Expr]) -> bool:
    """Whether the summands add to zero, whatever the values of their symbols."""
    bound, conditions = _conditions_as_symbols(list(parts))
    bound = _summands(_rational(bound))
    while bound:
        values = _values(bound, conditions)
        if values is None:
            return False
        seen = _seen(values[0])
        if not seen.any() or not _vanishes(*(v[seen] for v in values)):
            return False
        bound = [p for p, s in zip(bound, seen, strict=True) if not s]
    return True


def wide_points(
    symbols: Sequence[Expr], count: int, rng: np.random.Generator
) -> dict[Expr, np.ndarray]:
    """Values (count,) for each symbol: of both signs and many sizes, half of them in (0.3, 1.7)."""
    out = {}
    for s in symbols:
        moderate = rng.uniform(0.3, 1.7, count)
        far = moderate * rng.choice(SIZES, count) * rng.choice((-1.0, 1.0), count)
        out[s] = np.where(rng.random(count) < 0.5, moderate, far)
    return out


# -- the test at points
def _values(parts: list[Expr], conditions: list[Expr]) -> tuple[np.ndarray, np.ndarray] | None:
    """The summands (parts, points) at near points and at wide ones; None where one is no number at
    a near point."""
    rng = np.random.default_rng(20150)
    free = sorted(symbols_of(parts) - set(conditions), key=to_text)
    cases = _cases(len(conditions), rng)
    size = NEAR * cases.shape[1]
    near = {s: np.tile(rng.uniform(0.3, 1.7, NEAR), cases.shape[1]) for s in free}
    near |= {s: np.repeat(row, NEAR) for s, row in zip(conditions, cases, strict=True)}
    wide = wide_points(free, WIDE, rng)
    some = cases[:, rng.integers(0, cases.shape[1], WIDE)]
    wide |= dict(zip(conditions, some, strict=True))
    with np.errstate(all="ignore"):
        at_near = np.array([np.broadcast_to(v, size) for v in evaluate(parts, near)], dtype=float)
        at_wide = np.array([np.broadcast_to(v, WIDE) for v in evaluate(parts, wide)], dtype=float)
        finite = np.isfinite(np.abs(at_wide).sum(axis=0))
    return (at_near, at_wide[:, finite]) if np.all(np.isfinite(at_near)) else None


def _seen(near: np.ndarray) -> np.ndarray:
    """(parts,) whether each of the summands (parts, points) would be missed at some point."""
    sizes = np.abs(near)
    with np.errstate(invalid="ignore"):
        share = sizes / sizes.sum(axis=0)
    return np.any(share >= MISSED, axis=1)


def _vanishes(near: np.ndarray, wide: np.ndarray) -> bool:
    with np.errstate(over="ignore"):
        exact = np.abs(near.sum(axis=0)) <= EXACT * np.abs(near).sum(axis=0)
        loose = np.abs(wide.sum(axis=0)) <= LOOSE * np.abs(wide).sum(axis=0)
    return bool(exact.all() and loose.all())


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


# -- the form that is tested
def _conditions_as_symbols(parts: list[Expr]) -> tuple[list[Expr], list[Expr]]:
    """(the summands with a symbol for each condition, these symbols)."""
    names: dict[Expr, Expr] = {}
    leaves: dict[Expr, Expr] = {}
    for condition in conditions_of(parts):
        asked, opposite = affirmed(condition)
        name = names.setdefault(asked, symbol("condition", str(len(names))))
        leaves[condition] = 1.0 - name if opposite else name
    return substitute(parts, leaves), list(names.values())


def _rational(parts: list[Expr]) -> list[Expr]:
    """With a symbol in place of every other function, and powers of symbols for exponentials."""
    new: dict[Expr, Expr] = {}
    own: dict[Expr, Expr] = {}
    for node in topological(parts):
        moved = rebuilt(node, tuple(new[a] for a in node.args))
        if moved.op == "exp":
            moved = _exponential(moved.args[0], own)
        elif moved.op in SEVERAL or is_tuple(moved):
            pass  # what is taken from it is a symbol
        elif (moved.op == "item" and moved.args[0].op in (*SEVERAL, "call")) or (
            moved.op not in _FOLLOWED and not (moved.op == "pow" and moved.args[1].op == "const")
        ):
            moved = own.setdefault(moved, symbol("function", str(len(own))))
        new[node] = moved
    return [new[p] for p in parts]


def _exponential(exponent: Expr, own: dict[Expr, Expr]) -> Expr:
    """exp(2 a + log b) as e_a^2 b; `own` has the symbol of each exp(a)."""
    total = constant(1.0)
    for term in _summands([exponent]):
        factor, core = split_constant(term)
        if core.op == "const":
            total = total * apply("exp", constant(factor * core.data))
        elif core.op == "log":
            total = total * core.args[0] ** factor
        else:
            e = own.setdefault(apply("exp", core), symbol("function", str(len(own))))
            total = total * e**factor
    return total


def _summands(parts: list[Expr]) -> list[Expr]:
    """Sums taken apart, also in products and numerators; none where that makes too many."""
    found: dict[Expr, list[Expr]] = {}
    left = MOST
    for node in topological(parts):
        op, own = node.op, [node]
        under = [found[a] for a in node.args]
        if op == "add":
            own = under[0] + under[1]
        elif op == "sub":
            own = under[0] + [-p for p in under[1]]
        elif op == "neg":
            own = [-p for p in under[0]]
        elif op == "div":
            own = [p / node.args[1] for p in under[0]]
        elif op == "mul" and 1 < (size := len(under[0]) * len(under[1])) <= min(MANY, left):
            own = [a * b for a in under[0] for b in under[1]]
            left -= size
        found[node] = own if len(own) <= MANY else [node]
    return [p for part in parts for p in found[part]]
