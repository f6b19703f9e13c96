"""Backward simulation: the law of the indices, enumerated; moments against exact ones."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

import ssmppl as ssm
from ssmppl.data import check_parameters
from ssmppl.errors import ArgumentError, SamplingError
from ssmppl.inference.particles.backward import (
    ParticleSystem,
    backward_draws,
    choose_kernel,
    draw_paths,
    genealogy,
    particle_system,
)
from ssmppl.inference.particles.filtering import SCHEMES, FilterSettings, log_likelihood_estimate
from ssmppl.inference.run.problem import pose
from ssmppl.inference.run.seeds import random_state
from tests.inference.smoothing_cases import assert_moments, moments_of, smoothing_case
from tests.models import standard as models
from tests.statistics.checks import seed_of, some

LEVEL = 0.001


def stream_of(*name):
    return random_state(np.random.SeedSequence(seed_of("backward", *name)))


# -- the law of the indices given the particles, enumerated
def short(label, steps, n):
    """A problem of few steps with its particle system."""
    problem, theta, *_ = smoothing_case(label)
    model, data = problem.trace.name, problem.experiments[0]
    short_data = {"y": data.y[:steps, 0].copy()}
    short_data["y"][data.seen[:steps, 0] == 0] = np.nan
    chosen = {"lgss": models.lgss, "ar2": models.ar2, "vehicle": models.vehicle}[model]
    problem = pose(chosen, short_data)
    settings = FilterSettings(n, "bootstrap")
    experiment = problem.experiments[0]
    system = particle_system(problem, theta, settings, experiment, stream_of(label, steps, n))
    return problem, theta, experiment, system


def log_normal(x, mean, sd):
    return -0.5 * ((x - mean) / sd) ** 2 - np.log(sd)


def future(problem, theta, experiment, t, start, rest):
    """log p(rest, what is measured of it | x_t) up to a constant, for each row of start : (n, D).

    rest : noisy components of x_{t+1}, x_{t+2}, ...; each model's laws written down by hand.
    """
    y, seen = experiment.y[:, 0], experiment.seen[:, 0]
    name, total, before = problem.trace.name, np.zeros(len(start)), start
    for k, x in enumerate(rest, start=t + 1):
        if name == "lgss":
            total += log_normal(x, 0.7 * before[:, 0], 1 / np.sqrt(theta[0]))
            now, expected, sd = [x], 0.5 * x, np.sqrt(0.1)
        elif name == "ar2":
            total += log_normal(x, 1.2 * before[:, 0] - 0.5 * before[:, 1], 0.8)
            now, expected, sd = [x, before[:, 0]], x, 1.0
        else:
            position = before[:, 1] + theta[0] * before[:, 0]
            total += log_normal(x, 0.9 * before[:, 0] + 0.1, 0.4)
            now, expected, sd = [x, position], position, 0.5
        if seen[k]:
            total += log_normal(y[k], expected, sd)
        before = np.stack(np.broadcast_arrays(*now, np.zeros(len(start)))[:-1], axis=1)
    return total


def enumerate_law(problem, theta, experiment, system):
    """{indices: probability} of backward simulation, the weights from `future`."""
    steps = len(system.particles)
    law = {(i,): p for i, p in enumerate(system.weights[-1])}
    for t in range(steps - 2, -1, -1):
        longer = {}
        for indices, p in law.items():
            rest = [system.particles[t + 1 + k, 0, i] for k, i in enumerate(indices)]
            log_v = future(problem, theta, experiment, t, system.particles[t].T, rest)
            v = system.weights[t] * np.exp(log_v - log_v.max())
            longer |= {(i, *indices): p * q for i, q in enumerate(v / v.sum())}
        law = longer
    assert sum(law.values()) == pytest.approx(1.0, abs=1e-9)
    return law


def count(system, paths):
    """{indices: number of paths}; particles are told apart by their first component, noisy."""
    columns = []
    for t in range(paths.shape[1]):
        order = np.argsort(system.particles[t, 0])
        at = np.searchsorted(system.particles[t, 0, order], paths[:, t, 0])
        columns.append(order[at])
        np.testing.assert_array_equal(system.particles[t, 0, order[at]], paths[:, t, 0])
    rows, counts = np.unique(np.array(columns).T, axis=0, return_counts=True)
    return dict(zip(map(tuple, rows.tolist()), counts.tolist(), strict=True))


def chi_square_p(law, found, draws):
    """p value of Pearson's test, cells of less than 5 expected put together."""
    rare_expected = rare_found = 0.0
    total, cells = 0.0, 0
    for indices, p in law.items():
        expected, seen = draws * p, found.get(indices, 0)
        if expected < 5:
            rare_expected, rare_found = rare_expected + expected, rare_found + seen
        else:
            total, cells = total + (seen - expected) ** 2 / expected, cells + 1
    if rare_expected > 0:
        total, cells = total + (rare_found - rare_expected) ** 2 / rare_expected, cells + 1
    return float(stats.chi2.sf(total, cells - 1))


ENUMERATED = [
    ("one state, gaps", "exact", 3, 5), ("one state, gaps", "rejection", 2, 60),
    ("one state, gaps", "mcmc", 3, 5), ("ar2", "exact", 4, 4), ("ar2", "mcmc", 4, 4),
    ("vehicle", "exact", 4, 4), ("vehicle", "mcmc", 4, 4),
]  # fmt: skip


@pytest.mark.parametrize(("label", "kernel", "steps", "n"), some(ENUMERATED, 3))
def test_law_given_the_particles(label, kernel, steps, n):
    problem, theta, experiment, system = short(label, steps, n)
    law = enumerate_law(problem, theta, experiment, system)
    draws = 100_000
    paths = draw_paths(
        problem, theta, experiment, system, draws, stream_of(label, kernel), kernel, moves=60
    )
    p = chi_square_p(law, count(system, paths), draws)
    print(f"{label} {kernel}: {len(law)} index paths, p = {p:.3f}")
    assert p > LEVEL / len(ENUMERATED)


@pytest.mark.slow
def test_more_moves_come_closer():
    """Total variation of the MCMC kernel's law to the exact one, from the genealogy on."""
    problem, theta, experiment, system = short("one state, gaps", 3, 5)
    law = enumerate_law(problem, theta, experiment, system)
    draws, distances = 100_000, []
    for moves in (0, 1, 3, 10, 60):
        paths = draw_paths(
            problem, theta, experiment, system, draws, stream_of("moves", moves), "mcmc", moves
        )
        found = count(system, paths)
        keys = {*law, *found}
        distances.append(0.5 * sum(abs(found.get(k, 0) / draws - law.get(k, 0.0)) for k in keys))
    noise = 0.5 * sum(np.sqrt(2 * p / (np.pi * draws)) for p in law.values())
    print("total variation", np.round(distances, 4), "noise", round(noise, 4))
    assert distances[0] > distances[1] > distances[2]
    assert distances[0] > 20 * noise
    assert distances[-1] < 2 * noise


def test_no_move_is_the_genealogy():
    problem, theta, experiment, system = short("one state, gaps", 3, 5)
    paths = draw_paths(
        problem, theta, experiment, system, 500, stream_of("no move"), "mcmc", moves=0
    )
    lines = genealogy(system, 500, stream_of("no move, 2"))
    assert {p.tobytes() for p in paths} == {p.tobytes() for p in lines}


def test_early_stopping_takes_both_ways():
    """One index is far from the rest, which no proposal finds: the exact kernel takes over."""
    problem, theta, experiment, system = short("one state, gaps", 2, 200)
    particles = system.particles.copy()
    particles[1, 0, 7] = 5.0
    weights = np.full_like(system.weights, 1 / 400)
    weights[1, 7] = 201 / 400
    changed = ParticleSystem(
        particles, weights / weights.sum(1, keepdims=True), system.ancestors,
        system.log_increments, system.ess,
    )  # fmt: skip
    law = enumerate_law(problem, theta, experiment, changed)
    draws, tally = 100_000, np.zeros(2)
    paths = np.empty((2, 1, draws))
    problem.program.entry("backward_rejection")(
        theta, experiment.y, experiment.seen, experiment.u, stream_of("early"),
        changed.particles, changed.weights, paths, tally,
    )  # fmt: skip
    p = chi_square_p(law, count(changed, np.moveaxis(paths, 2, 0)), draws)
    print(f"proposals {tally[0] / draws:.2f} and exact {tally[1] / draws:.3f} an index, p {p:.3f}")
    assert 0.4 * draws < tally[1] < 0.7 * draws
    assert tally[0] > 1.5 * draws
    assert p > LEVEL


# -- moments, over independent runs of the filter too
MOMENTS = [
    ("four states", "auxiliary", "exact", 1000), ("four states", "auxiliary", "rejection", 1000),
    ("one state, gaps", "bootstrap", "rejection", 500),
    ("one state, gaps", "bootstrap", "mcmc", 500),
    pytest.param("echo", "bootstrap", "exact", 500, marks=pytest.mark.slow),
    pytest.param("echo", "guided", "mcmc", 500, marks=pytest.mark.slow),
    ("vehicle", "bootstrap", "exact", 500),
]  # fmt: skip


@pytest.mark.parametrize(("label", "proposal", "kernel", "particles"), some(MOMENTS, 1))
def test_moments(label, proposal, kernel, particles):
    problem, theta, exact, *_ = smoothing_case(label)
    stream = stream_of("moments", label, kernel)
    settings = FilterSettings(particles, proposal)
    runs = []
    for _ in range(60):
        (paths,), _ = backward_draws(problem, theta, settings, 100, stream, kernel)
        runs.append(moments_of(paths, exact))
    assert_moments(runs, exact, f"{label} {kernel}")


# -- the filter that keeps its particles
KEPT = [("bootstrap", "systematic", 1.0), ("bootstrap", "residual", 0.5),
        ("auxiliary", "systematic", 1.0)]  # fmt: skip


@pytest.mark.parametrize(("proposal", "scheme", "threshold"), KEPT)
def test_filter_is_the_same_with_its_particles_kept(proposal, scheme, threshold):
    problem, theta, *_ = smoothing_case("one state, gaps")
    settings = FilterSettings(50, proposal, SCHEMES[scheme], threshold)
    a, b = stream_of("kept"), stream_of("kept")
    system = particle_system(problem, theta, settings, problem.experiments[0], a)
    assert system.log_Z == log_likelihood_estimate(problem, theta, settings, b)
    np.testing.assert_array_equal(a, b)
    np.testing.assert_allclose(system.weights.sum(1), 1.0)
    if proposal != "auxiliary":  # which resamples by its look-ahead too
        for t in range(1, len(system.weights)):
            offspring = np.bincount(system.ancestors[t], minlength=50)
            wanted = 50 * system.weights[t - 1]
            if threshold < 1.0 and system.ess[t - 1] >= threshold * 50:
                wanted = np.ones(50)
            assert np.all(np.abs(offspring - wanted) < 1 if scheme == "systematic" else
                          offspring >= np.floor(wanted))  # fmt: skip
    np.testing.assert_allclose(1 / (system.weights**2).sum(1), system.ess)


# -- the call
def test_experiments_seeds_and_log_z():
    problem = pose(models.lgss, [{"y": np.r_[0.3, np.nan, 1.1]}, {"y": np.r_[-0.4, 0.2]}])
    theta = check_parameters(problem.trace, {"theta": 1.0, "c": 0.5})
    settings = FilterSettings(300, "bootstrap")
    stream = stream_of("experiments")
    paths, log_z = backward_draws(problem, theta, settings, 40, stream)
    assert [p.shape for p in paths] == [(40, 3, 1), (40, 2, 1)]
    again, same = backward_draws(problem, theta, settings, 40, stream_of("experiments"))
    assert log_z == same
    for p, q in zip(paths, again, strict=True):
        np.testing.assert_array_equal(p, q)
    other, _ = backward_draws(problem, theta, settings, 40, stream)
    assert not np.array_equal(other[0], paths[0])


def test_choice_of_the_kernel():
    lgss, *_ = smoothing_case("one state, gaps")
    assert choose_kernel(lgss, FilterSettings(1000, "bootstrap"), 100)[0] == "rejection"
    assert choose_kernel(lgss, FilterSettings(20, "bootstrap"), 100)[0] == "exact"
    echo, *_ = smoothing_case("echo")
    kernel, why = choose_kernel(echo, FilterSettings(1000, "bootstrap"), 100)
    assert kernel == "exact"
    assert "deterministic component e" in why
    vehicle, *_ = smoothing_case("vehicle")
    assert choose_kernel(vehicle, FilterSettings(1000, "bootstrap"), 100)[0] == "exact"
    kernel, why = choose_kernel(vehicle, FilterSettings(100_000, "bootstrap"), 10_000)
    assert kernel == "mcmc"
    assert "deterministic" in why


def test_refusals():
    echo, theta, *_ = smoothing_case("echo")
    settings = FilterSettings(50, "bootstrap")
    with pytest.raises(ArgumentError, match=r"(?s)echo_transition.*rejection.*Fix: use kernel"):
        backward_draws(echo, theta, settings, 10, stream_of("no"), "rejection")
    with pytest.raises(ArgumentError, match=r"kernel='exakt' is unknown(?s:.*)exact, "):
        backward_draws(echo, theta, settings, 10, stream_of("no"), "exakt")
    with pytest.raises(ArgumentError, match="trajectories=0"):
        backward_draws(echo, theta, settings, 0, stream_of("no"))


def test_a_density_that_is_no_number():
    """Fine for the filter, which draws x_2 with the sd of its own x_1 only, not of all others."""
    model = ssm.Model("no number")
    model.initial(lambda: {"x": ssm.Normal(0, sd=1), "z": ssm.Normal(0, sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(x, sd=1), "z": ssm.Normal(0, sd=np.sqrt(x + 2.5))})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=0.1)})
    problem = pose(model, {"y": [0.0, 0.1, -0.1]})
    with pytest.raises(SamplingError, match=r"a weight is nan at t=2|not a number"):
        backward_draws(
            problem, np.empty(0), FilterSettings(2000, "bootstrap"), 10, stream_of("nan"), "exact"
        )
