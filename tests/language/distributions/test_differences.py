"""What whole numbers without a lower bound ask of the places that take counts."""

import numpy as np
import pytest

import ssmppl as ssm
import ssmppl.language.distributions as D
from ssmppl.analysis.conjugacy import numerical_check
from ssmppl.data.values import outside
from ssmppl.errors import ModelError
from ssmppl.expressions.arrays import array
from ssmppl.expressions.calculus import gradient, reverse_gradient
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import symbol
from ssmppl.language.distributions.nested import cut

X, RATE = symbol("state", "x"), symbol("parameter", "rate")


@pytest.mark.parametrize(
    ("law", "value", "expected"),
    [
        (D.Skellam(1, 2), 0.5, "the whole numbers"),
        (D.Truncated(D.Skellam(1, 2), upper=3), 4.0, "the whole numbers up to 3"),
        (D.Truncated(D.Skellam(1, 2), lower=-3), -4.0, "the whole numbers from -3"),
        (D.Censored(D.Skellam(1, 2), lower=-3, upper=0), 1.0, "the whole numbers from -3 to 0"),
    ],
    ids=repr,
)
def test_values_outside(law, value, expected):
    assert outside(law, np.array([-3.0, 0.0]), {}) is None
    fault = outside(law, np.array([0.0, value]), {})
    assert fault.index == (1,)
    assert fault.found.endswith(f", {expected}")
    assert fault.fix == f"one of {expected}"
    assert evaluate(law.log_density(value)) == -np.inf


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (-np.inf, np.inf, range(-2, 4)), (-np.inf, -3.0, range(-8, -2)),
        (-np.inf, 1.5, range(-4, 2)), (2.5, np.inf, range(3, 9)), (0.0, 2.0, range(3)),
    ],
)  # fmt: skip
def test_trial_values_of_an_update(low, high, expected):
    ends = [np.full(numerical_check.POINTS, end) for end in (low, high)]
    rngs = map(np.random.default_rng, range(200))
    made = [numerical_check._integers(*ends, rng) for rng in rngs]
    assert set(np.concatenate(made)) == set(expected)


def test_a_component_that_ends_below_another():
    """Where the one has no mass, neither it nor its slope is NaN in the mixture's."""
    cut = D.Truncated(D.Skellam(RATE, 2.0), upper=1)
    mixed = D.Mixture([0.25, 0.75], [cut, D.Skellam(4.0, RATE)])
    for value in (-3.0, 1.0, 6.0):
        at = {RATE: 1.5}
        share = [np.exp(float(evaluate(law.log_density(value), at))) for law in mixed.components]
        found = mixed.log_density(X)
        expected = np.log(0.25 * share[0] + 0.75 * share[1])
        assert evaluate(found, {X: value, **at}) == pytest.approx(expected)
        ends = [float(evaluate(found, {X: value, RATE: 1.5 + h})) for h in (-1e-5, 1e-5)]
        for derivative in (gradient, reverse_gradient):
            slope = float(evaluate(derivative(found, [RATE])[0], {X: value, **at}))
            assert slope == pytest.approx((ends[1] - ends[0]) / 2e-5, rel=1e-6)


def test_outside_of_a_component_its_density_is_taken_inside():
    """-inf there would be no number in a slope."""
    (outside_law,) = cut(D.Truncated(D.Skellam(RATE, 2.0), upper=1), array(X)).ravel()
    assert outside_law.op == "where"
    assert np.isfinite(evaluate(outside_law.args[1], {X: 6.0, RATE: 1.5}))


def test_moments_between_bounds_of_large_rates():
    """Where terms of the size of the squared rate cancel; an infinite bound far out is none."""
    law = D.Skellam(1e6, 9e5)
    for bounds in ({"lower": 9e4}, {"upper": 1.1e5}, {"lower": 9e4, "upper": 1.1e5}):
        cut = D.Truncated(law, **bounds)
        assert float(evaluate(array(cut.mean()))) == pytest.approx(1e5, rel=1e-9)
        assert float(evaluate(array(cut.variance()))) == pytest.approx(1.9e6, rel=1e-6)
    one = D.Truncated(D.Skellam(2.0, 3.0), lower=-2, upper=-2)
    assert float(evaluate(array(one.mean()))) == pytest.approx(-2.0)
    assert float(evaluate(array(one.variance()))) == 0.0


def test_rates_out_of_range():
    density = D.Skellam(RATE, 2.0).log_density(1.0)
    assert np.isnan(evaluate(density, {RATE: -0.5}))
    assert evaluate(density, {RATE: 0.0}) == -np.inf
    with pytest.raises(ModelError, match="rate2 = -1 is outside"):
        ssm.Skellam(1.0, -1.0)
    with pytest.raises(ModelError, match="write rate1="):
        ssm.Skellam(mu1=1.0, rate2=1.0)


def test_zeros_are_added_to_counts_alone():
    with pytest.raises(ModelError, match="Skellam is no distribution of counts"):
        ssm.ZeroInflated(ssm.Skellam(1.0, 2.0), 0.1)
    kept = ssm.ZeroInflated(ssm.Truncated(ssm.Skellam(1.0, 2.0), lower=0), 0.1)
    total = sum(np.exp(float(evaluate(kept.log_density(float(k))))) for k in range(40))
    assert total == pytest.approx(1.0)
