"""The table of simplifications: every rule is used, and means what its left-hand side means."""

import itertools

import numpy as np
import pytest

from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import RULES, Expr, apply, constant, symbol

X, Y = symbol("state", "x"), symbol("state", "y")
AT = {X: np.array([0.7, 1.3, 2.9]), Y: np.array([1.9, 0.4, 0.8])}
NUMBERS = [constant(v) for v in (0.0, 1.0, -1.0, 0.5, 2.5)]
SYMBOLIC = [X, Y, -X, 2.5 * X, 2.5 / Y, np.exp(X), X + Y,
            np.maximum(X, 1.0)]  # fmt: skip
PRODUCTS = [Y * np.exp(X), np.exp(X) / Y, Y / np.exp(X), np.exp(-X) * X * np.exp(Y), 2 * np.exp(X)]
CONDITIONS = [constant(1.0), constant(0.0), X < Y]


def arguments(op):
    """Arguments as `apply` hands them to the rules: not all of them numbers."""
    first = CONDITIONS if op == "where" else NUMBERS + SYMBOLIC
    count = {"log": 1, "neg": 1, "where": 3}.get(op, 2)
    if op == "log":
        yield from ((a,) for a in PRODUCTS)
    for args in itertools.product(first, *[NUMBERS + SYMBOLIC] * (count - 1)):
        if any(a.op != "const" for a in args):
            yield args


@pytest.mark.parametrize(
    ("op", "rule"), [(op, rule) for op, rules in RULES.items() for rule in rules],
    ids=[rule[0] for rules in RULES.values() for rule in rules],
)  # fmt: skip
def test_rules_keep_the_meaning(op, rule):
    _, applies, result = rule
    used = [args for args in arguments(op) if applies(*args)]
    assert used
    for args in used:
        with np.errstate(all="ignore"):
            plain = np.broadcast_to(evaluate(Expr(op, args), AT), 3)
            simple = np.broadcast_to(evaluate(result(*args), AT), 3)
        real = np.isfinite(plain)  # 0 / 0, and the logarithm of a negative number, have no meaning
        np.testing.assert_allclose(simple[real], plain[real], rtol=1e-14, atol=1e-15)


@pytest.mark.parametrize("op", RULES)
def test_simplifying_again_changes_nothing(op):
    for args in arguments(op):
        once = apply(op, *args)
        if once.op in RULES:
            assert apply(once.op, *once.args) is once


@pytest.mark.parametrize("x", [-800.0, 800.0])
def test_logarithms_of_products_neither_underflow_nor_overflow(x):
    at = {X: np.array([x]), Y: np.array([3.0])}
    for product, expected in [
        (Y * np.exp(X), np.log(3) + x), (np.exp(X) / Y, x - np.log(3)),
        (Y / np.exp(X), np.log(3) - x), (np.exp(X) * Y * np.exp(-X), np.log(3)),
    ]:  # fmt: skip
        assert evaluate(np.log(product), at)[0] == pytest.approx(expected, rel=1e-14)


def test_logarithms_of_products_of_many_factors():
    parts = [symbol("state", "z", (i,)) for i in range(3000)]
    at = {s: 0.001 * i for i, s in enumerate(parts)}
    found = np.log(np.prod([np.exp(s) for s in parts]))
    assert evaluate(found, at) == pytest.approx(sum(at.values()))
    square = np.exp(X)
    for _ in range(60):  # 2^60 factors, of which each half is the other
        square = square * square
    assert evaluate(np.log(square), {X: 2.0}) == pytest.approx(2.0**61)
