"""Observations without noise, `ssm.Dirac` of what is affine in the states: autoregressions with
moving averages, sums of components.

Held against the joint normal density of the data, against sums over a grid of parameters, and,
where the states are not linear, against sums over a grid of the states.
"""

from __future__ import annotations

import numpy as np
import pytest
import scipy.optimize
import scipy.stats

import ssmppl as ssm
from tests.statistics.checks import mean_one_p

ROWS = 40


def arma() -> ssm.Model:
    """x_t = a x_{t-1} + e_t + b e_{t-1}, measured as it is."""
    model = ssm.Model("ARMA(1, 1)")
    model.prior(lambda: {
        "a": ssm.Uniform(-1, 1), "b": ssm.Uniform(-1, 1), "q": ssm.HalfNormal(sd=2)
    })  # fmt: skip

    def initial(q, a, b):
        variance = q * (1 + (a + b) ** 2 / (1 - a**2))
        return {"x": ssm.Normal(0.0, variance=variance), "m": ssm.Dirac(0.0)}

    model.initial(initial)
    model.transition(lambda q: {"e": ssm.Normal(0.0, variance=q)})
    model.transition(lambda x, m, a, b, e_next: {
        "x": ssm.Dirac(a * x + m + e_next), "m": ssm.Dirac(b * e_next)
    })  # fmt: skip
    model.observation(lambda x: {"y": ssm.Dirac(x)})
    return model


def sum_of_two() -> ssm.Model:
    """A random walk and an autoregression, of which the sum is measured without noise."""
    model = ssm.Model("sum")
    model.prior(lambda: {"q": ssm.InverseGamma(2, scale=1), "p": ssm.InverseGamma(2, scale=1)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1), "s": ssm.Normal(0, sd=1)})
    model.transition(lambda x, s, q, p: {
        "x": ssm.Normal(x, variance=q), "s": ssm.Normal(0.5 * s, variance=p)
    })  # fmt: skip
    model.observation(lambda x, s: {"y": ssm.Dirac(x + s)})
    return model


Y = np.cumsum(np.random.default_rng(7).normal(size=ROWS))


def log_density(q: float, p: float, y: np.ndarray = Y) -> float:
    t = np.arange(ROWS)
    walk = 1.0 + q * np.minimum.outer(t, t)
    spread = np.empty(ROWS)
    spread[0] = 1.0
    for i in t[1:]:
        spread[i] = 0.25 * spread[i - 1] + p
    other = np.minimum.outer(t, t)
    auto = 0.5 ** np.abs(np.subtract.outer(t, t)) * spread[other]
    seen = ~np.isnan(y)
    cov = (walk + auto)[np.ix_(seen, seen)]
    return float(scipy.stats.multivariate_normal(np.zeros(seen.sum()), cov).logpdf(y[seen]))


@pytest.mark.parametrize("gaps", [False, True])
def test_likelihood(gaps):
    y = Y.copy()
    if gaps:
        y[[3, 4, 20]] = np.nan
    theta = {"q": 0.7, "p": 0.4}
    found = ssm.log_likelihood(sum_of_two(), {"y": y}, theta)[0]
    assert found == pytest.approx(log_density(0.7, 0.4, y), abs=1e-9)
    log_z = ssm.log_likelihood(
        sum_of_two(), {"y": y}, theta, proposal="guided", particles=200, repeats=200, seed=1
    )
    assert mean_one_p(log_z - found) > 1e-3


def test_smooth():
    found = ssm.smooth(sum_of_two(), {"y": Y}, {"q": 0.7, "p": 0.4})
    assert found["x"].to_numpy()[0] + found["s"].to_numpy()[0] == pytest.approx(Y, abs=1e-9)
    assert found["x_sd"].to_numpy()[0] == pytest.approx(found["s_sd"].to_numpy()[0], abs=1e-7)
    assert found["x_sd"].to_numpy().min() > 0.1
    drawn = ssm.smooth(
        sum_of_two(), {"y": Y}, {"q": 0.7, "p": 0.4}, ssm.FFBSi(kernel="genealogy"),
        particles=3000, seed=1,
    )  # fmt: skip
    last = drawn["x"].to_numpy().reshape(-1, ROWS)[:, -1]
    mean, sd = found["x"].to_numpy()[0, -1], found["x_sd"].to_numpy()[0, -1]
    assert abs(last.mean() - mean) < 5.0 * sd / np.sqrt(len(last))


def test_maximum():
    found = ssm.maximize(sum_of_two(), {"y": Y}, seed=1, progress=False)
    best = scipy.optimize.minimize(
        lambda z: -log_density(*np.exp(z)), np.zeros(2), tol=1e-10, method="Nelder-Mead"
    )
    assert found.log_likelihood == pytest.approx(-best.fun, abs=1e-6)


def test_posterior():
    """Means by the default method, and by sums over a grid of log q and log p."""
    axis = np.linspace(-5.0, 4.0, 61)
    prior = scipy.stats.invgamma(2.0, scale=1.0)
    height = np.array([
        [log_density(np.exp(a), np.exp(b)) + prior.logpdf(np.exp(a)) + a
         + prior.logpdf(np.exp(b)) + b for b in axis] for a in axis
    ])  # fmt: skip
    weight = np.exp(height - height.max())
    weight /= weight.sum()
    idata = ssm.sample(sum_of_two(), {"y": Y}, seed=1, progress=False)
    assert idata.posterior.attrs["method"] == "MetropolisHastings"
    summary = ssm.summary(idata)
    for name, exact in (("q", weight.sum(axis=1) @ np.exp(axis)),
                        ("p", weight.sum(axis=0) @ np.exp(axis))):  # fmt: skip
        found = summary.loc[name]
        assert abs(found["mean"] - exact) < 4.5 * found["mcse_mean"], (name, exact)


def test_arma():
    """Against the autocovariances of an ARMA(1, 1) that starts without its moving average."""
    a, b, q = 0.6, 0.4, 0.5
    model, n = arma(), 12
    y = ssm.simulate(model, {"a": a, "b": b, "q": q}, steps=n, seed=1)["y"].to_numpy()[0]
    first = q * (1 + (a + b) ** 2 / (1 - a**2))
    basis = np.zeros((n, n + 1))  # of the start and the noises
    basis[0, 0] = np.sqrt(first)
    for t in range(1, n):
        basis[t] = a * basis[t - 1]
        basis[t, t] += np.sqrt(q)
        if t > 1:
            basis[t, t - 1] += b * np.sqrt(q)
    expected = scipy.stats.multivariate_normal(np.zeros(n), basis @ basis.T).logpdf(y)
    found = ssm.log_likelihood(model, {"y": y}, {"a": a, "b": b, "q": q})[0]
    assert found == pytest.approx(expected, abs=1e-8)


def test_states_that_are_not_linear():
    """Two states, of which the sum is measured: by a grid of the first."""
    model = ssm.Model("nonlinear sum")
    model.initial(lambda: {"x": ssm.Normal(0, sd=1), "s": ssm.Normal(0, sd=1)})
    model.transition(lambda x, s: {
        "x": ssm.Normal(np.sin(2 * x), sd=0.6), "s": ssm.Normal(0.5 * s, sd=0.4)
    })  # fmt: skip
    model.observation(lambda x, s: {"y": ssm.Dirac(x + s)})
    y = np.array([0.3, -0.4, 0.8, 0.1, 1.2])
    x = np.linspace(-5.0, 5.0, 1001)
    step = x[1] - x[0]
    normal = scipy.stats.norm.pdf
    mass = normal(x) * normal(y[0] - x) * step
    for t in range(1, len(y)):
        move = normal(x[:, None], np.sin(2 * x)[None, :], 0.6)
        other = normal((y[t] - x)[:, None], 0.5 * (y[t - 1] - x)[None, :], 0.4)
        mass = (move * other) @ mass * step
    expected = np.log(mass.sum())
    log_z = ssm.log_likelihood(model, {"y": y}, {}, particles=300, repeats=300, seed=1)
    assert mean_one_p(log_z - expected) > 1e-3
    with pytest.raises(ssm.ArgumentError, match="without noise"):
        ssm.log_likelihood(model, {"y": y}, {}, proposal="bootstrap")
    plan = " ".join(str(ssm.explain(model)).split())
    assert "Laplace approximation none: y is observed without noise" in plan


def test_an_exact_channel_beside_a_noisy_one():
    """Of a variance that is a parameter: the covariance of both is singular, and no reason for a
    likelihood of zero. By a grid of the first state."""
    model = ssm.Model("exact and noisy")
    model.prior(lambda: {"r": ssm.HalfNormal(sd=1)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1), "s": ssm.Normal(0, sd=1)})
    model.transition(lambda x, s: {
        "x": ssm.Normal(np.sin(2 * x), sd=0.6), "s": ssm.Normal(0.5 * s, sd=0.4)
    })  # fmt: skip
    model.observation(lambda x, s, r: {"y": ssm.Dirac(x + s), "z": ssm.Normal(x, sd=r)})
    y, z = np.array([0.3, -0.4, 0.8, 0.1]), np.array([0.1, np.nan, 0.9, -0.3])
    x = np.linspace(-5.0, 5.0, 1001)
    step, normal = x[1] - x[0], scipy.stats.norm.pdf
    mass = normal(x) * normal(y[0] - x) * normal(z[0], x, 0.7) * step
    for t in range(1, len(y)):
        move = normal(x[:, None], np.sin(2 * x)[None, :], 0.6)
        other = normal((y[t] - x)[:, None], 0.5 * (y[t - 1] - x)[None, :], 0.4)
        mass = (move * other) @ mass * step
        mass *= 1.0 if np.isnan(z[t]) else normal(z[t], x, 0.7)
    log_z = ssm.log_likelihood(
        model, {"y": y, "z": z}, {"r": 0.7}, particles=300, repeats=300, seed=1
    )
    assert mean_one_p(log_z - np.log(mass.sum())) > 1e-3


def test_a_first_row_that_no_particle_can_meet_is_refused():
    """Its state is drawn without a look at the observation, as it is not Gaussian."""
    model = ssm.Model("uniform start")
    model.initial(lambda: {"x": ssm.Uniform(-1, 1)})
    model.transition(lambda x: {"x": ssm.Normal(np.sin(2 * x), sd=0.6)})
    model.observation(lambda x: {"y": ssm.Dirac(x)})
    with pytest.raises(ssm.ArgumentError, match="observed without noise"):
        ssm.log_likelihood(model, {"y": np.array([0.2, 0.4])}, {}, seed=1)


def test_what_is_not_affine_is_refused():
    model = ssm.Model("square")
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(x, sd=1)})
    model.observation(lambda x: {"y": ssm.Dirac(x**2)})
    with pytest.raises(ssm.ModelError, match="affine in the states") as caught:
        ssm.log_likelihood(model, {"y": np.ones(3)}, {})
    assert "give the channel a noise" in str(caught.value)


@pytest.mark.parametrize("method", [ssm.Gibbs(), ssm.PGAS()])
def test_methods_that_need_a_density_say_so(method):
    with pytest.raises(ssm.ArgumentError, match="observed without noise"):
        ssm.sample(sum_of_two(), {"y": Y}, method, draws=5, warmup=5, progress=False)
