"""SMC^2 against quadrature: evidence without bias, posterior moments, and what it refuses."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

import ssmppl as ssm
from ssmppl import datasets
from ssmppl.inference.chains.sampling import SamplingSetup
from ssmppl.inference.chains.smc2 import Filters, begin, exchange, one_row
from ssmppl.inference.preparation.space import space_of
from ssmppl.inference.run.problem import pose
from tests.models import standard as models
from tests.statistics.checks import LEVEL, mean_one_p, seed_of

LGSS = {"y": datasets.load("lgss_main_text")["y"]}

# One free parameter; k is fixed below, and its prior makes it a datum for m.
tiny = ssm.Model("tiny")
tiny.prior(lambda: {"m": ssm.Normal(0, sd=1)})
tiny.prior(lambda m: {"k": ssm.Normal(m, sd=2)})
tiny.initial(lambda m: {"x": ssm.Normal(m, sd=1)})
tiny.transition(lambda x, m: {"x": ssm.Normal(0.5 * x + m, sd=0.8)})
tiny.observation(lambda x, k: {"y": ssm.Normal(k * x, sd=0.7)})
TINY = [{"y": np.array([0.5, np.nan, 1.2])}, {"y": np.array([0.9, 2.0])}]


def tiny_evidence():
    """By the Kalman likelihood on a grid of m; the trapezoidal rule is exact to rounding here."""
    grid, log_p = tiny_posterior()
    return float(np.logaddexp.reduce(log_p) + np.log(grid[1] - grid[0]))


def tiny_posterior():
    """A grid of m, and log p(y, k, m) on it."""
    grid = np.linspace(-7, 7, 281)
    log_p = [ssm.log_likelihood(tiny, TINY, {"m": m, "k": 1.5})[0] for m in grid]
    return grid, log_p + stats.norm.logpdf(grid) + stats.norm.logpdf(1.5, grid, 2)


@pytest.mark.parametrize(("name", "settings", "runs"), [
    pytest.param("weights alone", {"ess_threshold": 0.0}, 400, marks=pytest.mark.slow),
    pytest.param("moves", {"ess_threshold": 0.95, "acceptance": 0.0}, 400, marks=pytest.mark.slow),
    ("moves and exchanges", {"ess_threshold": 0.95, "acceptance": 1.0}, 80),
])  # fmt: skip
def test_the_evidence_is_unbiased(name, settings, runs):
    """Few particles of either kind, two experiments, a missing row, a fixed parameter's prior."""
    method = ssm.SMC2(parameters=40, particles=4, moves=1, proposal="bootstrap", **settings)
    found = ssm.evidence(tiny, TINY, method, chains=runs, fixed={"k": 1.5},
                         seed=seed_of("smc2", name), progress=False)  # fmt: skip
    if settings.get("acceptance") == 1.0:
        assert min(found.report["particles"]) >= 8
    assert mean_one_p(np.array(found.report["log_evidence_of_runs"]) - tiny_evidence()) > LEVEL


def test_the_evidence_of_a_series(exact_values):
    exact = exact_values["lgss_main_text"]["log_evidence"]
    method = ssm.SMC2(parameters=100, particles=30, proposal="guided")
    found = ssm.evidence(models.lgss, LGSS, method, chains=8, fixed={"c": 0.5},
                         seed=seed_of("smc2", "series"), progress=False)  # fmt: skip
    assert abs(found.log_evidence - exact) < stats.t.isf(LEVEL / 2, 7) * found.standard_error
    assert found.standard_error < 0.4


def test_posterior_moments(exact_values):
    """Mean and variance of each of eight runs, as a sample of independent ones."""
    exact = exact_values["lgss_main_text"]
    idata = ssm.sample(models.lgss, LGSS, ssm.SMC2(particles=30, proposal="guided"), draws=100,
                       chains=8, fixed={"c": 0.5}, seed=seed_of("smc2", "moments"),
                       progress=False)  # fmt: skip
    theta = idata["posterior"]["theta"].values
    assert theta.shape == (8, 100)
    mean, sd = exact["posterior_mean"], exact["posterior_sd"]
    for power, expected in ((1, 0.0), (2, sd**2)):
        runs = ((theta - mean) ** power).mean(axis=1)
        off = abs(runs.mean() - expected)
        assert off < stats.t.isf(LEVEL / 4, 7) * runs.std(ddof=1) / np.sqrt(8)
    attrs = idata["posterior"].attrs
    assert attrs["method"] == "SMC2"
    assert attrs["warmup"] == 0
    assert attrs["log_evidence"] == pytest.approx(exact["log_evidence"], abs=1.5)


def test_the_prior_counts_in_the_moves():
    """Without measurements, six moves leave N(0, 1) times N(1.5; m, 2^2): N(0.3, 0.8)."""
    method = ssm.SMC2(particles=5, moves=6, acceptance=0.0, proposal="bootstrap")
    idata = ssm.sample(tiny, {"y": np.full(3, np.nan)}, method, draws=60, chains=8,
                       fixed={"k": 1.5}, progress=False, seed=seed_of("smc2", "prior"))  # fmt: skip
    m = idata["posterior"]["m"].values
    for power, expected in ((1, 0.3), (2, 0.8 + 0.3**2)):
        runs = (m**power).mean(axis=1)
        off = abs(runs.mean() - expected)
        assert off < stats.t.isf(LEVEL / 4, 7) * runs.std(ddof=1) / np.sqrt(8)
    assert m.var() < 1.6


def test_an_exchange_weighs_by_the_ratio_of_the_likelihoods():
    problem = pose(tiny, TINY)
    held = {"k": np.array(1.5)}
    space = space_of(problem, held, {})
    method = ssm.SMC2(parameters=10, particles=5, ess_threshold=0.0)
    setup, filters = (
        SamplingSetup(problem, space, held, 1, 0, 1, np.random.SeedSequence(1), False),
        Filters(space, method, "bootstrap"),
    )
    state, _, _ = one_row(filters, begin(filters, setup, 0))
    new = exchange(filters, state, 10)
    assert new.size == 10
    ratio = new.log_z - state.log_z
    assert np.ptp(ratio) > 0.1
    np.testing.assert_allclose(new.log_w - state.log_w, ratio)
    mean = np.log(state.weights() @ np.exp(ratio))
    assert new.log_evidence - state.log_evidence == pytest.approx(mean)


def test_a_vector_a_simplex_and_a_seed():
    model = ssm.Model("kinds")
    model.prior(lambda: {"b": ssm.Normal(np.zeros(2), sd=1),
                         "p": ssm.Dirichlet(np.array([2.0, 2.0, 2.0]))})  # fmt: skip
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x, b, p: {"x": ssm.Normal(p[0] * x + b[0], sd=1)})
    model.observation(lambda x, b: {"y": ssm.Poisson(np.exp(0.3 * x + b[1]))})
    data, method = (
        {"y": np.array([1.0, 0.0, 2.0, 3.0])},
        ssm.SMC2(particles=20, proposal="bootstrap"),
    )
    runs = [ssm.sample(model, data, method, draws=30, chains=2, seed=s, progress=False)["posterior"]
            for s in (1, 1, 2)]  # fmt: skip
    assert runs[0]["b"].shape == (2, 30, 2)
    np.testing.assert_allclose(runs[0]["p"].values.sum(axis=-1), 1.0)
    np.testing.assert_array_equal(runs[0]["b"].values, runs[1]["b"].values)
    assert not np.array_equal(runs[0]["b"].values, runs[2]["b"].values)


def test_without_parameters_it_is_the_likelihood():
    values = {"m": 0.4, "k": 1.5}
    exact = ssm.log_likelihood(tiny, TINY, values)[0]
    method = ssm.SMC2(parameters=50, particles=50, proposal="bootstrap")
    found = ssm.evidence(tiny, TINY, method, fixed=values, chains=8, seed=3, progress=False)
    assert abs(found.log_evidence - exact) < stats.t.isf(LEVEL / 2, 7) * found.standard_error


def test_an_interrupted_run_has_nothing_to_give(monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(Filters, "on", interrupted)
    with pytest.raises(KeyboardInterrupt):
        ssm.sample(tiny, TINY, ssm.SMC2(), draws=10, fixed={"k": 1.5}, progress=False)


@pytest.mark.parametrize(("method", "words"), [
    (ssm.SMC2(parameters=1), r"parameters=1"),
    (ssm.SMC2(particles=0), r"particles=0"),
    (ssm.SMC2(parameters=20), r"draws=50 from SMC2\(parameters=20\).*at most 20"),
    (ssm.SMC2(acceptance=2.0), r"acceptance=2\.0"),
    (ssm.SMC2(proposal="auxiliary"), r"'auxiliary' looks ahead"),
])  # fmt: skip
def test_what_is_refused(method, words):
    with pytest.raises(ssm.ArgumentError, match=f"(?s){words}"):
        ssm.sample(tiny, TINY, method, draws=50 if method.parameters != 1 else 1,
                   fixed={"k": 1.5}, progress=False)  # fmt: skip


def test_an_improper_prior_is_refused():
    model = ssm.Model("flat")
    model.prior(lambda: {"a": ssm.Flat()})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x, a: {"x": ssm.Normal(a * x, sd=1)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=1)})
    with pytest.raises(ssm.ArgumentError, match=r"(?s)prior of 'a' is Flat.*improper"):
        ssm.sample(model, {"y": [0.1, 0.2]}, ssm.SMC2(), progress=False)
    with pytest.raises(ssm.ArgumentError, match=r"chains=1"):
        ssm.evidence(tiny, TINY, ssm.SMC2(), chains=1, progress=False)
