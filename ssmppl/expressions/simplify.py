"""Applying an operation: constants folded, neutral elements dropped, spellings brought together."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from typing import Any

import numpy as np

from ssmppl.expressions import special
from ssmppl.expressions.node import BOOLEAN, UNARY, Expr, as_expr, behaviour, constant


def apply(op: str, *operands: Any) -> Expr:
    """The node of `op` on nodes or numbers, with constants folded and neutral elements dropped.

    As in the algebra of real numbers, 0 * x and x - x are 0 and log(exp(x)) is x whatever x is,
    also where IEEE arithmetic would overflow or give nan.
    """
    args = tuple(as_expr(a) for a in operands)
    if op not in BOOLEAN and op != "where":  # arithmetic on a condition: 1 where it holds
        args = tuple(_as_number(a) for a in args)
    elif op == "where":
        args = (args[0], _as_number(args[1]), _as_number(args[2]))
    if all(a.op == "const" for a in args) and op in FOLD:
        with np.errstate(all="ignore"):
            return constant(FOLD[op](*(np.float64(a.data) for a in args)))
    for _, applies, result in RULES.get(op, ()):
        if applies(*args):
            return result(*args)
    return Expr(op, args)


behaviour["apply"] = apply


def _as_number(a: Expr) -> Expr:
    return Expr("where", (a, constant(1.0), constant(0.0))) if a.op in BOOLEAN else a


def _gammaln(x: float) -> float:
    if not math.isfinite(x):
        return math.inf if x > 0 else math.nan
    return math.inf if x <= 0 and x == int(x) else math.lgamma(x)


# Constants are folded with NumPy's arithmetic, which is the meaning of these operations.
FOLD: dict[str, Callable[..., Any]] = {
    **{name: getattr(np, name) for name in UNARY if hasattr(np, name)},
    "neg": operator.neg, "abs": abs, "add": operator.add, "sub": operator.sub,
    "mul": operator.mul, "div": np.divide, "pow": np.power, "mod": np.mod,
    "maximum": np.maximum, "minimum": np.minimum, "arctan2": np.arctan2,
    "logaddexp": np.logaddexp, "gammaln": _gammaln, "where": np.where,
    "gammaln_rise": special.gammaln_rise, "betaln": special.betaln,
    "lt": operator.lt, "le": operator.le, "eq": operator.eq, "ne": operator.ne,
    "and": np.logical_and, "or": np.logical_or, "not": np.logical_not,
}  # fmt: skip


def _is(a: Expr, value: float) -> bool:
    return a.op == "const" and a.data == value


def _number(a: Expr) -> bool:
    return a.op == "const"


def _begins_with_number(a: Expr, op: str) -> bool:
    """c x or c / x, as `op` says; the rules of "mul" put the number first."""
    return a.op == op and a.args[0].op == "const"


def _begins_with_positive(a: Expr, op: str) -> bool:
    return _begins_with_number(a, op) and a.args[0].data > 0


def without_exponentials(a: Expr) -> tuple[Expr, Expr | None]:
    """(b, e) with a = b exp(e), for products and quotients; no e where no factor is an exp."""
    done: dict[Expr, tuple[Expr, Expr | None]] = {}
    waiting = [a]
    while waiting:  # a product may have thousands of factors, and share them
        node = waiting[-1]
        missing = [f for f in node.args if f not in done] if node.op in _FACTORS else []
        waiting += missing
        if not missing:
            done[waiting.pop()] = _gathered(node, done)
    return done[a]


_FACTORS = {"neg", "mul", "div"}


def _gathered(a: Expr, done: dict[Expr, tuple[Expr, Expr | None]]) -> tuple[Expr, Expr | None]:
    """As `without_exponentials`, from what is known of the factors."""
    if a.op == "exp":
        return constant(1.0), a.args[0]
    if a.op == "neg":
        rest, exponent = done[a.args[0]]
        return (-rest, exponent) if exponent is not None else (a, None)
    if a.op not in _FACTORS:
        return a, None
    (left, up), (right, down) = (done[f] for f in a.args)
    if up is None and down is None:
        return a, None
    if down is not None and a.op == "div":
        down = -down
    parts = [e for e in (up, down) if e is not None]
    return apply(a.op, left, right), parts[0] if len(parts) == 1 else parts[0] + parts[1]


def _log_without_exponentials(a: Expr) -> Expr:
    rest, exponent = without_exponentials(a)
    assert exponent is not None
    return apply("log", rest) + exponent


# By operation: the mathematics (c, d are numbers), where the rule applies, what it gives. The first
# that applies is taken. Arguments that are all numbers are folded before.
Rule = tuple[str, Callable[..., bool], Callable[..., Expr]]
RULES: dict[str, tuple[Rule, ...]] = {
    "add": (
        ("0 + b = b", lambda a, b: _is(a, 0.0), lambda a, b: b),
        ("a + 0 = a", lambda a, b: _is(b, 0.0), lambda a, b: a),
        ("a + (-b) = a - b", lambda a, b: b.op == "neg", lambda a, b: a - b.args[0]),
    ),
    "sub": (
        ("a - 0 = a", lambda a, b: _is(b, 0.0), lambda a, b: a),
        ("0 - b = -b", lambda a, b: _is(a, 0.0), lambda a, b: -b),
        ("a - a = 0", lambda a, b: a is b, lambda a, b: constant(0.0)),
        ("a - (-b) = a + b", lambda a, b: b.op == "neg", lambda a, b: a + b.args[0]),
    ),
    "mul": (
        ("0 b = 0", lambda a, b: _is(a, 0.0), lambda a, b: constant(0.0)),
        ("a 0 = 0", lambda a, b: _is(b, 0.0), lambda a, b: constant(0.0)),
        ("a c = c a", lambda a, c: _number(c), lambda a, c: c * a),
        ("(-a) b = -(a b)", lambda a, b: a.op == "neg", lambda a, b: -(a.args[0] * b)),
        ("c (-b) = (-c) b", lambda c, b: _number(c) and b.op == "neg", lambda c, b: -c * b.args[0]),
        ("a (-b) = -(a b)", lambda a, b: b.op == "neg", lambda a, b: -(a * b.args[0])),
        ("c (d x) = (c d) x",
         lambda c, b: _number(c) and _begins_with_number(b, "mul"),
         lambda c, b: (c * b.args[0]) * b.args[1]),
        ("1 b = b", lambda a, b: _is(a, 1.0), lambda a, b: b),
        ("(-1) b = -b", lambda a, b: _is(a, -1.0), lambda a, b: -b),
    ),
    "div": (
        ("a / 1 = a", lambda a, b: _is(b, 1.0), lambda a, b: a),
        ("c / (d / x) = (c / d) x, d not 0",
         lambda c, b: _number(c) and _begins_with_number(b, "div") and b.args[0].data != 0,
         lambda c, b: (c / b.args[0]) * b.args[1]),
        ("0 / b = 0", lambda a, b: _is(a, 0.0), lambda a, b: constant(0.0)),
    ),
    "pow": (
        ("a ** 0 = 1", lambda a, b: _is(b, 0.0), lambda a, b: constant(1.0)),
        ("a ** 1 = a", lambda a, b: _is(b, 1.0), lambda a, b: a),
        ("a ** 0.5 = sqrt(a)", lambda a, b: _is(b, 0.5), lambda a, b: apply("sqrt", a)),
        ("a ** -1 = 1 / a", lambda a, b: _is(b, -1.0), lambda a, b: 1.0 / a),
    ),
    "log": (
        ("log(exp x) = x", lambda a: a.op == "exp", lambda a: a.args[0]),
        ("log(b exp(x)) = log b + x, also where exp(x) under- or overflows",
         lambda a: without_exponentials(a)[1] is not None, _log_without_exponentials),
        ("log(c x) = log c + log x, c > 0",
         lambda a: _begins_with_positive(a, "mul"),
         lambda a: math.log(a.args[0].data) + apply("log", a.args[1])),
        ("log(c / x) = log c - log x, c > 0",
         lambda a: _begins_with_positive(a, "div"),
         lambda a: math.log(a.args[0].data) - apply("log", a.args[1])),
    ),
    "neg": (
        ("-(-x) = x", lambda a: a.op == "neg", lambda a: a.args[0]),
        ("-(c x) = (-c) x",
         lambda a: _begins_with_number(a, "mul"), lambda a: -a.args[0] * a.args[1]),
    ),
    "where": (
        ("where(c, a, b) = a if c else b",
         lambda c, a, b: _number(c), lambda c, a, b: a if c.data else b),
        ("where(x, a, a) = a", lambda x, a, b: a is b, lambda x, a, b: a),
    ),
}  # fmt: skip


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
