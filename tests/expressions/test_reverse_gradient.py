"""Gradients by reverse accumulation are those of the chain rule forward."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as some

from ssmppl.expressions.arrays import array
from ssmppl.expressions.calculus import NotDifferentiable, gradient, reverse_gradient
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import MATRIX_OPS, apply, constant, symbol
from tests.expressions.graphs import HALF_SMOOTH, KINKED, SMOOTH, X, Y, Z, programs, run

SYMBOLS = [X, Y, Z]


def check(node, values, symbols=SYMBOLS):
    try:
        forward = gradient(node, symbols)
    except NotDifferentiable:  # where nothing comes of it, the other way may do without
        return
    expected = evaluate(forward, values)
    found = evaluate(reverse_gradient(node, symbols), values)
    for f, e in zip(found, expected, strict=True):
        np.testing.assert_allclose(f, e, rtol=1e-9, atol=1e-11, err_msg=repr(node))


@settings(max_examples=40, deadline=None)
@given(
    programs(sorted(set(SMOOTH) | set(HALF_SMOOTH) | set(KINKED)), max_size=8),
    some.integers(0, 2**32 - 1),
)
def test_random_graphs(program, seed):
    rng = np.random.default_rng(seed)
    values = {s: rng.uniform(-0.9, 0.9, 3) for s in SYMBOLS}
    with np.errstate(all="ignore"):
        check(run(program, values)[0], values)


@pytest.mark.parametrize("n", [1, 2, 3])
@pytest.mark.parametrize("op", MATRIX_OPS)
def test_matrix_operations(op, n):
    rng = np.random.default_rng([n, len(op)])
    m = array([[np.sin((i + 1) * X + 2 * j) + Y * np.cos(i - j + X * Y) for j in range(n)]
               for i in range(n)])  # fmt: skip
    m = m @ m.T + np.eye(n)
    made = {
        "cholesky": np.linalg.cholesky, "inverse": np.linalg.inv, "det": np.linalg.det,
        "logdet": lambda a: np.linalg.slogdet(a)[1],
    }[op](m)  # fmt: skip
    weighed = sum(w * e for w, e in zip(rng.normal(size=n * n), array(made).ravel(), strict=False))
    check(np.exp(0.1 * weighed) + weighed * Y, {X: rng.normal(size=3), Y: rng.normal(size=3)},
          [X, Y])  # fmt: skip


def test_entries_of_a_covariance():
    """Of a law whose covariance's entries are parameters, both halves the same symbols."""
    s = [[symbol("parameter", "S", (max(i, j), min(i, j))) for j in range(3)] for i in range(3)]
    symbols = [s[i][j] for i in range(3) for j in range(i + 1)]
    root = np.linalg.cholesky(array(s))
    numbers = np.array([[2.0, 0.3, 0.4], [0.3, 1.5, -0.2], [0.4, -0.2, 1.0]])
    values = {e: np.full(2, numbers[e.data[2]]) for e in symbols}
    check((root @ np.array([0.5, -1.0, 2.0]))[2] ** 2 + np.linalg.slogdet(array(s))[1], values,
          symbols)  # fmt: skip


def test_what_a_condition_leaves_out_counts_nothing():
    node = apply("where", X > 0, np.log(X) * Y, Y**2)
    found = evaluate(reverse_gradient(node, [X, Y]), {X: np.array([0.0, 2.0]), Y: np.ones(2) * 3})
    np.testing.assert_allclose(found[0], [0.0, 1.5])
    np.testing.assert_allclose(found[1], [6.0, np.log(2.0)])


def test_a_constant_has_none():
    assert reverse_gradient(constant(2.0), [X]) == [constant(0.0)]
    assert reverse_gradient(X, [X, Y]) == [constant(1.0), constant(0.0)]
