"""Test points: values of symbols at which two forms of an expression are compared. Moderate ones,
wide ones, and such that each condition holds at some of them and fails at others.

`where`, `maximum`, `minimum` and `abs` have conditions. Each number that one compares with is among
the values of the symbols in it; one that they do not decide both ways is itself set to true and
false.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import BOOLEAN, Expr, apply, constant, symbols_of, topological
from ssmppl.expressions.properties import affirmed, conditions_of

TestPoints = dict[Expr, np.ndarray]
PLAIN, CASES, WIDE = 4, 64, 512  # how many, moderate ones without and with conditions, wide ones
LEAST, MOST = -6.0, 5.0  # powers of ten of wide values
AROUND = (-1.0, -0.1, 0.0, 0.1, 1.0)  # a number that is compared with, in parts of it


def with_cases(forms: Iterable[Expr]) -> list[Expr]:
    """The forms with `where` in place of what has a condition without saying so."""
    forms = list(forms)
    done: dict[Expr, Expr] = {}
    for node in topological(forms):
        args = tuple(done[a] for a in node.args)
        if node.op in ("maximum", "minimum"):
            a, b = args if node.op == "minimum" else args[::-1]
            done[node] = apply("where", apply("lt", *args), a, b)
        elif node.op == "abs":
            done[node] = apply("where", apply("lt", args[0], 0.0), -args[0], args[0])
        elif all(new is old for new, old in zip(args, node.args, strict=True)):
            done[node] = node
        else:
            done[node] = Expr(node.op, args, node.data)
    return [done[f] for f in forms]


def moderate(forms: list[Expr]) -> TestPoints:
    """Where most parameters may be; the first PLAIN of them whatever conditions there are.

    forms : as `with_cases` has them.
    """
    rng, compared = np.random.default_rng(20), _compared(forms)
    size = CASES if conditions_of(forms) else PLAIN
    values = {s: rng.uniform(0.2, 0.9, size) for s in _symbols(forms)}
    return _decided(forms, _crossed(values, compared, rng), rng)


def wide(forms: list[Expr]) -> TestPoints:
    """Points of many magnitudes; half of the points have positive values only."""
    rng, compared = np.random.default_rng(21), _compared(forms)
    values = {}
    for s in _symbols(forms):
        sign = np.where(np.arange(WIDE) % 2 == 0, 1.0, rng.choice([-1.0, 1.0], WIDE))
        values[s] = sign * 10.0 ** rng.uniform(LEAST, MOST, WIDE)
    return _decided(forms, _crossed(values, compared, rng), rng)


def _symbols(forms: list[Expr]) -> list[Expr]:
    return [n for n in topological(forms) if n.op == "symbol"]


def _compared(forms: list[Expr]) -> dict[Expr, list[float]]:
    """The numbers in the conditions that a symbol stands in."""
    found: dict[Expr, list[float]] = {}
    for condition in conditions_of(forms):
        numbers = [n.data for n in topological([condition])
                   if n.op == "const" and np.isfinite(n.data)]  # fmt: skip
        if condition.op not in BOOLEAN:
            numbers += [0.0, 1.0]
        for s in symbols_of(condition):
            found[s] = found.get(s, []) + numbers
    return found


def _crossed(
    values: TestPoints, compared: dict[Expr, list[float]], rng: np.random.Generator
) -> TestPoints:
    """With half of a symbol's values at, and on both sides of, what it is compared with."""
    for s, numbers in compared.items():
        if numbers:
            size = len(values[s])
            c = rng.choice(numbers, size)
            near = c + rng.choice(AROUND, size) * np.maximum(1.0, np.abs(c))
            kept = (rng.random(size) < 0.5) | (np.arange(size) < PLAIN)
            values[s] = np.where(kept, values[s], near)
    return values


def _decided(forms: list[Expr], values: TestPoints, rng: np.random.Generator) -> TestPoints:
    """With truth values for the conditions that are the same everywhere."""
    conditions = conditions_of(forms)
    size = len(next(iter(values.values()))) if values else PLAIN
    truth: dict[Expr, np.ndarray] = {}
    for condition, found in zip(conditions, evaluate(conditions, values), strict=True):
        holds = np.broadcast_to(found != 0.0, size)
        if holds.all() or not holds.any():
            name, opposite = affirmed(condition)
            own = truth.setdefault(name, rng.integers(0, 2, size).astype(float))
            own = 1.0 - own if opposite else own
            values[condition] = np.where(np.arange(size) < PLAIN, holds, own)
    return values


def numbers_at(forms: list[Expr], points: TestPoints) -> np.ndarray:
    """(points, forms): their values."""
    size = max((len(v) for v in points.values()), default=1)
    values = evaluate([constant(0.0), *forms], points)
    return np.stack([np.broadcast_to(np.asarray(v, dtype=float), size) for v in values[1:]], axis=1)
