"""The evidence against quadrature, and its stated error against its spread."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

import ssmppl as ssm
from ssmppl.datasets import ice_varves, load
from ssmppl.inference.chains.bridge import bridge, importance
from tests.models import standard as models
from tests.statistics.checks import LEVEL, seed_of

ERRORS = 4.0  # standard errors that an estimate may lie off


def ar_chains(rng, rho, chains, draws):
    """Markov chains with standard normal marginals and correlation rho."""
    x = np.empty((chains, draws))
    x[:, 0] = rng.standard_normal(chains)
    for t in range(1, draws):
        x[:, t] = rho * x[:, t - 1] + np.sqrt(1 - rho**2) * rng.standard_normal(chains)
    return x


@pytest.mark.parametrize("rho", [0.0, 0.8])
def test_the_error_of_a_bridge_is_its_spread(rho):
    """p~ = exp(3) N(0, 1) against a shifted t: z scores of 300 estimates have variance 1."""
    rng = np.random.default_rng(seed_of("bridge", rho))
    law = stats.t(5, loc=0.5, scale=1.3)

    def log_ratio(x):
        return 3.0 + stats.norm.logpdf(x) - law.logpdf(x)

    scores = []
    for _ in range(300):
        own = log_ratio(ar_chains(rng, rho, 4, 250))
        found = bridge(own, log_ratio(law.rvs(1000, random_state=rng)))
        scores.append((found.log_constant - 3.0) / found.standard_error)
    scores = np.array(scores)
    assert abs(scores.mean()) < ERRORS / np.sqrt(300)
    low, high = stats.chi2.ppf([LEVEL / 2, 1 - LEVEL / 2], 299) / 299
    assert low < scores.var(ddof=1) < high


def test_importance_sampling_is_unbiased():
    rng = np.random.default_rng(seed_of("importance"))
    law = stats.t(5, scale=1.3)
    x = law.rvs((2000, 50), random_state=rng)
    ratio = stats.norm.logpdf(x) - law.logpdf(x)
    found = np.exp([importance(row).log_constant for row in ratio])
    assert abs(found.mean() - 1.0) < ERRORS * found.std() / np.sqrt(len(found))


@pytest.mark.parametrize(("series", "c"), [("main_text", 0.5), ("appendix", 1.0)])
def test_linear_gaussian_evidence(exact_values, series, c):
    exact = exact_values[f"lgss_{series}"]["log_evidence"]
    found = ssm.evidence(
        models.lgss, {"y": load(f"lgss_{series}")["y"]}, fixed={"c": c}, draws=500, warmup=300,
        chains=2,
        seed=seed_of("evidence", series), progress=False,
    )  # fmt: skip
    assert abs(found.log_evidence - exact) < ERRORS * found.standard_error
    assert found.standard_error < 0.03
    check = found.report["importance_sampling"] - exact
    assert abs(check) < ERRORS * found.report["importance_sampling_standard_error"]


def test_few_particles_leave_it_consistent(exact_values):
    """The extended target: an estimate with sd(log Z) near 1 bridges to the exact value too."""
    exact = exact_values["lgss_main_text"]["log_evidence"]
    found = ssm.evidence(
        models.lgss, {"y": load("lgss_main_text")["y"]},
        ssm.PMMH(particles=100, proposal="bootstrap"), fixed={"c": 0.5},
        draws=1500, warmup=500, chains=2, seed=seed_of("evidence", "few"), progress=False,
    )  # fmt: skip
    assert abs(found.log_evidence - exact) < ERRORS * found.standard_error
    assert found.standard_error < 0.15


@pytest.mark.slow
def test_varves_evidence(exact_values):
    exact = exact_values["ice_varves"]["log_evidence"]
    found = ssm.evidence(
        models.varves, {"y": ice_varves()}, draws=600, warmup=400,
        seed=seed_of("evidence", "varves"), progress=False,
    )  # fmt: skip
    print(found, found.report)
    assert abs(found.log_evidence - exact) < ERRORS * found.standard_error
    assert found.standard_error < 0.1


def test_without_parameters_it_is_the_likelihood(exact_values):
    data = {"y": load("lgss_main_text")["y"]}
    found = ssm.evidence(models.lgss, data, fixed={"theta": 1.0, "c": 0.5})
    exact = exact_values["lgss_main_text"]["log_likelihood"]["1.0"]
    assert found.log_evidence == pytest.approx(exact, abs=1e-9)
    assert found.standard_error == 0.0
    estimated = ssm.evidence(
        models.lgss, data, ssm.PMMH(particles=300, proposal="bootstrap"),
        fixed={"theta": 1.0, "c": 0.5}, seed=seed_of("evidence", "fixed"),
    )  # fmt: skip
    assert abs(estimated.log_evidence - exact) < ERRORS * estimated.standard_error


def test_models_are_compared_by_it():
    one = ssm.Evidence(-10.0, 0.3)
    other = ssm.Evidence(-12.0, 0.4)
    assert one.bayes_factor(other) == (2.0, pytest.approx(0.5))


def test_an_improper_prior_is_refused():
    model = ssm.Model("flat")

    @model.prior
    def prior():
        return {"a": ssm.Flat()}

    @model.initial
    def initial():
        return {"x": ssm.Normal(0, sd=1)}

    @model.transition
    def transition(x, a):
        return {"x": ssm.Normal(a * x, sd=1)}

    @model.observation
    def observation(x):
        return {"y": ssm.Normal(x, sd=1)}

    with pytest.raises(ssm.ArgumentError, match=r"(?s)prior of 'a' is Flat.*improper.*fixed="):
        ssm.evidence(model, {"y": [0.1, 0.2]})


def test_a_method_without_likelihoods_is_refused():
    with pytest.raises(ssm.ArgumentError, match="no estimates of the likelihood"):
        ssm.evidence(models.lgss, {"y": [0.1]}, ssm.PGAS())
    with pytest.raises(ssm.ArgumentError, match=r"correlation=0\.99"):
        ssm.evidence(models.lgss, {"y": [0.1]}, ssm.PMMH(correlation=0.99))


def test_chains_that_do_not_move_have_no_evidence():
    """A law without width was fitted to them, and log p(y) was off by hundreds."""
    model = ssm.Model("stuck")
    model.prior(lambda: {"a": ssm.Normal(0, sd=1)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(np.tanh(x), sd=1)})
    model.observation(lambda x, a: {"y": ssm.Normal(x + a, sd=0.1)})
    y = np.random.default_rng(1).normal(size=100)
    method = ssm.PMMH(particles=3, proposal="bootstrap")
    with pytest.raises(ssm.SamplingError, match="1 differ, in 1 free parameter"):
        ssm.evidence(model, {"y": y}, method, draws=20, warmup=5, chains=1, seed=1)


def test_too_few_draws_for_a_law():
    """Ten draws of four numbers gave an evidence that was off by 45, with an error of 0.2."""
    data = {"y": load("lgss_main_text")["y"]}
    for draws, chains, least in ((19, 1, 20), (9, 2, 10)):
        with pytest.raises(
            ssm.ArgumentError, match="too few to fit a distribution of 1 number"
        ) as found:
            ssm.evidence(models.lgss, data, fixed={"c": 0.5}, draws=draws, chains=chains)
        assert f"at least {least} draws" in found.value.fix
