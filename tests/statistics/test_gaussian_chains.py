"""Chains that go by the Gaussian approximation: ISMCMC, PMMH over twisted filters, delayed
acceptance. Against quadrature, of parameters and of a state.

Four models with an AR(1) for their one state and two parameters: a linear Gaussian one, and three
whose approximation is none: thicknesses like those of the varves, a stochastic volatility, counts.
The exact posterior is a sum over a grid in (logit phi, log tau), the likelihood and the smoothed
state at each node by a point-mass filter. Few particles, so that a wrong weight or ratio of
acceptance would show.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy import stats
from scipy.special import expit, logit

import ssmppl as ssm
from ssmppl.inference.chains import metropolis_kernel

from .checks import MCSE, assert_within, deviations, seed_of, some

STEPS, HALF = 30, 15
A, B, SHAPE, RATE = 6.0, 2.0, 4.0, 1.0
LOGIT, LOG = (-2.5, 7.0), (-2.6, 3.6)
POINTS, CELLS = 40, 180

OBSERVATIONS = {  # the law of y given x, and SciPy's log density of y (T, 1) at x (cells,)
    "linear": (
        lambda x: ssm.Normal(x, sd=0.5),
        lambda y, x: stats.norm.logpdf(y, x, 0.5),
    ),
    "varves": (
        lambda x: ssm.Gamma(6.25, rate=6.25 * np.exp(-x)),
        lambda y, x: stats.gamma.logpdf(y, 6.25, scale=np.exp(x) / 6.25),
    ),
    "volatility": (
        lambda x: ssm.Normal(0, sd=np.exp(x / 2)),
        lambda y, x: stats.norm.logpdf(y, 0, np.exp(x / 2)),
    ),
    "counts": (
        lambda x: ssm.Poisson(np.exp(0.3 + x)),
        lambda y, x: stats.poisson.logpmf(y, np.exp(0.3 + x)),
    ),
}


@cache
def model_of(name):
    law = OBSERVATIONS[name][0]
    model = ssm.Model(f"small {name}")
    model.prior(lambda: {"phi": ssm.Beta(A, B), "tau": ssm.Gamma(SHAPE, rate=RATE)})
    model.initial(lambda phi, tau: {"x": ssm.Normal(0, precision=(1 - phi**2) * tau)})
    model.transition(lambda x, phi, tau: {"x": ssm.Normal(phi * x, precision=tau)})
    model.observation(lambda x: {"y": law(x)})
    return model


@cache
def data_of(name):
    drawn = ssm.simulate(
        model_of(name), {"phi": 0.7, "tau": 3.0}, steps=STEPS, seed=seed_of("gaussian", name)
    )
    y = drawn["y"].values[0].astype(float)
    y[[4, 20]] = np.nan
    return {"y": y}


def log_likelihood_and_state(log_g, phi, tau):
    """log p(y), and mean and mean square of the state half-way given y; log_g (T, cells)."""
    sd = 1 / np.sqrt(tau)
    reach = min(7 * sd / np.sqrt(1 - phi**2), 14.0)
    x, h = np.linspace(-reach, reach, CELLS, retstep=True)
    move = stats.norm.pdf(x[:, None], phi * x[None, :], sd) * h
    g = log_g(x)
    top = g.max(axis=1, keepdims=True)
    g, total = np.exp(g - top), float(top.sum())
    density = stats.norm.pdf(x, 0, sd / np.sqrt(1 - phi**2))
    for t in range(STEPS):
        density = (move @ density if t else density) * g[t]
        mass = density.sum() * h
        total += np.log(mass)
        density /= mass
        if t == HALF:
            middle = density
    after = np.ones(CELLS)
    for t in range(STEPS - 1, HALF, -1):
        after = move.T @ (g[t] * after)
        after /= after.max()
    smoothed = middle * after
    smoothed /= smoothed.sum()
    return total, smoothed @ x, smoothed @ x**2


@cache
def exact(name):
    """Mean and sd of logit phi, log tau and the state half-way."""
    y, log_density = data_of(name)["y"], OBSERVATIONS[name][1]

    def log_g(x):
        found = log_density(np.nan_to_num(y, nan=1.0)[:, None], x)
        return np.where(np.isnan(y)[:, None], 0.0, found)

    a, b = np.linspace(*LOGIT, POINTS), np.linspace(*LOG, POINTS)
    log_p, first, second = np.empty((3, POINTS, POINTS))
    for i, j in np.ndindex(POINTS, POINTS):
        phi, tau = expit(a[i]), np.exp(b[j])
        value, first[i, j], second[i, j] = log_likelihood_and_state(log_g, phi, tau)
        log_p[i, j] = value + A * np.log(phi) + B * np.log1p(-phi) + SHAPE * b[j] - RATE * tau
    p = np.exp(log_p - log_p.max())
    p /= p.sum()
    assert max(p[0].sum(), p[-1].sum(), p[:, 0].sum(), p[:, -1].sum()) < 2e-4
    of_a, of_b = p.sum(axis=1), p.sum(axis=0)

    def moments(values, weights):
        mean = weights @ values
        return mean, np.sqrt(weights @ (values - mean) ** 2)

    mean = (p * first).sum()
    state = mean, np.sqrt((p * second).sum() - mean**2)
    return {"phi": moments(a, of_a), "tau": moments(b, of_b), "x": state}


METHODS = {
    "ISMCMC": ssm.ISMCMC(particles=5),
    "ISMCMC extended": ssm.ISMCMC(particles=5, approximation="extended", steps=1),
    "PMMH": ssm.PMMH(),
    "PMMH twisted": ssm.PMMH(particles=5, proposal="twisted", delayed_acceptance=False),
    "PMMH twisted, delayed": ssm.PMMH(particles=5, proposal="twisted"),
    "PMMH bootstrap, delayed": ssm.PMMH(
        particles=30, proposal="bootstrap", delayed_acceptance=True
    ),
}
CASES = [(name, label) for label in METHODS for name in OBSERVATIONS]


def found_deviations(name, label):
    idata = ssm.sample(
        model_of(name), data_of(name), METHODS[label], draws=3000, warmup=500, progress=False,
        seed=seed_of("gaussian chains", name, label),
    )  # fmt: skip
    posterior = idata["posterior"]
    drawn = {
        "phi": logit(posterior["phi"].values), "tau": np.log(posterior["tau"].values),
        "x": posterior["x"].values[:, :, HALF],
    }  # fmt: skip
    found = {}
    for quantity, (mean, sd) in exact(name).items():
        off = deviations(drawn[quantity], mean=mean, sd=sd)
        found |= {f"{what} of {quantity}": v for what, v in off.items()}
    print(ssm.summary(idata).to_string())
    return found


@pytest.mark.parametrize(("name", "label"), some(CASES, 1))
def test_posterior(name, label):
    assert_within(found_deviations(name, label))


@pytest.mark.slow
def test_a_second_stage_that_counts_the_first_again_is_found(monkeypatch):
    """Its posterior has the likelihood twice, about: too narrow by a root of two."""
    original = metropolis_kernel._delayed

    def delayed(kernel, state, made, normals):
        new, promising, probability = original(kernel, state, made, normals)
        if new is not None:
            change = new.run.log_likelihood - state.point.run.log_likelihood
            probability = float(np.exp(min(change, 0.0)))
        return new, promising, probability

    monkeypatch.setattr(metropolis_kernel, "_delayed", delayed)
    found = found_deviations("volatility", "PMMH twisted, delayed")
    assert max(map(abs, found.values())) > 2 * MCSE, found
