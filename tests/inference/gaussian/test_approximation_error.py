"""How far the approximations of the likelihood are off, against a point-mass filter: small counts,
and the chaotic map of Ricker. No verb takes one of them for exact by itself."""

import numpy as np
import pytest
from scipy import stats
from scipy.special import logsumexp

import ssmppl as ssm

CELLS, ROWS = 1500, 40


def counts(rate):
    model = ssm.Model("counts")
    model.prior(lambda: {"q": ssm.HalfNormal(sd=1)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1.0)})
    model.transition(lambda x, q: {"x": ssm.Normal(0.9 * x, sd=q)})
    model.observation(lambda x: {"y": ssm.Poisson(rate * np.exp(x))})
    return model, (lambda x: 0.9 * x), rate, 0.5, 1.0, (-6.0, 6.0)


def ricker():
    model = ssm.Model("ricker")
    model.prior(lambda: {"q": ssm.HalfNormal(sd=1)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=0.5)})
    model.transition(lambda x, q: {"x": ssm.Normal(x + 3.8 - np.exp(x), sd=q)})
    model.observation(lambda x: {"y": ssm.Poisson(10.0 * np.exp(x))})
    return model, (lambda x: x + 3.8 - np.exp(x)), 10.0, 0.3, 0.5, (-40.0, 5.0)


# model, the largest error of "laplace" and of "extended" in nats over forty rows
CASES = {
    "counts of 5": (counts(5.0), 0.15, 0.2),
    "counts of 0.5": (counts(0.5), 0.2, 0.3),
    "counts of 0.05": (counts(0.05), 0.15, 0.15),
    "ricker": (ricker(), 0.2, 3.0),
}


def exact(case, y):
    """log p(y) by a filter on a grid of the state, each mass at its cell's middle."""
    _, move, rate, q, begin, ends = case
    x = np.linspace(*ends, 4 * CELLS if ends[0] < -10 else CELLS)
    width = x[1] - x[0]
    log_mass = stats.norm.logpdf(x, 0.0, begin) + np.log(width)
    density = stats.norm.pdf(x[:, None], move(x)[None, :], q) * width
    total = 0.0
    for t, value in enumerate(y):
        if t:
            with np.errstate(divide="ignore"):
                log_mass = np.log(density @ np.exp(log_mass))
        joint = log_mass + stats.poisson.logpmf(value, rate * np.exp(x))
        step = logsumexp(joint)
        total, log_mass = total + step, joint - step
    return total


@pytest.mark.parametrize("name", CASES)
@pytest.mark.slow
def test_the_error_of_the_approximate_likelihoods(name):
    case, laplace, extended = CASES[name]
    model, q = case[0], case[3]
    y = np.asarray(ssm.simulate(model, {"q": q}, steps=ROWS, seed=3)["y"]).ravel()
    truth = exact(case, y)
    at = {"q": q}
    for proposal, most in (("laplace", laplace), ("extended", extended)):
        (found,) = ssm.log_likelihood(model, {"y": y}, at, proposal=proposal)
        assert abs(found - truth) < most
        assert abs(found - truth) > 1e-3  # an approximation it is
    found = ssm.log_likelihood(
        model, {"y": y}, at, proposal="twisted", particles=200, repeats=60, seed=5
    )
    weights = np.exp(found - truth)
    assert abs(weights.mean() - 1.0) < 4 * weights.std(ddof=1) / np.sqrt(60) + 1e-4
    default = ssm.log_likelihood(model, {"y": y}, at, particles=200, repeats=60, seed=6)
    weights = np.exp(default - truth)
    assert weights.std() > 0.0  # particles, and no approximation
    assert abs(weights.mean() - 1.0) < 4 * weights.std(ddof=1) / np.sqrt(60) + 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("name", ["counts of 0.05", "ricker"])
def test_the_default_methods_are_exact_there(name):
    case = CASES[name][0]
    y = np.asarray(ssm.simulate(case[0], {"q": case[3]}, steps=ROWS, seed=3)["y"]).ravel()
    drawn = ssm.sample(case[0], {"y": y}, draws=50, warmup=50, chains=2, seed=1, progress=False)
    assert drawn["posterior"].attrs["method"] in ("PMMH", "PGAS")
    assert "approximate" not in drawn["posterior"].attrs
