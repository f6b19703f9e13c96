"""The M-step over trajectories: where there is a closed form, that; where not, a stationary top."""

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.data import check_parameters
from ssmppl.inference.maximum.m_step import maximise_over_paths, maximiser
from tests.inference.maximum.test_em import setup_of
from tests.models import em as em_models
from tests.statistics.checks import seed_of

closed = ssm.Model("closed")


@closed.prior
def closed_prior():
    return {"a": ssm.Normal(0, sd=1), "q": ssm.Gamma(2, rate=1), "r": ssm.Gamma(3, rate=2)}


@closed.initial
def closed_initial():
    return {"x": ssm.Normal(0, sd=1)}


@closed.transition
def closed_transition(x, a, q):
    return {"x": ssm.Normal(a * np.sin(x), precision=q)}


@closed.observation
def closed_observation(x, r):
    return {"y": ssm.Poisson(r * np.exp(x))}


def trajectories(seed, counts, m=12):
    """Of each experiment (M, T, 1), and weights of the M, one of them negative."""
    rng = np.random.default_rng(seed)
    paths = [0.3 * np.cumsum(rng.standard_normal((m, n, 1)), axis=1) for n in counts]
    weights = rng.uniform(0.5, 1.5, m)
    weights[3] = -0.1
    return paths, weights / weights.sum()


@pytest.mark.parametrize("objective", ["likelihood", "posterior"])
@pytest.mark.parametrize("start", [(0.5, 1.0, 1.0), (-3.0, 0.01, 40.0)])
def test_the_closed_form(objective, start):
    """Where the density separates, the derived M-step is the exact answer; near and far starts."""
    rng = np.random.default_rng(seed_of("closed form"))
    data = [{"y": rng.poisson(2.0, n).astype(float)} for n in (20, 35)]
    data[0]["y"][4] = np.nan
    setup = setup_of(closed, data, objective=objective)
    maximum = maximiser(setup, "ParticleEM")
    theta = check_parameters(setup.problem.trace, dict(zip("aqr", start, strict=True)))
    paths, w = trajectories(seed_of("closed form"), (20, 35))
    exact = maximum.q.maximise(maximum.statistics(theta, paths, [w, w]), theta)
    found = maximise_over_paths(
        setup.transform, maximum.scores, paths, w, setup.space_at(theta), objective == "posterior"
    )
    np.testing.assert_allclose(found, exact, rtol=1e-6)


@pytest.mark.parametrize("objective", ["likelihood", "posterior"])
def test_what_does_not_separate(objective, monkeypatch):
    """The log density of the generated program, which knows no derivatives, is flat there; BFGS,
    for laws without second derivatives, ends at the same place."""
    rng = np.random.default_rng(seed_of("decay climb"))
    data = {"y": rng.standard_normal(30), "dt": rng.uniform(0.1, 2.0, 30)}
    setup = setup_of(em_models.decay, data, objective=objective)
    maximum = maximiser(setup, "ParticleEM")
    paths, _ = trajectories(seed_of("decay climb"), (30,))
    start = check_parameters(setup.problem.trace, {"k": 2.0, "s": 4.0})

    def mean(z):
        theta, _ = setup.space.parameters(z)
        prior = setup.transform.at(z).log_prior if objective == "posterior" else 0.0
        return float(maximum.scores.log_density(theta, paths).mean()) + prior

    found = maximum.from_paths(start, paths, np.zeros((1, 1)))
    top = setup.space_at(found)
    for step in 1e-3 * np.eye(2):
        up, down = mean(top + step), mean(top - step)
        curvature = (up - 2.0 * mean(top) + down) / 1e-6
        assert curvature < 0.0
        off = (up - down) / 2e-3 / -curvature
        assert abs(off) < 1e-4 / np.sqrt(-curvature) + 1e-6, "not the top"
    monkeypatch.setattr(type(maximum.scores), "twice", False)
    again = maximum.from_paths(start, paths, np.zeros((1, 1)))
    np.testing.assert_allclose(again, found, rtol=1e-4)
