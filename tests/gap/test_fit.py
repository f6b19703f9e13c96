"""Fits: exact modes, and particle fits of the same models, in nats from the exact one."""

import numpy as np
import pytest
from scipy import stats

import ssmppl as ssm
from ssmppl.errors import NotApplicable
from ssmppl.gap.fit import Fitter
from ssmppl.gap.smoothing import Settings
from ssmppl.inference.exact.kalman import kalman_model
from ssmppl.inference.maximum.ascent import Setup
from ssmppl.inference.particles.filtering import random_state, seed_sequence
from ssmppl.inference.problem import pose
from tests.gap import models
from tests.gap.small import level, levels
from tests.statistics.checks import LEVEL, seed_of

CASES = {
    "level": (level, levels, {}),
    "ar1": (
        lambda: models.build("ar1"), lambda n: models.simulated("ar1", n), {"r": np.array(0.5)},
    ),
}  # fmt: skip


def fitter_of(name, *, exact):
    build, data, fixed = CASES[name]
    problem = pose(build(), data(80))
    found = Fitter(problem, fixed, Settings(400, "auxiliary"))
    if not exact:
        found.kalman = found.smoother.__dict__["kalman"] = NotApplicable("particles are tested")
    return problem, found


def log_posterior(fitter, fit, z):
    """Exact log p(y) + log prior on the natural scale, which is what the mode is of."""
    fixed = fitter.fixed
    setup = Setup(fit.problem, fit.space, "posterior", fixed, {}, np.random.SeedSequence(0))
    point = setup.chart.at(z)
    kalman = kalman_model(fit.problem.trace)
    return kalman.log_likelihood(fit.problem.experiments, point.theta) + point.log_prior


@pytest.mark.parametrize("name", list(CASES))
def test_particles_find_the_exact_mode(name):
    problem, exact = fitter_of(name, exact=True)
    _, particles = fitter_of(name, exact=False)
    seed = seed_sequence(seed_of("fit", name))
    top = exact.fit(problem.experiments, seed, {})
    start = {n: v * 1.4 for n, v in top.start.items() if n not in exact.fixed and n != "phi"}
    found = particles.fit(problem.experiments, seed, start, searched=True)
    lost = log_posterior(exact, top, top.z) - log_posterior(exact, top, found.z)
    # The last steps average the score's noise out: no worse than the noise of one score alone.
    slopes = [particles.gradient(found.space, top.z, random_state(seed, 50, r))[1]
              for r in range(20)]  # fmt: skip
    noise = np.atleast_2d(np.cov(np.array(slopes).T))
    root = np.linalg.cholesky(np.linalg.inv(top.information))
    largest = np.linalg.eigvalsh(root.T @ noise @ root)[-1]
    tolerance = 0.5 * largest * stats.chi2.isf(LEVEL, len(top.z))
    # Where the last quadratic is off by a quarter, so is the last step before the averaging.
    assert -1e-6 <= lost <= tolerance + 0.1, (lost, tolerance)
    assert found.converged
    kalman = kalman_model(problem.trace)
    off = found.log_likelihood - kalman.log_likelihood(problem.experiments, found.theta)
    assert abs(off) <= stats.t.isf(LEVEL / 2, 7) * found.error


def test_numbers_restore_a_fit():
    problem, fitter = fitter_of("level", exact=True)
    fit = fitter.fit(problem.experiments, seed_sequence(1), {})
    again = fitter.restored(problem.experiments, fit.numbers)
    for name, value in fit.numbers.items():
        np.testing.assert_array_equal(again.numbers[name], value)
    assert again.values() == fit.values()
    np.testing.assert_array_equal(again.space.theta, fit.space.theta)


def test_a_quick_fit_is_the_same_without_information():
    problem, fitter = fitter_of("level", exact=True)
    fit = fitter.fit(problem.experiments, seed_sequence(seed_of("quick")), {})
    quick = fitter.fit(problem.experiments, seed_sequence(seed_of("quick")), {}, quick=True)
    np.testing.assert_array_equal(quick.theta, fit.theta)
    assert np.isnan(quick.information).all()
    assert np.all(np.linalg.eigvalsh(fit.information) > 0.0)


def test_a_flat_start_is_fitted_as_a_vague_one():
    """Two data sets apart by a constant give the same fit, as a shift of x_1 is nothing."""
    found = []
    for shift in (0.0, 1000.0):
        problem = pose(level(ssm.Flat()), {"y": levels(80)["y"] + shift})
        fitter = Fitter(problem, {}, Settings())
        found.append(fitter.fit(problem.experiments, seed_sequence(1), {}))
    np.testing.assert_allclose(found[0].theta, found[1].theta, rtol=1e-4)
    np.testing.assert_allclose(found[0].information, found[1].information, rtol=1e-2)
