"""Posteriors of models made of laws of a user's own, against sums over grids."""

import numpy as np
import pytest
from scipy import stats

import ssmppl as ssm
from tests.language.user_defined.user_defined_laws import Gumbel, OwnGamma, Yule
from tests.statistics.checks import assert_within, deviations, seed_of

PHI, STEP = 0.7, 0.4
X = np.linspace(-6.0, 14.0, 1601)
S = np.linspace(0.01, 3.0, 200)


def of_gumbels():
    """A law of one's own as prior, initial law, transition and observation."""
    model = ssm.Model("gumbels")
    model.prior(lambda: {"s": OwnGamma(4.0, rate=8.0)})
    model.initial(lambda: {"x": Gumbel(0.0, 1.0)})
    model.transition(lambda x: {"x": Gumbel(PHI * x, STEP)})
    model.observation(lambda x, s: {"y": Gumbel(x, s)})
    return model


def of_counts():
    """Counts of a heavy tail, whose exponent follows the state."""
    model = ssm.Model("counts")
    model.prior(lambda: {"s": OwnGamma(4.0, rate=8.0)})
    model.initial(lambda: {"x": Gumbel(0.0, 1.0)})
    model.transition(lambda x: {"x": Gumbel(PHI * x, STEP)})
    model.observation(lambda x, s: {"y": Yule(1.0 + s * np.exp(0.5 * x))})
    return model


def log_gumbel(y, s):
    return lambda x: stats.gumbel_r.logpdf(y, x, s)


def log_yule(y, s):
    return lambda x: stats.yulesimon.logpmf(y + 1, 1.0 + s * np.exp(0.5 * x))


def on_grid(y, log_density, grid=S):
    """Moments of s and of x_T, and log p(y | s) on the grid of s, by the trapezoidal rule."""
    dx = X[1] - X[0]
    step = stats.gumbel_r.pdf(X[:, None], PHI * X, STEP) * dx
    log_z, mean, square = np.empty((3, len(grid)))
    for k, s in enumerate(grid):
        alpha, log_z[k] = stats.gumbel_r.pdf(X, 0.0, 1.0) * dx, 0.0
        for t, one in enumerate(y):
            alpha = (step @ alpha if t else alpha) * np.exp(log_density(one, s)(X))
            log_z[k] += np.log(alpha.sum())
            alpha /= alpha.sum()
        mean[k], square[k] = alpha @ X, alpha @ X**2
    p = np.exp(log_z - log_z.max()) * stats.gamma.pdf(grid, 4.0, scale=1 / 8)
    p /= p.sum()
    moments = {}
    for name, first, second in (("s", grid, grid**2), ("x", mean, square)):
        m = p @ first
        moments[name] = m, np.sqrt(p @ second - m**2)
    return moments, log_z


CASES = [
    (of_gumbels, log_gumbel, [0.5, 0.1, 1.4, 0.9, 2.2, 0.3]),
    (of_counts, log_yule, [0.0, 2.0, 0.0, 1.0, 7.0, 0.0]),
]


@pytest.mark.parametrize(("model", "log_density", "y"), CASES, ids=["gumbels", "counts"])
def test_likelihoods_are_those_of_a_grid(model, log_density, y):
    _, (log_z,) = on_grid(y, log_density, np.array([0.6]))
    found = ssm.log_likelihood(
        model(), {"y": y}, {"s": 0.6}, particles=5000, repeats=40, seed=seed_of("written", y)
    )
    ratio = np.exp(found - log_z)
    assert abs(ratio.mean() - 1.0) < 4 * ratio.std(ddof=1) / np.sqrt(len(ratio))


@pytest.mark.slow
@pytest.mark.parametrize(("model", "log_density", "y"), CASES, ids=["gumbels", "counts"])
@pytest.mark.parametrize("method", [ssm.PGAS(particles=30), ssm.PMMH()], ids=["PGAS", "PMMH"])
def test_posteriors_are_those_of_a_grid(method, model, log_density, y):
    moments, _ = on_grid(y, log_density)
    posterior = ssm.sample(
        model(), {"y": y}, method, draws=4000, warmup=500, chains=4,
        seed=seed_of("written", type(method).__name__, y), progress=False,
    )["posterior"]  # fmt: skip
    found = {}
    for name, draws in (("s", posterior["s"].values), ("x", posterior["x"].values[..., -1])):
        mean, sd = moments[name]
        found |= {f"{name} {k}": v for k, v in deviations(draws, mean=mean, sd=sd).items()}
    assert_within(found)
