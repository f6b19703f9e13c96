"""Every distribution against SciPy: density, tails, quantiles, moments, support, sampler."""

import math

import numpy as np
import pytest
import scipy.stats as st

import ssmppl as ssm
import ssmppl.language.distributions as D
from ssmppl.errors import ModelError
from ssmppl.expressions.arrays import array
from ssmppl.expressions.evaluate import evaluate, numpy_draws
from ssmppl.expressions.expr import symbol
from ssmppl.language.distributions.draws import Draws
from tests.language.distributions.distribution_table import CASES, JOINT_CASES, NOT_IN_SCIPY, Case

X = symbol("state", "x")
scalar = pytest.mark.parametrize("case", CASES, ids=lambda c: c.id)
joint = pytest.mark.parametrize("case", JOINT_CASES, ids=lambda c: c.id)
LEVEL = 1e-6 / (len(CASES) + len(JOINT_CASES))  # Bonferroni: one false alarm in a million runs


def at(expression, points):
    """Values of a scalar expression (or 0-dimensional array of one) in X at each point."""
    value = evaluate(array(expression)[()], {X: np.asarray(points, dtype=float)})
    return np.broadcast_to(value, np.shape(points))


def number(expression) -> np.ndarray:
    return evaluate(array(expression))


def test_the_table_is_complete():
    covered = {c.cls.__name__ for c in [*CASES, *JOINT_CASES]} | NOT_IN_SCIPY
    assert covered == set(D.DISTRIBUTIONS)


@scalar
def test_log_density_is_scipys(case):
    x, law = case.points(), case.reference
    expected = (law.logpmf if case.cls.discrete else law.logpdf)(x)
    density = case.build().log_density(X)
    np.testing.assert_allclose(at(density, x), expected, rtol=1e-10, atol=1e-10)
    # with symbols for the parameters too
    distribution, values = case.with_symbols()
    found = evaluate(distribution.log_density(X), {**values, X: x})
    np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-10)


@scalar
def test_log_density_of_an_array_is_the_sum(case):
    if case.cls is D.Categorical:
        pytest.skip("Categorical has a vector of probabilities and a scalar value")
    x = case.points()[:4]
    wide = {k: np.full(len(x), v) for k, v in case.parameters.items()}
    distribution = case.cls(**wide)
    each = at(case.build().log_density(X), x)
    np.testing.assert_allclose(number(distribution.guarded_log_densities(x)), each, rtol=1e-10)
    total = evaluate(distribution.log_density(x))
    np.testing.assert_allclose(total, each.sum(), rtol=1e-12)


@scalar
def test_support_is_scipys_and_the_density_vanishes_outside(case):
    distribution, (low, high) = case.build(), case.reference.support()
    support = distribution.support()
    assert float(number(support.lower)) == low
    assert float(number(support.upper)) == pytest.approx(high, rel=1e-15)
    outside = [v for v in (low - 1.0, low - 1e6, high + 1.0, high + 1e6) if np.isfinite(v)]
    outside += [0.5, 1.0 + 1e-9] if distribution.discrete else []
    for guarded in (distribution, case.with_symbols()[0]):
        values = case.with_symbols()[1]
        for v in outside:
            assert evaluate(guarded.log_density(X), {**values, X: v}) == -math.inf


@scalar
def test_cdf_and_survival_keep_both_tails(case):
    x, d, law = case.points(), case.build(), case.reference
    if d.discrete:
        x = np.unique(np.concatenate([x, x + 0.5, [-1.0]]))
    if case.cls is D.VonMises:  # a circle has no tails where it is cut
        np.testing.assert_allclose(at(d.cdf(array(X)), x), law.cdf(x), rtol=0, atol=2e-15)
        np.testing.assert_allclose(at(d.survival(array(X)), x), law.sf(x), rtol=0, atol=2e-15)
        return
    np.testing.assert_allclose(at(d.cdf(array(X)), x), law.cdf(x), rtol=1e-9, atol=1e-290)
    if case.cls is D.Categorical:
        np.testing.assert_allclose(at(d.survival(array(X)), x), law.sf(x), atol=1e-15)
        return
    np.testing.assert_allclose(at(d.survival(array(X)), x), law.sf(x), rtol=1e-9, atol=1e-290)
    np.testing.assert_allclose(
        np.exp(at(d.log_survival(array(X)), x)), law.sf(x), rtol=1e-9, atol=1e-290
    )
    np.testing.assert_allclose(
        np.exp(at(d.log_cdf(array(X)), x)), law.cdf(x), rtol=1e-9, atol=1e-290
    )


@scalar
def test_quantiles_keep_both_tails(case):
    d, law = case.build(), case.reference
    p = np.array([1e-30, 1e-12, 1e-6, 0.01, 0.2, 0.4999999, 0.5000001, 0.7, 0.99, 1 - 1e-6])
    found, expected = at(d.quantile(array(X)), p), law.ppf(p)
    if d.discrete:  # the smallest k with cdf(k) >= p
        assert np.all(law.cdf(found) >= p)
        assert np.all((found == 0) | (law.cdf(found - 1) < p))
        return
    scale = np.abs(law.ppf(0.75) - law.ppf(0.25))
    kept = expected > 1e-290 if law.support()[0] == 0 else np.full(len(p), True)
    np.testing.assert_allclose(found[kept], expected[kept], rtol=1e-9, atol=1e-9 * scale *
                               (law.support()[0] != 0))  # fmt: skip
    found, expected = at(d.survival_quantile(array(X)), p), law.isf(p)
    kept = expected > 1e-290 if law.support()[0] == 0 else np.full(len(p), True)
    np.testing.assert_allclose(found[kept], expected[kept], rtol=1e-9, atol=1e-9 * scale *
                               (law.support()[0] != 0))  # fmt: skip


@scalar
def test_moments_are_scipys(case):
    d, law = case.build(), case.reference
    mean, variance = law.mean(), law.var()
    for found, expected in [(d.mean(), mean), (d.variance(), variance)]:
        found = float(number(found))
        if np.isfinite(expected):
            assert found == pytest.approx(float(expected), rel=1e-10)
        else:
            assert not np.isfinite(found)


@scalar
def test_the_density_normalises(case):
    d, law = case.build(), case.reference
    if d.discrete:
        x = np.arange(min(law.ppf(1e-14), 0.0), law.isf(1e-14) + 2)
        assert np.exp(at(d.log_density(X), x)).sum() == pytest.approx(1.0, abs=1e-9)
        return
    # Gauss-Legendre in y on pieces between quantiles; x = exp(y) if positive.
    p = np.concatenate([10.0 ** np.arange(-12, 0.0), np.linspace(0.15, 0.5, 8)])
    with np.errstate(all="ignore"):
        cuts = np.unique(np.concatenate([law.ppf(p), law.isf(p)]))
    cuts = cuts[np.isfinite(cuts) & (cuts < law.support()[1])]
    positive = law.support()[0] == 0
    cuts = np.unique(np.log(cuts[cuts > 0])) if positive else cuts
    nodes, weights = np.polynomial.legendre.leggauss(60)
    half = 0.5 * np.diff(cuts)[:, None]
    y = 0.5 * (cuts[1:] + cuts[:-1])[:, None] + half * nodes
    x = np.exp(y) if positive else y
    total = (half * weights * np.exp(at(d.log_density(X), x)) * (x if positive else 1.0)).sum()
    assert total == pytest.approx(1.0, abs=1e-7)  # Beta's last bit before 1


def draws_of(distribution, n, seed, values=None):
    sample = array(distribution.sample(Draws("x")))
    rng = np.random.default_rng(seed)
    return evaluate(sample, values or {}, numpy_draws(rng, (n,)))


@scalar
def test_the_sampler_follows_the_law(case):
    for k, (d, values) in enumerate([(case.build(), {}), case.with_symbols()]):
        x = draws_of(d, 20_000, 1 + k, values)
        assert x.shape == (20_000,)
        assert p_value(x, case.reference, d.discrete) > LEVEL


def p_value(x, law, discrete) -> float:
    """Kolmogorov-Smirnov, or chi-square over cells of expected count at least 10."""
    if not discrete:
        return st.kstest(x, law.cdf).pvalue
    assert np.all(x == np.floor(x))
    p = np.linspace(0, 1, 41)[1:-1]
    edges = np.unique(law.ppf(p))
    cdf = np.concatenate([[0.0], law.cdf(edges), [1.0]])
    observed = np.histogram(x, np.concatenate([[-np.inf], edges + 0.5, [np.inf]]))[0]
    expected = np.diff(cdf) * len(x)
    keep = expected >= 10
    if keep.sum() < 2:
        return st.binomtest(int(observed[0]), len(x), float(cdf[1])).pvalue
    rest = [observed[~keep].sum()], [expected[~keep].sum()]
    observed, expected = observed[keep], expected[keep]
    if rest[1][0] >= 5:
        observed, expected = np.append(observed, rest[0]), np.append(expected, rest[1])
    statistic = ((observed - expected) ** 2 / expected).sum()
    return st.chi2.sf(statistic, len(expected) - 1)


# -- vectors and matrices


def _for_scipy(case, x):
    return x.T if case.cls is D.Dirichlet else x


@joint
def test_joint_log_density_is_scipys(case):
    rng = np.random.default_rng(3)
    d = case.build()
    tolerance = 1e-10 if np.linalg.cond(_matrix(case)) < 1e4 else 1e-8
    for _ in range(5):
        x = case.reference.rvs(random_state=rng)
        x = np.reshape(x, d.shape)
        x = x / x.sum() if case.cls is D.Dirichlet else x
        if case.cls is D.Dirichlet and np.any(x < 1e-300):
            continue
        expected = case.reference.logpdf(x if x.shape != (1, 1) else x[0, 0])
        assert evaluate(d.log_density(x)) == pytest.approx(expected, rel=tolerance, abs=tolerance)
        symbolic, values = case.with_symbols()
        place = np.empty(d.shape, dtype=object)
        for i in np.ndindex(d.shape):
            place[i] = symbol("state", "x", tuple(sorted(i, reverse=True)))
            values[place[i]] = x[i]
        found = evaluate(symbolic.log_density(place), values)
        assert found == pytest.approx(expected, rel=tolerance, abs=tolerance)


def _matrix(case):
    return next((np.asarray(v) for v in case.parameters.values() if np.ndim(v) == 2), np.eye(1))


@joint
def test_joint_sampler_moments_and_support(case):
    d, n = case.build(), 40_000
    shape = d.shape
    x = draws_of(d, n, 11)
    assert x.shape == (*shape, n)
    assert np.all(np.isfinite(x))
    mean, variance = number(d.mean()), number(d.variance())
    assert mean.shape == variance.shape == shape
    if case.cls is D.MvNormal:
        root = np.linalg.cholesky(np.atleast_2d(case.reference.cov))
        z = np.linalg.solve(root, x - np.asarray(case.parameters["mean"])[:, None])
        for row in z:
            assert st.kstest(row, st.norm.cdf).pvalue > LEVEL
        np.testing.assert_allclose(np.cov(z), np.eye(len(z)), atol=6 * math.sqrt(2 / n))
        np.testing.assert_allclose(mean, case.parameters["mean"])
        cov = np.atleast_2d(case.reference.cov)
        np.testing.assert_allclose(variance, np.diagonal(cov), rtol=1e-9)
        np.testing.assert_allclose(number(d.covariance_matrix()), cov, rtol=1e-9)
        factor = number(d.factor())
        np.testing.assert_allclose(factor @ factor.T, cov, rtol=1e-9)
    elif case.cls is D.Dirichlet:
        a = np.asarray(case.parameters["concentration"])
        np.testing.assert_allclose(x.sum(0), 1.0, rtol=1e-12)
        for k in range(len(a)):
            law = st.beta(a[k], a.sum() - a[k])
            assert st.kstest(x[k], law.cdf).pvalue > LEVEL
            assert [mean[k], variance[k]] == pytest.approx([law.mean(), law.var()])
    elif case.cls is D.LogisticNormal:
        np.testing.assert_allclose(x.sum(0), 1.0, rtol=1e-12)
        own = case.reference.ratios
        away = np.log(x[:-1] / x[-1]) - np.reshape(own.mean, (-1, 1))
        z = np.linalg.solve(np.linalg.cholesky(np.atleast_2d(own.cov)), away)
        for row in z:
            assert st.kstest(row, st.norm.cdf).pvalue > LEVEL
        np.testing.assert_allclose(np.cov(z), np.eye(len(z)), atol=6 * math.sqrt(2 / n))
        assert np.all(np.isnan(mean))
    elif case.cls is D.MvStudentT:
        own, df = case.reference, case.parameters["df"]
        z = np.linalg.solve(np.linalg.cholesky(own.shape), x - own.loc[:, None])
        for row in z:
            assert st.kstest(row, st.t(df).cdf).pvalue > LEVEL
        assert st.kstest((z**2).mean(axis=0), st.f(len(z), df).cdf).pvalue > LEVEL
        np.testing.assert_allclose(mean, own.loc if df > 1 else np.nan)
        finite = np.diag(own.shape) * (df / (df - 2)) if df > 2 else np.nan
        np.testing.assert_allclose(variance, np.inf if 1 < df <= 2 else finite)
    else:
        wishart = case.cls is D.Wishart
        s, df, p = _matrix(case), case.parameters["df"], shape[0]
        np.testing.assert_allclose(x, np.swapaxes(x, 0, 1), rtol=1e-9, atol=1e-9)
        # a' X a / a' S a ~ chi-square(df); its inverse counterpart has df - p + 1
        rng = np.random.default_rng(5)
        for _ in range(3):
            a = rng.standard_normal(p)
            if wishart:
                q = np.einsum("i,ijn,j->n", a, x, a) / (a @ s @ a)
                law = st.chi2(df)
            else:
                q = (a @ s @ a) / np.einsum("i,ijn,j->n", a, x, a)
                law = st.chi2(df - p + 1)
            assert st.kstest(q, law.cdf).pvalue > LEVEL
        expected = df * s if wishart else (s / (df - p - 1) if df > p + 1 else math.nan * s)
        np.testing.assert_allclose(mean, expected, rtol=1e-10)
        known = wishart or df > p + 3
        if known:
            reference = np.atleast_2d(case.reference.var())
            np.testing.assert_allclose(variance, reference, rtol=1e-10)
        else:
            assert np.all(np.isnan(variance))


def test_determinant_of_the_wishart_sampler():
    # det X / det S ~ product of chi-squares with df, df - 1, ... (Bartlett), which the quadratic
    # forms above do not see
    case = next(c for c in JOINT_CASES if c.cls is D.Wishart)
    x = draws_of(case.build(), 20_000, 12)
    p, df = 3, case.parameters["df"]
    ratio = np.linalg.det(np.moveaxis(x, -1, 0)) / np.linalg.det(_matrix(case))
    rng = np.random.default_rng(8)
    expected = np.prod([st.chi2(df - k).rvs(20_000, random_state=rng) for k in range(p)], axis=0)
    assert st.ks_2samp(ratio, expected).pvalue > LEVEL


@pytest.mark.parametrize("shape", [1e-3, 0.02])
def test_tiny_shapes_give_no_nan(shape):
    x = draws_of(D.Beta(shape, shape), 20_000, 4)
    assert np.mean(x > 0.5) == pytest.approx(0.5, abs=0.03)
    z = draws_of(D.Dirichlet([shape, 2 * shape, shape]), 20_000, 5)
    assert np.all(np.isfinite(z))
    np.testing.assert_allclose(z.mean(1), [0.25, 0.5, 0.25], atol=0.02)


@pytest.mark.parametrize(
    "law",
    [
        D.Beta(0.1, 0.02),
        D.Beta(0.02, 0.001),
        D.Truncated(D.Beta(0.1, 0.1), lower=0.5),
        D.Truncated(D.Beta(0.001, 0.1), upper=0.5),
        D.Dirichlet([0.001, 0.1, 0.02]),
    ],
    ids=repr,
)
def test_what_is_drawn_has_a_density(law):
    """Shares are not rounded to 0 or 1, where it is infinite or there is none."""
    x = draws_of(law, 20_000, 7)
    symbols = array([symbol("state", "x", (i,)) for i in range(law.shape[0])]) if law.shape else X
    known = dict(zip(array(symbols).ravel(), np.atleast_2d(x), strict=True))
    density = evaluate(law.log_density(symbols), known)
    assert np.all(np.isfinite(density))


# -- what SciPy does not have


def test_dirac():
    d = D.Dirac(np.array([1.0, -2.0]))
    assert d.support().kind == "point"
    assert number(d.sample(Draws("x"))).tolist() == [1.0, -2.0]
    assert number(d.mean()).tolist() == [1.0, -2.0]
    assert number(d.variance()).tolist() == [0.0, 0.0]
    assert evaluate(d.log_density([1.0, -2.0])) == 0.0
    assert evaluate(d.log_density([1.0, -2.5])) == -math.inf
    assert number(d.cdf(array([1.0, -2.5]))).tolist() == [1.0, 0.0]


def test_flat_and_half_flat():
    assert not D.Flat().proper
    assert not D.HalfFlat().proper
    assert evaluate(D.Flat().log_density(X), {X: -1e9}) == 0.0
    assert evaluate(D.HalfFlat().log_density(X), {X: 2.0}) == 0.0
    assert evaluate(D.HalfFlat().log_density(X), {X: -2.0}) == -math.inf
    assert D.Flat((2, 3)).shape == (2, 3)
    for cls in (D.Flat, D.HalfFlat):
        with pytest.raises(ModelError, match=f"{cls.__name__}.. is improper and cannot be drawn"):
            cls().sample(Draws("x"))


def test_each_draw_is_its_own():
    a, b = D.Normal(0, sd=1), D.Normal(0, sd=1)
    first, second = a.sample(Draws("a")), b.sample(Draws("b"))
    assert first is not second
    x = draws_of(D.Normal(np.zeros(2), sd=1), 1000, 1)
    assert abs(np.corrcoef(x)[0, 1]) < 0.2


def test_the_text_of_a_distribution_has_the_users_names():
    assert repr(D.Normal(X, sd=2)) == "Normal(mean=x, sd=2)"
    assert repr(D.Gamma(2, rate=X)) == "Gamma(shape=2, rate=x)"
    assert repr(D.NegativeBinomial(X, dispersion=3)) == "NegativeBinomial(mean=x, dispersion=3)"
    assert repr(D.Truncated(D.Normal(0, sd=1), lower=0)) == (
        "Truncated(Normal(mean=0, sd=1), lower=0)"
    )


def test_cases_can_be_built_and_named():
    assert all(isinstance(c, Case) and c.id for c in CASES)


@pytest.mark.parametrize("spread", ["covariance", "precision"])
def test_no_density_where_a_matrix_is_not_positive_definite(spread):
    a = symbol("parameter", "a")
    law = D.MvNormal(np.zeros(2), **{spread: a * np.array([[1.0, 0.3], [0.3, 1.0]])})
    density = law.log_density(np.ones(2))
    found = evaluate(density, {a: np.array([2.0, -2.0])})  # -2: determinant positive all the same
    assert np.isfinite(found[0])
    assert found[1] == -np.inf


@pytest.mark.parametrize("name", ["Wishart", "InverseWishart"])
def test_no_density_of_a_matrix_whose_law_has_no_covariance_for_its_scale(name):
    law = getattr(D, name)(6, scale=np.array([[1.0, X], [X, 1.0]], dtype=object))
    value = np.array([[1.0, 0.2], [0.2, 1.0]])
    found = evaluate(law.log_density(value), {X: np.array([0.5, 0.99, -2.0, 1.5, 4.0])})
    reference = {"Wishart": st.wishart, "InverseWishart": st.invwishart}[name]
    expected = [reference(6, [[1.0, r], [r, 1.0]]).logpdf(value) for r in (0.5, 0.99)]
    assert found[:2] == pytest.approx(expected, rel=1e-10)
    assert np.all(found[2:] == -np.inf)


def test_no_labels_of_probabilities_that_do_not_sum_to_one():
    law = D.Categorical([X, X, 0.2])
    at = {X: np.array([0.4, 0.9, 0.1])}
    found = evaluate(law.log_density(1.0), at)
    assert found[0] == pytest.approx(math.log(0.4))
    assert np.all(np.isnan(found[1:]))
    assert evaluate(law.in_range()[()], at).tolist() == [1.0, 0.0, 0.0]


@pytest.mark.parametrize("spread", ["scale", "precision", "cholesky"])
def test_a_student_vector_with_holes_has_the_density_of_what_is_there(spread):
    """The margins of a multivariate Student distribution are such, of the same degrees of
    freedom."""
    c = np.array([[2.0, 0.3, -0.2], [0.3, 1.0, 0.4], [-0.2, 0.4, 0.7]])
    given = {"scale": c, "precision": np.linalg.inv(c), "cholesky": np.linalg.cholesky(c)}[spread]
    model = ssm.Model("holes")
    model.prior(lambda: {"m": ssm.Normal(0, sd=3), "df": ssm.Gamma(2, rate=0.1)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(0.5 * x, sd=1)})

    @model.observation
    def observation(m, df):
        return {"y": ssm.MvStudentT(df, m, **{spread: given})}

    nan = np.nan
    y = np.array([[1, 2, 3], [nan, 0.5, 4], [nan, nan, nan], [1, nan, -2], [nan, 9, nan]])
    expected = 0.0
    for row in y:
        there = np.flatnonzero(np.isfinite(row))
        if len(there):
            own = st.multivariate_t(np.full(len(there), 0.4), c[np.ix_(there, there)], df=3.5)
            expected += own.logpdf(row[there])
    found = ssm.log_likelihood(model, {"y": y}, {"m": 0.4, "df": 3.5}, particles=10, seed=1)
    assert found[0] == pytest.approx(expected, rel=1e-10)


def test_a_constant_beyond_the_support_has_no_density():
    for law, value in [
        (D.Uniform(0, 1), -1.0), (D.Beta(2, 2), -0.5), (D.Binomial(5, 0.5), 7.0),
        (D.Truncated(D.Normal(0, sd=1), lower=0, upper=2), -0.1),
    ]:  # fmt: skip
        assert float(evaluate(law.log_density(value))) == -np.inf
