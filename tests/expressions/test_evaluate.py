"""The interpreter against the same computation by NumPy directly."""

import numpy as np
import pytest
import scipy.stats as st
from hypothesis import given, settings
from hypothesis import strategies as some

from ssmppl.codegen.kernels.math import scalars
from ssmppl.expressions.arrays import array
from ssmppl.expressions.evaluate import MEANING, evaluate, numpy_draws
from ssmppl.expressions.expr import Expr, apply, constant, symbol
from tests.expressions.graphs import TABLE, X, Y, Z, programs, run

OTHERS = {
    "eq", "ne", "poisson_quantile", "binomial_quantile", "negbinomial_quantile",
    "poisson_survival_quantile", "negbinomial_survival_quantile",
    "betabinomial_cdf", "betabinomial_quantile", "skellam_quantile",
}  # fmt: skip


def test_every_operation_has_a_meaning_and_is_tested():
    assert set(MEANING) == set(TABLE) | OTHERS


@settings(max_examples=100, deadline=None)
@given(programs(), some.integers(0, 2**32 - 1))
def test_random_graphs(program, seed):
    rng = np.random.default_rng(seed)
    points = {s: rng.uniform(-2.0, 2.0, 4) for s in (X, Y, Z)}
    expression, expected = run(program, points)
    found = np.broadcast_to(evaluate(expression, points), expected.shape)
    np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-7)
    one = evaluate(expression, {s: v[2] for s, v in points.items()})
    np.testing.assert_allclose(one, found[2], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", sorted(TABLE))
def test_each_operation(name):
    function, *domains = TABLE[name]
    rng = np.random.default_rng(1)
    values = [rng.uniform(*d, 50) for d in domains]
    points = dict(zip((X, Y, Z), values, strict=False))
    found = evaluate(run([(name, 0, 1, 2)], {X: [1.0], Y: [1.0], Z: [1.0]} | points)[0], points)
    np.testing.assert_allclose(found, function(*values), rtol=1e-14)


def test_shapes():
    a = array([[X, Y], [1.0, Z]])
    values = {X: np.arange(3.0), Y: 2.0, Z: np.ones((5, 1))}
    assert evaluate(a, values).shape == (2, 2, 5, 3)
    assert evaluate(X + Y, values).shape == (3,)
    assert evaluate([X, Z], values)[1].shape == (5, 1)
    assert evaluate(array(np.zeros((0, 2))), {}).shape == (0, 2)


def test_a_missing_value_is_named():
    with pytest.raises(KeyError, match="y_prev"):
        evaluate(X + symbol("state_prev", "y"), {X: 1.0})


def test_draws_are_shared_within_and_new_between_nodes():
    one = Expr("random", (), ("normal", ("a", 1)))
    two = Expr("random", (), ("normal", ("a", 2)))
    draws = numpy_draws(np.random.default_rng(1), (1000,))
    a, b, difference = evaluate([one, two, one + two], {}, draws)
    np.testing.assert_array_equal(difference, a + b)
    assert abs(np.corrcoef(a, b)[0, 1]) < 0.2
    with pytest.raises(KeyError, match="no random draws"):
        evaluate(one)


def test_draws_with_impossible_parameters_are_nan():
    node = Expr("random", (X,), ("gamma", ("a", 1)))
    out = evaluate(node, {X: np.array([1.0, -1.0, np.nan])}, numpy_draws(np.random.default_rng(1)))
    assert np.isfinite(out[0])
    assert np.all(np.isnan(out[1:]))


def test_factorisations_that_do_not_exist_are_nan():
    m = array([[X, 2.0], [2.0, 1.0]])
    found = evaluate(np.linalg.cholesky(m), {X: np.array([5.0, 1.0])})
    np.testing.assert_allclose(found[..., 0], np.linalg.cholesky([[5, 2], [2, 1]]))
    assert np.all(np.isnan(found[1, 1, 1:]))


@pytest.mark.parametrize(
    ("name", "args", "law"),
    [
        ("poisson_quantile", (3.5,), st.poisson(3.5)),
        ("binomial_quantile", (12.0, 0.3), st.binom(12, 0.3)),
        ("negbinomial_quantile", (2.5, 3.75), st.nbinom(2.5, 0.4)),
        ("negbinomial_quantile", (1e16, 3.75), st.poisson(3.75)),
    ],
)
def test_discrete_quantiles(name, args, law):
    at_steps = law.cdf(np.arange(6.0))
    q = np.concatenate([np.linspace(0.001, 0.999, 97), at_steps * (1 - 1e-9)])
    found = evaluate(apply(name, *args, X), {X: q})
    np.testing.assert_array_equal(found, law.ppf(q))
    np.testing.assert_array_equal([getattr(scalars, name)(*args, p) for p in q], found)


@pytest.mark.parametrize(
    ("name", "args", "law"),
    [
        ("poisson_survival_quantile", (3.5,), st.poisson(3.5)),
        ("negbinomial_survival_quantile", (2.5, 3.75), st.nbinom(2.5, 0.4)),
    ],
)
def test_discrete_quantiles_of_the_upper_tail(name, args, law):
    q = 10.0 ** -np.arange(0, 250, 0.7)
    found = evaluate(apply(name, *args, X), {X: q})
    survival = law.sf
    assert np.all(survival(found) <= q * (1 + 1e-9))
    assert np.all(found >= 0)
    assert np.all((found == 0) | (survival(found - 1) > q * (1 - 1e-9)))
    at = evaluate(apply(name, *args, X), {X: np.array([0.0, -0.1, 1.1, np.nan])})
    np.testing.assert_array_equal(at[1:], np.nan)
    assert at[0] > 170
    kernel = getattr(scalars, name)
    np.testing.assert_array_equal([kernel(*args, p) for p in q], found)
    assert np.all(np.isnan([kernel(*args, p) for p in (-0.1, 1.1, np.nan)]))


def test_opaque_functions():
    node = Expr("call", (X, constant(2.0)), lambda a, b: a + b if a > 0 else b)
    np.testing.assert_array_equal(evaluate(node, {X: np.array([1.0, -1.0])}), [3.0, 2.0])
