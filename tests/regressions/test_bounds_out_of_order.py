"""Bounds in the wrong order, and priors out of their range: nothing that is drawn is a number."""

import numpy as np
import pytest

import ssmppl as ssm
import ssmppl.language.distributions as D
from ssmppl.analysis.proposals.proposals import drawn
from ssmppl.expressions.arrays import array
from ssmppl.expressions.evaluate import evaluate, numpy_draws
from ssmppl.expressions.expr import symbol
from ssmppl.inference.run.prior import draw_prior
from ssmppl.language.model.trace import Site
from ssmppl.language.tracing import trace

A = symbol("parameter", "a")
LAWS = {
    "normal": (lambda a: D.Truncated(D.Normal(0.0, sd=1.0), lower=a, upper=1.0)),
    "exponential": (lambda a: D.Truncated(D.Exponential(rate=1.0), lower=a, upper=1.0)),
    "gamma": (lambda a: D.Truncated(D.Gamma(2.0, rate=1.0), lower=a, upper=1.0)),
    "laplace": (lambda a: D.Truncated(D.Laplace(0.0, scale=1.0), lower=a, upper=1.0)),
    "poisson": (lambda a: D.Truncated(D.Poisson(2.0), lower=a, upper=1.0)),
    "the base's own": (lambda a: D.Truncated(D.Gamma(2.0, rate=1.0), upper=1.0 - a)),
    "uniform": (lambda a: D.Uniform(a, 1.0)),
}


@pytest.mark.parametrize("name", LAWS)
def test_no_draw_is_a_number(name):
    law = LAWS[name](A)
    sample = drawn(Site("x", "transition", law, array(symbol("state", "x")), law.location))
    for a, known in [(-0.5, True), (0.2, True), (1.5, False)]:
        x = evaluate(sample, {A: a}, numpy_draws(np.random.default_rng(1), (100,)))
        assert np.all(np.isfinite(x)) if known else np.all(np.isnan(x))


def test_numbers_and_absent_bounds_ask_nothing():
    assert D.Truncated(D.Normal(A, sd=1.0), lower=0.0, upper=1.0).in_range() is None
    assert D.Truncated(D.Normal(0.0, sd=1.0), lower=A).in_range() is None
    assert D.Uniform(0.0, 1.0).in_range() is None


@pytest.mark.parametrize(
    "law",
    [
        lambda a: ssm.HalfNormal(sd=a),
        lambda a: ssm.LogNormal(0.0, sd=a),
        lambda a: ssm.Weibull(a, scale=1.0),
        lambda a: ssm.Truncated(ssm.Normal(0.0, sd=1.0), lower=-a, upper=0.0),
        lambda a: ssm.Uniform(0.0, a),
    ],
)
def test_draws_of_a_prior_out_of_its_range(law):
    model = ssm.Model("out")
    model.prior(lambda: {"a": ssm.Normal(0.0, sd=1.0)})
    model.prior(lambda a: {"b": law(a)})
    model.initial(lambda: {"x": ssm.Normal(0.0, sd=1.0)})
    model.transition(lambda x, b: {"x": ssm.Normal(b * x, sd=1.0)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=1.0)})
    a, b = draw_prior(trace(model), np.random.default_rng(1), 50).T
    np.testing.assert_array_equal(np.isfinite(b), a > 0.0)
