"""Mixture and ZeroInflated: density, moments, tails, samplers, ranges, and what is refused."""

import math

import numpy as np
import pytest
import scipy.stats as st
from scipy.special import logsumexp

import ssmppl.language.distributions as D
from ssmppl.errors import ModelError
from ssmppl.expressions.arrays import array
from ssmppl.expressions.calculus import differentiate, hessian
from ssmppl.expressions.evaluate import evaluate, numpy_draws
from ssmppl.expressions.expr import symbol
from ssmppl.language.distributions.draws import Draws
from ssmppl.language.distributions.nested import log_sum

X, P, A, B = (symbol("state", n) for n in "xpab")
LEVEL = 1e-6  # of each distribution test

# components with SciPy's laws; the weights; where quadrature is cut
CONTINUOUS = {
    "two normals": ([0.9, 0.1], [(D.Normal(1.0, sd=0.5), st.norm(1, 0.5)),
                                 (D.Normal(1.0, sd=8.0), st.norm(1, 8))], [1.0]),
    "three": ([0.2, 0.5, 0.3], [(D.Normal(-4.0, variance=2.0), st.norm(-4, math.sqrt(2))),
                                (D.StudentT(5, 0.0, scale=1.0), st.t(5)),
                                (D.Laplace(3.0, scale=0.3), st.laplace(3, 0.3))], [-4, 0, 3]),
    "positive": ([0.4, 0.6], [(D.Gamma(2.0, rate=1.0), st.gamma(2)),
                              (D.LogNormal(1.0, sd=0.3), st.lognorm(0.3, scale=math.e))], [1, 3]),
    "real and positive": ([0.7, 0.3], [(D.Normal(0.0, sd=0.5), st.norm(0, 0.5)),
                                       (D.Exponential(scale=3.0), st.expon(scale=3))], [0.0]),
    "two intervals": ([0.5, 0.5], [(D.Uniform(0.0, 1.0), st.uniform()),
                                   (D.Uniform(3.0, 5.0), st.uniform(3, 2))], [0, 1, 3, 5]),
    "of one mixed": ([0.25, 0.75], [
        (D.Mixture([0.5, 0.5], [D.Normal(0.0, sd=1.0), D.Normal(5.0, sd=1.0)]), None),
        (D.Normal(2.0, sd=0.1), st.norm(2, 0.1))], [0, 2, 5]),
}  # fmt: skip
COUNTS = {
    "poissons": ([0.7, 0.3], [(D.Poisson(2.0), st.poisson(2)), (D.Poisson(20.0), st.poisson(20))]),
    "kinds": ([0.5, 0.3, 0.2], [(D.Binomial(10, 0.3), st.binom(10, 0.3)),
                                (D.NegativeBinomial(4.0, dispersion=1.5),
                                 st.nbinom(1.5, 1.5 / 5.5)),
                                (D.Bernoulli(0.4), st.bernoulli(0.4))]),
    "short and long": ([0.5, 0.5], [(D.Binomial(3, 0.5), st.binom(3, 0.5)),
                                    (D.BetaBinomial(12, 2.0, 1.0), st.betabinom(12, 2, 1))]),
}  # fmt: skip
INFLATED = {
    "poisson": (D.Poisson(3.0), st.poisson(3.0), 0.25),
    "rare": (D.Poisson(0.1), st.poisson(0.1), 0.02),
    "negative binomial": (D.NegativeBinomial(5.0, dispersion=0.8), st.nbinom(0.8, 0.8 / 5.8), 0.4),
    "binomial": (D.Binomial(8, 0.6), st.binom(8, 0.6), 0.3),
    "beta-binomial": (D.BetaBinomial(8, 2.0, 1.0), st.betabinom(8, 2, 1), 0.3),
}


class Mixed:
    """The same from SciPy's components."""

    def __init__(self, weights, laws):
        self.w, self.laws = weights, laws

    def _sum(self, name, x):
        return sum(w * getattr(law, name)(x) for w, law in zip(self.w, self.laws, strict=True))

    def cdf(self, x):
        return self._sum("cdf", x)

    def sf(self, x):
        return self._sum("sf", x)

    def logdensity(self, x, name):
        parts = [getattr(law, name)(x) for law in self.laws]
        return logsumexp(parts, axis=0, b=np.array(self.w)[:, None])


def case(name):
    weights, pairs, *cuts = {**CONTINUOUS, **COUNTS}[name]
    laws = [law for _, law in pairs]
    if None in laws:
        laws[laws.index(None)] = Mixed([0.5, 0.5], [st.norm(), st.norm(5)])
    return D.Mixture(weights, [d for d, _ in pairs]), Mixed(weights, laws), cuts[0] if cuts else []


def at(expression, points, **values):
    value = evaluate(array(expression)[()], {X: np.asarray(points, dtype=float), **values})
    return np.broadcast_to(value, np.shape(points))


def draws_of(distribution, n, seed, values=None):
    sample = array(distribution.sample(Draws("x")))
    return evaluate(sample, values or {}, numpy_draws(np.random.default_rng(seed), (n,)))


@pytest.mark.parametrize("name", [n for n in CONTINUOUS if n != "of one mixed"])
def test_density_of_continuous_ones(name):
    law, reference, _ = case(name)
    x = np.concatenate([np.linspace(-15, 15, 201), [-300.0, 300.0, 0.5, 2.0]])
    with np.errstate(divide="ignore"):
        expected = reference.logdensity(x, "logpdf")
    found = at(law.log_density(X), x)
    np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-10)


def test_no_component_is_lost_to_underflow():
    law = D.Mixture([1e-300, 1.0 - 1e-300], [D.Normal(0.0, sd=1.0), D.Normal(1e3, sd=1e-3)])
    expected = math.log(1e-300) + st.norm.logpdf(3.0)
    assert at(law.log_density(X), [3.0]) == pytest.approx(expected, rel=1e-14)


@pytest.mark.parametrize("name", COUNTS)
def test_density_of_counts(name):
    law, reference, _ = case(name)
    k = np.arange(-2.0, 80.0, 0.5)
    with np.errstate(divide="ignore"):
        expected = reference.logdensity(k, "logpmf")
    np.testing.assert_allclose(at(law.log_density(X), k), expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", [*CONTINUOUS, *COUNTS])
def test_distribution_function_moments_and_sampler(name):
    law, reference, cuts = case(name)
    x = np.linspace(-12.0, 40.0, 105)
    np.testing.assert_allclose(at(law.cdf(array(X)), x), reference.cdf(x), rtol=1e-9, atol=1e-14)
    np.testing.assert_allclose(at(law.survival(array(X)), x), reference.sf(x), rtol=1e-9,
                               atol=1e-14)  # fmt: skip
    mean, variance = (float(evaluate(array(m))) for m in (law.mean(), law.variance()))
    if name in COUNTS:
        k = np.arange(400.0)
        mass = np.exp(at(law.log_density(X), k))
        moments = [1.0, mean, variance + mean**2]
        assert [mass @ k**j for j in range(3)] == pytest.approx(moments, rel=1e-9)
    else:
        edges = [-200.0, *np.linspace(-20.0, 40.0, 25), *cuts, 200.0, 3000.0]
        edges = sorted(set(edges))
        nodes, weights = np.polynomial.legendre.leggauss(80)
        half = 0.5 * np.diff(edges)[:, None]
        v = (0.5 * (np.array(edges[1:]) + edges[:-1])[:, None] + half * nodes).ravel()
        mass = (half * weights).ravel() * np.exp(at(law.log_density(X), v))
        for j, expected in enumerate([1.0, mean, variance + mean**2]):
            total = mass @ v**j
            # a Student's t with 5 degrees has lost moments of 1e-5 beyond 200
            assert total == pytest.approx(expected, rel=2e-4 if name == "three" else 1e-7)
    drawn = draws_of(law, 40_000, 3)
    if name in CONTINUOUS:
        assert st.kstest(drawn, reference.cdf).pvalue > LEVEL
    else:
        assert chi_square(drawn, mass[:60]) > LEVEL


def chi_square(x, mass):
    """p-value of counts over the values of expected count at least 10, and the rest."""
    expected = mass * len(x)
    keep = expected >= 10
    observed = np.array([np.sum(x == k) for k in np.flatnonzero(keep)])
    rest = len(x) - observed.sum(), len(x) - expected[keep].sum()
    o, e = observed, expected[keep]
    if rest[1] > 5:
        o, e = np.append(o, rest[0]), np.append(e, rest[1])
    return st.chi2.sf(((o - e) ** 2 / e).sum(), len(e) - 1)


def test_elements_of_an_array_choose_by_themselves():
    """Also with scalar components, and where they need unlike numbers of draws."""
    law = D.Mixture(
        [0.5, 0.5],
        [D.StudentT(3, np.array([0.0, 4.0, -7.0]), scale=1.0), D.Normal(100.0, sd=1.0)],
    )
    x = draws_of(law, 20_000, 4)
    assert x.shape == (3, 20_000)
    chosen = x > 50
    for i in range(3):
        assert st.binomtest(int(chosen[i].sum()), 20_000, 0.5).pvalue > LEVEL
        assert st.kstest(x[i, ~chosen[i]], st.t(3, [0.0, 4.0, -7.0][i]).cdf).pvalue > LEVEL
        assert st.kstest(x[i, chosen[i]], st.norm(100.0).cdf).pvalue > LEVEL
        for j in range(i):
            # of those that chose alike, the values are independent too
            for own in (chosen[i] & chosen[j], ~chosen[i] & ~chosen[j], chosen[i] & ~chosen[j]):
                assert st.binomtest(int((own).sum()), 20_000, 0.25).pvalue > LEVEL
                assert st.spearmanr(x[i, own], x[j, own]).pvalue > LEVEL
    inflated = D.ZeroInflated(D.Poisson(5.0), np.array([0.5, 0.5]))
    n = draws_of(inflated, 20_000, 5)
    both = (n[0] > 0) & (n[1] > 0)
    assert st.spearmanr(n[0, both], n[1, both]).pvalue > LEVEL
    assert st.binomtest(int(both.sum()), 20_000, (0.5 * st.poisson.sf(0, 5)) ** 2).pvalue > LEVEL


def test_components_share_their_draws():
    """One uniform and one normal, however many normal components there are."""
    draws = Draws("x")
    D.Mixture([0.2] * 5, [D.Normal(float(k), sd=1.0) for k in range(5)]).sample(draws)
    assert draws.count == 2


def test_weights_of_each_element_and_by_symbols():
    weights = np.array([[0.9, 0.2], [0.1, 0.8]])
    law = D.Mixture(weights, [D.Normal(0.0, sd=1.0), D.Normal(4.0, sd=1.0)])
    assert law.shape == (2,)
    expected = [st.norm.pdf(1.0) * w[0] + st.norm.pdf(1.0, 4) * w[1] for w in weights.T]
    assert evaluate(law.log_density([1.0, 1.0])) == pytest.approx(np.log(expected).sum())
    by_symbol = D.Mixture([1 - P, P], [D.Normal(0.0, sd=1.0), D.Normal(4.0, sd=1.0)])
    found = evaluate(by_symbol.log_density(X), {X: 1.0, P: 0.8})
    assert found == pytest.approx(np.log(expected[1]))


@pytest.mark.parametrize("name", INFLATED)
def test_zero_inflated(name):
    base, reference, p = INFLATED[name]
    k = np.arange(0.0, 400.0)
    with np.errstate(divide="ignore"):
        log_mass = math.log1p(-p) + reference.logpmf(k)
    log_mass[0] = np.logaddexp(math.log(p), log_mass[0])
    mass = np.exp(log_mass)
    for law, values in ((D.ZeroInflated(base, p), {}), (D.ZeroInflated(base, P), {P: p})):
        found = evaluate(law.log_density(X), {X: k, **values})
        np.testing.assert_allclose(found, log_mass, rtol=1e-9, atol=1e-12)
        for x in (-1.0, 0.5):
            assert evaluate(law.log_density(X), {X: x, **values}) == -math.inf
        below = evaluate(array(law.cdf(array(X)))[()], {X: k, **values})
        np.testing.assert_allclose(below, np.cumsum(mass), rtol=1e-9)
        above = evaluate(array(law.survival(array(X)))[()], {X: k, **values})
        np.testing.assert_allclose(above, (1 - p) * reference.sf(k), rtol=1e-9, atol=1e-300)
        mean, variance = (float(evaluate(array(m), values)) for m in (law.mean(), law.variance()))
        assert mean == pytest.approx(mass @ k, rel=1e-9)
        assert variance == pytest.approx(mass @ (k - mean) ** 2, rel=1e-9)
        q = np.array([1e-9, p / 2, p, 0.5 * (p + mass[0]), mass[0] + 1e-9, 0.6, 0.99, 1 - 1e-9])
        found = evaluate(array(law.quantile(array(X)))[()], {X: q, **values})
        assert found.tolist() == np.searchsorted(np.cumsum(mass), q).tolist()
        assert chi_square(draws_of(law, 40_000, 6, values), mass[:60]) > LEVEL


def test_a_hurdle_is_inflation_of_a_law_without_zeros():
    law = D.ZeroInflated(D.Truncated(D.Poisson(2.0), lower=1), 0.4)
    k = np.arange(0.0, 30.0)
    mass = 0.6 * st.poisson.pmf(k, 2.0) / st.poisson.sf(0, 2.0)
    mass[0] = 0.4
    np.testing.assert_allclose(np.exp(at(law.log_density(X), k)), mass, rtol=1e-10)
    assert chi_square(draws_of(law, 40_000, 7), mass) > LEVEL
    later = D.ZeroInflated(D.Truncated(D.Poisson(2.0), lower=2), 0.4)
    assert at(later.log_density(X), [1.0]) == -math.inf


def test_zeros_are_added_to_a_vector_of_laws_with_and_without():
    lower, k = [0, 1, 2], np.arange(0.0, 5.0)
    law = D.ZeroInflated(D.Truncated(D.Poisson(2.0), lower=lower), P)
    for i, least in enumerate(lower):
        mass = 0.7 * st.poisson.pmf(k, 2.0) / st.poisson.sf(least - 1, 2.0) * (k >= least)
        mass[0] += 0.3
        for own in (law, law.element((i,))):
            found = own.log_densities(array([X] * 3 if own is law else X)).ravel()
            density = evaluate(found[i if own is law else 0], {X: k, P: 0.3})
            np.testing.assert_allclose(np.exp(density), mass, rtol=1e-10)


def test_truncated_zero_inflated():
    law = D.Truncated(D.ZeroInflated(D.Poisson(3.0), 0.3), lower=0, upper=4)
    mass = 0.7 * st.poisson.pmf(np.arange(5), 3.0)
    mass[0] += 0.3
    mass /= mass.sum()
    np.testing.assert_allclose(np.exp(at(law.log_density(X), np.arange(5.0))), mass, rtol=1e-9)
    assert chi_square(draws_of(law, 20_000, 8), mass) > LEVEL
    mean = float(evaluate(array(law.mean())))
    assert mean == pytest.approx(mass @ np.arange(5))
    above = D.Truncated(D.ZeroInflated(D.Poisson(3.0), 0.3), lower=2)
    expected = st.poisson.pmf(np.arange(2, 40), 3.0) / st.poisson.sf(1, 3.0)
    found = np.exp(at(above.log_density(X), np.arange(2.0, 40.0)))
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    assert chi_square(draws_of(above, 20_000, 9) - 2, expected) > LEVEL


def richardson(f, x, h=1e-3):
    """(derivative, bound of its error) by central differences at two steps."""
    wide, narrow = ((f(x + s) - f(x - s)) / (2 * s) for s in (h, h / 2))
    return (4 * narrow - wide) / 3, 0.1 * abs(narrow - wide) + 1e-11 / h


DENSITIES = {
    "mixture": D.Mixture([1 - P, P], [D.Normal(A, sd=0.5), D.StudentT(4, A, scale=B)]),
    "supports": D.Mixture([1 - P, P], [D.Normal(A, sd=0.5), D.Gamma(1.5, rate=B)]),
    "inflated": D.ZeroInflated(D.NegativeBinomial(B, dispersion=1.5), P),
    "beta-binomial": D.BetaBinomial(6, A, B),
    "weibull": D.Weibull(A, scale=B),
    "von mises": D.VonMises(A, concentration=B),
}


@pytest.mark.parametrize("value", [0.0, 2.0, -0.7])
@pytest.mark.parametrize("name", DENSITIES)
def test_first_and_second_derivatives(name, value):
    law, point = DENSITIES[name], {P: 0.3, A: 0.8, B: 1.7}
    density = law.log_density(value)
    if not np.isfinite(evaluate(density, point)):
        pytest.skip("outside of its support")
    symbols = [P, A, B]
    first = [differentiate([density], s)[0] for s in symbols]
    second = hessian(density, symbols)
    for i, s in enumerate(symbols):
        for f, found in [(density, first[i]), *[(first[j], second[i, j]) for j in range(3)]]:
            expected, bound = richardson(
                lambda v, f=f, s=s: float(evaluate(f, {**point, s: v})), point[s]
            )
            assert abs(float(evaluate(found, point)) - expected) < bound + 1e-9 * abs(expected)


EDGES = {
    "mixture": (D.Mixture([P, 1 - P], [D.Normal(A, sd=0.5), D.StudentT(4, A, scale=B)]),
                lambda x, a, b: (st.norm(a, 0.5).pdf(x), st.t(4, a, b).pdf(x))),
    "far apart": (D.Mixture([1 - P, P], [D.Normal(A + 30, sd=0.5), D.Normal(A, sd=B)]),
                  lambda x, a, b: (st.norm(a, b).pdf(x), st.norm(a + 30, 0.5).pdf(x))),
    "inflated": (D.ZeroInflated(D.Poisson(A + B), P),
                 lambda x, a, b: (float(x == 0), st.poisson(a + b).pmf(x))),
}  # fmt: skip


@pytest.mark.parametrize("value", [0.0, 2.0])
@pytest.mark.parametrize("name", EDGES)
def test_slopes_where_a_share_is_zero(name, value):
    """Of p f + (1 - p) g: (f - g) / (rest) in p; in others those of log g, at 1 of log f."""
    law, densities = EDGES[name]
    density, h = law.log_density(value), 1e-5
    slopes = [differentiate([density], s)[0] for s in (P, A, B)]
    for p in (0.0, 1.0):
        f, g = densities(value, 0.8, 1.7)
        kept = (g, f)[int(p)]
        if kept == 0.0:
            continue
        point = {P: p, A: 0.8, B: 1.7}
        assert evaluate(density, point) == pytest.approx(math.log(kept), rel=1e-10)
        found = [float(evaluate(s, point)) for s in slopes]
        assert found[0] == pytest.approx((f - g) / kept, rel=1e-9)
        for k, (a, b) in enumerate([(h, 0.0), (0.0, h)]):
            up, down = (densities(value, 0.8 + s * a, 1.7 + s * b)[1 - int(p)] for s in (1, -1))
            assert found[1 + k] == pytest.approx(math.log(up / down) / (2 * h), rel=1e-6, abs=1e-8)


def test_a_component_that_is_never_chosen_hides_no_other_one():
    """However much likelier the value would be by it."""
    law = D.Mixture([P, 1 - P], [D.Normal(0.0, sd=1.0), D.Normal(60.0, sd=1.0)])
    density = law.log_density(0.0)
    assert evaluate(density, {P: 0.0}) == pytest.approx(st.norm.logpdf(60.0))
    assert evaluate(density, {P: 1e-30}) == pytest.approx(st.norm.logpdf(0.0) + math.log(1e-30))
    ends = [array([0.0, math.inf, -math.inf]), array([0.0, 0.0, -math.inf])]
    found = evaluate(log_sum([array([P] * 3), array([1 - P] * 3)], ends), {P: 0.5})
    assert found.tolist() == [0.0, math.inf, -math.inf]


OUT = {
    "weight": (D.Mixture([1 - P, P], [D.Normal(0.0, sd=1.0), D.Normal(1.0, sd=1.0)]), P,
               [-0.1, 1.1]),
    "sum": (D.Mixture([P, A], [D.Normal(0.0, sd=1.0), D.Normal(1.0, sd=1.0)]), P, [0.3, 0.8]),
    "component": (D.Mixture([0.5, 0.5], [D.Normal(0.0, sd=1.0), D.Exponential(B)]), B, [-0.5]),
    "variance": (D.Mixture([0.5, 0.5], [D.Normal(0.0, variance=B), D.Normal(0.0, sd=3.0)]), B,
                 [-0.5]),
    "width": (D.Mixture([0.5, 0.5], [D.Normal(0.0, sd=1.0), D.Uniform(0.0, B)]), B, [-0.5]),
    "counts": (D.Mixture([0.5, 0.5], [D.Poisson(2.0), D.Binomial(4, B)]), B, [-0.5, 1.5]),
    "zeros": (D.ZeroInflated(D.Poisson(2.0), P), P, [-0.1, 1.1]),
    "inside": (D.ZeroInflated(D.Binomial(4, B), 0.5), B, [-0.5, 1.5]),
    "nested": (D.Mixture([0.5, 0.5], [D.Poisson(1.0), D.ZeroInflated(D.Poisson(B), 0.5)]), B,
               [-0.5]),
}  # fmt: skip


@pytest.mark.parametrize("name", OUT)
def test_no_density_where_a_parameter_is_out_of_range(name):
    law, changed, outside = OUT[name]
    inside = {P: 0.4, A: 0.6, B: 0.7}
    values = np.array([-2.0, 0.0, 0.5, 1.0, 2.0])
    allowed = law.in_range()
    assert allowed is not None
    assert np.isfinite(evaluate(law.log_density(X), {X: values, **inside})).any()
    assert bool(evaluate(allowed[()], inside))
    for v in outside:
        found = evaluate(law.log_density(X), {X: values, **inside, changed: v})
        assert not np.isfinite(found).any()
        assert not bool(evaluate(allowed[()], {**inside, changed: v}))


def test_the_formula_by_itself_has_no_number_there():
    """As slice steps take it, without the support: counts above zero are no exception."""
    law = D.ZeroInflated(D.Poisson(2.0), P)
    for v in (-0.1, 1.1):
        for count in (0.0, 3.0):
            assert math.isnan(evaluate(law.log_density(count, guard=False), {P: v}))


REFUSED = {
    "one component": (lambda: D.Mixture([1.0], [D.Normal(0, sd=1)]), "at least two"),
    "no distributions": (lambda: D.Mixture([0.5, 0.5], [1.0, 2.0]), "components are"),
    "weights": (lambda: D.Mixture([0.2, 0.3, 0.5], [D.Normal(0, sd=1), D.Normal(1, sd=1)]),
                "one weight for each component"),
    "sum": (lambda: D.Mixture([0.5, 0.6], [D.Normal(0, sd=1), D.Normal(1, sd=1)]),
            "weights sum to 1.1"),
    "negative": (lambda: D.Mixture([1.5, -0.5], [D.Normal(0, sd=1), D.Normal(1, sd=1)]),
                 "is outside"),
    "two kinds": (lambda: D.Mixture([0.5, 0.5], [D.Normal(0, sd=1), D.Poisson(1)]),
                  "Normal (continuous), Poisson (discrete)"),
    "atom": (lambda: D.Mixture([0.5, 0.5], [D.Dirac(0), D.Normal(0, sd=1)]), "ZeroInflated"),
    "joint": (lambda: D.Mixture([0.5, 0.5], [D.MvNormal(np.zeros(2), covariance=np.eye(2))] * 2),
              "make the choice a state"),
    "labels": (lambda: D.Mixture([0.5, 0.5], [D.Categorical([0.5, 0.5])] * 2),
               "mix the probabilities"),
    "truncation": (lambda: D.Truncated(
        D.Mixture([0.5, 0.5], [D.Normal(0, sd=1), D.Normal(1, sd=1)]), lower=0),
                   "truncate each component"),
    "an angle": (lambda: D.Truncated(D.VonMises(0, concentration=1), lower=0), "VonMises"),
    "quantile": (lambda: D.Mixture([0.5, 0.5], [D.Normal(0, sd=1)] * 2).quantile(0.5),
                 "no formula"),
    "no counts": (lambda: D.ZeroInflated(D.Normal(0, sd=1), 0.5), "no distribution of counts"),
    "labels inflated": (
        lambda: D.ZeroInflated(D.Categorical([0.5, 0.5]), 0.5), "no distribution of counts"
    ),
    "twice": (
        lambda: D.ZeroInflated(D.ZeroInflated(D.Poisson(1), 0.5), 0.5), "no distribution of counts"
    ),
    "share": (lambda: D.ZeroInflated(D.Poisson(1), 1.5), "p = 1.5 is outside"),
    "trials": (lambda: D.BetaBinomial(2.5, 1, 1), "n = 2.5 is no whole number"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_refused_says_what_to_write(name):
    build, text = REFUSED[name]
    with pytest.raises(ModelError) as caught:
        build()
    assert text in str(caught.value)
    assert "test_mixtures.py" in str(caught.value)
    assert "Fix:" in str(caught.value)


def test_text():
    law = D.Mixture([1 - P, P], [D.Normal(X, sd=1), D.Normal(X, sd=10)])
    assert repr(law) == "Mixture([1 - p, p], [Normal(mean=x, sd=1), Normal(mean=x, sd=10)])"
    assert repr(D.ZeroInflated(D.Poisson(X), P)) == "ZeroInflated(Poisson(rate=x), p=p)"
