"""Functions of plain Python numbers against the interpreter."""

import math

import numpy as np
import pytest

from ssmppl.analysis.lambdify import python_function, python_sum
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import Expr, apply, symbol

A, B = symbol("parameter", "a"), symbol("parameter", "b")
GUARDED = {
    "a root": np.where(B > 0, np.sqrt(B), B),
    "a ratio": np.where(A != 0.0, B / A, 1.0),
    "a logarithm in both cases of another": np.where(
        A > 0, np.where(A > 2, np.log(A), np.log(A) * B), 0.0
    ),
    "one outside too": np.where(B > 0, np.sqrt(B), 0.0) + np.where(B < 0, np.sqrt(-B), 0.0),
    "the second of two": np.where((A > 0) & (np.log(A) > B), A, B),
    "either of two": np.where((A <= 0) | (np.log(A) > B), A, B),
    "a chain": np.exp(np.where(B > 0, np.log(np.sqrt(B) + np.log1p(B)), B)) * A,
    "a matrix": np.where(A * A < B, apply("log", B - A * A), A),
}
POINTS = [(a, b) for a in (-1.5, 0.0, 0.5, 3.0) for b in (-0.7, 0.0, 2.0, 12.0)]


@pytest.mark.parametrize("name", GUARDED)
def test_what_a_condition_guards_is_not_computed(name):
    """The square root of the case that does not hold raised, and a climb stood still."""
    function = python_function([GUARDED[name], A + B], [A, B])
    summed = python_sum([GUARDED[name], A + B], [A, B])
    for point in POINTS:
        with np.errstate(all="ignore"):
            exact = evaluate([GUARDED[name], A + B], dict(zip((A, B), point, strict=True)))
        assert function(point) == pytest.approx([float(e) for e in exact], rel=1e-14)
        assert summed(point, [2.0, 3.0]) == pytest.approx(2.0 * exact[0] + 3.0 * exact[1])


# Numbers made of what Python's `math` raises for, and NumPy has inf or nan for.
BEYOND = {
    "a quotient": 1.0 / (1.0 + 1.0 / np.maximum(A, 0.0)),
    "an exponential": 1.0 / (1.0 + np.exp(-A / 1e-3)),
    "a power": (1.0 + np.exp(A) ** (-1000.0)) ** (-2.0),
    "an exponential of one": np.exp(-np.exp(-800.0 * A)),
    "a hyperbolic cosine": 1.0 / np.cosh(800.0 * B),
    "a logarithm": np.exp(np.log(np.maximum(A, 0.0))),
    "a remainder": np.where(A % np.maximum(B, 0.0) > -1.0, B, A),
    "log sums": np.logaddexp(1.0 / np.maximum(A, 0.0), -1.0 / np.maximum(B, 0.0)),
    "a root": np.where(B > 0, np.sqrt(B), B) + np.sqrt(B),
    "nan in second place": np.maximum(A, np.sqrt(B)) + np.minimum(A, np.sqrt(B)),
}


@pytest.mark.parametrize("name", BEYOND)
@pytest.mark.filterwarnings("error")
def test_beyond_the_range_of_python_the_numbers_are_numpys(name):
    """A density was zero where it was not, and parts of a posterior were never seen."""
    function = python_function([BEYOND[name], A - B], [A, B])
    summed = python_sum([BEYOND[name], A - B], [A, B])
    for point in POINTS:
        exact = evaluate([BEYOND[name], A - B], dict(zip((A, B), point, strict=True)))
        close = {"rel": 1e-14, "nan_ok": True}
        assert function(point) == pytest.approx([float(e) for e in exact], **close)
        assert summed(point, [2.0, 3.0]) == pytest.approx(2.0 * exact[0] + 3.0 * exact[1], **close)


def test_a_users_function_raises_its_own_errors():
    own = Expr("call", (A,), math.log)
    with pytest.raises(ValueError, match="domain"):
        python_function([own], [A])([-1.0])


def test_what_is_shared_is_written_once():
    """Of a loop over a parameter each step doubled the text, up to gigabytes."""
    k = A
    for _ in range(200):
        k = np.tanh(k) + 0.3 * np.sin(k)
    for made, rest in ((python_function, ()), (python_sum, ([1.0],))):
        found = made([k], [A])([0.4], *rest)
        exact = float(evaluate([k], {A: 0.4})[0])
        assert np.ravel(found)[0] == pytest.approx(exact, rel=1e-12)
    assert python_sum([], [A])([0.4], []) == 0.0
