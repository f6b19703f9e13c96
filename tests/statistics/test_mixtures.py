"""Likelihoods and posteriors of mixtures, inflated counts, differences of counts, lifetimes and
headings against grids.

The grids' densities are SciPy's; estimates are held against them within their Monte Carlo errors.
"""

from __future__ import annotations

import functools

import numpy as np
import pytest
import scipy.stats as st

import ssmppl as ssm

from .checks import LEVEL, assert_within, deviations, mean_one_p, seed_of
from .exact import GridPosterior

X, STEP = np.linspace(-9.0, 9.0, 1801, retstep=True)
CIRCLE = np.linspace(-np.pi, np.pi, 601)[1:]


def declared(name, observation, prior=None, initial=None, transition=None):
    """A model from its laws; the state is an autoregression unless told otherwise."""
    model = ssm.Model(name)
    if prior is not None:
        model.prior(prior)
    model.initial(initial or (lambda: {"x": ssm.Normal(0, sd=1)}))
    model.transition(transition or (lambda x: {"x": ssm.Normal(0.8 * x, sd=0.5)}))
    model.observation(observation)
    return model


outliers = declared(
    "outliers", lambda x, p: {
        "y": ssm.Mixture([1 - p, p], [ssm.Normal(x, sd=0.3), ssm.Normal(x, sd=4)])
    },
    prior=lambda: {"p": ssm.Beta(2, 8)},
)  # fmt: skip
jumps = declared(
    "jumps", lambda x, m: {"y": ssm.Normal(x, sd=0.4), "z": ssm.Normal(m, sd=3)},
    prior=lambda: {
        "p": ssm.Beta(2, 8),
        "m": ssm.Mixture([0.3, 0.7], [ssm.Normal(-2, sd=0.5), ssm.Laplace(1, scale=0.5)]),
    },
    transition=lambda x, p: {
        "x": ssm.Mixture([1 - p, p], [ssm.Normal(0.9 * x, sd=0.2), ssm.Normal(0, sd=2)])
    },
)  # fmt: skip
absent = declared(
    "absent", lambda x, p: {"y": ssm.ZeroInflated(ssm.Poisson(np.exp(1 + x)), p)},
    prior=lambda: {"p": ssm.Beta(2, 8)},
)  # fmt: skip
scattered = declared(
    "scattered", lambda x: {"y": ssm.BetaBinomial(10, np.exp(x), 2.0)}
)  # fmt: skip
differences = declared("differences", lambda x: {"y": ssm.Skellam(np.exp(1 + x), 2.0)})
lifetimes = declared("lifetimes", lambda x: {"y": ssm.Weibull(1.7, scale=np.exp(x))})
headings = declared(
    "headings", lambda x: {"y": ssm.VonMises(x, concentration=1.5)},
    initial=lambda: {"x": ssm.VonMises(1.0, concentration=1.0)},
    transition=lambda x: {"x": ssm.VonMises(x + 0.8, concentration=4.0)},
)  # fmt: skip


def weibull(y):
    return st.weibull_min.pdf(y[:, None], 1.7, scale=np.exp(X))


def inflated(y, p):
    return p * (y[:, None] == 0) + (1 - p) * st.poisson.pmf(y[:, None], np.exp(1 + X))


def subtracted(y):
    """The sum over the second count."""
    second = np.arange(40)
    first = y[:, None, None] + second[:, None]
    return np.einsum("jk,tjk->tk", st.poisson.pmf(second, 2.0)[:, None] * np.ones(len(X)),
                     st.poisson.pmf(first, np.exp(1 + X)))  # fmt: skip


def contaminated(y, p):
    near, far = (st.norm.pdf(y[:, None], X, sd) for sd in (0.3, 4.0))
    return (1 - p) * near + p * far


def grid_log_likelihood(first, move, g, step):
    """The point-mass filter: densities on a grid, `move` from column to row."""
    density, total = first, 0.0
    for t, row in enumerate(g):
        density = row * (move @ density * step if t else density)
        mass = density.sum() * step
        total, density = total + np.log(mass), density / mass
    return float(total)


AR = st.norm.pdf(X[:, None], 0.8 * X, 0.5)
FIRST = st.norm.pdf(X)


def jumping(p):
    return (1 - p) * st.norm.pdf(X[:, None], 0.9 * X, 0.2) + p * st.norm.pdf(X[:, None], 0, 2)


def turning():
    turn = CIRCLE[:, None] - CIRCLE
    return (
        st.vonmises.pdf(CIRCLE, 1.0, loc=1.0),
        st.vonmises.pdf(turn, 4.0, loc=0.8),
        lambda y: st.vonmises.pdf(y[:, None] - CIRCLE, 1.5),
    )


def exact(name, y, p=0.1):
    if name == "jumps":
        return grid_log_likelihood(FIRST, jumping(p), st.norm.pdf(y[:, None], X, 0.4), STEP)
    if name == "headings":
        first, move, g = turning()
        return grid_log_likelihood(first, move, g(y), CIRCLE[1] - CIRCLE[0])
    g = {
        "outliers": lambda: contaminated(y, p),
        "absent": lambda: inflated(y, p),
        "scattered": lambda: st.betabinom.pmf(y[:, None], 10, np.exp(X), 2.0),
        "differences": lambda: subtracted(y),
        "lifetimes": lambda: weibull(y),
    }[name]()
    return grid_log_likelihood(FIRST, AR, g, STEP)


MODELS = {m.name: m for m in (outliers, jumps, absent, scattered, differences, lifetimes, headings)}
THETA = {"outliers": {"p": 0.1}, "jumps": {"p": 0.1, "m": 1.0}, "absent": {"p": 0.1}}


@functools.cache
def data_of(name, steps=12):
    made = ssm.simulate(MODELS[name], THETA.get(name, {}), steps=steps, seed=seed_of(name))
    return {k: made[k].values[0] for k in made if k in ("y", "z")}


CASES = [(name, "bootstrap") for name in MODELS]
OF_SLOPES = ("outliers", "absent", "scattered", "differences", "lifetimes")
CASES += [(name, "guided") for name in OF_SLOPES]


@pytest.mark.parametrize(("name", "proposal"), CASES)
def test_likelihood(name, proposal):
    """Estimates have the mean of a grid's sum."""
    data = data_of(name)
    expected = exact(name, data["y"])
    if name == "jumps":
        expected += st.norm.logpdf(data["z"], 1.0, 3.0).sum()
    estimates = ssm.log_likelihood(
        MODELS[name], data, THETA.get(name, {}), particles=300, repeats=400, proposal=proposal,
        seed=seed_of("likelihood", name, proposal),
    )  # fmt: skip
    assert mean_one_p(estimates - expected) > LEVEL / len(CASES)


def test_a_guided_filter_beats_the_bootstrap():
    """The derivatives of a mixture are worth something: a smaller spread at the same cost."""
    spread = [
        np.std(ssm.log_likelihood(
            absent, data_of("absent"), {"p": 0.1}, particles=100, repeats=200, proposal=proposal,
            seed=seed_of("spread", proposal),
        ))
        for proposal in ("guided", "bootstrap")
    ]  # fmt: skip
    assert spread[0] < 0.8 * spread[1]


METHODS = {
    "PGAS": (ssm.PGAS(particles=25), 2000),
    "PMMH": (ssm.PMMH(particles=100), 2500),
}


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("name", ["outliers", "absent", "jumps"])
def test_posterior(name, method):
    """Of the share p, and of a parameter whose prior is a mixture, against grids."""
    data, (settings, draws) = data_of(name, 30), METHODS[method]
    label = f"{name} {method}"
    idata = ssm.sample(
        MODELS[name], data, settings, draws=draws, warmup=500, states=False, progress=False,
        seed=seed_of(label),
    )  # fmt: skip
    posterior = idata["posterior"]
    grids = {
        "p": GridPosterior(
            lambda p: exact(name, data["y"], p) + st.beta.logpdf(p, 2, 8), 1e-10, 1 - 1e-4, 61
        )
    }
    if name == "jumps":
        prior = lambda m: np.log(0.3 * st.norm.pdf(m, -2, 0.5) + 0.7 * st.laplace.pdf(m, 1, 0.5))  # noqa: E731
        grids["m"] = GridPosterior(
            lambda m: prior(m) + st.norm.logpdf(data["z"], m, 3).sum(), -6, 9, 3001
        )
    found = {}
    for k, g in grids.items():
        off = deviations(posterior[k].values, mean=g.mean, sd=g.sd)
        found |= {f"{what} of {k}": v for what, v in off.items()}
    assert_within(found)


def test_what_is_explained():
    """Slices for what is inside of a mixture; nothing is linear and Gaussian."""
    sections = dict(ssm.explain(outliers).sections())
    parameters = dict(sections["Gibbs updates (full conditionals given states and data)"])
    assert "slice sampling" in parameters["p"]
    assert "does not separate in p" in parameters["p"]
    assert "Mixture" in str(sections["Structure"])
    filters = dict(sections["Particle filter"])
    assert filters["guided"].startswith("Laplace")
    assert "no state has a Gaussian transition" in str(
        dict(dict(ssm.explain(jumps).sections())["Particle filter"])["guided"]
    )


def test_smoothing_of_jumps_by_rejection_is_exact():
    """Backward draws need a bound of the transition density: that of the mixture."""
    data = data_of("jumps")
    method = ssm.FFBSi(kernel="rejection")
    found = ssm.smooth(
        jumps, data, {"p": 0.1, "m": 1.0}, method, particles=2000, trajectories=2000,
        seed=seed_of("rejection"),
    )  # fmt: skip
    # means by the point-mass filter and its backward pass
    move, g = jumping(0.1), st.norm.pdf(data["y"][:, None], X, 0.4)
    filtered = [FIRST * g[0]]
    for row in g[1:]:
        filtered.append(row * (move @ filtered[-1] * STEP))
        filtered[-1] /= filtered[-1].sum() * STEP
    later, means = np.ones(len(X)), []
    for t in range(len(g) - 1, -1, -1):
        weight = filtered[t] * later
        means.append(float(weight @ X / weight.sum()))
        later = move.T @ (g[t] * later)
        later /= later.max()
    x = found["x"].values
    # the filter's own error is of the size of 1 / sqrt(particles) posterior spreads
    error = x.std(0) * np.sqrt(1 / 2000 + 1 / 2000) * 3
    assert (np.abs(x.mean(0) - means[::-1]) < 4 * error).all()
