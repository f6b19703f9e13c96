"""IF2: its kernel against exact likelihoods, its steps in closed form, its ends at exact maxima."""

from __future__ import annotations

import pickle
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

import ssmppl as ssm
from ssmppl import datasets
from ssmppl.analysis.proposals.perturbed import perturbed
from ssmppl.inference.maximum.ascent import Maximization
from ssmppl.inference.maximum.iterated_filtering import (
    IF2State,
    PerturbedFilter,
    climb,
    if2_block,
    perturbed_model,
    step_scales,
)
from ssmppl.inference.maximum.noisy_maximum import LocalMaximum, local_maximum
from ssmppl.inference.preparation.space import space_of
from ssmppl.inference.run.problem import pose
from ssmppl.inference.run.seeds import random_state, seed_sequence
from tests.models import standard as models
from tests.statistics.checks import LEVEL, mean_one_p, seed_of

LGSS = {"y": datasets.load("lgss_main_text")["y"]}

# phi, q and r act at every row, m in the initial law alone, a as a bound of phi, h in priors.
series = ssm.Model("series", inputs=("u",))


@series.prior
def series_prior():
    return {"a": ssm.HalfNormal(sd=1), "h": ssm.Gamma(2, rate=1), "m": ssm.Normal(0, sd=3)}


@series.prior
def series_later(a, h):
    return {"phi": ssm.Uniform(-a, 1), "q": ssm.Exponential(rate=h), "r": ssm.Exponential(rate=h)}


@series.initial
def series_initial(m):
    return {"x": ssm.Normal(m, sd=0.5)}


@series.transition
def series_transition(x, u, phi, q):
    return {"x": ssm.Normal(phi * x + u, sd=q)}


@series.observation
def series_observation(x, r):
    return {"y": ssm.Normal(x, sd=r)}


VALUES = {"a": 0.5, "h": 1.0, "m": 1.0, "phi": 0.7, "q": 0.6, "r": 0.3}


def simulated(steps, *name, parameters=VALUES, model=series):
    u = np.sin(np.arange(steps) / 2.0)
    inputs = {"u": u} if model.inputs else None
    found = ssm.simulate(model, parameters, steps=steps, inputs=inputs, seed=seed_of(*name))
    return {"y": found["y"].values[0]} | (inputs or {})


def setup_of(model, data, fixed=None, start=None, objective="likelihood", seed=1):
    problem = pose(model, data)
    held = {k: np.asarray(v, dtype=float) for k, v in (fixed or {}).items()}
    near = {k: np.asarray(v, dtype=float) for k, v in (start or {}).items()}
    return Maximization(
        problem, space_of(problem, held, near), objective, held, near, seed_sequence(seed)
    )


def filter_of(setup, method):
    model = perturbed_model(setup.space, setup.with_prior)
    scales = step_scales(setup, method, model)
    return PerturbedFilter(setup.space, setup.with_prior, scales, model.moving, method.cooling)


@pytest.mark.parametrize("with_prior", [pytest.param(False, marks=pytest.mark.slow), True])
def test_each_particle_carries_its_own_parameters(with_prior):
    """Particles at two atoms that do not step: Z and the final share of an atom are unbiased for
    the mean of the atoms' likelihoods, and for an atom's part of it (times its prior)."""
    data = [simulated(6, "atoms"), simulated(4, "more atoms")]
    data[0]["y"][2] = np.nan
    objective = "posterior" if with_prior else "likelihood"
    setup = setup_of(series, data, {"a": 0.5, "h": 1.0}, VALUES, objective)
    perturbed = filter_of(setup, ssm.IF2())
    perturbed = PerturbedFilter(
        perturbed.space, with_prior, 0.0 * perturbed.perturbation, perturbed.moving, 0.5
    )
    one = setup.space.z[setup.space.positions]
    atoms = [one, one + np.array([0.3, 0.4, -0.3, 0.5])]  # m, phi, q, r
    exact = []
    for z in atoms:
        theta, _ = setup.space.parameters(z)
        log_p = setup.exact.log_likelihood(setup.problem.experiments, theta.copy())
        exact.append(log_p + (setup.transform.at(z).log_prior if with_prior else 0.0))
    assert abs(exact[0] - exact[1]) < 3.0  # both count
    stream, n = random_state(setup.seed(1)), 40
    whole, part = [], []
    for _ in range(1500):
        particles = np.repeat(np.array(atoms).T, n // 2, axis=1)
        _, increments = perturbed.one_pass(particles, 1, stream)
        log_z = increments.sum() - (np.logaddexp(*exact) - np.log(2.0))  # less that of the mean
        share = np.mean(particles[0] == atoms[0][0])
        whole.append(log_z)
        with np.errstate(divide="ignore"):
            part.append(log_z + np.log(share) - exact[0] + np.logaddexp(*exact))
    assert mean_one_p(whole) > LEVEL
    assert mean_one_p(part) > LEVEL


def test_the_steps_cool_as_they_should():
    """Without measurements the particles take a random walk: its variance is the sum of s^2, of all
    rows for what acts at them, of the first one for what acts in the initial law alone."""
    rows, passes, n, cooling, scale = 7, 30, 20_000, 0.2, {"m": 0.3, "q": 0.05}
    data = [{"y": np.full(t, np.nan), "u": np.zeros(t)} for t in (rows, 3)]
    setup = setup_of(series, data, {"a": 0.5, "h": 1.0, "phi": 0.5, "r": 1.0})
    perturbed = filter_of(setup, ssm.IF2(cooling=cooling, perturbation=scale))
    state = IF2State(np.zeros((2, n)), random_state(setup.seed(2)), 0)
    state, _ = if2_block(perturbed, state, 10)
    state, _ = if2_block(perturbed, state, passes - 10)
    m, q = np.arange(passes)[:, None], np.arange(rows + 3)[None]
    factor = cooling ** ((m + q / (rows + 3)) / 50.0)
    first = np.zeros(rows + 3)
    first[[0, rows]] = 1.0
    variance = [np.sum((0.3 * factor * first) ** 2), np.sum((0.05 * factor) ** 2)]
    assert [s.data[1] for s in setup.transform.z] == ["m", "q"]
    low, high = stats.chi2.ppf([LEVEL / 2, 1 - LEVEL / 2], n) / n
    for drawn, expected in zip(state.particles, variance, strict=True):
        assert low < np.mean(drawn**2) / expected < high


def test_what_acts_where_is_found_in_the_model():
    problem = pose(series, simulated(3, "found"))
    free, missing = [True] * 6, problem.program.missing
    for with_prior in (False, True):
        found = perturbed(problem.trace, missing, free, with_prior)
        assert found.moving.tolist() == [
            True,
            False,
            False,
            True,
            True,
            True,
        ]  # a by the bound of phi
        assert found.acting.tolist() == [True, with_prior, True, True, True, True]
    held = perturbed(problem.trace, missing, [False, True, True, False, True, True])
    assert held.moving.tolist() == [False, False, True, True]  # h, m, q, r


def test_names_of_the_model_are_kept_apart():
    model = ssm.Model("taken", inputs=("perturbation",))
    model.prior(lambda: {"prior_counts": ssm.Normal(0, sd=1)})
    model.initial(lambda: {"unconstrained": ssm.Normal(0, sd=1)})

    @model.transition
    def transition(unconstrained, prior_counts, perturbation):
        mean = prior_counts * unconstrained + perturbation
        return {"unconstrained": ssm.Normal(mean, sd=1)}

    model.observation(lambda unconstrained: {"y": ssm.Normal(unconstrained, sd=1)})
    data = {"y": np.array([0.3, -0.2, 0.5]), "perturbation": np.ones(3)}
    setup = setup_of(model, data, objective="posterior")
    perturbed, particles = filter_of(setup, ssm.IF2()), np.zeros((1, 50))
    mean, _ = perturbed.one_pass(particles, 1, random_state(setup.seed(1)))
    assert 0.0 < abs(mean[0]) < 0.5


def check_ends(found, exact):
    """The ends of eight runs lie round the exact top as far as their own spread allows; the bias
    of steps that have not vanished is below a fifth of the standard error."""
    for name, sd in exact.standard_errors.items():
        ends = np.array([e[name] for e in found.attrs["start_parameters"]])
        error = ends.std(ddof=1) / np.sqrt(8)
        off = abs(ends.mean() - exact.parameters[name])
        assert off < stats.t.isf(LEVEL / 2 / len(exact.standard_errors), 7) * error + 0.2 * sd
        assert error < 0.2 * sd


@pytest.mark.slow
def test_a_linear_gaussian_maximum(exact_values):
    exact = exact_values["lgss_main_text"]
    found = ssm.maximize(models.lgss, LGSS, ssm.IF2(starts=8, iterations=80, particles=1000),
                         fixed={"c": 0.5}, seed=seed_of("if2"), progress=False)  # fmt: skip
    direct = ssm.maximize(models.lgss, LGSS, fixed={"c": 0.5}, progress=False)
    assert direct.parameters["theta"] == pytest.approx(exact["mle"], abs=1e-6)
    check_ends(found, direct)
    gap = exact["max_log_likelihood"] - found.log_likelihood
    assert 0.0 <= gap < 0.02
    values = [ssm.log_likelihood(models.lgss, LGSS, e)[0] for e in found.attrs["start_parameters"]]
    np.testing.assert_allclose(found.attrs["start_log_likelihoods"], values, atol=1e-9)
    assert found.log_likelihood >= max(values) - 1e-9
    assert found.attrs["converged"]
    assert "highest log-likelihood" in found.attrs["estimate"]


def test_the_iterates_of_every_start():
    given = [{"theta": 0.3}, {"theta": 2.0}]
    method = ssm.IF2(particles=100, iterations=5, starts=given, averaged=2)
    found = ssm.maximize(models.lgss, LGSS, method, fixed={"c": 0.5}, seed=3, progress=False)
    assert found.iterates["theta"].dims == ("start", "iteration")
    assert dict(found.iterates.sizes) == {"start": 2, "iteration": 6}
    np.testing.assert_allclose(found.iterates["theta"].values[:, 0], [0.3, 2.0])
    log_p = found.iterates["perturbed_log_likelihood"].values
    assert np.all(np.isnan(log_p[:, 0]))
    last = {"theta": found.iterates["theta"].values[0, -1], "c": 0.5}
    assert log_p[0, -1] == pytest.approx(ssm.log_likelihood(models.lgss, LGSS, last)[0], abs=6.0)
    z = np.log(found.iterates["theta"].values[:, -2:]).mean(axis=1)
    ends = [e["theta"] for e in found.attrs["start_parameters"]]
    np.testing.assert_allclose(np.exp(z), ends)
    again = ssm.maximize(models.lgss, LGSS, method, fixed={"c": 0.5}, seed=3, progress=False)
    assert again.parameters == found.parameters


@pytest.mark.slow
@pytest.mark.parametrize("objective", ["likelihood", "posterior"])
def test_several_experiments(objective):
    """Three free parameters, an input, missing rows, two experiments."""
    data = [simulated(40, "first"), simulated(25, "second")]
    data[0]["y"][10:13] = np.nan
    fixed = {"a": 0.5, "h": 1.0, "r": 0.3}
    exact = ssm.maximize(series, data, fixed=fixed, objective=objective, seed=1, progress=False)
    method = ssm.IF2(particles=1000, iterations=60, starts=8)
    found = ssm.maximize(series, data, method, fixed=fixed, objective=objective,
                         seed=seed_of("several"), progress=False)  # fmt: skip
    assert found.attrs["initial_law_only"] == ["m"]
    assert found.attrs["perturbation"]["m"] == pytest.approx(0.02 * np.sqrt(32.5))
    check_ends(found, exact)


@ssm.primitive
def grow(n, r, e):
    return n * np.exp(r - n + e)


def ricker(growth):
    model = ssm.Model("ricker")
    model.prior(lambda: {"r": ssm.Normal(3, sd=1), "sd": ssm.HalfNormal(sd=1)})
    model.prior(lambda: {"scale": ssm.Gamma(2, rate=0.2), "n0": ssm.Gamma(2, rate=0.2)})
    model.initial(lambda n0, sd: {"n": ssm.Dirac(n0), "e": ssm.Normal(0, sd=sd)})
    model.transition(lambda n, e, r, sd: {"n": ssm.Dirac(growth(n, r, e)),
                                          "e": ssm.Normal(0, sd=sd)})  # fmt: skip
    model.observation(lambda n, scale: {"y": ssm.Poisson(scale * n + 1e-9)})
    return model


@pytest.mark.slow
@pytest.mark.parametrize("growth", [
    pytest.param(lambda n, r, e: n * np.exp(r - n + e), id="formula"),
    pytest.param(grow, id="primitive"),
])  # fmt: skip
def test_counts_of_a_deterministic_state(growth):
    truth = {"r": 3.6, "sd": 0.3, "scale": 10.0, "n0": 7.0}
    model = ricker(growth)
    data = simulated(60, "ricker", parameters=truth, model=model)
    found = ssm.maximize(model, data, ssm.IF2(particles=1000, iterations=60, starts=2),
                         seed=seed_of("ricker"), progress=False)  # fmt: skip
    assert found.attrs["initial_law_only"] == ["n0"]
    at_truth = ssm.log_likelihood(model, data, truth, particles=4000, repeats=8, seed=1)
    best = np.logaddexp.reduce(at_truth) - np.log(8)
    assert found.log_likelihood > best - 4 * found.attrs["log_likelihood_error"]
    assert "a quadratic fitted" in found.attrs["information"]
    for name, value in truth.items():
        assert abs(found.parameters[name] - value) < 4 * found.standard_errors[name], name


@pytest.mark.slow
def test_an_epidemic_of_discrete_states():
    model = ssm.Model("epidemic")
    model.prior(lambda: {"beta": ssm.Gamma(2, rate=1), "rho": ssm.Beta(2, 2)})
    model.initial(lambda: {"s": ssm.Dirac(300.0), "i": ssm.Poisson(5.0)})

    @model.transition
    def transition(s, i, beta):
        force = beta * i / 300.0
        return {"s": ssm.Binomial(s, np.exp(-force)), "i": ssm.Poisson(0.3 * i + force * s)}

    model.observation(lambda i, rho: {"y": ssm.Binomial(i, rho)})
    data = simulated(20, "epidemic", parameters={"beta": 0.9, "rho": 0.6}, model=model)
    found = ssm.maximize(model, data, ssm.IF2(particles=500, iterations=40, starts=2), seed=2,
                         start={"beta": 0.7, "rho": 0.5}, progress=False)  # fmt: skip
    assert found.parameters["beta"] == pytest.approx(0.9, abs=0.3)
    assert np.isfinite(found.log_likelihood)


@ssm.primitive
def carried(x, phi):
    return phi * x


def walk(carry):
    """Linear and Gaussian, which can be seen unless `carry` is compiled."""
    model = ssm.Model("walk")
    model.prior(lambda: {"phi": ssm.Normal(0.5, sd=0.5), "q": ssm.Gamma(3, rate=4)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x, phi, q: {"x": ssm.Normal(carry(x, phi), sd=q)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=0.6)})
    return model


PLAIN, OPAQUE = walk(lambda x, phi: phi * x), walk(carried)
WALK = {"phi": 0.6, "q": 0.5}


def tops_of_walk(objective, count, particles=300):
    """The exact top (z), and those found from two standard errors beside it, with other seeds."""
    data = simulated(80, "walk", parameters=WALK, model=PLAIN)
    exact = ssm.maximize(PLAIN, data, objective=objective, seed=1, progress=False)
    out = []
    for k in range(count):
        seed = seed_of("walk", k)
        setup = setup_of(OPAQUE, data, start=exact.parameters, objective=objective, seed=seed)
        z = setup.space.z[setup.space.positions]
        inverse = np.linalg.pinv(setup.transform.at(z).jacobian)
        inner = inverse @ exact.covariance.to_numpy() @ inverse.T
        rng = np.random.default_rng(seed)
        beside = rng.standard_normal(2)
        beside *= 2.0 / np.linalg.norm(beside)
        begin = z + np.linalg.cholesky(inner) @ beside
        out.append(local_maximum(setup, ssm.IF2(particles=particles), begin, 0.5))
    return z, inner, out


@pytest.mark.parametrize(
    "objective", ["likelihood", pytest.param("posterior", marks=pytest.mark.slow)]
)
def test_the_top_is_found_from_beside_it(objective):
    """From where all runs may lag: within its own Monte Carlo error of the exact top, and that
    error is small beside the standard error."""
    z, inner, found = tops_of_walk(objective, 6 if objective == "likelihood" else 12)
    assert all(isinstance(f, LocalMaximum) for f in found)
    lengths = [(f.z - z) @ np.linalg.solve(f.error, f.z - z) for f in found]
    low, high = stats.chi2.ppf([LEVEL / 2, 1 - LEVEL / 2], 2 * len(found))
    assert low < np.sum(lengths) < 1.2**2 * high  # errors that are 1.2 times too small at most
    shares = [np.trace(np.linalg.solve(inner, f.error)) for f in found]
    assert np.mean(shares) < 0.2**2 * 2
    assert np.mean([f.moved for f in found]) > 1.5
    if objective == "likelihood":  # the curvature over a region, not at a point: to a fifth
        told = [np.sqrt(np.diagonal(np.linalg.inv(f.information))) for f in found]
        np.testing.assert_allclose(np.median(told, axis=0), np.sqrt(np.diagonal(inner)), rtol=0.2)


def test_an_exact_likelihood_has_its_top_to_many_digits():
    data = simulated(80, "walk", parameters=WALK, model=PLAIN)
    exact = ssm.maximize(PLAIN, data, seed=1, progress=False)
    short = ssm.IF2(particles=100, iterations=5, starts=2, averaged=2)
    found = ssm.maximize(PLAIN, data, short, seed=2, progress=False)
    for name, sd in exact.standard_errors.items():
        error = found.attrs["monte_carlo_errors"][name]
        off = abs(found.parameters[name] - exact.parameters[name])
        assert off < max(5.0 * error, 0.003 * sd)
        assert error < 0.005 * sd
        assert found.standard_errors[name] == pytest.approx(sd, rel=0.01)


def test_the_fit_can_be_left_out():
    data = simulated(30, "left out", parameters=WALK, model=PLAIN)
    method = ssm.IF2(particles=100, iterations=5, starts=2, averaged=2, points=0)
    found = ssm.maximize(OPAQUE, data, method, start=WALK, seed=1, progress=False)
    ends = found.attrs["start_parameters"]
    means = [np.exp(np.mean(np.log([e["q"] for e in ends])))] + [e["q"] for e in ends]
    assert found.parameters["q"] == pytest.approx(means[0]) or found.parameters["q"] in means[1:]
    assert "monte_carlo_errors" not in found.attrs
    assert np.all(np.isnan(list(found.standard_errors.values())))
    assert any("IF2(points=0) asks for none" in note for note in found.notes)
    known = ssm.maximize(PLAIN, data, method, start=WALK, seed=1, progress=False)
    assert np.all(np.isfinite(list(known.standard_errors.values())))  # exact, at no cost
    assert known.attrs["monte_carlo_error"].startswith("none")


def test_the_numbers_do_not_hang_on_who_runs_the_filters():
    data = simulated(30, "workers", parameters=WALK, model=PLAIN)
    method = ssm.IF2(particles=50, iterations=3, starts=2, averaged=2)
    found = []
    for workers in (1, 3):
        with ThreadPoolExecutor(workers) as executor:
            found.append(ssm.maximize(OPAQUE, data, method, start=WALK, seed=1, progress=False,
                                      executor=executor))  # fmt: skip
    found.append(ssm.maximize(OPAQUE, data, method, start=WALK, seed=1, progress=False))
    assert "monte_carlo_errors" in found[0].attrs
    for other in found[1:]:
        assert other.parameters == found[0].parameters
        assert other.standard_errors == found[0].standard_errors
        assert other.attrs["monte_carlo_errors"] == found[0].attrs["monte_carlo_errors"]


def test_filters_run_side_by_side():
    """As many tasks as there are points, over 8, are with the executor before the first is done."""

    class Counting(ThreadPoolExecutor):
        waiting, most = 0, 0

        def submit(self, *task):
            self.most = max(self.most, self._work_queue.qsize() + 1)
            return super().submit(*task)

    data = simulated(30, "workers", parameters=WALK, model=PLAIN)
    setup = replace(setup_of(OPAQUE, data, start=WALK), executor=Counting(1))
    local_maximum(
        setup, ssm.IF2(particles=50, points=160), setup.space.z[setup.space.positions], 0.5
    )
    assert setup.executor.most > 10


@pytest.mark.slow
def test_no_top_is_told_where_there_is_none():
    """Only the sum of a and b matters: their own values have no top, no errors, and a note."""
    model = ssm.Model("sum")
    model.prior(lambda: {"a": ssm.Normal(0, sd=1), "b": ssm.Normal(0, sd=1)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x, a, b: {"x": ssm.Normal(carried(x, a + b), sd=0.5)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=0.6)})
    data = simulated(40, "walk", parameters=WALK, model=PLAIN)
    method = ssm.IF2(particles=100, iterations=5, starts=1, averaged=2)
    found = ssm.maximize(model, data, method, start={"a": 0.3, "b": 0.3}, seed=1, progress=False)
    assert "monte_carlo_errors" not in found.attrs
    assert np.all(np.isnan(list(found.standard_errors.values())))
    assert found.attrs["converged"] is False
    assert any("has no maximum within" in note for note in found.notes)


def test_too_much_noise_for_a_top_is_told():
    data = simulated(300, "noise", parameters=WALK | {"q": 1.0}, model=PLAIN)
    method = ssm.IF2(particles=2, iterations=2, starts=1, averaged=2)
    found = ssm.maximize(OPAQUE, data, method, start=WALK, seed=1, progress=False)
    assert "monte_carlo_errors" not in found.attrs
    assert any(
        "Monte Carlo error too large" in note and "more particles" in note for note in found.notes
    )


def test_a_row_that_no_particle_can_produce_is_counted():
    model = ssm.Model("bounded")
    model.prior(lambda: {"a": ssm.Normal(0, sd=1)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x, a: {"x": ssm.Normal(a * x, sd=1)})
    model.observation(lambda x: {"y": ssm.Uniform(x - 1, x + 1)})
    data = {"y": np.array([0.1, 0.3, 60.0, 0.2])}
    setup = setup_of(model, data)
    perturbed = filter_of(setup, ssm.IF2())
    state = IF2State(np.zeros((1, 50)), random_state(setup.seed(1)), 0)
    _, block = if2_block(perturbed, state, 2)
    assert block.stats["impossible"].tolist() == [1, 1]
    assert np.all(np.isfinite(block.draws["z"]))
    assert np.all(block.stats["perturbed_log_likelihood"] == -np.inf)


def test_an_interrupt_keeps_the_passes_made(monkeypatch):
    plain, seen = PerturbedFilter.one_pass, []

    def one_pass(self, particles, iteration, stream):
        seen.append(iteration)
        if len(seen) > 60:
            raise KeyboardInterrupt
        return plain(self, particles, iteration, stream)

    monkeypatch.setattr(PerturbedFilter, "one_pass", one_pass)
    setup = setup_of(models.lgss, LGSS, {"c": 0.5}, {"theta": 1.0})
    found = climb(setup, ssm.IF2(particles=50, starts=2, iterations=1000))
    assert found.interrupted
    assert found.report["converged"] is None
    assert 1 < found.iterates.shape[1] < 70
    assert np.all(np.isfinite(found.theta))


def test_the_filter_travels_to_other_processes():
    setup = setup_of(models.lgss, LGSS)
    perturbed = filter_of(setup, ssm.IF2())
    state = IF2State(np.zeros((2, 50)), random_state(setup.seed(1)), 0)
    here = if2_block(perturbed, state, 2)[1].draws["z"]
    there = if2_block(pickle.loads(pickle.dumps(perturbed)), state, 2)[1].draws["z"]
    np.testing.assert_array_equal(here, there)


@pytest.mark.parametrize(("method", "words"), [
    (ssm.IF2(cooling=0.0), r"cooling=0\.0"),
    (ssm.IF2(cooling=1.5), r"cooling=1\.5"),
    (ssm.IF2(perturbation=-1.0), r"perturbation=-1\.0"),
    (ssm.IF2(perturbation={"c": 0.1}), r"names 'c', which is no free parameter.*theta"),
    (ssm.IF2(perturbation={"theta": "0.1"}), r"perturbation=.*positive numbers"),
    (ssm.IF2(starts=0), r"starts=0"),
    (ssm.IF2(starts=[]), r"starts is empty"),
    (ssm.IF2(starts=[{"thta": 1.0}]), r"starts\[0\] names 'thta'"),
    (ssm.IF2(particles=1), r"particles=1"),
    (ssm.IF2(evaluations=1), r"evaluations=1"),
    (ssm.IF2(points=-1), r"points=-1"),
    (ssm.IF2(points=7), r"points=7, too few.*at least 8"),
])  # fmt: skip
def test_what_is_refused(method, words):
    with pytest.raises(ssm.ArgumentError, match=f"(?s){words}"):
        ssm.maximize(models.lgss, LGSS, method, fixed={"c": 0.5}, progress=False)
