"""The basis functions: standardised, bounded, and the same on numbers and on symbols."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from ssmppl.diagnosis.model.basis import bases
from ssmppl.errors import ArgumentError
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import Expr, symbol
from tests.statistics.checks import seed_of

X = np.random.default_rng(seed_of("bases")).gamma(3.0, 2.0, (200, 7))


def test_orthonormal_on_values_and_on_scales():
    design = np.stack([f(X).ravel() for f in bases(X)], axis=1)
    np.testing.assert_allclose(design.T @ design / X.size, np.eye(6), atol=1e-8)
    np.testing.assert_allclose(design[:, 0], 1.0)
    drawn = 4.0 + 3.0 * np.random.default_rng(seed_of("normal")).standard_normal(400_000)
    for f in bases((4.0, 3.0), 5):
        values = f(drawn) ** 2
        assert abs(values.mean() - 1) < 4 * values.std() / np.sqrt(values.size) + 1e-9


def test_bounded_and_level_beyond_the_data():
    far = np.linspace(-1e3, 1e3, 20_001)
    for f in bases((0.0, 1.0), 6):
        inside = np.max(np.abs(f(np.linspace(-4, 4, 401))))
        assert np.max(np.abs(f(far))) < 3 * inside
        assert f(50.0) == pytest.approx(f(1000.0))


def test_as_many_as_there_are_values():
    switch = np.tile([0.0, 1.0], 50)
    assert [f.order for f in bases(switch)] == [0, 1]


@pytest.mark.parametrize(
    "missing", [lambda v: v * np.abs(v), lambda v: np.tanh(v / 0.3), lambda v: v**3]
)
def test_they_hold_what_is_missing_in_practice(missing):
    """Drag, friction and stiffness over normal values: six functions hold 95% of the square."""
    v = np.random.default_rng(seed_of("spans")).standard_normal(4000)
    design = np.stack([f(v) for f in bases(v, 6)], axis=1)
    left = missing(v) - design @ np.linalg.lstsq(design, missing(v), rcond=None)[0]
    assert np.sum(left**2) < 0.05 * np.sum(missing(v) ** 2)


def test_on_symbols():
    v, f = symbol("state", "v"), bases(X, 4)
    written = [h(v) for h in f]
    assert all(isinstance(e, Expr) for e in written)
    found = [float(e) for e in evaluate(written, {v: np.array(1.7)})]
    np.testing.assert_allclose(found, [h(1.7) for h in f])
    assert pickle.loads(pickle.dumps(f)) == f


@pytest.mark.parametrize("x", [np.full(5, 3.0), np.full(4, np.nan), (1.0, 0.0)])
def test_a_variable_that_does_not_vary(x):
    with pytest.raises(ArgumentError, match="does not vary"):
        bases(x)
