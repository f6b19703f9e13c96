"""Posteriors by PGAS and PMMH against quadrature, in Monte Carlo standard errors.

The exact values stand in tests/reference. The long runs meet all of: within 4 standard errors,
these below 5% of the posterior standard deviation, R-hat below 1.01. The short ones check the same
agreement, with the standard errors that they have.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import scipy.stats as st
from numpy.polynomial import Chebyshev

import ssmppl as ssm
from ssmppl.datasets import ice_varves, lgss_appendix, lgss_main_text
from tests.models import standard as models

from .checks import (
    assert_within,
    deviations,
    influence_of_correlation,
    mcse_mean,
    seed_of,
    some,
)
from .exact import DenseGaussian, GridPosterior


def draw(label, model, data, method, draws, warmup=500, **options):
    """Four chains, their summary printed; returns (posterior, summary)."""
    idata = ssm.sample(
        model, data, method, draws=draws, warmup=warmup, states=False, progress=False,
        seed=seed_of(label), **options,
    )  # fmt: skip
    summary = ssm.summary(idata)
    print(f"{label}, {idata['posterior'].attrs['seconds']:.1f} s\n{summary.to_string()}")
    return idata["posterior"], summary


def assert_long_enough(summary):
    """What makes agreement worth something: small errors, and chains that agree."""
    assert (summary["mcse_mean"] < 0.05 * summary["sd"]).all(), summary.to_string()
    assert (summary["r_hat"] < 1.01).all(), summary.to_string()


def varve_deviations(posterior, exact) -> dict[str, float]:
    out = {}
    for name in ("phi", "tau"):
        mean, sd = exact["posterior_mean"][name], exact["posterior_sd"][name]
        found = deviations(posterior[name].values, mean=mean, sd=sd)
        out |= {f"{what} of {name}": v for what, v in found.items()}
    phi, tau = posterior["phi"].values, posterior["tau"].values
    r = np.corrcoef(phi.ravel(), tau.ravel())[0, 1]
    error = mcse_mean(influence_of_correlation(phi, tau))
    return out | {"correlation": (r - exact["posterior_correlation"]) / error}


VARVE_RUNS = [
    pytest.param("PGAS", ssm.PGAS(), 2_000, 200, False, id="PGAS"),
    pytest.param("PMMH", ssm.PMMH(particles=800, proposal="bootstrap"), 1_200, 500, False,
                 id="PMMH", marks=pytest.mark.slow),
    pytest.param("PGAS interweaved", ssm.PGAS(interweave="auto"), 5_000, 500, True,
                 id="PGAS-interweaved", marks=[pytest.mark.slow, pytest.mark.exhaustive]),
    pytest.param("PGAS", ssm.PGAS(), 20_000, 500, True, id="PGAS-long",
                 marks=[pytest.mark.slow, pytest.mark.exhaustive]),
    pytest.param("PGAS without tau", ssm.PGAS(particles=20, eliminate=("tau",)), 10_000, 500, False,
                 id="PGAS-eliminated", marks=[pytest.mark.slow, pytest.mark.exhaustive]),
    pytest.param("PMMH", ssm.PMMH(), 10_000, 1_000, True, id="PMMH-long",
                 marks=[pytest.mark.slow, pytest.mark.exhaustive]),
]  # fmt: skip


@pytest.mark.parametrize(("name", "method", "draws", "warmup", "long"), VARVE_RUNS)
def test_varves(exact_values, name, method, draws, warmup, long):
    label = f"varves {name} {draws}"
    posterior, summary = draw(label, models.varves, {"y": ice_varves()}, method, draws, warmup)
    if long:
        assert_long_enough(summary)
    assert_within(varve_deviations(posterior, exact_values["ice_varves"]))


LGSS = {"main text": (lgss_main_text, 0.5), "appendix": (lgss_appendix, 1.0)}
LGSS_METHODS = [
    ssm.Gibbs(),
    ssm.MetropolisHastings(),
    *(ssm.PGAS(particles=n, proposal=p) for p in ("bootstrap", "auxiliary") for n in (2, 5, 20)),
    ssm.PMMH(),
    ssm.PMMH(particles=500, proposal="bootstrap"),
]
STEERED = [ssm.PGAS(particles=5, proposal="twisted"), ssm.PMMH(particles=20, proposal="twisted")]


@cache
def lgss_quantiles(series):
    """The posterior's quantiles, mean and sd, by quadrature in log theta.

    The reference has quantiles too, but at the points of a grid, 0.1% too low: more than the Monte
    Carlo error of the long runs.
    """
    load, c = LGSS[series]
    y = load()

    def likelihood(z):
        return [DenseGaussian(y, **models.lgss_matrices(v, c)).log_likelihood for v in np.exp(z)]

    fine = np.linspace(-3, 2.5, 100_001)
    log_p = 0.01 * (fine - np.exp(fine))
    log_p += Chebyshev.interpolate(likelihood, 80, domain=[-3, 2.5])(fine)
    p = np.exp(log_p - log_p.max())
    p /= p.sum()
    theta, below = np.exp(fine), np.cumsum(p) - 0.5 * p
    mean = p @ theta
    levels = (0.05, 0.25, 0.5, 0.75, 0.95)
    quantiles = {v: float(np.exp(np.interp(v, below, fine))) for v in levels}
    return quantiles, mean, np.sqrt(p @ (theta - mean) ** 2)


@pytest.mark.slow
@pytest.mark.parametrize("series", LGSS)
def test_quadrature_against_reference(exact_values, series):
    exact = exact_values[f"lgss_{series.replace(' ', '_')}"]
    quantiles, mean, sd = lgss_quantiles(series)
    assert mean == pytest.approx(exact["posterior_mean"], abs=1e-8)
    assert sd == pytest.approx(exact["posterior_sd"], abs=1e-8)
    for level, value in exact["posterior_quantiles"].items():
        assert quantiles[float(level)] == pytest.approx(value, rel=2e-3)


@pytest.mark.parametrize("draws", [2_000, pytest.param(25_000, marks=pytest.mark.exhaustive)])
@pytest.mark.parametrize(
    "method", [*some(LGSS_METHODS, 1), *some(STEERED, 0, pytest.mark.exhaustive)], ids=str
)
@pytest.mark.parametrize("series", some(LGSS, 1))
def test_lgss(exact_values, series, method, draws):
    """theta with its vague Gamma prior; c is known. Mean, sd and the quantiles' levels."""
    load, c = LGSS[series]
    exact = exact_values[f"lgss_{series.replace(' ', '_')}"]
    posterior, summary = draw(
        f"lgss {series} {method} {draws}", models.lgss, {"y": load()}, method, draws,
        fixed={"c": c},
    )  # fmt: skip
    if draws > 10_000:
        assert_long_enough(summary)
    quantiles, _, _ = lgss_quantiles(series)
    theta = posterior["theta"].values
    assert_within(deviations(theta, exact["posterior_mean"], exact["posterior_sd"], quantiles))


# --- several experiments -------------------------------------------------------------------------


@cache
def experiments():
    """Three series of one system, of different lengths, one with gaps."""
    out = []
    for i, steps in enumerate((30, 12, 45)):
        d = ssm.simulate(
            models.lgss, {"theta": 2.0, "c": 1.0}, steps=steps, seed=seed_of("experiments", i)
        )
        y = d["y"].values[0].copy()
        if i == 1:
            y[[0, 5, 6]] = np.nan
        out.append({"y": y})
    return out


def joint_log_likelihood(theta, c):
    matrices = models.lgss_matrices(theta, c)
    return sum(DenseGaussian(e["y"], **matrices).log_likelihood for e in experiments())


def test_likelihood_of_several_experiments_is_their_product():
    parameters = {"theta": 1.3, "c": 1.0}
    exact = joint_log_likelihood(**parameters)
    kalman = ssm.log_likelihood(models.lgss, experiments(), parameters, proposal="kalman")
    assert kalman[0] == pytest.approx(exact, abs=1e-8)
    log_z = ssm.log_likelihood(
        models.lgss, experiments(), parameters, particles=300, repeats=500,
        proposal="auxiliary", seed=seed_of("several experiments"),
    )  # fmt: skip
    ratio = np.exp(log_z - exact)
    assert abs(ratio.mean() - 1) <= 4 * ratio.std(ddof=1) / np.sqrt(len(ratio))


@pytest.mark.parametrize(
    "method",
    some([ssm.PGAS(particles=10), ssm.PMMH(particles=50, proposal="guided"), ssm.Gibbs()], 1),
    ids=str,
)
def test_posterior_of_several_experiments(method):
    def log_density(log_theta):  # Gamma(0.01, rate 0.01), on the scale of log theta
        theta = np.exp(log_theta)
        return 0.01 * log_theta - 0.01 * theta + joint_log_likelihood(theta, 1.0)

    exact = GridPosterior(log_density, -1.5, 3.0)
    posterior, _ = draw(
        f"experiments {method}", models.lgss, experiments(), method, 4000, fixed={"c": 1.0}
    )
    assert_within(deviations(np.log(posterior["theta"].values), exact.mean, exact.sd))


# --- parameters whose prior reaches where a law has no density ------------------------------------


def of_an_argument(law):
    """a, Normal a priori, is the argument of the law of y and has to be positive."""
    model = ssm.Model("argument")
    model.prior(lambda: {"a": ssm.Normal(0.3, sd=1)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(0.5 * x, sd=1)})
    model.observation(lambda x, a: {"y": law(a), "z": ssm.Normal(x, sd=1)})
    return model


ARGUMENTS = {  # law of y, SciPy's of the same, y: at these a negative a had a finite density
    "Poisson": (lambda a: ssm.Poisson(a), st.poisson.logpmf, [0.0, 0.0]),
    "Gamma": (lambda a: ssm.Gamma(a, rate=1), st.gamma.logpdf, [0.05, 0.3]),
}


@pytest.mark.parametrize("method", [ssm.PGAS(10), ssm.PMMH(50)], ids=["PGAS", "PMMH"])
@pytest.mark.parametrize("name", some(ARGUMENTS, 1))
def test_a_prior_beyond_the_range_of_an_argument(name, method):
    law, log_density, y = ARGUMENTS[name]
    a = np.linspace(0, 8, 400_001)[1:]
    p = st.norm.logpdf(a, 0.3, 1) + sum(log_density(v, a) for v in y)
    p = np.exp(p - p.max()) / np.exp(p - p.max()).sum()
    mean = p @ a
    data = {"y": np.array(y), "z": np.array([0.1, -0.2])}
    label = f"argument of {name} {type(method).__name__}"
    posterior, _ = draw(label, of_an_argument(law), data, method, 2000)
    assert posterior["a"].values.min() > 0
    assert_within(deviations(posterior["a"].values, mean, np.sqrt(p @ (a - mean) ** 2)))
