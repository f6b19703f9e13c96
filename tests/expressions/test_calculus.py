"""Derivatives against finite differences, with tolerances that come from the step size."""

import math

import mpmath as mp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as some
from scipy import special

from ssmppl.expressions.arrays import array
from ssmppl.expressions.calculus import (
    CHOICES,
    FLAT,
    PARTIALS,
    NotDifferentiable,
    differentiate,
    gradient,
    hessian,
    lower_inverse,
)
from ssmppl.expressions.evaluate import MEANING, evaluate
from ssmppl.expressions.expr import MATRIX_OPS, Expr, apply, constant, symbol
from tests.expressions.graphs import HALF_SMOOTH, KINKED, SMOOTH, X, Y, Z, programs, run

SYMBOLS = [X, Y, Z]
NO_DERIVATIVE = {
    "poisson_quantile", "binomial_quantile", "negbinomial_quantile", "trigamma",
    "betabinomial_cdf", "betabinomial_quantile",
    "poisson_survival_quantile", "negbinomial_survival_quantile", "skellam_quantile",
}  # fmt: skip


def richardson(f, at, h):
    """(derivative, bound of its error): central differences with steps h and h / 2 extrapolated.

    The extrapolation's own change bounds the truncation; rounding is eps |f| / h, times a margin.
    """
    wide = (f(at + h) - f(at - h)) / (2 * h)
    narrow = (f(at + h / 2) - f(at - h / 2)) / h
    rounding = 2e-15 * (np.abs(f(at)) + np.abs(at * wide) + 1e-3) / h
    return (4 * narrow - wide) / 3, 0.1 * np.abs(narrow - wide) + 20 * rounding


def check_derivative(expression, s, values, h=1e-3):
    """d expression / d s at the values, where f is smooth over +-h."""
    found = evaluate(differentiate([expression], s)[0], values)

    def f(v):
        return np.broadcast_to(evaluate(expression, {**values, s: v}), np.shape(v)).astype(float)

    expected, bound = richardson(f, np.asarray(values[s], dtype=float), h)
    np.testing.assert_array_less(np.abs(found - expected), bound + 1e-10 * np.abs(expected) + 1e-11)


def test_every_operation_has_a_rule_or_a_reason():
    ruled = set(PARTIALS) | set(CHOICES) | FLAT | {"where"} | NO_DERIVATIVE
    assert ruled == set(MEANING)


@pytest.mark.parametrize("name", sorted(SMOOTH | HALF_SMOOTH))
def test_first_and_second_derivatives_of_each_operation(name):
    _, *domains = (SMOOTH | HALF_SMOOTH)[name]
    rng = np.random.default_rng(2)
    points = [rng.uniform(lo + 0.02 * (hi - lo), hi - 0.02 * (hi - lo), 20) for lo, hi in domains]
    symbols = SYMBOLS[: len(domains)]
    values = dict(zip(symbols, points, strict=True))
    node = apply(name, *symbols)
    where = symbols if name in SMOOTH else symbols[-1:]
    for s in where:
        check_derivative(node, s, values)
        first = differentiate([node], s)[0]
        try:
            seconds = [differentiate([first], other)[0] for other in where]
        except NotDifferentiable:
            assert name.startswith("digamma")  # their derivative, trigamma, has none
            continue
        assert len(seconds) == len(where)
        for other in where:
            check_derivative(first, other, values)


@pytest.mark.parametrize("name", sorted(HALF_SMOOTH))
def test_derivatives_in_shape_parameters_are_refused(name):
    _, *domains = HALF_SMOOTH[name]
    node = apply(name, *SYMBOLS[: len(domains)])
    with pytest.raises(NotDifferentiable, match=f"{name}.*has no derivative in x"):
        gradient(node, [X])


@pytest.mark.parametrize("x", [-3.0, -1e-5, 1e-5, 0.4, 30.0, 1e4])
def test_derivatives_of_bessel_functions_are_mpmaths(x):
    scaled = [lambda v, k=k: mp.besseli(k, v) * mp.exp(-abs(v)) for k in (0, 1)]
    with mp.workdps(40):
        for name, function in zip(("i0e", "i1e"), scaled, strict=True):
            (first,) = differentiate([apply(name, X)], X)
            (second,) = differentiate([first], X)
            for order, derivative in ((1, first), (2, second)):
                expected = float(mp.diff(function, mp.mpf(x), order, h=mp.mpf(10) ** -12))
                # terms of the size of the function cancel to its derivatives
                size = float(function(mp.mpf(x)))
                found = float(evaluate(derivative, {X: x}))
                assert found == pytest.approx(expected, rel=1e-10, abs=1e-14 * abs(size) + 1e-16)
    (at_zero,) = differentiate([apply("i1e", X)], X)
    assert evaluate(at_zero, {X: 0.0}) == 0.5


@pytest.mark.parametrize("name", sorted(set(KINKED) - NO_DERIVATIVE))
def test_kinked_operations_away_from_the_kink(name):
    rng = np.random.default_rng(3)
    points = {s: rng.uniform(0.3, 0.6, 10) + k for k, s in enumerate(SYMBOLS)}
    node, _ = run([(name, 0, 1, 2)], points)
    shifted = node * X + apply("sin", node + Y)
    for s in SYMBOLS:
        check_derivative(shifted, s, points, h=1e-4)


def test_ties_of_maximum_and_minimum():
    for op in ("maximum", "minimum"):
        parts = [evaluate(g, {X: 1.0, Y: 1.0}) for g in gradient(apply(op, X, Y), [X, Y])]
        assert sum(parts) == 1.0


def _conditioned(names):
    ill = ("ndtri", "tan", "arctanh", "arccosh", "digamma", "digamma_rise")
    return [n for n in names if n not in ill]


@settings(max_examples=80, deadline=None)
@given(programs(_conditioned(SMOOTH), max_size=8), some.integers(0, 2**32 - 1))
def test_random_graphs(program, seed):
    rng = np.random.default_rng(seed)
    values = {s: rng.uniform(-0.9, 0.9, 3) for s in SYMBOLS}
    node, _ = run(program, values)
    for s in SYMBOLS:
        _check_loosely(node, s, values)
    second = hessian(node, SYMBOLS[:2])
    assert second[0, 1] is second[1, 0]
    first = gradient(node, SYMBOLS[:2])
    for i, s in enumerate(SYMBOLS[:2]):
        for j in range(2):
            _compare(second[i, j], first[j], s, values)


def _check_loosely(node, s, values):
    _compare(differentiate([node], s)[0], node, s, values)


def _compare(derivative, node, s, values):
    found = np.broadcast_to(evaluate(derivative, values), (3,))

    def f(v):
        return np.broadcast_to(evaluate(node, {**values, s: v}), (3,)).astype(float)

    at = np.asarray(values[s])
    tries = [richardson(f, at, h) for h in (1e-2, 1e-3, 1e-4)]
    excess = np.min([np.abs(found - e) - b - 1e-7 * np.abs(e) - 1e-8 for e, b in tries], axis=0)
    assert np.all(excess <= 0), (node, s, found, tries)


def _matrix(n, positive):
    """An n x n matrix of smooth functions of x and y, and whether it is symmetric."""
    rows = [
        [np.sin((i + 1) * X + 2 * j) + Y * np.cos(i - j + X * Y) for j in range(n)]
        for i in range(n)
    ]
    m = array(rows)
    return m @ m.T + np.eye(n) if positive else m + 4.0 * np.eye(n)


@pytest.mark.parametrize("n", [1, 2, 3])
@pytest.mark.parametrize("op", MATRIX_OPS)
def test_matrix_operations(op, n):
    m = _matrix(n, positive=op in ("cholesky", "logdet"))
    function = {
        "cholesky": np.linalg.cholesky, "inverse": np.linalg.inv, "det": np.linalg.det,
        "logdet": lambda a: np.linalg.slogdet(a)[1],
    }[op]  # fmt: skip
    values = {X: np.array([0.3, -0.7, 1.1]), Y: np.array([0.5, 0.2, -0.4])}
    for e in array(function(m)).ravel():
        for s in (X, Y):
            _compare(differentiate([e], s)[0], e, s, values)
        first = gradient(e, [X, Y])
        for s in (X, Y):
            for g in first:
                _compare(differentiate([g], s)[0], g, s, values)


def test_derivatives_in_entries_of_matrices():
    entries = [[symbol("parameter", "S", (max(i, j), min(i, j))) for j in range(3)]
               for i in range(3)]  # fmt: skip
    m = array(entries)
    x = array([symbol("state", "x", (i,)) for i in range(3)])
    log_density = -0.5 * x @ np.linalg.inv(m) @ x - 0.5 * np.linalg.slogdet(m)[1]
    rng = np.random.default_rng(4)
    root = rng.standard_normal((3, 3))
    numbers = root @ root.T + np.eye(3)
    values = {entries[i][j]: np.full(3, numbers[i, j]) for i in range(3) for j in range(3)}
    values |= {s: np.full(3, rng.standard_normal()) for s in x}
    for s in {e for row in entries for e in row}:
        _compare(differentiate([log_density], s)[0], log_density, s, values)
    for s in x:
        _compare(differentiate([log_density], s)[0], log_density, s, values)


def test_lower_inverse():
    rng = np.random.default_rng(5)
    lower = np.tril(rng.standard_normal((4, 4))) + 3 * np.eye(4)
    found = evaluate(lower_inverse(array(lower)))
    np.testing.assert_allclose(found, np.linalg.inv(lower), atol=1e-14)


def test_what_has_no_derivative_is_named():
    call = Expr("call", (X,), abs)
    for node in (call, Expr("random", (X,), ("gamma", ("a", 1))), apply("trigamma", X)):
        with pytest.raises(NotDifferentiable):
            gradient(node * 2.0, [X])
        assert gradient(node * Y, [Y])[0] is node


def test_derivatives_simplify():
    assert gradient(3.0 * X + Y, [X, Y, Z])[0] is constant(3.0)
    assert gradient(3.0 * X + Y, [X, Y, Z])[2] is constant(0.0)
    assert hessian(X * Y, [X, Y])[0, 1] is constant(1.0)
    assert hessian(X * Y, []).shape == (0, 0)
    first, second = differentiate([X, Y * 1.0], X)
    assert first is constant(1.0)
    assert second is constant(0.0)


def test_a_zero_branch_does_not_poison_the_other():
    # d where(x > 0, log x, 0) is 0 below zero, though log's own derivative is not
    node = np.where(X > 0, np.log(X), 0.0)
    assert evaluate(gradient(node, [X])[0], {X: np.array([-1.0, 2.0])}).tolist() == [0.0, 0.5]


def test_power_with_constant_exponent_at_and_below_zero():
    node = X**3
    np.testing.assert_allclose(evaluate(gradient(node, [X])[0], {X: [-2.0, 0.0]}), [12.0, 0.0])
    second = gradient(gradient(node, [X])[0], [X])[0]
    np.testing.assert_allclose(evaluate(second, {X: [-2.0, 0.0]}), [-12.0, 0.0])


HINGED = [  # functions, their derivative in x and in y, and points where the rules multiply 0 by oo
    (np.sqrt(np.maximum(X - Y, 0.0)), 0.0, 0.0),
    (np.maximum(X - Y, 0.0) ** 0.7, 0.0, 0.0),
    (np.maximum(0.0, Z * (X - Y)) ** 0.7, 0.0, 0.0),
    (np.clip(X - Y, 0.0, 1.0) ** 0.3, 0.0, 0.0),
    (np.exp(-1.0 / np.maximum(X - Y, 0.0)), 0.0, 0.0),
    (np.sqrt(np.maximum(X - Y, 0.0) ** 2 + np.maximum(X - 2.0 * Y, 0.0)), 0.0, 0.0),
    (np.sqrt(np.where(X < Y, 0.0, np.maximum(X, Y) - Y)), 0.0, 0.0),
    (X + np.sqrt(Z * np.minimum(0.0, Y - X) * -1.0), 1.0, 0.0),
    (np.sqrt(np.maximum(X - Y, 0.0) + np.maximum(1.0, X)), 0.0, 0.0),
]


@pytest.mark.parametrize(("node", "in_x", "in_y"), HINGED)
def test_slopes_below_a_hinge_are_zero_under_a_root(node, in_x, in_y):
    below = {X: np.array([0.5, 0.2]), Y: np.array([0.75, 2.0]), Z: np.array([1.5, 0.5])}
    first = gradient(node, [X, Y])
    for slope, expected in zip(first, (in_x, in_y), strict=True):
        np.testing.assert_array_equal(np.broadcast_to(evaluate(slope, below), 2), expected)
        for other in (X, Y):
            second = evaluate(differentiate([slope], other)[0], below)
            np.testing.assert_array_equal(np.broadcast_to(second, 2), 0.0)
    above = {X: np.array([2.5, 1.3]), Y: np.array([0.5, 0.25]), Z: np.array([1.5, 0.5])}
    for s, slope in zip((X, Y), first, strict=True):
        check_derivative(node, s, above, h=1e-4)
        for other in (X, Y):
            check_derivative(slope, other, above, h=1e-4)


STEEP = [
    1.0 / (1.0 + np.exp(-X)),
    3.0 / (np.exp(-2.0 * X) * Y + 2.0),
    1.0 / (np.exp(-X) / Y - (-1.0)),
    (1.0 + 0.5 * np.exp(-X)) ** (-1.0 / Y),
    1.0 / np.cosh(X),
    np.sin(special.expit(X) * Y),
    np.exp(-np.exp(X)),
    special.ndtr(-np.exp(X)),
    special.erfc(np.exp(X)),
]


@pytest.mark.parametrize("node", STEEP)
def test_slopes_of_what_exponentials_drive_to_its_limit_are_zero(node):
    far = {X: np.array([-800.0, 800.0]), Y: np.array([1.5, 0.7])}
    (first,) = differentiate([node], X)
    second = differentiate([first], X) if any(node is e for e in STEEP[:6]) else []
    np.testing.assert_allclose(evaluate([first, *second], far), 0.0, atol=1e-200)
    near = {X: np.linspace(-3.0, 2.0, 9), Y: np.linspace(0.5, 2.0, 9)}
    check_derivative(node, X, near)
    check_derivative(first, X, near)
    # far out, where the function rounds to its limit, the slope keeps its digits
    (tail,) = differentiate([STEEP[0]], X)
    assert evaluate(tail, {X: 40.0}) == pytest.approx(math.exp(-40.0), rel=1e-14)


def test_slopes_where_a_factor_under_a_root_is_zero():
    for node in (np.sqrt(X * Y), (X * Y / 3.0) ** 0.7, (Z * X * Y) ** Z, Y**X):
        values = {X: np.array([0.5, 1.5]), Y: np.array([0.0, 2.0]), Z: np.array([0.6, 0.6])}
        (slope,) = differentiate([node], X)
        assert evaluate(slope, values)[0] == 0.0
        assert evaluate(differentiate([slope], X)[0], values)[0] == 0.0
        check_derivative(node, X, {s: v[1:] for s, v in values.items()})
    (square,) = differentiate([(X * Y) ** 2], X)
    assert evaluate(square, {X: 0.0, Y: 3.0}) == 0.0
    (shifted,) = differentiate([(np.exp(X) - 1.0) ** 2], X)
    assert evaluate(shifted, {X: 0.0}) == 0.0


@pytest.mark.parametrize("value", [0.0, 1e-160, 0.3, -0.3])
def test_slopes_of_exponentials_of_quotients(value):
    """exp(-a / u**2) is 0 at u = 0, and so are its slopes in both."""
    node = np.exp(-X / Y**2)
    with np.errstate(all="ignore"):
        found = evaluate(differentiate([node], X) + differentiate([node], Y), {X: 1.5, Y: value})
    there = np.exp(-1.5 / value**2) if abs(value) > 0.1 else 0.0
    wanted = [-there / value**2, 3.0 * there / value**3] if there else [0.0, 0.0]
    np.testing.assert_allclose(found, wanted, rtol=1e-12)


def test_ties_of_a_maximum_take_one_slope_only():
    node = np.maximum(2.0 * X, 3.0 * X)
    assert evaluate(gradient(node, [X])[0], {X: np.array([-1.0, 0.0, 1.0])}).tolist() == [2, 2, 3]
