"""Scales unbounded at zero, and components that are missing: posteriors against importance
sampling by likelihoods of their own, in Monte Carlo standard errors of both."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

import ssmppl as ssm

from .checks import LEVEL, mcse_mean, seed_of, some
from .scales_at_zero import (
    QUANTITIES,
    TRUE,
    data,
    importance,
    kalman,
    model,
    particles,
    quantities,
    unconstrained,
)

SEEDS = 10
OTHERS = {False: 20_000, True: 3_000}  # draws of the importance sampler
LEAST_ESS = 100.0


def deviations(nonlinear: bool, method, seed: int, **options) -> np.ndarray:
    """(12,) of the means and mean squares of the quantities, in standard errors of both."""
    y = data(seed, nonlinear)
    posterior = ssm.sample(
        model(nonlinear), {"y": y}, method, seed=seed, states=False, progress=False, **options
    ).posterior
    q = quantities(*(posterior[n].values for n in ("s", "rho", "S")))
    assert q[..., :2].min() > 1e-12  # the density of s is finite at 0
    rng = np.random.default_rng(seed_of("scales at zero", nonlinear, seed))

    def log_likelihood(points):
        if not nonlinear:
            return kalman(y, points)
        pieces = np.array_split(points, 20)
        return np.concatenate([particles(y, piece, rng, 100) for piece in pieces])

    near = unconstrained(q.reshape(-1, len(QUANTITIES)))
    exact = importance(log_likelihood, near, OTHERS[nonlinear], rng)
    assert exact.ess > LEAST_ESS
    out = []
    for power in (1, 2):
        mean, error = exact.mean(exact.q**power)
        for k in range(len(QUANTITIES)):
            own = q[..., k] ** power
            out.append((own.mean() - mean[k]) / np.hypot(mcse_mean(own), error[k]))
    print(f"seed {seed}: ESS of the others {exact.ess:.0f}, deviations {np.round(out, 2)}")
    return np.array(out)


def assert_small(found: np.ndarray, tables: int = 1) -> None:
    """Bonferroni at LEVEL over all of them, and over the tables of this kind."""
    limit = stats.norm.isf(LEVEL / (2 * found.size * tables))
    assert np.abs(found).max() < limit, (limit, np.round(found, 1))


def test_the_likelihood_of_the_oracle():
    """The filter of the linear model against the package's own."""
    y = data(0, nonlinear=False)
    q = quantities(TRUE["s"], TRUE["rho"], TRUE["S"])[None]
    found = ssm.log_likelihood(
        model(False), {"y": y}, {n: np.array(v) for n, v in TRUE.items()}, proposal="kalman"
    )
    assert kalman(y, q)[0] == pytest.approx(found[0], rel=1e-9)


@pytest.mark.slow
def test_the_particles_of_the_oracle():
    """Of the other model, whose likelihood both estimate without bias."""
    q = quantities(TRUE["s"], TRUE["rho"], TRUE["S"])[None]
    y = data(0, nonlinear=True)
    rng = np.random.default_rng(seed_of("particles"))
    log_z = particles(y, np.repeat(q, 100, axis=0), rng)
    found = ssm.log_likelihood(
        model(True), {"y": y}, {n: np.array(v) for n, v in TRUE.items()}, repeats=100, seed=1,
        proposal="guided",
    )  # fmt: skip
    means = [np.exp(v - log_z.max()) for v in (log_z, found)]
    error = np.hypot(*(m.std(ddof=1) / np.sqrt(len(m)) for m in means))
    assert abs(means[0].mean() - means[1].mean()) < 4.0 * error


@pytest.mark.parametrize("interweave", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.filterwarnings("ignore:the chains")  # the errors know how far they are
def test_gibbs_with_scales_at_zero(interweave):
    """It fell to a scale of 1e-170 and below, whose square is 0, and never came back."""
    method = ssm.Gibbs(interweave=interweave)
    assert_small(deviations(False, method, 2, draws=300, warmup=200))


@pytest.mark.slow
@pytest.mark.parametrize("seed", some(range(SEEDS), 5, pytest.mark.exhaustive))
@pytest.mark.parametrize("nonlinear", [False, True])
@pytest.mark.filterwarnings("ignore:the chains")
def test_ten_seeds_with_scales_at_zero(nonlinear, seed):
    """Of 2000 draws: near zero the scales mix slowly given the states, and the error of a mean over
    few effective draws is not known."""
    method = ssm.PGAS() if nonlinear else ssm.Gibbs()
    assert_small(deviations(nonlinear, method, seed, draws=2000), tables=2 * SEEDS)
