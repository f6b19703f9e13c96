"""Names that do not exist: what is written for them; asking whether they do still works."""

import re

import numpy as np
import pytest
import scipy.stats as st

import ssmppl as ssm
from ssmppl.expressions.evaluate import evaluate
from ssmppl.language.model.name_hints import HINTS, name_hint

NAMES = {
    "Weibul": "write ssm.Weibull",
    "Gauss": "write ssm.Normal(mean, sd=)",
    "MultivariateNormal": "write ssm.MvNormal(mean, covariance=)",
    "multi_normal": "write ssm.MvNormal(mean, covariance=)",
    "GammaPoisson": "write ssm.NegativeBinomial(mean, dispersion=)",
    "Multinomail": "write ssm.Multinomial",
    "reulermultinom": "write ssm.EulerMultinomial(n, rates, dt)",
    "loglikelihood": "write ssm.log_likelihood",
    "Normla": "write ssm.Normal",
    "Poison": "write ssm.Poisson",
    "smaple": "write ssm.sample",
    "NegativeBionmial": "write ssm.NegativeBinomial",
    "SkewStudentT": "write a distribution of your own, by @ssm.distribution",
    "PowerLaw": "write ssm.Pareto(shape, scale=)",
    "factor": "write ssm.Potential(log_density)",
    "LKJCholeskyCov": "write ssm.LKJ(dim, eta), a correlation matrix R",
    "lkj_corr": "write ssm.LKJ(dim, eta)",
    "lkj": "write ssm.LKJ",
    "MultivariateStudentT": "write ssm.MvStudentT(df, loc, scale=)",
    "positive_ordered": "write ssm.Ordered(law)",
    "Tobit": "write ssm.Censored(dist, lower=, upper=)",
    "Simplex": "write ssm.Dirichlet(concentration)",
    "prior": 'write model = ssm.Model("name"), and then @model.prior',
    "transition": 'write model = ssm.Model("name"), and then @model.transition',
}


@pytest.mark.parametrize("name", NAMES)
def test_a_name_that_is_not_there(name):
    assert not hasattr(ssm, name)
    with pytest.raises(AttributeError) as caught:
        getattr(ssm, name)
    assert f"module 'ssmppl' has no attribute {name!r}" in str(caught.value)
    assert NAMES[name] in str(caught.value)


@pytest.mark.parametrize("name", ["save", "Bilinear", "predictive", "Tweedie", "x"])
def test_another_word_is_no_misspelling(name):
    """`save` was answered by PSAEM, and `Pareto` by predict."""
    with pytest.raises(AttributeError, match=rf"no attribute '{name}'$"):
        getattr(ssm, name)


def test_nothing_near_is_left_out():
    with pytest.raises(AttributeError, match=r"no attribute 'qqqq'$"):
        ssm.qqqq  # noqa: B018
    assert name_hint("qqqq", ssm.__all__) == ""


def test_in_a_model_the_line_and_the_law():
    model = ssm.Model("misspelled")
    model.initial(lambda: {"x": ssm.Gauss(0, sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(x, sd=1)})
    with pytest.raises(ssm.ModelError) as caught:
        ssm.explain(model)
    text = str(caught.value)
    assert "asks for ssm.Gauss, which does not exist" in text
    assert "Fix: write ssm.Normal(mean, sd=); the distributions are: " in text
    assert "test_name_hints.py" in text


def test_what_is_written_exists():
    assert not {k for k in HINTS if k in {n.lower() for n in ssm.__all__}}
    for text in HINTS.values():
        names = re.findall(r"ssm\.(\w+)", text)
        assert names, text
        assert set(names) <= set(ssm.__all__), text


def test_what_acts_by_a_function_has_the_distribution_that_was_asked_for():
    x = np.array([1.3, 2.0, 7.5])
    tail = [float(evaluate(ssm.Exponential(rate=1).survival(np.exp(-(v - 1.0) / 0.7)))) for v in x]
    np.testing.assert_allclose(tail, st.gumbel_r(1.0, 0.7).cdf(x))


def test_a_multinomial_of_binomials_and_its_overdispersed_kin():
    """The masses that the hint composes sum to those of SciPy's laws."""
    counts, p, a = np.array([2.0, 3.0, 1.0]), np.array([0.5, 0.2, 0.3]), np.array([1.0, 2.0, 0.5])
    left = [counts[k:].sum() for k in range(3)]
    by_parts = sum(
        float(evaluate(ssm.Binomial(left[k], p[k] / p[k:].sum()).log_density(counts[k])))
        for k in range(2)
    )
    assert by_parts == pytest.approx(st.multinomial(6, p).logpmf(counts))
    by_parts = sum(
        float(evaluate(ssm.BetaBinomial(left[k], a[k], a[k + 1 :].sum()).log_density(counts[k])))
        for k in range(2)
    )
    assert by_parts == pytest.approx(st.dirichlet_multinomial(a, 6).logpmf(counts.astype(int)))
