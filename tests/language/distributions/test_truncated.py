"""Truncations, far tails above all: mass, density, distribution function, moments, sampler."""

import math

import numpy as np
import pytest
import scipy.stats as st

import ssmppl.language.distributions as D
from ssmppl.errors import ModelError
from ssmppl.expressions.arrays import array
from ssmppl.expressions.calculus import differentiate
from ssmppl.expressions.evaluate import evaluate, numpy_draws
from ssmppl.expressions.expr import symbol
from ssmppl.language.distributions.draws import Draws
from tests.language.distributions.distribution_table import TRUNCATED_CASES
from tests.statistics.checks import some

X = symbol("state", "x")
cases = pytest.mark.parametrize("case", TRUNCATED_CASES, ids=lambda c: c.id)
LEVEL = 1e-6 / len(TRUNCATED_CASES)


def value(expression, **values):
    return evaluate(array(expression)[()], {symbol("state", k): v for k, v in values.items()})


def symbolic(case):
    """The same with symbols for the bounds and the base's parameters."""
    base, values = case.base.with_symbols()
    bounds = {k: symbol("parameter", f"bound_{k}") for k in case.bounds()}
    values |= {bounds[k]: v for k, v in case.bounds().items()}
    return D.Truncated(base, **bounds), values


def grid(case):
    """(points, weights, density over the mass) with sum w f = 1: fine at ends, mode and kink."""
    law, mass = case.base.reference, case.log_mass()
    low, high = law.support()
    a, b = max(case.lower, low), min(case.upper, high)
    if case.base.cls.discrete:
        top = b if math.isfinite(b) else max(law.mean() + 40 * law.std(), a) + 400
        bottom = a if math.isfinite(a) else min(law.mean() - 40 * law.std(), b) - 400
        x = np.arange(math.ceil(bottom), top + 1)
        return x, np.ones(len(x)), np.exp(law.logpmf(x) - mass)
    inside = [v for v in (law.median(), law.mean()) if a < v < b]
    ends = [v for v in (a, b, *inside) if math.isfinite(v)]
    steps = 2.0 ** np.arange(-60, 300)
    cuts = [np.array(ends)] + [e + s * steps for e in ends for s in (-1, 1)]
    cuts = np.unique(np.concatenate(cuts))
    cuts = cuts[(cuts >= a) & (cuts <= b) & (np.abs(cuts) < 1e80)]
    nodes, weights = np.polynomial.legendre.leggauss(20)
    half = 0.5 * np.diff(cuts)[:, None]
    x = np.clip((0.5 * (cuts[1:] + cuts[:-1])[:, None] + half * nodes).ravel(), a, b)
    with np.errstate(all="ignore"):
        density = np.exp(law.logpdf(x) - mass)
    return x, (half * weights).ravel(), density


@cases
def test_log_mass(case):
    d = case.build()
    found = value(d.base.log_mass(*d._bounds()))
    if math.isfinite(case.log_mass()):
        assert found == pytest.approx(case.log_mass(), rel=1e-9, abs=1e-9)
    made, values = symbolic(case)
    assert evaluate(array(made.base.log_mass(*made._bounds()))[()], values) == pytest.approx(
        found, rel=1e-9, abs=1e-9
    )


@cases
def test_density_normalises_and_vanishes_outside(case):
    d, (x, w, expected) = case.build(), grid(case)
    found = np.exp(value(d.log_density(X), x=x))
    np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-280)
    assert (w * found).sum() == pytest.approx(1.0, abs=1e-7)
    for v in (case.lower - 1.0, case.upper + 1.0):
        if math.isfinite(v):
            assert value(d.log_density(X), x=v) == -math.inf


@cases
def test_quantiles_invert_the_distribution_function(case):
    d = case.build()
    p = np.array([1e-9, 1e-3, 0.2, 0.5, 0.8, 0.999])
    for made, values in [(d, {}), symbolic(case)]:
        x = evaluate(array(made.quantile(array(X)))[()], {**values, X: p})
        lower, upper = (float(evaluate(b)) for b in d._bounds())
        assert np.all((x >= lower) & (x <= upper))
        cdf = evaluate(array(made.cdf(array(X)))[()], {**values, X: x})
        survival = evaluate(array(made.survival(array(X)))[()], {**values, X: x})
        np.testing.assert_allclose(cdf + survival, 1.0, atol=1e-9)
        if d.discrete:
            assert np.all(cdf >= p * (1 - 1e-9))
            before = evaluate(array(made.cdf(array(X)))[()], {**values, X: x - 1})
            assert np.all((x == lower) | (before < p))
        else:
            width = np.spacing(np.abs(x)) * np.exp(value(d.log_density(X), x=x))
            assert np.all(np.abs(cdf - p) <= 1e-9 + 8 * width)


@cases
def test_the_sampler_follows_the_law(case):
    d = case.build()
    x_grid, w, density = grid(case)
    cumulative = np.cumsum(w * density)
    for made, values in [(d, {}), symbolic(case)]:
        n = 4000
        sample = array(made.sample(Draws("x")))[()]
        x = evaluate(sample, values, numpy_draws(np.random.default_rng(7), (n,)))
        lower, upper = (float(evaluate(b)) for b in d._bounds())
        assert np.all((x >= lower) & (x <= upper))
        if d.discrete:
            expected = density * n
            observed = np.array([(x == k).sum() for k in x_grid])
            assert observed.sum() == n
            big = expected >= 8
            if big.sum() >= 2:
                e = np.append(expected[big], max(expected[~big].sum(), 1.0))
                o = np.append(observed[big], observed[~big].sum())
                assert st.chi2.sf(((o - e) ** 2 / e).sum(), len(e) - 1) > LEVEL
        else:
            u = np.interp(x, x_grid, cumulative)
            assert st.kstest(u, st.uniform.cdf).pvalue > LEVEL


@pytest.mark.parametrize("case", some(TRUNCATED_CASES, 25), ids=lambda c: c.id)
def test_moments(case):
    d, (x, w, density) = case.build(), grid(case)
    heavy = {D.Cauchy: 1.0, D.HalfCauchy: 1.0}.get(case.base.cls)
    heavy = heavy or case.base.parameters.get("df")
    heavy = case.base.parameters["shape"] if case.base.cls is D.InverseGamma else heavy
    low, high = case.base.reference.support()
    one_sided = not (math.isfinite(max(case.lower, low)) and math.isfinite(min(case.upper, high)))
    if heavy and one_sided and heavy <= 1:
        assert abs(value(d.mean())) == math.inf
        assert math.isnan(value(d.variance()))
        return
    mean = (w * x * density).sum()
    assert value(d.mean()) == pytest.approx(mean, rel=1e-7, abs=1e-7)
    if heavy and one_sided and heavy <= 2:
        assert value(d.variance()) == math.inf
        return
    variance = (w * (x - mean) ** 2 * density).sum()
    assert value(d.variance()) == pytest.approx(variance, rel=1e-6)


def test_array_bounds():
    d = D.Truncated(D.Normal([0.0, 1.0], sd=1), lower=0, upper=[1.0, 5.0])
    one = D.Truncated(D.Normal(0, sd=1), lower=0, upper=1)
    two = D.Truncated(D.Normal(1, sd=1), lower=0, upper=5)
    found = evaluate(d.log_density([0.5, 3.0]))
    assert found == pytest.approx(evaluate(one.log_density(0.5)) + evaluate(two.log_density(3.0)))
    assert evaluate(array(d.mean())) == pytest.approx([value(one.mean()), value(two.mean())])


def test_truncating_twice_is_truncating_once():
    twice = D.Truncated(D.Truncated(D.Normal(X, sd=1), lower=0), lower=-1, upper=2)
    once = D.Truncated(D.Normal(X, sd=1), lower=0, upper=2)
    assert twice.log_density(1.0) is once.log_density(1.0)


def test_discrete_bounds_are_whole_numbers():
    d = D.Truncated(D.Poisson(3.0), lower=0.5, upper=4.7)
    whole = D.Truncated(D.Poisson(3.0), lower=1, upper=4)
    assert value(d.log_density(X), x=2.0) == value(whole.log_density(X), x=2.0)
    x = evaluate(array(d.sample(Draws("x")))[()], {}, numpy_draws(np.random.default_rng(1), (500,)))
    assert set(x) == {1.0, 2.0, 3.0, 4.0}


@pytest.mark.parametrize(
    "make",
    [
        lambda: D.Truncated(D.Uniform(0, 1), lower=2),
        lambda: D.Truncated(D.Gamma(2, rate=1), upper=-1),
        lambda: D.Truncated(D.Binomial(3, 0.5), lower=4),
    ],
)
def test_bounds_that_leave_nothing_are_refused(make):
    with pytest.raises(ModelError, match="leaves no probability"):
        make()


def test_a_symbolic_mean_far_outside_the_bounds():
    d = D.Truncated(D.Normal(X, sd=0.01), lower=0)
    draws = numpy_draws(np.random.default_rng(1), (1000,))
    x = evaluate(array(d.sample(Draws("x")))[()], {X: -20.0}, draws)
    assert np.all((x > 0) & np.isfinite(x))
    # the tail is exponential with rate |mean| / variance
    assert st.kstest(x, st.expon(scale=1e-4 / 20.0).cdf).pvalue > 1e-6


def test_what_was_truncated_twice_is_rebuilt_and_goes_into_mixtures():
    twice = D.Truncated(D.Truncated(D.Normal(X, sd=1), lower=0), upper=2)
    assert twice.rebuilt({}).log_density(1.0) is twice.log_density(1.0)
    mixed = D.Mixture([0.5, 0.5], [twice, D.Uniform(0, 2)])
    drawn = 0.5 * np.exp(evaluate(twice.log_density(1.0), {X: 0.3})) + 0.25
    assert evaluate(mixed.log_density(1.0), {X: 0.3}) == pytest.approx(np.log(drawn))


def test_one_law_between_bounds_for_each_element():
    d = D.Truncated(D.Poisson(3.0), lower=[0, 1, 2], upper=9)
    each = [D.Truncated(D.Poisson(3.0), lower=k, upper=9) for k in range(3)]
    expected = sum(evaluate(one.log_density(4.0)) for one in each)
    assert evaluate(d.log_density([4.0, 4.0, 4.0])) == pytest.approx(expected)
    assert evaluate(array(d.mean())) == pytest.approx([value(one.mean()) for one in each])


UNBOUNDED = {
    "Normal": D.Normal([0.5, 0.5], sd=X), "StudentT": D.StudentT(4, [0.5, 0.5], scale=X),
    "Laplace": D.Laplace([0.5, 0.5], scale=X), "Gamma": D.Gamma([2.0, 2.0], rate=X),
    "InverseGamma": D.InverseGamma([3.0, 3.0], scale=X), "Poisson": D.Poisson([X, X]),
}  # fmt: skip


@pytest.mark.parametrize("name", UNBOUNDED)
def test_a_law_between_infinite_bounds_beside_one_with_a_bound(name):
    """An element of a vector of laws, as mixtures and missing components take it."""
    both = D.Truncated(UNBOUNDED[name], lower=[-math.inf, 1.0])
    free, bounded = both.element((0,)), both.element((1,))
    law = UNBOUNDED[name].element((0,))
    for p in (0.2, 0.5, 0.9):
        x = value(law.quantile(array(p)), x=1.3)
        assert value(free.quantile(array(p)), x=1.3) == pytest.approx(x, rel=1e-12)
        for part in ("cdf", "survival", "log_density"):
            found = value(getattr(free, part)(array(x)), x=1.3)
            assert found == pytest.approx(value(getattr(law, part)(array(x)), x=1.3), rel=1e-12)
    for part in ("mean", "variance"):
        expected = value(getattr(law, part)(), x=1.3)
        assert value(getattr(free, part)(), x=1.3) == pytest.approx(expected, rel=1e-12)
    one = D.Truncated(law, lower=1.0)
    assert value(bounded.log_density(2.0), x=1.3) == value(one.log_density(2.0), x=1.3)
    mixed = D.Mixture([0.5, 0.5], [both, UNBOUNDED[name]])
    rng = np.random.default_rng(1)
    drawn = evaluate(mixed.sample(Draws("m")), {X: 1.3}, numpy_draws(rng, (2000,)))
    assert np.all(np.isfinite(drawn.astype(float)))


@pytest.mark.parametrize("bounds", [{"upper": 2.0}, {"lower": 0.5}, {"lower": 0.5, "upper": 2.0}])
def test_slopes_of_a_truncated_weibull_by_its_shape(bounds):
    """Also where a bound is the end of the support, of which a power has none."""
    density = D.Truncated(D.Weibull(X, scale=1.5), **bounds).log_density(1.0)
    slope = float(evaluate(differentiate([density], X)[0], {X: 2.0}))
    below, above = (float(evaluate(density, {X: 2.0 + h})) for h in (-1e-5, 1e-5))
    assert slope == pytest.approx((above - below) / 2e-5, rel=1e-6)


def test_a_mass_that_has_no_number_leaves_no_density():
    """The share of Gamma(2, rate) beyond 800 is 1e-345 at a rate of 1: no infinite density."""
    law = D.Truncated(D.Gamma(2.0, rate=symbol("parameter", "rate")), lower=800.0)
    log_density = law.log_density(X)
    for rate, known in [(0.9, True), (1.0, False)]:
        found = evaluate(log_density, {symbol("parameter", "rate"): rate, X: 805.0})
        assert np.isfinite(found) == known
        assert np.isnan(found) != known


@pytest.mark.parametrize(
    ("law", "at", "expected"),
    [
        (D.Beta(0.1, 0.1), 1.0, -np.inf),
        (D.Truncated(D.Beta(0.1, 0.1), lower=0.5), 1.0, -np.inf),
        (D.Truncated(D.Beta(0.1, 0.1), upper=0.5), 0.0, -np.inf),
        (D.Truncated(D.Gamma(0.1, rate=1.0), upper=2.0), 0.0, -np.inf),
        (D.Truncated(D.Beta(1.0, 1.0), lower=0.5), 0.5, math.log(2.0)),
        (D.Truncated(D.Beta(1.0, 1.0), upper=0.5), 0.5, math.log(2.0)),
        (D.Truncated(D.HalfNormal(sd=1.0), upper=9.0), 0.0, math.log(math.sqrt(2 / math.pi))),
        (D.Mixture([0.5, 0.5], [D.Beta(0.1, 0.1), D.Beta(2.0, 0.5)]), 1.0, -np.inf),
        (D.Mixture([0.5, 0.5], [D.Beta(0.1, 0.1), D.Uniform(0.0, 1.0)]), 1.0, math.log(0.5)),
    ],
)
def test_an_end_that_the_law_does_not_have(law, at, expected):
    """There a density may be +inf; an end that was cut belongs to what is left."""
    assert float(evaluate(law.log_density(X), {X: at})) == pytest.approx(expected)


COUNTS = {  # and the law from SciPy
    "poisson": (D.Poisson(2.0), st.poisson(2.0)),
    "negative binomial": (D.NegativeBinomial(2.0, dispersion=3.0), st.nbinom(3.0, 0.6)),
    "binomial": (D.Binomial(5, 0.3), st.binom(5, 0.3)),
}


@pytest.mark.parametrize("name", COUNTS)
def test_counts_from_a_lower_bound_that_is_an_expression(name):
    """At and below 0 too, where it cuts nothing off."""
    base, law = COUNTS[name]
    n = symbol("input", "n")
    lower = array([n, -3.0, n + 1.0, n + 2.0])
    drawn = evaluate(
        array(D.Truncated(base, lower=lower).sample(Draws("x"))),
        {n: 0.0},
        numpy_draws(np.random.default_rng(3), (20_000,)),
    )
    for x, at_least in zip(drawn, (0, -3, 1, 2), strict=True):
        check_counts(x, law, at_least)


def check_counts(x, law, at_least):
    """Frequencies of counts given that they are at least this, by the chi-square test."""
    k = np.arange(40)
    expected = np.where(k >= at_least, law.pmf(k), 0.0) / law.sf(at_least - 1) * len(x)
    observed = np.bincount(x.astype(int), minlength=40)
    assert observed[: max(at_least, 0)].sum() == 0
    big = expected >= 8
    e = np.append(expected[big], expected[~big].sum())
    o = np.append(observed[big], observed[~big].sum())
    e, o = (v[e > 0] for v in (e, o))
    assert st.chi2.sf(((o - e) ** 2 / e).sum(), len(e) - 1) > 1e-6
