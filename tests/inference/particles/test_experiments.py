"""Many data sets in one compiled pass, against one after the other."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import integrate, stats

import ssmppl as ssm
from ssmppl.codegen.kernels.data_sets.each import filter_each
from ssmppl.codegen.native.entries import ByAddress, over_data_sets
from ssmppl.errors import SamplingError
from ssmppl.inference.chains.gibbs_updates import (
    GibbsUpdates,
    draw_parameters,
    log_joint,
    plan_updates,
)
from ssmppl.inference.chains.interweaving import NoiseMove, noises
from ssmppl.inference.chains.pgas import SweepSetup, csmc_settings, run_conditional_smc
from ssmppl.inference.particles.filtering import FilterSettings, log_likelihood_estimate
from ssmppl.inference.run.problem import EndToEnd, pose
from ssmppl.inference.run.seeds import random_state, seed_sequence
from ssmppl.inference.updates import draw_update
from tests.statistics.checks import seed_of

LENGTHS = (4, 1, 7, 4, 12)
THETA = np.array([0.3, 0.7, 0.5])


def counts():
    """A stationary log intensity, and its value of the row before."""
    model = ssm.Model("counts of a panel")
    model.prior(lambda: {
        "mu": ssm.Normal(0, sd=1), "phi": ssm.Uniform(-1, 1), "q": ssm.InverseGamma(3, scale=1),
    })  # fmt: skip
    model.initial(lambda mu, phi, q: {
        "x": ssm.Normal(mu, variance=q / (1 - phi**2)), "old": ssm.Dirac(0.0),
    })  # fmt: skip
    model.transition(lambda x, mu, phi, q: {
        "x": ssm.Normal(mu + phi * (x - mu), variance=q), "old": ssm.Dirac(x),
    })  # fmt: skip
    model.observation(lambda x: {"y": ssm.Poisson(np.exp(x))})
    return model


def panel(lengths=LENGTHS):
    rng = np.random.default_rng(seed_of("panel", str(len(lengths))))
    out = [{"y": rng.poisson(1.5, n).astype(float)} for n in lengths]
    out[2]["y"][-1] = np.nan
    return out


@pytest.fixture(scope="module")
def problem():
    return pose(counts(), panel())


def alone(problem):
    """The same program with each data set by itself."""
    return [replace(problem, experiments=(e,)) for e in problem.experiments]


def a_path(problem):
    rng = np.random.default_rng(1)
    return [rng.normal(size=(e.steps, 2)) for e in problem.experiments]


def new_stream():
    return random_state(seed_sequence(seed_of("stream")))


def test_rows_end_to_end(problem):
    every = problem.end_to_end
    assert np.diff(every.first).tolist() == list(LENGTHS)
    for e, y in zip(problem.experiments, every.split(every.y), strict=True):
        np.testing.assert_array_equal(y, e.y)
    single = alone(problem)[2]
    assert EndToEnd.of(single.experiments).y is single.experiments[0].y


@pytest.mark.parametrize("threshold", [1.0, 0.5])
@pytest.mark.parametrize("proposal", ["bootstrap", "guided"])
def test_a_filter_of_all_is_the_filters_of_each(problem, proposal, threshold):
    settings = FilterSettings(40, proposal, ess_threshold=threshold)
    stream, other = new_stream(), new_stream()
    found = log_likelihood_estimate(problem, THETA, settings, stream)
    assert found == sum(log_likelihood_estimate(p, THETA, settings, other) for p in alone(problem))
    np.testing.assert_array_equal(stream, other)


def test_without_addresses_the_loop_is_pythons(problem):
    run = problem.program.entry("filter_bootstrap")
    assert isinstance(run, ByAddress)
    found = []
    for one in (run, lambda *arguments: run(*arguments)):
        increments, ess = np.empty(problem.rows), np.empty(problem.rows)
        given = THETA, *problem.end_to_end.data, 40, None, 1.0, new_stream(), increments, ess
        assert over_data_sets(filter_each, one)(*given)[0] == 0
        found.append(increments)
    np.testing.assert_array_equal(*found)


def test_sweeps_of_all_are_the_sweeps_of_each(problem):
    settings = csmc_settings(problem, 15, "bootstrap")
    paths, apart = a_path(problem), a_path(problem)
    stream, other = new_stream(), new_stream()
    rates = run_conditional_smc(SweepSetup(problem, (), settings), THETA, paths, stream)
    each = []
    for p, path in zip(alone(problem), apart, strict=True):
        own = [path]
        each.append(run_conditional_smc(SweepSetup(p, (), settings), THETA, own, other))
        np.testing.assert_array_equal(paths[len(each) - 1], own[0])
    np.testing.assert_allclose(rates, np.mean(each, axis=0), rtol=1e-14)
    np.testing.assert_array_equal(stream, other)


def test_what_is_deterministic_is_set_in_every_path(problem):
    paths, apart = a_path(problem), a_path(problem)
    found = log_joint(GibbsUpdates(problem, ()), THETA, paths)
    prior = float(problem.program.entry("log_prior")(THETA))
    each = [
        log_joint(GibbsUpdates(p, ()), THETA, [x]) - prior
        for p, x in zip(alone(problem), apart, strict=True)
    ]
    assert found == pytest.approx(prior + sum(each), rel=1e-13)
    for path, other in zip(paths, apart, strict=True):
        np.testing.assert_array_equal(path, other)
        np.testing.assert_array_equal(path[1:, 1], path[:-1, 0])


@pytest.mark.parametrize("steered", [False, True])
def test_moves_of_all_are_the_moves_of_each(problem, steered):
    found, paths = noises(problem.trace, problem.program.missing), a_path(problem)
    log_joint(GibbsUpdates(problem, ()), THETA, paths)
    move = NoiseMove(problem, found, steered, THETA)
    value, held = move.stand(THETA, paths)
    other = THETA + [0.1, -0.1, 0.05]
    there, moved = move.at(other, held, paths)
    values = np.zeros(2)
    for p, path, end, noise in zip(
        alone(problem), paths, moved, problem.end_to_end.split(held), strict=True
    ):
        single = NoiseMove(p, found, steered, THETA)
        own, kept = single.stand(THETA, [path])
        np.testing.assert_array_equal(kept, noise)
        beyond, (new,) = single.at(other, kept, [path])
        np.testing.assert_array_equal(new, end)
        values += own, beyond
    np.testing.assert_allclose([value, there], values, rtol=1e-13)


def test_a_row_that_cannot_be_is_that_of_its_data_set():
    model = ssm.Model("strict")
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(x, sd=1)})
    model.observation(lambda x: {"y": ssm.Uniform(x - 1, x + 1)})
    data = [{"y": [0.5] * 3}, {"y": [0.5, 0.5, 99.0]}]
    strict = pose(model, data)
    settings = csmc_settings(strict, 5, "bootstrap")
    paths = [np.zeros((3, 1)), np.zeros((3, 1))]
    with pytest.raises(SamplingError, match=r"t=3, where y = 99"):
        run_conditional_smc(SweepSetup(strict, (), settings), np.empty(0), paths, new_stream())


def test_many_initial_laws_leave_rejection_to_slices(monkeypatch):
    """Their correction has next to no chance where the others would lead; what is drawn instead has
    the conditional for its law."""
    problem = pose(counts(), panel((3,) * 100))
    updates = plan_updates(problem, {"mu": np.zeros(()), "q": np.ones(())})
    steps, rng = GibbsUpdates(problem, updates), np.random.default_rng(seed_of("hopeless"))
    paths = [0.6 * rng.normal(size=(3, 2)) for _ in problem.experiments]
    log_joint(steps, THETA, paths)
    drawn, seen, draw = [], [], draw_update.UpdateSampler.draw

    def noted(*arguments):
        value, info = draw(*arguments)
        seen.append(info)
        return value, info

    monkeypatch.setattr(draw_update.UpdateSampler, "draw", noted)
    theta = np.array([0.0, 0.7, 0.1])
    for _ in range(4000):
        draw_parameters(steps, theta, paths, rng)
        drawn.append(theta[1])

    grid = np.linspace(-0.999, 0.999, 2001)
    density = np.array([log_joint(steps, np.array([0.0, v, 0.1]), paths) for v in grid])
    cdf = integrate.cumulative_simpson(np.exp(density - density.max()), x=grid, initial=0.0)
    u = np.interp(drawn, grid, cdf / cdf[-1])
    # slices are a chain: every tenth draw is taken for independent
    assert stats.kstest(u[::10], "uniform").pvalue > 1e-4
    assert {i.tries for i in seen if i.route == "slice"} <= {draw_update.LOOK, 100}
    assert any(i.tries == draw_update.LOOK for i in seen)
