"""Where chains and climbs begin, if a parameter's bounds depend on another one."""

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.inference.particles.ordinary import ordinary_values
from ssmppl.language.trace import trace

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
    assert estimate.parameters["a"] < r < estimate.parameters["b"]


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
