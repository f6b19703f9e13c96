"""Fits: exact modes, and particle fits of the same models, in nats from the exact one."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

import ssmppl as ssm
from ssmppl.diagnosis.fitting.fit import FROM_START, Effort, Fit, Fitter
from ssmppl.diagnosis.model.smoothing import Settings
from ssmppl.errors import NotApplicable
from ssmppl.inference.exact.kalman import kalman_model
from ssmppl.inference.maximum.ascent import Maximization
from ssmppl.inference.run.problem import pose
from ssmppl.inference.run.seeds import random_state, seed_sequence
from tests.diagnosis.small import level, levels
from tests.models import gaps as models
from tests.statistics.checks import LEVEL, seed_of, some

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
    setup = Maximization(fit.problem, fit.space, "posterior", fixed, {}, np.random.SeedSequence(0))
    point = setup.transform.at(z)
    kalman = kalman_model(fit.problem.trace)
    return kalman.log_likelihood(fit.problem.experiments, point.theta) + point.log_prior


@pytest.mark.parametrize("name", some(CASES, 1))
def test_particles_find_the_exact_mode(name):
    problem, exact = fitter_of(name, exact=True)
    _, particles = fitter_of(name, exact=False)
    seed = seed_sequence(seed_of("fit", name))
    top = exact.fit(problem.experiments, seed, {})
    start = {n: v * 1.4 for n, v in top.by_parameter.items() if n not in exact.fixed and n != "phi"}
    found = particles.fit(problem.experiments, seed, start, FROM_START)
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
    assert again.by_component == fit.by_component
    np.testing.assert_array_equal(again.space.theta, fit.space.theta)


def test_a_quick_fit_is_the_same_without_information():
    problem, fitter = fitter_of("level", exact=True)
    fit = fitter.fit(problem.experiments, seed_sequence(seed_of("quick")), {})
    quick = fitter.fit(
        problem.experiments, seed_sequence(seed_of("quick")), {}, Effort(standard_errors=False)
    )
    np.testing.assert_array_equal(quick.theta, fit.theta)
    assert np.isnan(quick.information).all()
    assert np.all(np.linalg.eigvalsh(fit.information) > 0.0)


@pytest.mark.slow
def test_a_flat_start_is_fitted_as_a_vague_one():
    """Two data sets apart by a constant give the same fit, as a shift of x_1 is nothing."""
    found = []
    for shift in (0.0, 1000.0):
        problem = pose(level(ssm.Flat()), {"y": levels(80)["y"] + shift})
        fitter = Fitter(problem, {}, Settings())
        found.append(fitter.fit(problem.experiments, seed_sequence(1), {}))
    np.testing.assert_allclose(found[0].theta, found[1].theta, rtol=1e-4)
    np.testing.assert_allclose(found[0].information, found[1].information, rtol=1e-2)


def second_derivatives(f, z, h=1e-3):
    """(F, F) by central differences."""
    size = len(z)
    e = h * np.eye(size)
    return np.array([
        [(f(z + e[i] + e[j]) - f(z + e[i] - e[j]) - f(z - e[i] + e[j]) + f(z - e[i] - e[j]))
         / (4 * h * h) for j in range(size)] for i in range(size)
    ])  # fmt: skip


@pytest.mark.parametrize("name", list(CASES))
def test_the_information_of_an_exact_fit_is_the_curvature_at_its_mode(name):
    problem, exact = fitter_of(name, exact=True)
    top = exact.fit(problem.experiments, seed_sequence(1), {})
    curvature = -second_derivatives(lambda z: log_posterior(exact, top, z), top.z)
    np.testing.assert_allclose(top.information, curvature, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("sd", [1.0, 1e7], ids=["known start", "vague start"])
@pytest.mark.parametrize("moves", [True, False], ids=["moves", "at rest"])
def test_the_fast_climb_of_a_linear_gaussian_model_is_the_exact_one(sd, moves):
    """With a vague start rounding leaves the extended filter without a number where the exact one
    has it; at rest the scale of the noise runs to its bound."""
    e, w = np.random.default_rng(seed_of("fast climb")).standard_normal((2, 151))
    y = np.cumsum(0.5 * w) + e if moves else e[1:] - 0.8 * e[:-1]
    problem = pose(level(ssm.Normal(0.0, sd=sd)), {"y": y})
    fast, exact = (
        Fitter(problem, {}, Settings(100, proposal)).fit(
            problem.experiments, seed_sequence(1), {"q": 0.3, "r": 0.8}, FROM_START
        )
        for proposal in ("twisted", "bootstrap")
    )
    np.testing.assert_array_equal(fast.at_bound, exact.at_bound)
    assert fast.at_bound.tolist() == [not moves, False]
    assert fast.log_likelihood == pytest.approx(exact.log_likelihood, abs=2e-3)
    assert fast.z[~fast.at_bound] == pytest.approx(exact.z[~exact.at_bound], abs=2e-2)
    inside = np.ix_(~fast.at_bound, ~fast.at_bound)
    np.testing.assert_allclose(fast.information[inside], exact.information[inside], rtol=0.05)


def test_a_fit_may_start_with_an_information_matrix():
    """That of the parameters, here the exact one: the mode is the same, and nothing is simulated
    until the errors are asked for."""
    problem, exact = fitter_of("level", exact=True)
    _, particles = fitter_of("level", exact=False)
    seed = seed_sequence(seed_of("information"))
    top = exact.fit(problem.experiments, seed, {})
    setup = Maximization(top.problem, top.space, "posterior", {}, {}, np.random.SeedSequence(0))
    back = np.linalg.inv(setup.transform.at(top.z).jacobian)
    information = back.T @ top.information @ back
    found = particles.fit(
        problem.experiments, seed, top.by_parameter, FROM_START, information=information
    )
    assert "simulator" not in particles.__dict__
    lost = log_posterior(exact, top, top.z) - log_posterior(exact, top, found.z)
    assert lost < 1.0
    measured = particles.with_information(found, seed)
    assert "simulator" in particles.__dict__
    # Expected, not observed: against that of the exact scores, each by 24 simulated sets.
    expected = exact._simulated_information(top.space, top.theta, seed)
    scale = 0.5 * np.log(np.diagonal(measured.information) / np.diagonal(expected))
    assert np.all(np.abs(scale) < stats.norm.isf(LEVEL / 4) * np.sqrt(2 * 0.5 / 24))


@pytest.mark.parametrize("after", [1, 3, 5])
def test_a_step_over_a_cliff_is_taken_back(monkeypatch, after):
    """Where the particles lose the data, the score sends the search to nowhere."""
    problem, particles = fitter_of("level", exact=False)
    seed = seed_sequence(seed_of("cliff"))
    start = particles.fit(problem.experiments, seed, {}).by_parameter
    whole, calls = particles.gradient, []

    def gradient(space, z, stream, transform):
        calls.append(z)
        value, slope = whole(space, z, stream, transform)
        return (value - 1e5, 1e5 * slope) if len(calls) == after + 1 else (value, slope)

    monkeypatch.setattr(particles, "gradient", gradient)
    found = particles.fit(problem.experiments, seed, start, FROM_START)
    assert len(calls) > after
    assert np.max(np.abs(found.z - calls[0])) < 2.0
    assert found.log_likelihood > -200.0


@pytest.mark.parametrize(
    ("curvature", "own", "expected"),
    [
        (np.diag([4.0, 2.0]), np.diag([3.0, 1.0]), np.diag([4.0, 2.0])),
        (np.diag([4.0, -2.0]), np.diag([3.0, 1.0]), np.diag([3.0, 1.0])),  # no top to see
        (np.diag([4.0, np.nan]), np.diag([3.0, 1.0]), np.diag([3.0, 1.0])),
        (np.diag([4.0, -2.0]), np.diag([3.0, -1.0]), np.eye(2)),  # neither: by simulation
    ],
)
def test_of_a_simulator_what_has_no_top_is_no_information(monkeypatch, curvature, own, expected):
    """A mean that bends sharply has second differences of any sign."""
    monkeypatch.setattr(Fitter, "_extended_of_many", lambda *_: "calls")
    monkeypatch.setattr(Fitter, "_curvature", lambda *_: curvature)
    monkeypatch.setattr(Fitter, "_simulated_information", lambda *_: np.eye(2))
    monkeypatch.setattr(Fitter, "_extended_log_likelihood", lambda *_: None)
    fitter = object.__new__(Fitter)
    fitter.kalman = NotApplicable("it calls a simulator")
    some = dict.fromkeys(Fit.__dataclass_fields__)
    space = SimpleNamespace(problem=None)
    fit = Fit(**some | {"space": space, "information": own, "at_bound": np.zeros(2, dtype=bool)})
    found = fitter.with_information(fit, None)
    np.testing.assert_array_equal(found.information, expected)
