"""ISMCMC: its parts, its diagnosis, executors and interrupts; and chains that go on."""

from __future__ import annotations

import os
import signal
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.inference.chains import ismcmc
from ssmppl.inference.chains.ismcmc import LANES, ApproximateRuns, Weighted, joined_lanes
from ssmppl.inference.chains.metropolis_kernel import coordinates, jump_block, metropolis_block
from ssmppl.inference.chains.pmmh import walk
from ssmppl.inference.chains.sampling import SamplingSetup
from ssmppl.inference.methods.methods import MetropolisHastings
from ssmppl.inference.preparation.gaussian_pilot import gaussian_pilot
from ssmppl.inference.preparation.space import space_of
from ssmppl.inference.run.draws import ChainDraws
from ssmppl.inference.run.problem import pose
from ssmppl.inference.verbs import sample as verb
from tests.models import standard as models
from tests.models import wider

QUIET = {"seed": 3, "progress": False}
COUNTS = {"y": ssm.simulate(models.counts, steps=40, seed=1)["y"].values[0].astype(float)}


def setup_of(model, data, warmup=20):
    problem = pose(model, data)
    root = np.random.SeedSequence(4)
    return SamplingSetup(problem, space_of(problem, {}, {}), {}, 1, warmup, 1, root)


def test_jump_chain_is_the_chain_with_its_repetitions_counted():
    setup = setup_of(models.counts, COUNTS)
    found = gaussian_pilot(setup.space, "laplace")
    where = coordinates(setup.space, "unconstrained", None)
    made = walk(
        setup, MetropolisHastings(), ApproximateRuns(found.likelihood(setup.problem)), where,
        found.pilot, "bootstrap", 0, 0.3, gaussian=found,
    )  # fmt: skip
    kernel, (state,) = made.kernel, made.states
    state, _ = metropolis_block(kernel, state, setup.warmup)
    _, jumps = jump_block(kernel, state, 25)
    holding = jumps.stats["holding"].astype(int)
    _, all_of_them = metropolis_block(kernel, state, int(holding.sum()))
    plain = np.concatenate([[state.point.theta], all_of_them.draws["theta"][:-1]])
    np.testing.assert_array_equal(np.repeat(jumps.draws["theta"], holding, axis=0), plain)
    assert holding.max() > 1


def test_lanes_are_put_back_in_the_order_of_the_chain():
    lanes = [
        ChainDraws({"d": np.arange(3.0) * LANES + k}, {"s": np.arange(3) * LANES + k}, {}, None)
        for k in range(LANES)
    ]
    draws, stats = joined_lanes(lanes, 40)
    np.testing.assert_array_equal(draws["d"], np.arange(40.0))
    np.testing.assert_array_equal(stats["s"], np.arange(40))


def test_resampling_keeps_the_order_and_rounds_the_weights():
    rng = np.random.default_rng(1)
    correction, holding = rng.normal(size=200), rng.integers(1, 4, 200).astype(float)
    theta = np.arange(200.0)[:, None]
    weighted = Weighted(theta, holding, correction, {"path_0": theta[:, :, None]}, {})
    drawn = weighted.resampled(setup_of(models.counts, COUNTS), 0)
    index = drawn.draws["theta"][:, 0].astype(int)
    assert np.all(np.diff(index) >= 0)
    expected = holding * np.exp(correction)
    expected *= 200 / expected.sum()
    assert np.all(np.abs(np.bincount(index, minlength=200) - expected) < 1.0)
    np.testing.assert_array_equal(drawn.draws["path_0"][:, 0, 0], index)
    np.testing.assert_allclose(drawn.stats["weight"], expected[index])


def test_no_weight_at_all_is_an_error():
    nothing = Weighted(np.zeros((2, 1)), np.ones(2), np.full(2, -np.inf), {}, {})
    with pytest.raises(ssm.SamplingError, match="no particle filter at any draw"):
        _ = nothing.weights


def test_draws_do_not_depend_on_the_executor_and_repeat_states_with_parameters():
    method, options = ssm.ISMCMC(particles=5), {"draws": 60, "warmup": 50, "chains": 2, **QUIET}
    one = ssm.sample(models.counts, COUNTS, method, **options)
    with ThreadPoolExecutor(3) as pool:
        other = ssm.sample(models.counts, COUNTS, method, executor=pool, **options)
    for name in ("mu", "phi", "tau", "x"):
        np.testing.assert_array_equal(one["posterior"][name], other["posterior"][name])
    assert one["posterior"]["x"].shape == (2, 60, 40)
    same = np.diff(one["posterior"]["mu"].values, axis=1) == 0.0
    assert np.all(same == np.all(np.diff(one["posterior"]["x"].values, axis=1) == 0.0, axis=2))
    stats = one["sample_stats"]
    exact, approximate = "log_marginal_likelihood", "approximate_log_marginal_likelihood"
    assert set(stats) == {"lp", exact, approximate, "weight"}
    rows = one["log_likelihood"]["one_step"]
    assert rows.shape == (2, 60, 40)
    sums = rows.sum("time")
    np.testing.assert_allclose(sums, stats[exact])


def test_ctrl_c_returns_the_first_draws(monkeypatch):
    calls = []
    plain = ismcmc.correct_block

    def pressed(correction, lane, n):
        calls.append(n)
        if len(calls) == 3 * LANES:
            os.kill(os.getpid(), signal.SIGINT)
        return plain(correction, lane, n)

    monkeypatch.setattr(ismcmc, "correct_block", pressed)
    idata = ssm.sample(
        models.counts, COUNTS, ssm.ISMCMC(particles=5), draws=2000, warmup=20, chains=1, **QUIET
    )
    attrs = idata["posterior"].attrs
    assert attrs["interrupted"]
    assert 0 < idata["posterior"].sizes["draw"] < 2000
    assert "weights_warning" not in attrs


def test_weights_are_even_where_the_approximation_is_exact():
    y = ssm.simulate(models.stationary, steps=40, seed=2)["y"].values[0]
    idata = ssm.sample(
        models.stationary, {"y": y}, ssm.ISMCMC(particles=32), draws=100, warmup=100, chains=2,
        states=False, **QUIET,
    )  # fmt: skip
    assert idata["posterior"].attrs["weights_ess_share"] > 0.95
    assert "x" not in idata["posterior"]


def test_a_poor_approximation_is_told():
    """y = x^2 / 20 leaves the sign of x open: two modes, of which Laplace's sees one."""
    y = ssm.simulate(wider.growth, steps=60, seed=1)["y"].values[0]
    with pytest.warns(UserWarning, match="the approximation is poor"):
        idata = ssm.sample(
            wider.growth, {"y": y}, ssm.ISMCMC(particles=32), draws=100, warmup=100, chains=2,
            states=False, **QUIET,
        )  # fmt: skip
    attrs = idata["posterior"].attrs
    assert attrs["weights_ess_share"] < 0.2
    assert "few distinct draws" in attrs["weights_warning"]


def test_what_has_no_approximation_is_refused():
    model = ssm.Model("jumps")
    model.prior(lambda: {"q": ssm.Gamma(2, rate=1)})
    model.initial(lambda: {"n": ssm.Poisson(3)})
    model.transition(lambda n, q: {"n": ssm.Poisson(q + 0.5 * n)})
    model.observation(lambda n: {"y": ssm.Normal(n, sd=1)})
    for method in (ssm.ISMCMC(), ssm.PMMH(delayed_acceptance=True)):
        with pytest.raises(ssm.ArgumentError, match=type(method).__name__.lower()[:2] + "|delayed"):
            ssm.sample(model, {"y": np.ones(5)}, method, draws=5, warmup=5, **QUIET)


def test_runs_too_short_to_meet_the_rule_do_not_go_on(monkeypatch):
    """What they return could not have the effective sample sizes however long they went on."""
    y = ssm.simulate(models.stationary, steps=20, seed=2)["y"].values[0]
    monkeypatch.setattr(verb, "have_converged", lambda chains, free: False)
    options = {"warmup": 30, "chains": 2, "states": False, **QUIET}
    short = ssm.sample(models.stationary, {"y": y}, draws=399, **options)
    assert "further_draws" not in short["posterior"].attrs
    long = ssm.sample(models.stationary, {"y": y}, draws=400, **options)
    assert long["posterior"].attrs["further_draws"] == 8 * 400


@pytest.mark.parametrize("kept", [False, True], ids=["in memory", "checkpoint"])
def test_chains_that_have_not_converged_go_on(monkeypatch, tmp_path, kept):
    y = ssm.simulate(models.stationary, steps=20, seed=2)["y"].values[0]
    options = {"warmup": 30, "chains": 2, "states": False, **QUIET}
    monkeypatch.setattr(verb, "have_converged", lambda chains, free: False)
    monkeypatch.setattr(verb, "LEAST_TO_GO_ON", 80)
    path = tmp_path / "a.npz" if kept else None
    found = ssm.sample(models.stationary, {"y": y}, draws=40, checkpoint=path, **options)
    assert found["posterior"].attrs["further_draws"] == 8 * 40
    method = getattr(ssm, found["posterior"].attrs["method"])()
    if isinstance(method, ssm.Gibbs):
        method = ssm.Gibbs(interweave="auto")
    longer = ssm.sample(models.stationary, {"y": y}, method, draws=9 * 40, **options)
    for name in ("phi", "tau"):
        expected = longer["posterior"][name].values[:, 40::8]
        np.testing.assert_array_equal(found["posterior"][name].values, expected)
    if kept:
        again = ssm.sample(models.stationary, {"y": y}, draws=40, checkpoint=path, **options)
        np.testing.assert_array_equal(found["posterior"]["tau"], again["posterior"]["tau"])
