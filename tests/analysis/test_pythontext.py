"""Functions of plain Python numbers against the interpreter."""

import numpy as np
import pytest

from ssmppl.analysis.pythontext import python_function, python_sum
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import apply, symbol

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


def test_what_no_condition_guards_raises():
    both = np.where(B > 0, np.sqrt(B), B) + np.sqrt(B)
    with pytest.raises(ValueError, match="domain"):
        python_function([both], [B])([-1.0])


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
