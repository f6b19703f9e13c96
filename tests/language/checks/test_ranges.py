"""Priors that go beyond what the distributions that their parameters are in allow."""

import pytest

import ssmppl as ssm
from ssmppl.language.checks.ranges import beyond_range
from ssmppl.language.tracing import trace

NORMAL = ssm.Normal(0, sd=1)


def model(prior, transition=None, observation=None):
    m = ssm.Model("m")
    m.prior(lambda: {"s": prior})
    m.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    m.transition(transition or (lambda x: {"x": ssm.Normal(x, sd=1)}))
    m.observation(observation or (lambda x: {"y": ssm.Normal(x, sd=1)}))
    return trace(m)


@pytest.mark.parametrize(
    ("prior", "transition", "told"),
    [
        (NORMAL, lambda x, s: {"x": ssm.Normal(x, sd=s)}, "below 0, and s is the sd of 'x'"),
        (NORMAL, lambda x, s: {"x": ssm.Normal(x, variance=s)}, "s is the variance of 'x'"),
        (ssm.Uniform(-1, 5), lambda x, s: {"x": ssm.Normal(x, sd=s)}, "below 0"),
        (ssm.Flat(), lambda x, s: {"x": ssm.Normal(x, precision=s)}, "s is the precision"),
        (ssm.HalfNormal(sd=1), lambda x, s: {"x": ssm.Normal(x, sd=s)}, ""),
        (ssm.Uniform(0, 5), lambda x, s: {"x": ssm.Normal(x, sd=s)}, ""),
        (NORMAL, lambda x, s: {"x": ssm.Normal(s * x, sd=1)}, ""),
        (NORMAL, lambda x, s: {"x": ssm.Normal(x, sd=1 + s * s)}, ""),
    ],
)
def test_a_prior_that_is_cut_off_is_told(prior, transition, told):
    found = beyond_range(model(prior, transition))
    assert len(found) == bool(told)
    assert all(told in text and "test_ranges.py" in text for text in found)


@pytest.mark.parametrize(
    ("prior", "told"),
    [
        (ssm.HalfNormal(sd=1), "above 1"),
        (NORMAL, "below 0 and above 1"),
        (ssm.Beta(1, 1), ""),
    ],
)
def test_a_probability_has_two_ends(prior, told):
    found = beyond_range(model(prior, observation=lambda s: {"y": ssm.Bernoulli(s)}))
    assert len(found) == bool(told)
    assert all(f"gives values {told}, and s is the p of 'y'" in text for text in found)


def test_a_verb_that_estimates_warns():
    m = ssm.Model("m")
    m.prior(lambda: {"s": ssm.Normal(0, sd=1)})
    m.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    m.transition(lambda x, s: {"x": ssm.Normal(x, sd=s)})
    m.observation(lambda x: {"y": ssm.Normal(x, sd=1)})
    with pytest.warns(UserWarning, match="the prior of 's'"):
        ssm.maximize(m, {"y": [0.1, 0.4, -0.3, 0.2]}, progress=False)
