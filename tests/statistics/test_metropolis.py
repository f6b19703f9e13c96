"""Every Metropolis variant and Gibbs leave the posterior invariant: a small series, by quadrature.

Twenty noisy values of an AR(1) with both parameters unknown. The particle filters are small, so
that log Z varies by more than one, and whatever is wrong with a variant's ratio of acceptance would
show. Orders 1 and 2 have estimates of score and information that are as poor.
"""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.expressions.expr import constant
from ssmppl.inference.chains import gibbs
from ssmppl.inference.chains.gibbs_updates import draw_parameters

from .checks import (
    MCSE,
    assert_within,
    deviations,
    influence_of_correlation,
    mcse_mean,
    seed_of,
    some,
)
from .exact import DenseGaussian

small = ssm.Model("small")
STEPS, SHAPE, RATE = 20, 3.0, 2.0
R = 0.3


@small.prior
def prior():
    return {"phi": ssm.Uniform(-1, 1), "tau": ssm.Gamma(SHAPE, rate=RATE)}


@small.initial
def initial(phi, tau):
    return {"x": ssm.Normal(0, precision=(1 - phi**2) * tau)}


@small.transition
def transition(x, phi, tau):
    return {"x": ssm.Normal(phi * x, precision=tau)}


@small.observation
def observation(x):
    return {"y": ssm.Normal(x, variance=R)}


@cache
def data():
    drawn = ssm.simulate(small, {"phi": 0.7, "tau": 1.5}, steps=STEPS, seed=seed_of("small"))
    y = drawn["y"].values[0].copy()
    y[[4, 11]] = np.nan
    return {"y": y}


@cache
def posterior():
    """Mean, sd and correlation of (phi, tau), on a grid in (atanh phi, log tau)."""
    a, b = np.linspace(-2.5, 4.0, 90), np.linspace(-3.5, 3.5, 90)
    phi, tau = np.tanh(a), np.exp(b)
    log_p = np.empty((len(a), len(b)))
    for i, f in enumerate(phi):
        for j, t in enumerate(tau):
            exact = DenseGaussian(
                data()["y"], m=[0.0], P=[[1 / ((1 - f**2) * t)]], A=[[f]], b=[0.0], Q=[[1 / t]],
                C=[[1.0]], d=[0.0], R=[[R]],
            )  # fmt: skip
            log_p[i, j] = exact.log_likelihood + SHAPE * b[j] - RATE * t + np.log1p(-(f**2))
    p = np.exp(log_p - log_p.max())
    p /= p.sum()
    edges = max(p[0].sum(), p[-1].sum(), p[:, 0].sum(), p[:, -1].sum())
    assert edges < 1e-5, f"the grid cuts the posterior off: {edges:.1e}"
    return p, phi, tau


def moments():
    """Mean and sd of phi and log tau, and their correlation.

    The logarithm, because tau itself has a long tail: the sd of its draws and the error of that sd
    would be small together.
    """
    p, phi, tau = posterior()
    log_tau, out = np.log(tau), {}
    for name, values, weight in (("phi", phi, p.sum(1)), ("log tau", log_tau, p.sum(0))):
        mean = weight @ values
        out[name] = mean, np.sqrt(weight @ (values - mean) ** 2)
    cross = (phi - out["phi"][0]) @ p @ (log_tau - out["log tau"][0])
    return out, cross / (out["phi"][1] * out["log tau"][1])


def compare(drawn) -> dict[str, float]:
    """Deviations of all moments, in Monte Carlo standard errors."""
    exact, r = moments()
    phi, log_tau = drawn["phi"].values, np.log(drawn["tau"].values)
    found = {}
    for name, values in (("phi", phi), ("log tau", log_tau)):
        z = deviations(values, mean=exact[name][0], sd=exact[name][1])
        found |= {f"{k} of {name}": v for k, v in z.items()}
    error = mcse_mean(influence_of_correlation(phi, log_tau))
    return found | {"correlation": (np.corrcoef(phi.ravel(), log_tau.ravel())[0, 1] - r) / error}


def sampled(label, method, draws, **options):
    options = {"warmup": 400, "chains": 4, "states": False, "progress": False} | options
    return ssm.sample(small, data(), method, draws=draws, seed=seed_of(label), **options)


BOOTSTRAP = {"proposal": "bootstrap", "particles": 15}
NATURAL = {"scale": "natural", "transform": {"tau": "reciprocal"}}
GIVEN = {"covariance": [[0.03, -0.015], [-0.015, 0.08]]}
METHODS = {
    "MH": (ssm.MetropolisHastings(), 1_500),
    "MH1": (ssm.MetropolisHastings(order=1), 1_500),
    "Gibbs": (ssm.Gibbs(), 1_500),
    "PMH0, natural": (ssm.PMMH(**BOOTSTRAP, **NATURAL, **GIVEN), 4_000),
    "PMH1": (ssm.PMMH(order=1, lag=4, **BOOTSTRAP), 2_000),
    "PMH2": (ssm.PMMH(order=2, lag=4, **BOOTSTRAP), 2_000),
    "correlated": (ssm.PMMH(correlation=0.9, **BOOTSTRAP), 4_000),
}
LONG = {
    "MH1, natural": (ssm.MetropolisHastings(order=1, **NATURAL), 6_000),
    "MH, natural": (
        ssm.MetropolisHastings(scale="natural", covariance=np.diag([0.08, 0.4])), 6_000,
    ),
    "PMH0": (ssm.PMMH(**BOOTSTRAP), 15_000),
    "PMH0, log": (ssm.PMMH(transform={"tau": "log", "phi": "natural"}, **BOOTSTRAP), 15_000),
    "PMH1, natural": (ssm.PMMH(order=1, **BOOTSTRAP, **NATURAL), 10_000),
    "PMH2, auxiliary": (ssm.PMMH(order=2, particles=4, proposal="auxiliary"), 10_000),
    "PMH2, natural": (ssm.PMMH(order=2, scale="natural", lag=2, **BOOTSTRAP), 10_000),
    "correlated, auxiliary": (
        ssm.PMMH(correlation=0.95, particles=4, proposal="auxiliary"), 15_000,
    ),
}  # fmt: skip
CASES = [
    *(pytest.param(*case, id=name) for name, case in METHODS.items()),
    *(pytest.param(*case, id=name, marks=pytest.mark.slow) for name, case in LONG.items()),
]


@pytest.mark.parametrize(("method", "draws"), some(CASES, 1))
def test_posterior_of_the_small_series(request, method, draws):
    idata = sampled(request.node.callspec.id, method, draws)
    rate = float(idata["sample_stats"]["acceptance_rate"].mean())
    seconds = idata["posterior"].attrs["seconds"]
    print(f"{seconds:.1f} s, acceptance {rate:.2f}\n{ssm.summary(idata).to_string()}")
    assert_within(compare(idata["posterior"]))


# --- faults seen in other samplers, put in on purpose --------------------------------------------


def test_the_initial_law_forgotten_is_found(monkeypatch):
    """Updates without p(x_1 | phi, tau) pass for a sampler that conditions on x_1: not here."""
    plan = gibbs.plan_updates

    def forgetful(problem, held):
        return tuple(
            dataclasses.replace(
                u,
                outside_family=(),
                coefficients=u.coefficients | {"initial": (constant(0.0),) * len(u.functions)},
            )
            for u in plan(problem, held)
        )

    monkeypatch.setattr(gibbs, "plan_updates", forgetful)
    found = compare(sampled("forgetful", ssm.Gibbs(), 1_500)["posterior"])
    assert max(map(abs, found.values())) > MCSE, found


product = ssm.Model("product")


@product.prior
def product_prior():
    return {"a": ssm.Normal(1, sd=0.5), "b": ssm.Normal(1, sd=0.5)}


@product.initial
def product_initial():
    return {"x": ssm.Normal(0, sd=1)}


@product.transition
def product_transition(x):
    return {"x": ssm.Normal(0.5 * x, sd=0.5)}


@product.observation
def product_observation(x, a, b):
    return {"y": ssm.Normal(x + a * b, sd=0.5)}


@cache
def product_data():
    return {"y": ssm.simulate(product, {"a": 1.2, "b": 1.1}, steps=15, seed=11)["y"].values[0]}


def product_deviations(drawn) -> dict[str, float]:
    """a, b and their correlation against quadrature: the likelihood depends on their product."""
    levels = np.array([0.0, 1.0, 2.0])  # of which its logarithm is a quadratic function
    matrices = {"m": [0.0], "P": [[1.0]], "A": [[0.5]], "b": [0.0], "Q": [[0.25]], "C": [[1.0]]}
    logs = [
        DenseGaussian(product_data()["y"], **matrices, d=[s], R=[[0.25]]).log_likelihood
        for s in levels
    ]
    grid = np.linspace(-2.5, 4.5, 1_200)
    log_p = np.polyval(np.polyfit(levels, logs, 2), np.outer(grid, grid))
    log_p -= 2.0 * ((grid - 1.0) ** 2 + (grid[:, None] - 1.0) ** 2)
    p = np.exp(log_p - log_p.max())
    p /= p.sum()
    mean = p.sum(1) @ grid
    sd = np.sqrt(p.sum(1) @ (grid - mean) ** 2)
    r = (grid - mean) @ p @ (grid - mean) / sd**2
    a, b = drawn["a"].values, drawn["b"].values
    z = {
        f"{k} of {n}": v
        for n, d in (("a", a), ("b", b))
        for k, v in deviations(d, mean, sd).items()
    }
    error = mcse_mean(influence_of_correlation(a, b))
    return z | {"correlation": (np.corrcoef(a.ravel(), b.ravel())[0, 1] - r) / error}


def product_drawn():
    return ssm.sample(
        product, product_data(), ssm.Gibbs(), draws=2_500, warmup=200, states=False,
        progress=False, seed=seed_of("product"),
    )["posterior"]  # fmt: skip


def test_each_update_sees_the_newest_parameters():
    assert_within(product_deviations(product_drawn()))


def test_updates_given_old_parameters_are_found(monkeypatch):
    """A sweep whose every update is given the parameters from before the sweep."""
    alone = {}

    def with_old(steps, theta, paths, generator):
        before, accepted = theta.copy(), []
        for k, update in enumerate(steps.updates):
            if k not in alone:
                alone[k] = dataclasses.replace(steps, updates=(update,))
            own = before.copy()
            accepted += draw_parameters(alone[k], own, paths, generator)
            theta[steps.positions[k]] = own[steps.positions[k]]
        return accepted

    monkeypatch.setattr(gibbs, "draw_parameters", with_old)
    drawn = product_drawn()
    assert len(alone) == 2, "the two parameters have to be drawn one after the other"
    found = product_deviations(drawn)
    assert max(map(abs, found.values())) > MCSE, found
