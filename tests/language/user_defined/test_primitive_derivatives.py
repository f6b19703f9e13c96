"""Derivatives of opaque functions, given or by differences, against those written out."""

import math
import pickle

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.expressions.calculus import differentiate, gradient, hessian, reverse_gradient
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import symbol
from ssmppl.expressions.zero import cancels
from ssmppl.language.user_defined.differences import CENTRAL

X, A = symbol("state", "x"), symbol("parameter", "a")
rng = np.random.default_rng(8)
AT = {X: rng.normal(size=100), A: rng.normal(size=100)}


@ssm.primitive
def wave(x, a):
    return math.sin(a * x) + x * a * a


@ssm.primitive
def pair(x, a):
    return math.sin(a * x), math.exp(-x) * a


@ssm.primitive(derivative=lambda x, a: (a * math.cos(a * x), x * math.cos(a * x)))
def given(x, a):
    return math.sin(a * x)


def pair_slopes(x, a):
    return (a * math.cos(a * x), x * math.cos(a * x)), (-math.exp(-x) * a, math.exp(-x))


@ssm.primitive(derivative=pair_slopes)
def given_pair(x, a):
    return math.sin(a * x), math.exp(-x) * a


@ssm.primitive(derivative={"a": lambda x, a: x * math.cos(a * x)})
def given_in_part(x, a):
    return math.sin(a * x)


WAVE = np.sin(A * X) + X * A * A
PRODUCT = np.sin(A * X) * np.exp(-X) * A


def product(call):
    first, second = call(X, A)
    return first * second


FORMS = [
    pytest.param(wave(X, A), WAVE, 1e-8, id="one number"),
    pytest.param(product(pair), PRODUCT, 1e-8, id="two numbers"),
    pytest.param(given(X, A), np.sin(A * X), 1e-14, id="given"),
    pytest.param(product(given_pair), PRODUCT, 1e-14, id="two given"),
    pytest.param(given_in_part(X, A), np.sin(A * X), 1e-8, id="one given"),
]


def furthest(found, exact):
    """The largest difference, of the largest value."""
    a, b = (np.array(evaluate(list(np.ravel(e)), AT), dtype=float) for e in (found, exact))
    return np.max(np.abs(a - b)) / np.max(np.abs(b))


@pytest.mark.parametrize(("form", "exact", "error"), FORMS)
def test_derivatives_of_all_orders_are_those_of_the_formula(form, exact, error):
    """First ones within eps^(2/3), second ones within eps^(1/2), third ones within eps^(2/5), times
    what the size of higher derivatives makes of it; given ones to rounding."""
    expected = gradient(exact, [X, A])
    assert furthest(gradient(form, [X, A]), expected) < error
    assert furthest(reverse_gradient(form, [X, A]), expected) < error
    second, exact_second = hessian(form, [X, A]), hessian(exact, [X, A])
    assert furthest(second, exact_second) < 1e-6
    third = differentiate([second[0, 0], second[0, 1]], A)
    assert furthest(third, differentiate([exact_second[0, 0], exact_second[0, 1]], A)) < 1e-4


def test_weights_of_the_differences_are_exact_on_polynomials():
    """sum_k w_k k**p is r! for p = r, and 0 for the other powers below r + 2."""
    for order, weights in CENTRAL.items():
        for power in range(order + 2):
            total = sum(w * float(k) ** power for k, w in weights.items())
            assert total == (math.factorial(order) if power == order else 0.0)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_steps_find_the_scale_of_the_argument(scale):
    """Also at zero, far below the scale, and where a slope vanishes."""

    @ssm.primitive
    def bend(x):
        return math.cos(x / scale)

    z = scale * np.concatenate([rng.normal(size=50), 10.0 ** rng.uniform(-9, 0, 50), [0.0]])
    first = differentiate([bend(X)], X)[0]
    second = differentiate([first], X)[0]
    one, two = (evaluate(e, {X: z}) for e in (first, second))
    np.testing.assert_allclose(one * scale, -np.sin(z / scale), atol=1e-6)
    np.testing.assert_allclose(two * scale**2, -np.cos(z / scale), atol=2e-4)


def test_jumps_kinks_and_the_edge_of_the_domain():
    @ssm.primitive
    def stick(x):  # as of whole numbers, friction, tables
        return (1.0 if x > 0.25 else 0.0) + 10 * math.floor(3 * x) + abs(x)

    z = np.array([0.25, 0.25 + 1e-12, 0.25 - 1e-9, 0.1, -0.1, 1.0, -1.0, 2.0])
    first = differentiate([stick(X)], X)[0]
    np.testing.assert_allclose(evaluate(first, {X: z}), np.sign(z), atol=1e-6)
    np.testing.assert_allclose(evaluate(differentiate([first], X)[0], {X: z}), 0.0, atol=1e-6)
    bent = ssm.primitive(lambda x: abs(x) + 2.0)
    assert evaluate(differentiate([bent(X)], X)[0], {X: 0.0}) == 0.0  # the mean of both sides

    @ssm.primitive
    def root(x):
        return math.sqrt(x)

    z = np.array([1e-14, 1e-3, 5.0])
    found = evaluate(differentiate([root(X)], X)[0], {X: z})
    np.testing.assert_allclose(found, 0.5 / np.sqrt(z), rtol=1e-4)
    assert np.isnan(evaluate(differentiate([root(X)], X)[0], {X: -1.0}))


def test_compiled_they_are_what_the_interpreter_says():
    second = wave.difference((1, 1))
    for x, a in zip(AT[X][:20].tolist(), AT[A][:20].tolist(), strict=True):
        assert second.compiled(x, a) == pytest.approx(second.numbers(x, a), rel=1e-12)
    both = pair.difference((1, 0))
    assert both.compiled(0.3, 0.7) == pytest.approx(both.numbers(0.3, 0.7), rel=1e-12)


def test_they_are_the_same_thing_in_another_process():
    for e in (hessian(wave(X, A), [X, A])[0, 1], gradient(product(given_pair), [X])[0]):
        assert pickle.loads(pickle.dumps(e)) is e


def test_several_numbers_are_unpacked_and_broadcast():
    first, second = pair(np.stack([X, 2.0 * X]), A)
    assert first.shape == second.shape == (2,)
    assert pair(0.3, 0.7) == (math.sin(0.21), math.exp(-0.3) * 0.7)
    np.testing.assert_allclose(evaluate(second[0], AT), np.exp(-AT[X]) * AT[A], rtol=1e-14)
    assert cancels([first[0], -first[0]])
    assert not cancels([first[0], -second[0]])


@pytest.mark.parametrize(
    ("derivative", "found"),
    [
        (lambda x, a: (a, x + 1.0), r"gives .* for the derivative in a at x = .*, where differ"),
        ({"x": lambda x, a: 2.0 * a}, r"gives .* for the derivative in x at x = "),
        ({"b": lambda x, a: a}, "names 'b', which is no argument"),
        (lambda x, a: a, "returns 1 numbers, where there are 2 derivatives"),
        (lambda x: (x, x), r"takes 1 arguments \(x\)"),
        ((None, 2.0), "in a is 2.0, which is no function"),
        (3.0, "is 3.0"),
    ],
)
def test_a_wrong_derivative_is_refused_where_it_is_declared(derivative, found):
    with pytest.raises(ssm.ModelError, match=found) as error:

        @ssm.primitive(derivative=derivative)
        def times(x, a):
            return x * a

    assert __file__ in str(error.value)


def test_a_wrong_form_for_several_numbers_is_refused():
    with pytest.raises(ssm.ModelError, match="2 tuples, one for each output"):
        ssm.primitive(derivative=lambda x, a: (x, a))(pair.function)
