"""Particle EM and particle SAEM: unbiased statistics, the exact maximum within stated errors."""

import pickle
from functools import partial

import numpy as np
import pytest
from scipy import stats

import ssmppl as ssm
from ssmppl.data import check_parameters
from ssmppl.datasets import ice_varves, load
from ssmppl.inference.chains.pgas import SweepSetup, csmc_settings, start_chain
from ssmppl.inference.maximum.em import ExactSteps
from ssmppl.inference.maximum.m_step import fixed_point, maximiser, ratio_weights
from ssmppl.inference.maximum.particle_em import climb as climb_particle_em
from ssmppl.inference.maximum.psaem import (
    PSAEMState,
    averaged_sweep,
    climb,
    saem_block,
    step_size,
)
from ssmppl.inference.particles.filtering import FilterSettings
from ssmppl.inference.run.seeds import random_state
from tests.inference.maximum.test_em import setup_of
from tests.models import em as em_models
from tests.models import standard as models
from tests.models.em import simulated
from tests.statistics.checks import LEVEL, mcse_mean, seed_of, some

SWEEPS = {"chains": 4, "dropped": 100, "kept": 3000}


def started(setup, theta, settings, *seed):
    root = np.random.SeedSequence(seed_of(*seed))
    sweep = SweepSetup(setup.problem, (), settings)
    begun = start_chain(sweep, theta, np.random.default_rng(root), random_state(root))
    return begun.paths, begun.stream


@pytest.mark.parametrize(
    "proposal", [pytest.param("bootstrap", marks=pytest.mark.slow), "auxiliary"]
)
@pytest.mark.parametrize("name", [pytest.param("lgss", marks=pytest.mark.slow), "companion"])
def test_mean_over_all_paths_has_the_expectation_of_the_drawn_one(name, proposal):
    """At a fixed theta, sweep by sweep, against the exact smoother; five particles.

    For the AR(2) the reference's ancestors are drawn with its deterministic component in mind.
    """
    model, parameters = {
        "lgss": (models.lgss, {"theta": 1.3, "c": 0.8}),
        "companion": (em_models.companion, em_models.COMPANION),
    }[name]
    data = simulated(model, parameters, 10, seed_of("sweeps", name), 0.2)
    setup = setup_of(model, data)
    theta = check_parameters(setup.problem.trace, parameters)
    maximum, settings = maximiser(setup, "PSAEM"), FilterSettings(5, proposal)
    exact = ExactSteps(setup, setup.kalman).statistics(theta)
    averaged, drawn = [], []
    for chain in range(SWEEPS["chains"]):
        paths, stream = started(setup, theta, settings, "sweeps", name, proposal, chain)
        rows = []
        for _ in range(SWEEPS["dropped"] + SWEEPS["kept"]):
            mean, paths, _ = averaged_sweep(maximum, settings, theta, paths, stream)
            alone = maximum.statistics(theta, [p[None] for p in paths], [np.ones(1)])
            rows.append((mean, alone))
        averaged.append([a for a, _ in rows[SWEEPS["dropped"] :]])
        drawn.append([b for _, b in rows[SWEEPS["dropped"] :]])
    varying = np.std(drawn, axis=(0, 1)) > 1e-9
    limit = stats.norm.isf(LEVEL / (2 * 2 * varying.sum() * 4))
    for kind in (averaged, drawn):
        found = np.array(kind)
        np.testing.assert_allclose(found.mean(axis=(0, 1))[~varying], exact[~varying], atol=1e-9)
        for i in np.flatnonzero(varying):
            z = (found[..., i].mean() - exact[i]) / mcse_mean(found[..., i])
            assert abs(z) <= limit, (i, z)
    assert np.all(np.var(averaged, axis=(0, 1))[varying] < np.var(drawn, axis=(0, 1))[varying])


def test_paths_and_weights_of_a_sweep():
    """The drawn path is one of the N, with their weights; asking for all changes nothing."""
    setup = setup_of(models.lgss, {"y": load("lgss_appendix")["y"]})
    theta, settings = np.array([0.8, 1.0]), FilterSettings(6, "bootstrap")
    (path,), stream = started(setup, theta, settings, "paths")
    (e,) = setup.problem.experiments
    run = setup.problem.program.entry("conditional_smc_bootstrap")
    paths, weights, figures = np.empty((6, *path.shape)), np.empty(6), np.empty(2)
    first, second = np.empty_like(path), np.empty_like(path)
    streams = stream.copy(), stream.copy()
    run(theta, e.y, e.seen, e.u, 6, streams[0], path, first, figures, paths, weights)
    run(theta, e.y, e.seen, e.u, 6, streams[1], path, second, figures)
    np.testing.assert_array_equal(first, second)
    np.testing.assert_array_equal(*streams)
    assert weights.sum() == pytest.approx(1.0)
    same = [k for k in range(6) if np.array_equal(paths[k], first)]
    assert same
    assert weights[same].sum() > 0.0
    density = stats.norm.logpdf(e.y[-1, 0], paths[:, -1, 0], np.sqrt(0.1))  # a bootstrap's weight
    np.testing.assert_allclose(weights, np.exp(density) / np.exp(density).sum(), rtol=1e-9)


def test_step_sizes():
    method = ssm.PSAEM(burn_in=10, exponent=0.7)
    sizes = np.array([step_size(k, method) for k in range(1, 10_001)])
    assert np.all(sizes[:10] == 1.0)
    np.testing.assert_allclose(sizes[19], 2.0**-0.7)
    assert np.all(np.diff(sizes) <= 0.0)


def test_blocks_neither_depend_on_their_borders_nor_on_the_process():
    setup = setup_of(models.lgss, {"y": load("lgss_appendix")["y"]}, fixed={"c": 1.0})
    method = ssm.PSAEM(particles=8, burn_in=5)
    maximum = maximiser(setup, "PSAEM")
    settings = csmc_settings(setup.problem, method.particles, method.proposal)
    theta = np.array([2.0, 1.0])
    paths, stream = started(setup, theta, settings, "blocks")
    state = PSAEMState(theta, paths, stream, np.empty(0), 0)
    whole, block = saem_block(maximum, settings, method, state, 9)
    task = pickle.loads(pickle.dumps(partial(saem_block, maximum, settings, method)))
    half, first = task(state, 4)
    other, second = task(pickle.loads(pickle.dumps(half)), 5)
    found = np.concatenate([first.draws["theta"], second.draws["theta"]])
    np.testing.assert_array_equal(found, block.draws["theta"])
    np.testing.assert_array_equal(other.statistics, whole.statistics)


# -- the maximum
def assert_maximum(found, exact, chains, worst):
    """Within the stated errors, by Student's t over the chains; and the errors small enough."""
    assert found.attrs["converged"], found.attrs
    errors = found.attrs["monte_carlo_errors"]
    names = [n for n in exact if n in found.standard_errors]
    flat = {}
    for name in names:
        for index in np.ndindex(np.shape(exact[name])):
            label = name + (f"[{', '.join(map(str, index))}]" if index else "")
            difference = np.asarray(found.parameters[name])[index] - np.asarray(exact[name])[index]
            flat[label] = difference / errors[label]
            deviation = np.asarray(found.standard_errors[name])[index]
            assert errors[label] < worst * deviation, (label, errors[label], deviation)
    limit = stats.t.isf(LEVEL / (2 * len(flat)), chains - 1)
    print({k: f"{v:+.2f}" for k, v in flat.items()}, f"of {limit:.2f} Monte Carlo errors")
    assert max(map(abs, flat.values())) <= limit, flat


METHODS = {
    "PSAEM": ssm.PSAEM(particles=10, iterations=400, burn_in=40, chains=8),
    "ParticleEM": ssm.ParticleEM(
        particles=200, trajectories=60, iterations=40, burn_in=10, chains=8, proposal="bootstrap"
    ),
}


@pytest.mark.parametrize("method", METHODS)
def test_linear_gaussian_series(method):
    data = {"y": load("lgss_appendix")["y"]}
    found = ssm.maximize(
        models.lgss, data, METHODS[method], fixed={"c": 1.0}, progress=False,
        seed=seed_of("series", method),
    )  # fmt: skip
    assert_maximum(found, {"theta": 0.830220361678073}, 8, worst=0.1)
    assert "closed form" in found.attrs["m_step"]


def direct(model, data, **options):
    """The exact maximum."""
    best = ssm.maximize(model, data, ssm.DirectOptimization(), progress=False, seed=1, **options)
    return best.parameters


@pytest.mark.parametrize("name", some(["echo", "vehicle"], 1))
def test_parameter_of_a_deterministic_state_by_its_noisy_ones(name):
    """Given all states g and h could not move; with the noisy ones as missing data they do.

    EM for the step h of the position nears its limit by one per cent a step: iterates are far from
    it, the fixed point is told by how they move, and the stated error is large.
    """
    model, truth, steps, worst = {
        "echo": (models.echo, {"g": 0.5}, 40, 0.2),
        "vehicle": (models.vehicle, {"h": 0.4}, 20, 2.0),
    }[name]
    data = simulated(model, truth, steps, seed_of(name))
    method = METHODS["ParticleEM"]
    found = ssm.maximize(model, data, method, progress=False, seed=seed_of(name, "em"))
    assert_maximum(found, direct(model, data), 8, worst)
    assert "Dirac" in found.attrs["m_step"]


@pytest.mark.slow
def test_a_density_that_does_not_separate():
    dt = np.random.default_rng(1).uniform(0.1, 2.0, 80)
    data = simulated(em_models.decay, em_models.DECAY, 80, seed_of("decay"), 0.1, {"dt": dt})
    found = ssm.maximize(
        em_models.decay, data, METHODS["ParticleEM"], progress=False, seed=seed_of("decay", "em")
    )
    assert_maximum(found, direct(em_models.decay, data), 8, worst=0.2)


def test_posterior_mode():
    data = {"y": load("lgss_appendix")["y"][:30]}
    options = {"fixed": {"theta": 1.0}, "objective": "posterior"}
    found = ssm.maximize(
        models.lgss, data, METHODS["PSAEM"], progress=False, seed=seed_of("mode"), **options
    )
    assert_maximum(found, {"c": direct(models.lgss, data, **options)["c"]}, 8, worst=0.2)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["regression", "two states"])
@pytest.mark.parametrize("method", METHODS)
def test_inputs_missing_values_several_experiments(method, name):
    seed, fixed = seed_of("experiments", name), {}
    if name == "regression":
        model, truth = models.regression, {"a": 0.6, "b": 0.8, "q": 0.5}
        inputs = [{"u": np.cos(0.7 * np.arange(n))} for n in (60, 90)]
    else:
        model, truth = models.two_states, {"a": 0.8, "k": 0.6, "precision": 3.0, "r": 0.3}
        inputs = [{}, {}]
        fixed = {"k": 0.6}  # without it the data tell little but k**2 / precision
    data = [simulated(model, truth, n, seed + n, 0.1, u)
            for n, u in zip((60, 90), inputs, strict=True)]  # fmt: skip
    if method == "PSAEM":
        settings = ssm.PSAEM(iterations=1500, burn_in=150, chains=8)
    else:
        settings = ssm.ParticleEM(particles=300, trajectories=100, iterations=80, burn_in=20)
    found = ssm.maximize(
        model,
        data,
        settings,
        fixed=fixed,
        progress=False,
        seed=seed_of("experiments", method, name, "likelihood"),
    )
    assert_maximum(found, direct(model, data, fixed=fixed), 8, worst=0.3)


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_varves(method, exact_values):
    """The maximum of the point-mass filter; at most two per cent off in tau."""
    mle = exact_values["ice_varves"]["mle"]
    settings = {
        "PSAEM": ssm.PSAEM(iterations=4000, burn_in=150, chains=8),
        "ParticleEM": ssm.ParticleEM(),
    }[method]
    found = ssm.maximize(
        models.varves, {"y": ice_varves()}, settings, progress=False, seed=seed_of("varves", method)
    )
    print(found)
    assert_maximum(found, mle, 8, worst=0.05)
    assert abs(found.parameters["tau"] / mle["tau"] - 1) <= 0.02


@pytest.mark.slow
def test_runs_weighed_by_their_likelihoods_have_less_bias():
    """Forty particles: one filter alone is off by many of its errors, six together are not."""
    data = {"y": load("lgss_appendix")["y"][:40]}
    exact = direct(models.lgss, data, fixed={"c": 1.0})["theta"]
    off = {}
    for runs in (1, 6):
        method = ssm.ParticleEM(
            particles=40, runs=runs, trajectories=24, iterations=120, burn_in=20, chains=10,
            proposal="bootstrap", kernel="exact",
        )  # fmt: skip
        setup = setup_of(models.lgss, data, fixed={"c": 1.0}, seed=seed_of("bias"))
        found = climb_particle_em(setup, method)
        off[runs] = (found.theta[0] - exact, np.sqrt(found.error[0, 0]))
    print(off)
    assert abs(off[1][0]) > 8 * off[1][1]
    assert abs(off[6][0]) < stats.t.isf(LEVEL / 2, 9) * off[6][1]
    assert abs(off[6][0]) < 0.25 * abs(off[1][0])


def test_weights_of_runs():
    assert ratio_weights(np.array([-700.0])) == pytest.approx(1.0)
    np.testing.assert_allclose(ratio_weights(np.full(4, -1e4)), 0.25)
    log_z = np.log([1.0, 2.0, 5.0])
    np.testing.assert_allclose(ratio_weights(log_z), 1.5 * np.array([1, 2, 5]) / 8 - 1 / 6)
    # and what they are for: E[Z S] / E[Z], for which the plain ratio has a bias
    rng = np.random.default_rng(seed_of("ratio"))
    z = np.exp(0.4 * rng.standard_normal((200_000, 4)))
    s = np.log(z) + rng.standard_normal(z.shape)  # E[Z S] / E[Z] = 0.16
    plain = np.array((z / z.sum(axis=1, keepdims=True) * s).sum(axis=1))
    jack = np.array([ratio_weights(row) for row in np.log(z)])
    jack = (jack * s).sum(axis=1)
    error = jack.std() / np.sqrt(len(jack))
    assert abs(plain.mean() - 0.16) > 8 * error
    assert abs(jack.mean() - 0.16) < 0.2 * abs(plain.mean() - 0.16) + 4 * error


def test_fixed_point_of_iterates_that_have_not_come_to_rest():
    rng = np.random.default_rng(seed_of("fixed point"))
    slope, limit = np.array([[0.97, 0.01], [0.0, 0.6]]), np.array([2.0, -1.0])
    z = np.empty((8, 60, 2))
    z[:, 0] = limit + np.array([3.0, 1.0]) + 0.3 * rng.standard_normal((8, 2))
    for k in range(1, 60):
        z[:, k] = limit + (z[:, k - 1] - limit) @ slope.T + 0.02 * rng.standard_normal((8, 2))
    found = fixed_point(z)
    errors = np.std([fixed_point(np.delete(z, r, axis=0)) for r in range(8)], axis=0) * np.sqrt(7)
    assert np.all(np.abs(found - limit) < 5.4 * errors)
    assert np.abs(z.mean(axis=(0, 1)) - limit)[0] > 10 * errors[0]
    assert fixed_point(np.cumsum(np.ones((3, 50, 1)), axis=1) ** 2) is None


# -- refusals
def test_psaem_refuses_what_does_not_separate():
    data = {"y": np.ones(5), "dt": np.linspace(0.1, 1, 5)}
    with pytest.raises(ssm.ArgumentError, match="does not separate") as caught:
        ssm.maximize(em_models.decay, data, ssm.PSAEM(), progress=False)
    assert caught.value.where.function == "decay_transition"
    assert "ssm.ParticleEM()" in str(caught.value)


def test_a_parameter_that_bounds_a_state_is_refused():
    model = ssm.Model("bounded")

    @model.prior
    def prior():
        return {"b": ssm.Gamma(2, rate=1)}

    @model.initial
    def initial(b):
        return {"x": ssm.Uniform(0, b)}

    @model.transition
    def transition(x, b):
        return {"x": ssm.Uniform(0, b)}

    @model.observation
    def observation(x):
        return {"y": ssm.Normal(x, sd=1)}

    for method in (ssm.ParticleEM(), ssm.PSAEM()):
        with pytest.raises(ssm.ArgumentError, match="bounds the support of x"):
            ssm.maximize(model, {"y": np.ones(4)}, method, progress=False)


@pytest.mark.parametrize(
    ("method", "found"),
    [
        (ssm.PSAEM(exponent=0.5), "exponent=0.5"),
        (ssm.PSAEM(iterations=10, burn_in=10), "iterations=10"),
        (ssm.PSAEM(particles=1), "particles=1"),
        (ssm.ParticleEM(iterations=5, burn_in=5), "iterations=5"),
        (ssm.ParticleEM(trajectories=0), "trajectories=0"),
        (ssm.ParticleEM(kernel="genea"), "kernel="),
        (ssm.ParticleEM(chains=0), "chains=0"),
    ],
)
def test_refuses_settings_without_sense(method, found):
    data = {"y": load("lgss_appendix")["y"]}
    with pytest.raises(ssm.ArgumentError, match=found):
        ssm.maximize(models.lgss, data, method, progress=False)


def test_one_chain_states_no_error():
    setup = setup_of(models.lgss, {"y": load("lgss_appendix")["y"]}, fixed={"c": 1.0})
    found = climb(setup, ssm.PSAEM(particles=5, iterations=30, burn_in=10, chains=1))
    assert found.error is None
    assert found.report["converged"] is None
