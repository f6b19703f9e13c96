"""Ordered: its density against that of order statistics and quadrature, its sampler, its transform,
and what is said of values out of order."""

import math

import numpy as np
import pytest
from scipy import stats

import ssmppl as ssm
from ssmppl.errors import ArgumentError, ModelError
from ssmppl.expressions.arrays import array
from ssmppl.expressions.evaluate import evaluate, numpy_draws
from ssmppl.expressions.expr import symbol
from ssmppl.inference.preparation.initial_values import ordinary_values
from ssmppl.language.distributions import Draws
from ssmppl.language.model.transforms import transforms
from ssmppl.language.tracing import trace

LEVEL = 1e-6 / 30
LAWS = {
    "Normal": (ssm.Normal(np.zeros(3), sd=2), stats.norm(0, 2)),
    "Gamma": (ssm.Gamma(2.5, rate=np.full(3, 0.5)), stats.gamma(2.5, scale=2)),
    "Uniform": (ssm.Uniform(-1, np.full(3, 4.0)), stats.uniform(-1, 5)),
    "Beta": (ssm.Beta(np.full(3, 0.5), 2), stats.beta(0.5, 2)),
    "below": (ssm.Truncated(ssm.Normal(np.zeros(3), sd=1), upper=0.5),
              stats.truncnorm(-np.inf, 0.5)),
}  # fmt: skip
named = pytest.mark.parametrize("name", LAWS)


def density(law, value):
    return float(evaluate(law.log_density(array(np.asarray(value, float))), {}))


@named
def test_the_density_is_that_of_order_statistics(name):
    law, own = LAWS[name]
    value = np.sort(own.rvs(3, random_state=np.random.default_rng(1)))
    expected = math.log(6) + own.logpdf(value).sum()
    assert density(ssm.Ordered(law), value) == pytest.approx(expected, rel=1e-10)
    assert density(ssm.Ordered(law), value[::-1]) == -np.inf
    assert density(ssm.Ordered(law), value[[0, 0, 2]]) == -np.inf


@named
def test_draws_are_order_statistics(name):
    """Those of U_1, ..., U_K, by the distribution function, are beta(k, K + 1 - k)."""
    law, own = LAWS[name]
    sample = array(ssm.Ordered(law).sample(Draws("x")))
    x = evaluate(sample, {}, numpy_draws(np.random.default_rng(5), (20_000,)))
    assert np.all(np.diff(x, axis=0) > 0)
    for k in range(3):
        assert stats.kstest(own.cdf(x[k]), stats.beta(k + 1, 3 - k).cdf).pvalue > LEVEL


def test_rows_are_ordered_each():
    law = ssm.Ordered(ssm.Normal(np.zeros((2, 2)), sd=1))
    value = np.array([[0.1, 0.7], [-2.0, -1.0]])
    expected = 2 * math.log(2) + stats.norm.logpdf(value).sum()
    assert density(law, value) == pytest.approx(expected)
    assert density(law, value[:, ::-1]) == -np.inf
    x = evaluate(array(law.sample(Draws("x"))), {}, numpy_draws(np.random.default_rng(5), (100,)))
    assert x.shape == (2, 2, 100)
    assert np.all(x[:, 0] < x[:, 1])


def log_order(law):
    """log P(the components come out in order), from the density at a point."""
    point = np.array([0.3, 0.31, 0.32, 0.33][: law.shape[-1]])
    return float(evaluate(np.sum(law.log_densities(array(point))), {})) - density(
        ssm.Ordered(law), point
    )


def test_the_probability_of_an_order_of_normals():
    """Two by their difference, three by the bivariate normal of theirs."""
    found = log_order(ssm.Normal([-1.0, 1.0], sd=[0.5, 2.0]))
    assert found == pytest.approx(stats.norm.logcdf(2 / math.hypot(0.5, 2.0)), rel=1e-10)
    found = log_order(ssm.Normal([3.0, -1.0], sd=[1.0, 0.5]))
    assert found == pytest.approx(stats.norm.logcdf(-4 / math.hypot(0.5, 1.0)), rel=1e-8)
    cov = [[1 + 4, -4], [-4, 4 + 2.25]]
    expected = stats.multivariate_normal(np.zeros(2), cov).cdf([1.0, -0.5])
    found = log_order(ssm.Normal([0.0, 1.0, 0.5], sd=[1.0, 2.0, 1.5]))
    assert math.exp(found) == pytest.approx(expected, rel=1e-6)


def test_the_probability_of_an_order_of_other_laws():
    """Exponentials, of which each in turn is the least of those left; a density with a pole; one
    with a kink; and one that is written by the user."""
    found = log_order(ssm.Exponential(rate=[1.0, 2.0, 5.0, 0.5]))
    expected = 1 / 8.5 * 2 / 7.5 * 5 / 5.5
    assert math.exp(found) == pytest.approx(expected, rel=1e-10)
    found = log_order(ssm.Gamma([0.3, 1.0], rate=[1.0, 2.0]))
    # P(G < E / 2) = E exp(-2 G) = 3^-0.3
    assert math.exp(found) == pytest.approx(3.0**-0.3, rel=1e-6)
    found = log_order(ssm.Laplace([0.0, 1.0], scale=1.0))
    assert math.exp(found) == pytest.approx(1 - math.exp(-1.0) * 0.75, rel=1e-10)


def test_hyperparameters_in_common():
    m, s = symbol("parameter", "m"), symbol("parameter", "s")
    law = ssm.Ordered(ssm.Normal(array([m, m]), sd=s))
    found = evaluate(law.log_density(array([0.2, 0.9])), {m: 1.0, s: 0.5})
    assert found == pytest.approx(math.log(2) + stats.norm(1, 0.5).logpdf([0.2, 0.9]).sum())
    assert evaluate(law.in_range()[()], {m: 1.0, s: -0.5}) == 0.0


def regimes(law):
    model = ssm.Model("regimes")
    model.prior(lambda: {"rate": law})
    model.initial(lambda: {"k": ssm.Bernoulli(0.5)})
    model.transition(lambda k: {"k": ssm.Bernoulli(np.where(k > 0.5, 0.9, 0.1))})
    model.observation(lambda k, rate: {"y": ssm.Normal(np.where(k > 0.5, rate[1], rate[0]), sd=1)})
    return model


SHAPES = {
    "real": (ssm.Normal(np.zeros(3), sd=5), [-2.0, 0.1, 7.0]),
    "lower": (ssm.Gamma(2, rate=np.ones(3)), [0.2, 0.3, 5.0]),
    "upper": (ssm.Truncated(ssm.Normal(np.zeros(3), sd=1), upper=0.5), [-3.0, 0.1, 0.4]),
    "both": (ssm.Uniform(-1, np.full(3, 4.0)), [-0.5, 2.0, 3.9]),
    "rows": (ssm.Beta(2, np.ones((2, 2))), [[0.1, 0.9], [0.4, 0.5]]),
}  # fmt: skip


@pytest.mark.parametrize("name", SHAPES)
def test_there_and_back_with_the_volume_of_numerical_differences(name):
    law, value = SHAPES[name]
    (made,) = transforms(trace(regimes(ssm.Ordered(law))))
    value = np.array(value)
    z = made.inverse(value, {})
    assert len(z) == len(made.free) == value.size

    def back(z):
        return np.array(evaluate(array(list(made.values)), dict(zip(made.free, z, strict=True))))

    np.testing.assert_allclose(back(z), value.ravel(), rtol=1e-12)
    columns = [(back(z + e) - back(z - e)) / 2e-6 for e in 1e-6 * np.eye(len(z))]
    found = evaluate(made.log_jacobian, dict(zip(made.free, z, strict=True)))
    assert found == pytest.approx(np.linalg.slogdet(np.array(columns))[1], abs=1e-7)


@pytest.mark.parametrize("name", SHAPES)
def test_values_that_are_one_by_rounding_have_a_finite_place(name):
    law, value = SHAPES[name]
    (made,) = transforms(trace(regimes(ssm.Ordered(law))))
    value = np.array(value)
    value[..., 0] = value[..., 1]
    assert np.all(np.isfinite(made.inverse(value, {})))


@pytest.mark.parametrize("name", SHAPES)
def test_ordinary_values_are_in_order(name):
    law, _ = SHAPES[name]
    value = ordinary_values(trace(regimes(ssm.Ordered(law))), {}, {})["rate"]
    assert np.isfinite(density(ssm.Ordered(law), value))
    improper = ordinary_values(trace(regimes(ssm.Ordered(ssm.Flat(3)))), {}, {})["rate"]
    assert np.all(np.diff(improper) > 0)


@pytest.mark.parametrize(
    ("call", "found", "fix"),
    [
        (lambda: ssm.Ordered(ssm.Normal(0, sd=1)), "Normal has shape ()", "np.zeros(2)"),
        (lambda: ssm.Ordered(ssm.Poisson([1, 2])), "no continuous distribution", "ssm.Normal"),
        (lambda: ssm.Ordered(ssm.MvNormal([0, 0], covariance=np.eye(2))), "no continuous", "ssm."),
        (lambda: ssm.Ordered(2.0), "Ordered: 2.0 is no continuous distribution", "ssm.Normal"),
        (lambda: ssm.Ordered(ssm.Uniform([0, 1], [1, 2])), "different bounds", "in common"),
        (lambda: ssm.Ordered(ssm.Normal([symbol("parameter", "m"), 1.0], sd=1)),
         "different distributions of parameters", "the same arguments, or numbers"),
        (lambda: ssm.Ordered(ssm.Normal([40.0, 1.0], sd=1)), "all but never", "lowest first"),
    ],
)  # fmt: skip
def test_what_has_no_order_is_refused(call, found, fix):
    with pytest.raises(ModelError) as caught:
        call()
    assert found in str(caught.value)
    assert fix in str(caught.value)


def test_values_out_of_order_are_named():
    model, data = regimes(ssm.Ordered(ssm.Normal(np.zeros(2), sd=1))), {"y": np.zeros(4)}
    with pytest.raises(ArgumentError, match=r"'rate'\[1\]: 0.5 does not lie above the component"):
        ssm.maximize(model, data, start={"rate": [1.0, 0.5]})
    with pytest.raises(ArgumentError, match="give values in increasing order"):
        ssm.sample(model, data, start={"rate": [1.0, 1.0]})


def test_nothing_is_drawn_of_different_distributions():
    model = regimes(ssm.Ordered(ssm.Normal([-1.0, 1.0], sd=1)))
    with pytest.raises(ModelError, match="Ordered of different distributions has no sampler"):
        ssm.predict(model, None, {"y": np.zeros(4)}, seed=1)
