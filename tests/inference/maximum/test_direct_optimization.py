"""Direct optimisation over the continuous particle filter, against the point-mass filter."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

import ssmppl as ssm
from ssmppl import datasets
from ssmppl.analysis.proposals.smooth import smooth_filter_applies
from ssmppl.inference.maximum.direct_optimization import SmoothLikelihood
from ssmppl.inference.particles.filtering import FilterSettings, log_likelihood_estimate
from ssmppl.inference.run.problem import pose
from ssmppl.inference.run.seeds import random_state
from ssmppl.language.tracing import trace
from tests.models import standard as models
from tests.statistics.checks import mean_one_p, seed_of
from tests.statistics.exact import varve_log_likelihood

ROWS = 150


@pytest.fixture(scope="module")
def problem():
    return pose(models.varves, {"y": datasets.ice_varves()[:ROWS]})


def test_the_likelihood_is_continuous_where_the_ordinary_one_jumps(problem):
    """Steps eight times smaller: changes eight times smaller, or about the same for jumps."""
    smooth = SmoothLikelihood(problem, 200, 1, np.random.SeedSequence(seed_of("continuous")))
    settings = FilterSettings(200, "bootstrap")
    seed = np.random.SeedSequence(seed_of("jumps"))

    def jumps(function, h):
        values = [function(np.array([0.9, 40.0 + h * k])) for k in range(60)]
        return np.max(np.abs(np.diff(values)))

    def plain(theta):
        return log_likelihood_estimate(problem, theta, settings, random_state(seed))

    ratio = jumps(lambda v: smooth.one(v, 0), 0.08) / jumps(lambda v: smooth.one(v, 0), 0.01)
    ordinary = jumps(plain, 0.08) / jumps(plain, 0.01)
    print(f"continuous {ratio:.1f}, ordinary {ordinary:.1f}")
    assert ratio > 4
    assert ordinary < 3


def test_its_likelihood_agrees_with_the_point_mass_filter(problem):
    theta = np.array([0.93, 30.0])
    smooth = SmoothLikelihood(problem, 1000, 100, np.random.SeedSequence(seed_of("smooth mean")))
    log_z = np.array([smooth.one(theta, k) for k in range(100)])
    exact = varve_log_likelihood(datasets.ice_varves()[:ROWS], *theta)
    assert log_z.std() < 1.0, "too noisy to tell"
    assert mean_one_p(log_z - exact) > 0.001


def exact_top(y):
    """(top, information) in (phi, tau) by the point-mass filter."""

    def value(v):
        return varve_log_likelihood(y, np.tanh(v[0]), np.exp(v[1]), points=300)

    found = minimize(lambda v: -value(v), [1.5, 3.5], method="Nelder-Mead",
                     options={"xatol": 1e-5, "fatol": 1e-7})  # fmt: skip
    top = np.array([np.tanh(found.x[0]), np.exp(found.x[1])])
    step = np.array([2e-3, 0.02 * top[1]])

    def at(i, j):
        return varve_log_likelihood(y, *(top + step * [i, j]), points=300)

    curve = np.empty((2, 2))
    curve[0, 0] = at(1, 0) - 2 * at(0, 0) + at(-1, 0)
    curve[1, 1] = at(0, 1) - 2 * at(0, 0) + at(0, -1)
    curve[0, 1] = curve[1, 0] = (at(1, 1) - at(1, -1) - at(-1, 1) + at(-1, -1)) / 4
    return top, -curve / np.outer(step, step)


@pytest.mark.slow
def test_the_top_of_a_short_series(problem):
    y = datasets.ice_varves()[:ROWS]
    top, information = exact_top(y)
    method = ssm.DirectOptimization(particles=300, averages=8, laplace=False)
    estimate = ssm.maximize(models.varves, {"y": y}, method, seed=seed_of("short"), progress=False)
    assert estimate.attrs["converged"]
    errors = estimate.attrs["monte_carlo_errors"]
    for name, exact, se in zip(("phi", "tau"), top, np.sqrt(np.diag(np.linalg.inv(information))),
                               strict=True):  # fmt: skip
        z = (estimate.parameters[name] - exact) / errors[name]
        print(f"{name} {estimate.parameters[name]:.5g}, exact {exact:.5g}, {z:+.2f} errors off; "
              f"standard error {estimate.standard_errors[name]:.4g}, exact {se:.4g}")  # fmt: skip
        assert abs(z) < 4
        assert errors[name] < 0.2 * se
        assert estimate.standard_errors[name] == pytest.approx(se, rel=0.2)


@pytest.mark.slow
def test_the_top_of_the_varves(exact_values):
    exact = exact_values["ice_varves"]
    estimate = ssm.maximize(models.varves, {"y": datasets.ice_varves()}, seed=seed_of("varves"),
                            progress=False)  # fmt: skip
    assert estimate.attrs["method"] == "DirectOptimization"
    for name, value in exact["mle"].items():
        z = (estimate.parameters[name] - value) / estimate.attrs["monte_carlo_errors"][name]
        print(f"{name} {estimate.parameters[name]:.5g}, exact {value:.5g}, {z:+.2f} errors off")
        assert abs(z) < 4
    assert estimate.parameters["tau"] == pytest.approx(exact["mle"]["tau"], rel=0.04)
    inverse = np.array(exact["inverse_observed_information_at_mle"])
    np.testing.assert_allclose(
        np.sqrt(np.diag(estimate.covariance)), np.sqrt(np.diag(inverse)), rtol=0.1
    )


def model_of(law):
    model = ssm.Model("law")
    model.prior(lambda: {"a": ssm.HalfNormal(sd=1)})
    model.initial(lambda: {"x": ssm.Gamma(2, rate=1)})
    model.transition(lambda x, a: {"x": law(x, a)})
    model.observation(lambda x: {"y": ssm.Poisson(x)})
    return trace(model)


def test_where_it_does_not_apply_it_says_why():
    reason = smooth_filter_applies(model_of(lambda x, a: ssm.Gamma(a + x, rate=1)))
    assert reason is not None
    assert "rejection" in reason.reason
    assert reason.where is not None
    assert smooth_filter_applies(trace(models.varves)) is None
    assert "3 components" in smooth_filter_applies(trace(models.machine)).reason


@pytest.mark.slow
def test_of_many_maxima_of_a_markov_chain_a_high_one_is_found():
    """Three states that start alike, where a climb goes to a saddle or to a maximum of two states:
    whatever the seed, as high as the best of ten climbs from places that tell the states apart."""
    model = ssm.Model("three levels")
    model.prior(lambda: {
        "stay": ssm.Dirichlet(1 + 8 * np.eye(3)), "level": ssm.Normal(np.zeros(3), sd=3),
        "s": ssm.HalfNormal(sd=2),
    })  # fmt: skip
    model.initial(lambda: {"k": ssm.Categorical(np.full(3, 1 / 3))})
    model.transition(lambda k, stay: {"k": ssm.Categorical(stay[k])})
    model.observation(lambda k, level, s: {"y": ssm.Normal(level[k], sd=s)})
    rng = np.random.default_rng(seed_of("three levels"))
    k, y = 0, []
    for _ in range(120):
        k = k if rng.random() < 0.9 else int(rng.integers(3))
        y.append(rng.normal([-2.0, 0.0, 2.5][k], 0.7))
    data = {"y": np.array(y)}
    apart = []
    for seed in range(10):
        start = {"level": np.quantile(y, [0.1, 0.5, 0.9]) + 0.5 * rng.standard_normal(3), "s": 1.0,
                 "stay": 0.1 + 0.7 * np.eye(3)}  # fmt: skip
        method = ssm.DirectOptimization(restarts=0)
        climbed = ssm.maximize(model, data, method, start=start, seed=seed, progress=False)
        apart.append(climbed.log_likelihood)
    for seed in range(3):
        found = ssm.maximize(model, data, seed=seed, progress=False)
        assert found.attrs["restarts"] == 24
        assert found.log_likelihood > max(apart) - 1e-3
