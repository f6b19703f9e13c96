"""The particle filter's stated properties, and the bias of backward simulation, as exponents.

Unbiasedness of Z is in test_likelihood. Slopes are fitted on logarithms with weights from the
computed errors, and may lie four of their standard errors off.
"""

from __future__ import annotations

import itertools

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.data import check_parameters
from ssmppl.inference.exact.kalman import kalman_filter, kalman_model
from ssmppl.inference.particles.backward import backward_draws, genealogy, particle_system
from ssmppl.inference.particles.filtering import FilterSettings, full_run, log_likelihood_estimate
from ssmppl.inference.run.problem import pose
from ssmppl.inference.run.seeds import random_state
from tests.models import standard as models

from .checks import seed_of

PARAMETERS = {"theta": 1.0, "c": 0.5}


def problem_of(steps):
    y = ssm.simulate(models.lgss, PARAMETERS, steps=steps, seed=seed_of("properties", steps))["y"]
    problem = pose(models.lgss, {"y": y.values[0]})
    return problem, check_parameters(problem.trace, PARAMETERS), problem.experiments[0]


def stream_of(*name):
    return random_state(np.random.SeedSequence(seed_of("properties", *name)))


def slope(x, value, error):
    """Exponent of a power law and its standard error."""
    u, v, weight = np.log(x), np.log(value), (np.asarray(value) / np.asarray(error)) ** 2
    centre = np.average(u, weights=weight)
    spread = np.sum(weight * (u - centre) ** 2)
    return np.sum(weight * (u - centre) * v) / spread, spread**-0.5


@pytest.mark.slow
def test_error_of_filter_means_falls_as_one_over_the_root_of_n():
    problem, theta, experiment = problem_of(60)
    exact = kalman_filter(problem.trace, experiment, theta).mean
    stream, sizes, rows = stream_of("means"), (100, 300, 1000, 3000), []
    for n in sizes:
        squares = []
        for _ in range(60):
            run = full_run(
                problem, experiment, theta, FilterSettings(n, "bootstrap"), stream, np.empty(0),
                stream,
            )  # fmt: skip
            squares.append(np.mean((run.mean - exact) ** 2))
        rows.append((np.mean(squares), np.std(squares, ddof=1) / np.sqrt(60)))
    exponent, error = slope(sizes, *np.transpose(rows))
    print(f"mean square error falls as N^{exponent:.3f} ± {error:.3f}")
    assert error < 0.1
    assert abs(exponent + 1) < 4 * error


@pytest.mark.slow
def test_variance_of_log_z_grows_linearly():
    """On one stretch of data over and over, so that no T has an outlier that others lack."""
    block = ssm.simulate(models.lgss, PARAMETERS, steps=100, seed=seed_of("block"))["y"].values[0]
    repeats, rows = (1, 2, 4, 8), []
    for k in repeats:
        problem = pose(models.lgss, {"y": np.tile(block, k)})
        theta = check_parameters(problem.trace, PARAMETERS)
        stream, settings = stream_of("variance", k), FilterSettings(1000, "bootstrap")
        z = [log_likelihood_estimate(problem, theta, settings, stream) for _ in range(300)]
        squares = (np.array(z) - np.mean(z)) ** 2
        rows.append((squares.mean(), squares.std(ddof=1) / np.sqrt(len(z))))
    exponent, error = slope(repeats, *np.transpose(rows))
    print(f"variance of log Z grows as T^{exponent:.3f} ± {error:.3f}")
    assert error < 0.1
    assert abs(exponent - 1) < 4 * error


def test_ancestral_paths_meet_and_backward_simulation_keeps_them_apart():
    problem, theta, experiment = problem_of(100)
    settings, n = FilterSettings(200, "bootstrap"), 200
    stream = stream_of("genealogy")
    system = particle_system(problem, theta, settings, experiment, stream)
    lines = genealogy(system, n, stream)
    (paths,), _ = backward_draws(problem, theta, settings, n, stream)
    old = [len(np.unique(lines[:, t])) for t in range(100)]
    new = [len(np.unique(paths[:, t])) for t in range(100)]
    assert all(a <= b for a, b in itertools.pairwise(old))  # who has met stays together
    assert 10 * old[0] < np.median(new)
    assert old[0] < min(new)


@pytest.mark.slow
def test_bias_of_backward_simulation_falls_as_one_over_n():
    """Of the smoothed variance, and of the covariance with the step before, averaged over time."""
    problem, theta, experiment = problem_of(30)
    exact = kalman_model(problem.trace).smooth(experiment, theta)
    stream, table = stream_of("bias"), {"variance": [], "pair": []}
    sizes = {15: 12_000, 30: 8000, 60: 8000, 120: 8000}
    for n, runs in sizes.items():
        found = np.empty((runs, 2))
        for r in range(runs):
            (paths,), _ = backward_draws(
                problem, theta, FilterSettings(n, "bootstrap"), n, stream, "exact"
            )
            z = paths[:, :, 0] - exact.mean[:, 0]
            found[r, 0] = np.mean(z**2) - np.mean(exact.covariance)
            found[r, 1] = np.mean(z[:, 1:] * z[:, :-1]) - np.mean(exact.cross[1:])
        for k, name in enumerate(table):
            table[name].append((found[:, k].mean(), found[:, k].std(ddof=1) / np.sqrt(runs)))
    for name, rows in table.items():
        value, error = np.transpose(rows)
        print(name, [f"{n}: {v:+.5f} ± {e:.5f}" for n, v, e in zip(sizes, value, error,
                                                                   strict=True)])  # fmt: skip
        scaled, spread = value * list(sizes), error * list(sizes)
        assert abs(value[0]) > 8 * error[0]  # there is a bias to speak of
        # N times the bias is constant up to a term in 1 / N, which a line in 1 / N fits
        design = np.stack([np.ones(4), 1 / np.array(list(sizes))], axis=1) / spread[:, None]
        _, rest, *_ = np.linalg.lstsq(design, scaled / spread, rcond=None)
        print(name, "N x bias", np.round(scaled, 3), "±", np.round(spread, 3), "chi2", rest)
        assert rest[0] < 13.8  # chi squared with two degrees of freedom at 0.001
