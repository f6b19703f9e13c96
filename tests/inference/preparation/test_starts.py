"""Where chains and climbs begin, if a parameter's bounds depend on another one."""

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.inference.preparation.initial_values import ordinary_values
from ssmppl.language.tracing import trace

SHORT = {"draws": 6, "warmup": 4, "chains": 1, "seed": 1, "progress": False}
DATA = {"y": np.cumsum(np.random.default_rng(2).normal(size=40))}


def between():
    """The spread r lies between a and b."""
    model = ssm.Model("between")
    model.prior(lambda: {"a": ssm.Beta(2, 2), "b": ssm.Gamma(6, rate=2)})
    model.prior(lambda a, b: {"r": ssm.Uniform(a, b)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(x, sd=1)})
    model.observation(lambda x, r: {"y": ssm.Normal(x, sd=r)})
    return model


@pytest.mark.parametrize("r", [0.01, 0.4, 2.0, 50.0])
def test_the_others_make_room_for_what_was_given(r):
    """They stood at their prior means, and the logarithm of a negative number was taken."""
    for given in ("start", "fixed"):
        both = {"start": {}, "fixed": {}} | {given: {"r": np.array(r)}}
        found = ordinary_values(trace(between()), **both)
        assert 0 < found["a"] < r < found["b"]
        assert found["a"] < 1
        chain = ssm.sample(between(), DATA, **{given: {"r": r}}, **SHORT)["posterior"]
        drawn = chain["r"] if given == "start" else r
        assert np.all(chain["a"] < drawn)
        assert np.all(drawn < chain["b"])
    estimate = ssm.maximize(between(), DATA, fixed={"r": r}, objective="posterior", progress=False)
    # The density of r grows as a comes near it: the maximum may be at r itself, as it rounds.
    assert estimate.parameters["a"] <= r <= estimate.parameters["b"]


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"start": {"r": 2.0}, "fixed": {"b": 1.0}}, "start: parameter 'r' is 2.*where .*b"),
        ({"start": {"a": 0.5}, "fixed": {"r": 0.1}}, "fixed: parameter 'r' is 0.1, outside .0.5,"),
    ],
)
def test_values_that_contradict_each_other(given, said):
    for verb in (ssm.sample, ssm.maximize):
        with pytest.raises(ssm.ArgumentError, match=said):
            verb(between(), DATA, **given, progress=False)


@pytest.mark.slow
def test_smc2_with_a_fixed_value_outside_of_bounds_that_were_drawn():
    """b given r is r plus an exponential number, where the data say nothing of b."""
    model = ssm.Model("below")
    model.prior(lambda: {"b": ssm.Gamma(2, rate=2)})
    model.prior(lambda b: {"r": ssm.Uniform(0, b)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(x, sd=0.5)})
    model.observation(lambda x, r: {"y": ssm.Normal(x, sd=r)})
    data, call = {"y": DATA["y"][:15]}, {"fixed": {"r": 0.5}, "seed": 1, "progress": False}
    method = ssm.SMC2(parameters=400)
    b = ssm.sample(model, data, method, draws=400, chains=4, **call)["posterior"]["b"].values
    assert b.min() > 0.5
    means = b.mean(axis=1)  # of independent runs
    assert abs(means.mean() - 1.0) < 4 * max(means.std(ddof=1) / 2, 0.5 / np.sqrt(4 * 400))
    by_bridge = ssm.evidence(model, data, **call)
    found = ssm.evidence(model, data, method, **call)
    error = np.hypot(found.standard_error, by_bridge.standard_error)
    assert abs(found.log_evidence - by_bridge.log_evidence) < 4 * error


def test_em_under_a_prior_with_a_root_that_a_condition_guards():
    model = ssm.Model("guarded prior")
    model.prior(lambda: {"h": ssm.Uniform(-2, 2)})
    model.prior(lambda h: {"mu": ssm.Normal(0, sd=np.where(h > 0, np.sqrt(h), 1.0))})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x, mu: {"x": ssm.Normal(0.5 * x + mu, sd=0.5)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=1)})
    found = [
        ssm.maximize(model, DATA, m, objective="posterior", fixed={"h": -1.0}, progress=False)
        for m in (ssm.EM(), ssm.DirectOptimization())
    ]
    assert found[0].parameters["mu"] == pytest.approx(found[1].parameters["mu"], rel=1e-5)


@pytest.mark.parametrize("scale", [1e-9, 1e3, 1e6, 1e9])
def test_units_make_no_difference(scale):
    """A prior mean above a million was not believed, and the climb went to a variance of zero."""

    def made(s):
        model = ssm.Model("noisy")
        model.prior(
            lambda: {
                "a": ssm.Beta(8, 2),
                "q": ssm.HalfNormal(sd=2 * s),
                "r": ssm.HalfNormal(sd=2 * s),
            }
        )
        model.initial(lambda: {"x": ssm.Normal(0, sd=s)})
        model.transition(lambda x, a, q: {"x": ssm.Normal(a * x, sd=q)})
        model.observation(lambda x, r: {"y": ssm.Normal(x, sd=r)})
        return model

    parameters = {"a": 0.7, "q": 0.5, "r": 0.5}
    y = ssm.simulate(made(1.0), parameters=parameters, steps=150, seed=4)["y"].values[0]
    plain = ssm.maximize(made(1.0), {"y": y}, seed=1, progress=False)
    scaled = ssm.maximize(made(scale), {"y": scale * y}, seed=1, progress=False)
    assert scaled.log_likelihood + 150 * np.log(scale) == pytest.approx(
        plain.log_likelihood, abs=0.01
    )
    assert scaled.parameters["q"] / scale == pytest.approx(plain.parameters["q"], rel=0.02)


@pytest.mark.parametrize(
    ("law", "value"),
    [
        (lambda: ssm.HalfCauchy(scale=2e6), 2e6),
        (lambda: ssm.Normal(3e6, sd=1e5), 3e6),
        (lambda: ssm.LogNormal(0, sd=8), 1.0),  # its mean is 1e14
        (lambda: ssm.InverseGamma(0.01, scale=0.01), 1.0),  # and its median 1e30
        (lambda: ssm.Gamma(0.01, rate=0.01), 1.0),
        (lambda: ssm.StudentT(1, 4.0, scale=2), 4.0),
        (lambda: ssm.HalfFlat(), 1.0),
    ],
)
def test_ordinary_values(law, value):
    model = between()
    model.prior(lambda: {"c": law()})
    assert ordinary_values(trace(model), {}, {})["c"] == pytest.approx(value)
