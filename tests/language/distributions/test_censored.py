"""Censored: densities and masses against SciPy's, moments and draws, in a model against a product
of exact terms, and what is refused."""

import itertools
import math

import numpy as np
import pytest
from scipy import integrate, optimize, stats

import ssmppl as ssm
from ssmppl.errors import DataError, ModelError
from ssmppl.expressions.arrays import array
from ssmppl.expressions.evaluate import evaluate, numpy_draws
from ssmppl.expressions.expr import symbol
from ssmppl.language.distributions import Draws

LEVEL = 1e-6 / 10
X = symbol("observation", "y")
LAWS = {
    "both": (ssm.Normal(1.0, sd=2.0), stats.norm(1, 2), {"lower": 0.0, "upper": 4.0}),
    "lower": (ssm.LogNormal(0.5, sd=0.8), stats.lognorm(0.8, scale=math.exp(0.5)), {"lower": 0.7}),
    "upper": (ssm.Gamma(2.5, rate=0.5), stats.gamma(2.5, scale=2), {"upper": 6.0}),
    "far": (ssm.Normal(0.0, sd=1.0), stats.norm(), {"lower": 12.0}),
    "student": (ssm.StudentT(5, 1.0, scale=0.7), stats.t(5, 1, 0.7), {"lower": 0.0, "upper": 1.5}),
    "counts": (ssm.Poisson(4.0), stats.poisson(4), {"lower": 2.0, "upper": 6.0}),
    "sold out": (ssm.NegativeBinomial(5.0, dispersion=2.0), stats.nbinom(2, 2 / 7), {"upper": 8.0}),
}
named = pytest.mark.parametrize("name", LAWS)


def at(law, values):
    values = np.asarray(values, float)
    found = evaluate(law.log_density(X), {X: values})
    return np.broadcast_to(found, values.shape)


def exact(law, bounds, values):
    """Log masses at the limits, log densities between them, -inf elsewhere."""
    low, high = bounds.get("lower", -np.inf), bounds.get("upper", np.inf)
    discrete = hasattr(law.dist, "pmf")
    out = (law.logpmf if discrete else law.logpdf)(values)
    out = np.where(values == low, law.logcdf(low), out)
    out = np.where(values == high, law.logsf(high - discrete), out)
    return np.where((values < low) | (values > high), -np.inf, out)


@named
def test_masses_at_the_limits_and_the_density_between(name):
    base, own, bounds = LAWS[name]
    values = np.array([-1.0, 0.0, 0.7, 0.8, 1.5, 2.0, 3.0, 4.0, 6.0, 7.0, 8.0, 9.0, 12.0, 12.5])
    if base.discrete:
        values = np.unique(np.floor(values))
    found = at(ssm.Censored(base, **bounds), values)
    np.testing.assert_allclose(found, exact(own, bounds, values), rtol=1e-9)


@named
def test_moments_draws_and_distribution_function(name):
    base, own, bounds = LAWS[name]
    law = ssm.Censored(base, **bounds)
    low, high = bounds.get("lower", -np.inf), bounds.get("upper", np.inf)
    if base.discrete:
        k = np.arange(2000)
        read, p = np.clip(k, low, high), own.pmf(k)
        mean, second = p @ read, p @ read**2
    else:
        ends = max(low, own.support()[0]), min(high, own.support()[1])
        points = [v for v in own.ppf([1e-6, 0.5, 1 - 1e-6]) if ends[0] < v < ends[1]]
        cut = [ends[0] if np.isfinite(ends[0]) else own.ppf(1e-15), *points,
               ends[1] if np.isfinite(ends[1]) else own.isf(1e-15)]  # fmt: skip
        mean = second = 0.0
        for a, b in itertools.pairwise(cut):
            mean += integrate.quad(lambda v: v * own.pdf(v), a, b, epsabs=1e-13)[0]
            second += integrate.quad(lambda v: v**2 * own.pdf(v), a, b, epsabs=1e-13)[0]
        for limit, share in ((low, own.cdf(low)), (high, own.sf(high))):
            if np.isfinite(limit):
                mean, second = mean + share * limit, second + share * limit**2
    assert float(evaluate(law.mean())) == pytest.approx(mean, rel=1e-7)
    assert float(evaluate(law.variance())) == pytest.approx(second - mean**2, rel=1e-5, abs=1e-12)
    rng = np.random.default_rng(3)
    x = evaluate(array(law.sample(Draws("x")))[()], {}, numpy_draws(rng, (20_000,)))
    x = np.broadcast_to(x, (20_000,))
    assert np.all((x >= low) & (x <= high))
    # P(X <= x) and P(X < x) by numbers of draws, at the limits and between
    for v in sorted({*(b for b in (low, high) if np.isfinite(b)), *np.floor(x[:5])}):
        for part, count in ((law.cdf, (x <= v).sum()), (law.cdf_below, (x < v).sum())):
            p = float(evaluate(array(part(array(float(v))))[()]))
            assert stats.binomtest(int(count), len(x), min(max(p, 0.0), 1.0)).pvalue > LEVEL


def meter(low=None, high=None):
    model = ssm.Model("meter", inputs=("limit",) if low is None else ())
    model.prior(lambda: {"m": ssm.Normal(0, sd=10), "s": ssm.HalfNormal(sd=5)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(0.5 * x, sd=1)})
    if low is None:

        @model.observation
        def observation(m, s, limit):
            return {"y": ssm.Censored(ssm.Normal(m, sd=s), lower=limit)}
    else:

        @model.observation
        def observation(m, s):
            return {"y": ssm.Censored(ssm.Normal(m, sd=s), lower=low, upper=high)}

    return model


def test_the_likelihood_is_that_of_tobit():
    y = np.array([0.0, 0.4, 1.7, 0.0, 3.0, 2.2, np.nan, 0.9])
    own, bounds = stats.norm(0.8, 1.5), {"lower": 0.0, "upper": 3.0}
    expected = exact(own, bounds, y[np.isfinite(y)]).sum()
    parameters = {"m": 0.8, "s": 1.5}
    found = ssm.log_likelihood(meter(0.0, 3.0), {"y": y}, parameters, particles=20, seed=1)
    assert found[0] == pytest.approx(expected, rel=1e-10)
    # limits of the rows
    limit = np.array([0.0, 0.1, 0.1, 0.0, 3.0, 0.1, 0.1, 0.9])
    expected = sum(
        exact(own, {"lower": a}, np.array([v]))[0]
        for a, v in zip(limit, y, strict=True) if np.isfinite(v)
    )  # fmt: skip
    data = {"y": y, "limit": limit}
    found = ssm.log_likelihood(meter(), data, parameters, particles=20, seed=1)
    assert found[0] == pytest.approx(expected, rel=1e-10)


def test_the_estimate_is_the_root_of_tobits_score():
    rng = np.random.default_rng(2)
    y = np.maximum(rng.normal(0.3, 1.2, 150), 0.0)
    found = ssm.maximize(meter(0.0, None), {"y": y}, seed=1)

    def negative(z):
        return -exact(stats.norm(z[0], math.exp(z[1])), {"lower": 0.0}, y).sum()

    best = optimize.minimize(negative, [0.0, 0.0], method="Nelder-Mead", options={"xatol": 1e-9})
    error = max(found.standard_errors["m"], 0.05)
    assert abs(found.parameters["m"] - best.x[0]) < 0.05 * error
    assert abs(found.parameters["s"] - math.exp(best.x[1])) < 0.05 * error


def test_a_state_behind_a_limit_is_known_by_its_neighbours():
    """The likelihood by quadrature over a grid of states."""
    model = ssm.Model("level")
    model.prior(lambda: {"q": ssm.HalfNormal(sd=1)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x, q: {"x": ssm.Normal(0.9 * x, sd=q)})
    model.observation(lambda x: {"y": ssm.Censored(ssm.Normal(x, sd=0.5), upper=1.0)})
    y = np.array([0.2, 0.9, 1.0, 1.0, 0.7, -0.1])
    grid = np.linspace(-7, 7, 1401)
    step = grid[1] - grid[0]
    weight = stats.norm(0, 1).pdf(grid)
    total, move = 0.0, stats.norm(0.9 * grid[:, None], 0.6).pdf(grid[None])
    for k, v in enumerate(y):
        weight = weight @ move * step if k else weight
        mass = stats.norm(grid, 0.5).sf(1.0) if v == 1.0 else stats.norm(grid, 0.5).pdf(v)
        weight = weight * mass
        total += math.log(weight.sum() * step)
        weight = weight / (weight.sum() * step)
    found = ssm.log_likelihood(model, {"y": y}, {"q": 0.6}, particles=4000, repeats=20, seed=4)
    ratio = np.exp(found - total)
    assert abs(ratio.mean() - 1.0) < 4 * ratio.std(ddof=1) / math.sqrt(20)
    assert ratio.std(ddof=1) < 0.2


def test_transforms_of_predictions_are_uniform_at_the_limits():
    """The PIT of what lies at a limit is anywhere below its probability."""
    model, truth = meter(0.0, None), {"m": 0.0, "s": 1.0}
    y = ssm.simulate(model, truth, steps=2000, seed=6)["y"].values[0]
    assert 0.45 < (y == 0.0).mean() < 0.55
    pit = ssm.particle_filter(model, {"y": y}, truth, particles=10, seed=1)["y_pit"].values[0]
    assert stats.kstest(pit, "uniform").pvalue > LEVEL
    assert pit[y == 0.0].min() < 0.01


@pytest.mark.parametrize(
    ("call", "found", "fix"),
    [
        (lambda: ssm.Censored(ssm.Normal(0, sd=1)), "neither lower nor upper", "lower="),
        (lambda: ssm.Censored(ssm.Normal(0, sd=1), lower=1, upper=0), "not below", "lower < upper"),
        (lambda: ssm.Censored(ssm.Normal(0, sd=1), 0), "takes its limits by name", "lower="),
        (lambda: ssm.Censored(ssm.Poisson(3), upper=2.5), "no whole number", "limit that is read"),
        (lambda: ssm.Censored(3.0, upper=2.5), "3.0 has no distribution function", "ssm.Normal"),
        (lambda: ssm.Censored(ssm.MvNormal([0, 0], covariance=np.eye(2)), lower=0),
         "MvNormal has no", "numbers"),
        (lambda: ssm.Mixture([0.5, 0.5], [ssm.Normal(0, sd=1),
                                          ssm.Censored(ssm.Normal(0, sd=1), lower=0)]),
         "cannot mix Censored", "censor the mixture"),
        (lambda: ssm.Truncated(ssm.Censored(ssm.Normal(0, sd=1), lower=0), upper=1),
         "cannot truncate Censored", "scalar"),
    ],
)  # fmt: skip
def test_what_cannot_be_censored_is_refused(call, found, fix):
    with pytest.raises(ModelError) as caught:
        call()
    assert found in str(caught.value)
    assert fix in str(caught.value)
    assert "test_censored.py" in str(caught.value)


def test_it_is_of_observations_only():
    model = meter(0.0, None)
    model.prior(lambda: {"z": ssm.Censored(ssm.Normal(0, sd=1), lower=0)})
    with pytest.raises(ModelError, match="'z' is Censored, which observations alone have"):
        ssm.explain(model)


def test_data_beyond_a_limit_are_named():
    with pytest.raises(DataError) as caught:
        ssm.explain(meter(0.0, 3.0), {"y": np.array([0.5, 3.2, 1.0])})
    assert "3.2 is outside the support of the censored Normal, [0, 3]" in str(caught.value)
