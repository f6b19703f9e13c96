"""The bound of a transition density over the state before: above it everywhere, and attained."""

from __future__ import annotations

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.analysis.density import terms
from ssmppl.analysis.proposals.upper_bounds import transition_upper_bound
from ssmppl.errors import NotApplicable
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import depends_on
from ssmppl.language.tracing import trace
from tests.statistics.checks import seed_of

GRID = np.linspace(-8, 8, 4001)
POSITIVE = np.array([0.2, 1.0, 3.7])
REAL = np.array([-1.3, 0.0, 2.2])
COUNTS = np.array([0.0, 1.0, 5.0])

# label -> (law of x_t given x_{t-1} = x, values of x_t, whether some x attains the bound)
LAWS = {
    "normal": (lambda x: ssm.Normal(0.7 * x, sd=0.4), REAL, True),
    "normal by precision": (lambda x: ssm.Normal(np.sin(x), precision=3), [0.5], True),
    "normal with a floor": (lambda x: ssm.Normal(x, sd=0.3 + np.exp(0.1 * x)), REAL, False),
    "spread alone": (lambda x: ssm.Normal(0, variance=0.5 + x**2), REAL, True),
    "deviation alone": (lambda x: ssm.Normal(0.3, sd=0.5 + np.abs(x)), REAL, True),
    "student's scale": (lambda x: ssm.StudentT(4, 1, scale=0.3 + x**2), REAL, True),
    "laplace's scale": (lambda x: ssm.Laplace(-0.2, scale=0.3 + x**2), REAL, True),
    "cauchy's scale": (lambda x: ssm.Cauchy(0, scale=0.3 + x**2), REAL, True),
    "log-normal's spread": (lambda x: ssm.LogNormal(0.1, sd=0.2 + x**2), POSITIVE, True),
    "log-normal": (lambda x: ssm.LogNormal(x, sd=0.5), POSITIVE, True),
    "student": (lambda x: ssm.StudentT(4, 0.5 * x, scale=0.7), REAL, True),
    "laplace": (lambda x: ssm.Laplace(x, scale=2), REAL, True),
    "cauchy": (lambda x: ssm.Cauchy(x, scale=0.5), REAL, True),
    "half normal": (lambda x: ssm.HalfNormal(sd=np.exp(x)), POSITIVE, True),
    "half cauchy": (lambda x: ssm.HalfCauchy(scale=np.exp(x)), POSITIVE, True),
    "uniform": (lambda x: ssm.Uniform(x - 1, x + 1), REAL, True),
    "exponential": (lambda x: ssm.Exponential(np.exp(x)), POSITIVE, True),
    "exponential by scale": (lambda x: ssm.Exponential(scale=np.exp(x)), POSITIVE, True),
    "gamma": (lambda x: ssm.Gamma(2.5, rate=np.exp(x)), POSITIVE, True),
    "gamma by scale": (lambda x: ssm.Gamma(2.5, scale=np.exp(x)), POSITIVE, True),
    "inverse gamma": (lambda x: ssm.InverseGamma(3, scale=np.exp(x)), POSITIVE, True),
    "poisson": (lambda x: ssm.Poisson(np.exp(x)), COUNTS, True),
    "negative binomial": (lambda x: ssm.NegativeBinomial(np.exp(x), dispersion=2), COUNTS, True),
    "binomial": (lambda x: ssm.Binomial(5, 1 / (1 + np.exp(-3 * x))), COUNTS, True),
    "bernoulli": (lambda x: ssm.Bernoulli(1 / (1 + np.exp(-5 * x))), COUNTS[:2], True),
    "weibull": (lambda x: ssm.Weibull(1.5, scale=np.exp(x)), POSITIVE, True),
    "von mises": (lambda x: ssm.VonMises(0.3 * x, concentration=2.0), REAL, True),
    "beta-binomial": (lambda x: ssm.BetaBinomial(5, np.exp(x), 2.0), COUNTS, False),
    "mixture at one place": (lambda x: ssm.Mixture([0.8, 0.2], [
        ssm.Normal(x, sd=0.4), ssm.Normal(x, sd=4)]), REAL, True),
    "mixture": (lambda x: ssm.Mixture([1 / (1 + x**2), 1 - 1 / (1 + x**2)], [
        ssm.Normal(x, sd=0.4), ssm.Laplace(np.sin(x), scale=1)]), REAL, False),
    "zero-inflated": (lambda x: ssm.ZeroInflated(ssm.Poisson(np.exp(x)), 0.2), COUNTS[1:], True),
    "zero-inflated by the state": (lambda x: ssm.ZeroInflated(
        ssm.Poisson(np.exp(x)), 1 / (1 + np.exp(x))), COUNTS, False),
    "free of the state": (lambda x: ssm.Gamma(2, rate=3), POSITIVE, True),
}  # fmt: skip

UNBOUNDED = {
    "spread without a floor": (lambda x: ssm.Normal(0, sd=np.exp(x)), "sd of x"),
    "shape": (lambda x: ssm.Gamma(np.exp(x), rate=1.0), "shape of x"),
    "truncated": (lambda x: ssm.Truncated(ssm.Normal(x, sd=1), lower=0), "of x (Truncated)"),
    "mixed supports": (
        lambda x: ssm.Mixture([0.5, 0.5], [ssm.Normal(x, sd=1), ssm.Exponential(np.exp(x))]),
        "different supports",
    ),
    "a component": (
        lambda x: ssm.Mixture([0.5, 0.5], [ssm.Normal(x, sd=1), ssm.Normal(x, sd=np.exp(x))]),
        "sd of x",
    ),
    "width": (lambda x: ssm.Uniform(0, np.exp(x)), "width of x"),
}


def model_of(law, shape=()):
    model = ssm.Model("upper bounds")
    model.initial(lambda: {"x": ssm.Normal(np.zeros(shape), sd=1)})
    model.transition(lambda x: {"x": law(x)})
    model.observation(lambda x: {"y": ssm.Normal(np.sum(x), sd=1)})
    return trace(model)


@pytest.mark.parametrize("label", LAWS)
def test_above_and_attained(label):
    law, values, attained = LAWS[label]
    traced = model_of(law)
    found = transition_upper_bound(traced)
    assert not isinstance(found, NotApplicable)
    assert not depends_on(found, traced.state_prev_symbols)
    (term,) = terms(traced, "transition")
    (x,), (x_prev,) = traced.state_symbols, traced.state_prev_symbols
    for value in values:
        density = np.asarray(evaluate([term.log_density], {x: value, x_prev: GRID})[0])
        (bound,) = evaluate([found], {x: value})
        top = np.max(density)
        assert top <= bound + 1e-9, (label, value, top, bound)
        if attained:
            assert top == pytest.approx(bound, abs=0.01), (label, value)


@pytest.mark.parametrize("label", UNBOUNDED)
def test_reason(label):
    law, reason = UNBOUNDED[label]
    found = transition_upper_bound(model_of(law))
    assert isinstance(found, NotApplicable)
    assert reason in found.reason
    assert found.where is not None


def test_vector_of_which_one_component_depends():
    """All of the mean goes to the value: with correlation, one component alone would not do."""
    covariance = np.array([[1.0, 0.9], [0.9, 1.0]])
    traced = model_of(
        lambda x: ssm.MvNormal(np.array([1.0, 1.0]) * x[0], covariance=covariance), (2,)
    )
    rng = np.random.default_rng(seed_of("heights", "vector"))
    (bound,), (term,) = [transition_upper_bound(traced)], terms(traced, "transition")
    one = model_of(
        lambda x: ssm.MvNormal(np.array([0.3, 0.0]) + np.array([0.0, 1.0]) * x[0],
                               covariance=covariance), (2,)
    )  # fmt: skip
    for t, h in ((traced, bound), (one, transition_upper_bound(one))):
        (term,) = terms(t, "transition")
        for value in rng.normal(size=(20, 2)):
            known = dict(zip(t.state_symbols, value, strict=True))
            before = dict(zip(t.state_prev_symbols, [GRID, 0.0], strict=True))
            top = np.max(evaluate([term.log_density], known | before)[0])
            assert top <= evaluate([h], known)[0] + 1e-9


def test_a_vector_of_which_one_spread_depends():
    """Each entry's own way: a spread at a centre that is fixed, and at one that moves."""
    traced = model_of(
        lambda x: ssm.Normal(np.stack([x[0], 0.4]), sd=0.2 + np.abs(x[0]) * np.ones(2)), (2,)
    )
    bound, (term,) = transition_upper_bound(traced), terms(traced, "transition")
    rng = np.random.default_rng(seed_of("heights", "spread of a vector"))
    for value in 3 * rng.normal(size=(20, 2)):
        known = dict(zip(traced.state_symbols, value, strict=True))
        before = dict(zip(traced.state_prev_symbols, [GRID, 0.0], strict=True))
        top = np.max(evaluate([term.log_density], known | before)[0])
        assert top <= evaluate([bound], known)[0] + 1e-9


def test_memory_of_a_deterministic_component():
    model = ssm.Model("memory")
    model.initial(lambda: {"x": ssm.Normal(0, sd=1), "last": ssm.Dirac(0.0)})
    model.transition(lambda x: {"x": ssm.Normal(x, sd=1), "last": ssm.Dirac(x)})
    model.observation(lambda last: {"y": ssm.Normal(last, sd=1)})
    found = transition_upper_bound(trace(model))
    assert isinstance(found, NotApplicable)
    assert "deterministic component last" in found.reason
