"""What adds to zero whatever its symbols are, and what only does so where one happens to look."""

import numpy as np
import pytest

from ssmppl.errors import NotApplicable
from ssmppl.expressions.algebra import affine, polynomial
from ssmppl.expressions.expr import constant, symbol
from ssmppl.expressions.zero import cancels

U, V, T = symbol("input", "u"), symbol("input", "v"), symbol("time", "t")
X, A = symbol("state", "x"), symbol("parameter", "a")
ONE = constant(1.0)

ZERO = {
    "a difference": [U, -U],
    "multiplied out": [U * (V + 1), -U * V, -U],
    "small ones beside large ones": [1e-8 * U, U * V, -1e-8 * U, -U * V],
    "fractions": [U**2 / (1 - U**2), ONE, -1 / (1 - U**2)],
    "a square of exp": [np.exp(2 * U), -(np.exp(U) ** 2)],
    "a sum in exp": [np.exp(U + V), -np.exp(U) * np.exp(V)],
    "a logarithm in exp": [np.exp(U + np.log(V)), -V * np.exp(U)],
    "logarithms": [np.log(U * V), -np.log(U), -np.log(V)],
    "a hinge": [np.maximum(U, 1) * V, -V * np.maximum(U, 1)],
    "sine and cosine": [np.sin(U) ** 2, np.cos(U) ** 2, -ONE],
    "both cases": [np.where(U > 3, V, 0.0), np.where(U <= 3, V, 0.0), -V],
    "the same case": [np.where(U > 3, V, 0.0), np.where(U > 3, -V, 0.0)],
}
NOT_ZERO = {
    "two hinges beyond the points": [0.3 * np.maximum(T - 50, 0), 0.2 * np.maximum(T - 100, 0)],
    "a hat beyond the points": [
        np.maximum(U - 100, 0), -2 * np.maximum(U - 101, 0), np.maximum(U - 102, 0)
    ],
    "a hinge below the points": [np.maximum(U, 18), -18 * ONE],
    "a dead zone": [np.maximum(U - 2, 0), -np.maximum(-U - 2, 0)],
    "the absolute value": [np.abs(U), -U],
    "limits": [U, -np.clip(U, -3, 3)],
    "roundings": [2 * np.floor(U / 10), -np.floor(U / 20)],
    "the sign": [np.sign(U), -ONE],
    "a remainder": [U % 5, -U],
    "the root of a square": [np.sqrt(U**2), -U],
    "the root of a square far off": [np.sqrt((U - 18) ** 2), -(18 - U)],
    "half a logarithm": [np.exp(0.5 * np.log(U**2)), -U],
    "an angle": [np.arctan2(np.sin(U), np.cos(U)), -U],
    "bumps beyond the points": [np.exp(-((U - 100) ** 2)), np.exp(-((U - 200) ** 2))],
    "a bump beside what cancels": [U, 0.2 * np.exp(-((U - 20) ** 2)), -U],
    "the tail of a softplus": [np.log1p(np.exp(-((U - 20) ** 2))), -np.exp(-((U - 20) ** 2))],
    "a small summand": [0.3 * U, 1e-14 * V * V, -0.3 * U],
    "a case beyond the points": [np.where(U > 18, U, 0.0), 1e-30 * V],
}  # fmt: skip


@pytest.mark.parametrize("name", ZERO)
def test_zero_is_found(name):
    assert cancels(ZERO[name])


@pytest.mark.parametrize("name", NOT_ZERO)
def test_what_is_not_zero_everywhere_is_kept(name):
    assert not cancels(NOT_ZERO[name])


@pytest.mark.parametrize(
    "of",
    [
        lambda x: np.sqrt(x**2),
        lambda x: (x**4) ** 0.25,
        lambda x: np.hypot(x, 0.0),
        lambda x: np.exp(0.5 * np.log(x**2)),
        lambda x: np.sqrt(x) * np.sqrt(x),
        lambda x: A * np.sqrt(x**2 * A) + 1,
    ],
)
def test_a_root_that_is_linear_on_one_side_only(of):
    found = affine([of(X)], [X])
    assert isinstance(found, NotApplicable)
    assert "whatever the sign of x" in found.reason


def test_roots_that_do_not_concern_the_sign():
    matrix, offset = affine([np.sqrt(A) * X + np.log(A), (A**2) ** 0.5 * X], [X])
    assert matrix[0, 0] is np.sqrt(A)
    assert offset[0] is np.log(A)
    assert polynomial(np.log(np.exp(X) * A), [X], 1)[(X,)].data == 1.0
