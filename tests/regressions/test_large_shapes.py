"""Laws whose parameters are so large that they are close to a limit: no cancellation there."""

import math

import numpy as np
import pytest
import scipy.stats as st

import ssmppl.language.distributions as D
from ssmppl.expressions.arrays import array
from ssmppl.expressions.calculus import differentiate
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import symbol

R = symbol("parameter", "r")
X = symbol("state", "x")
LARGE = [1e6, 1e10, 1e14, 1e15, 1e16, 1e18]


def number(expression, **values) -> np.ndarray:
    named = {"r": R, "x": X}
    return evaluate(array(expression)[()], {named[k]: v for k, v in values.items()})


@pytest.mark.parametrize("r", LARGE)
def test_densities_are_those_of_the_limits(r):
    counts, z = np.arange(30.0), np.linspace(-6, 6, 25)
    near = 30.0 / r  # of what r leaves of the difference from the limit
    law, limit = D.NegativeBinomial(5.0, dispersion=R), st.poisson(5)
    found = number(law.log_density(X), r=r, x=counts)
    np.testing.assert_allclose(found, limit.logpmf(counts), rtol=1e-12, atol=1e-12 + 30 * near)
    found = number(D.StudentT(R, 0.0, scale=1.0).log_density(X), r=r, x=z)
    np.testing.assert_allclose(found, st.norm.logpdf(z), rtol=1e-13, atol=1e-14 + 30 * near)
    law, limit = D.BetaBinomial(10.0, R, 3.0 * R), st.binom(10, 0.25)
    found = number(law.log_density(X), r=r, x=counts[:11])
    np.testing.assert_allclose(found, limit.logpmf(counts[:11]), atol=3e-13 + 3 * near)
    found = number(law.cdf(counts[:11])[4], r=r)
    assert found == pytest.approx(limit.cdf(4), rel=3e-13 + 3 * near)


@pytest.mark.parametrize("r", LARGE[:4])
def test_a_beta_law_with_one_large_shape_is_a_gamma_law(r):
    u = np.array([0.1, 1.0, 5.0])
    expected = st.gamma(2.5).logpdf(u) + math.log(r)
    beta = number(D.Beta(2.5, R).log_density(X), r=r, x=u / r)
    np.testing.assert_allclose(beta, expected, atol=1e-13 + 30 / r)
    (other,) = (
        number(law.log_density(array([one, 1.0 - one])), r=r)
        for law, one in [(D.Dirichlet([2.5, R]), float(u[1] / r))]
    )
    assert other == pytest.approx(expected[1], abs=30 / r + 2e-16 * r)  # 1 - x is rounded


@pytest.mark.parametrize("r", [1e3, *LARGE])
@pytest.mark.parametrize(
    ("law", "value"),
    [
        (D.NegativeBinomial(5.0, dispersion=R), 9.0),
        (D.StudentT(R, 0.0, scale=1.0), 1.5),
        (D.BetaBinomial(10.0, R, 3.0 * R), 4.0),
    ],
    ids=["NegativeBinomial", "StudentT", "BetaBinomial"],
)
def test_slopes_die_out(law, value, r):
    """In log r, as they are climbed: below 100 / r and rounding."""
    (slope,) = differentiate([law.log_density(value)], R)
    assert abs(r * number(slope, r=r)) < 100.0 / r + 1e-14


@pytest.mark.parametrize("r", LARGE)
def test_distribution_functions_are_those_of_the_limits(r):
    law, limit, near = D.NegativeBinomial(5.0, dispersion=R), st.poisson(5), 3e-12 + 100 / r
    for k in (0.0, 3.0, 9.0, 30.0):
        assert number(law.cdf(k), r=r) == pytest.approx(limit.cdf(k), rel=near)
        assert number(law.survival(k), r=r) == pytest.approx(limit.sf(k), rel=1e3 * near, abs=0)
    law = D.StudentT(R, 0.0, scale=1.0)
    for z in (-5.0, -1.0, -0.01):
        assert number(law.cdf(z), r=r) == pytest.approx(st.norm.cdf(z), rel=near + 1e3 / r)
    for p in (1e-6, 0.1, 0.49, 0.9):
        expected = st.norm.ppf(p)
        assert number(law.quantile(p), r=r) == pytest.approx(expected, rel=near + 1e3 / r)


@pytest.mark.parametrize("df", [3.0, 100.0, 1e3, 1e4])
def test_tails_of_students_t_are_scipys(df):
    z, law = np.array([-35.0, -12.0, -9.0, -8.2, -3.0, -1e-9]), D.StudentT(R, 0.0, scale=1.0)
    expected = st.t(df).cdf(z)
    np.testing.assert_allclose(number(law.cdf(X), r=df, x=z), expected, rtol=1e-11)
    np.testing.assert_allclose(number(law.survival(X), r=df, x=-z), expected, rtol=1e-11)
    np.testing.assert_allclose(number(law.quantile(X), r=df, x=expected)[:-1], z[:-1], rtol=1e-11)


def test_a_law_cut_off_in_the_tail_of_students_t():
    cut = D.Truncated(D.StudentT(1e3, 0.0, scale=1.0), lower=9.0)
    expected = st.t(1e3).logpdf(9.1) - st.t(1e3).logsf(9)
    assert number(cut.log_density(9.1)) == pytest.approx(expected, rel=1e-11)


@pytest.mark.parametrize(("a", "b"), [(2.0, 100.0), (1.0, 1000.0), (0.3, 0.2), (50.0, 2.0)])
def test_the_upper_tail_of_a_beta_law_keeps_its_digits(a, b):
    x, law = np.array([1e-9, 0.1, 0.3, 0.45, 0.6]), st.beta(a, b)
    np.testing.assert_allclose(number(D.Beta(a, b).survival(X), x=x), law.sf(x), rtol=1e-11)
    back = number(D.Beta(a, b).survival_quantile(X), x=law.sf(x))
    np.testing.assert_allclose(law.sf(back), law.sf(x), rtol=1e-10)
