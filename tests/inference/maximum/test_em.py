"""EM of linear Gaussian models: exact expectations, the exact maximum, a likelihood that rises."""

import numpy as np
import pytest
from scipy import stats

import ssmppl as ssm
from ssmppl.data import check_parameters, check_values
from ssmppl.datasets import load
from ssmppl.inference.maximum import em
from ssmppl.inference.maximum.ascent import Maximization
from ssmppl.inference.maximum.em import ExactSteps
from ssmppl.inference.maximum.em import climb as climb_em
from ssmppl.inference.maximum.m_step import maximiser
from ssmppl.inference.preparation.space import space_of
from ssmppl.inference.run.problem import pose
from tests.models import em as em_models
from tests.models import standard as models
from tests.models.em import simulated
from tests.statistics.checks import LEVEL, seed_of, some
from tests.statistics.exact import DenseGaussian

MLE = {"lgss_main_text": (0.5, 0.7579865296111391), "lgss_appendix": (1.0, 0.830220361678073)}


def setup_of(model, data, fixed=None, start=None, objective="likelihood", seed=1):
    problem = pose(model, data)
    held, near = check_values(problem.trace, fixed), check_values(problem.trace, start)
    root = np.random.SeedSequence(seed)
    return Maximization(problem, space_of(problem, held, near), objective, held, near, root)


def likelihoods(setup, thetas):
    return np.array([setup.kalman.log_likelihood(setup.problem.experiments, t) for t in thetas])


def assert_never_falls(setup, ascent):
    values = likelihoods(setup, ascent.iterates)
    if setup.with_prior:
        values += [setup.problem.program.entry("log_prior")(t) for t in ascent.iterates]
    assert np.all(np.diff(values) >= -1e-10 * np.abs(values[:-1]))


# -- the E-step against draws from the dense Gaussian
U = np.sin(np.arange(12.0))
CASES = {
    "lgss": (models.lgss, {"theta": 1.3, "c": 0.8}, lambda: models.lgss_matrices(1.3, 0.8), None),
    "companion": (
        em_models.companion, em_models.COMPANION, lambda: em_models.COMPANION_MATRICES, None,
    ),
    "vector": (em_models.vector, em_models.VECTOR, lambda: em_models.vector_matrices(U), {"u": U}),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_expected_statistics_are_those_of_the_dense_gaussian(name):
    """Exact draws of all states from one multivariate normal, through the compiled statistics."""
    model, parameters, matrices, inputs = CASES[name]
    data = simulated(model, parameters, 12, seed_of("e-step", name), 0.2, inputs)
    setup = setup_of(model, data)
    theta = check_parameters(setup.problem.trace, parameters)
    steps = ExactSteps(setup, setup.kalman)
    expected = steps.statistics(theta)
    dense = DenseGaussian(data["y"], **matrices())
    rng = np.random.default_rng(seed_of("e-step draws", name))
    m, (t, d) = 20_000, dense.mean.shape
    values, vectors = np.linalg.eigh(dense.covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    paths = dense.mean + (rng.standard_normal((m, t * d)) @ root.T).reshape(m, t, d)
    maximum = maximiser(setup, "EM")
    (e,) = setup.problem.experiments
    each, size = np.empty((m, len(expected))), len(expected)
    run = maximum.module.weighted_statistics
    run(theta, e.y, e.seen, e.u, paths, np.ones(m), each, np.empty(size), np.empty(size))
    error = each.std(axis=0, ddof=1) / np.sqrt(m)
    constant = error < 1e-9
    np.testing.assert_allclose(each.mean(axis=0)[constant], expected[constant], atol=1e-9)
    z = (each.mean(axis=0) - expected)[~constant] / error[~constant]
    assert np.max(np.abs(z)) <= stats.norm.isf(LEVEL / (2 * len(z) * len(CASES))), z


def test_weighted_statistics_leave_out_what_weighs_nothing():
    data = simulated(models.lgss, {"theta": 1.0, "c": 1.0}, 6, 3)
    setup = setup_of(models.lgss, data)
    maximum = maximiser(setup, "EM")
    theta = np.array([1.0, 1.0])
    paths = np.random.default_rng(1).standard_normal((3, 6, 1))
    single = [maximum.statistics(theta, [paths[[i]]], [np.ones(1)]) for i in range(3)]
    weights = np.array([0.3, 0.0, 0.7])
    found = maximum.statistics(theta, [paths], [weights])
    np.testing.assert_allclose(found, 0.3 * single[0] + 0.7 * single[2])


# -- the maximum
@pytest.mark.parametrize("accelerate", [True, False])
@pytest.mark.parametrize("name", MLE)
def test_reaches_the_exact_maximum(name, accelerate):
    c, mle = MLE[name]
    data = {"y": load(name)["y"]}
    setup = setup_of(models.lgss, data, fixed={"c": c})
    found = climb_em(setup, ssm.EM(accelerate=accelerate))
    assert found.report["converged"]
    assert found.theta[0] == pytest.approx(mle, rel=1e-7)
    assert_never_falls(setup, found)


def test_extrapolation_saves_steps_and_tells_the_distance():
    """Nearly all that the states tell is missing: the factor of EM is close to one."""
    data = simulated(em_models.stationary, em_models.STATIONARY, 300, seed_of("slow"))
    found = {}
    for accelerate in (True, False):
        setup = setup_of(em_models.stationary, data)
        found[accelerate] = climb_em(setup, ssm.EM(accelerate=accelerate, iterations=200))
        assert_never_falls(setup, found[accelerate])
    assert found[True].report["converged"]
    assert not found[False].report["converged"]
    # and the distance that stops the climb is honest, where a step is far shorter than it
    left = setup.space_at(found[True].theta) - setup.space_at(found[False].theta)
    assert 0.3 < np.abs(left).max() / found[False].report["distance"] < 3.0


def problem_data(name):
    seed = seed_of("maximum", name)
    if name == "regression":
        u = np.cos(0.7 * np.arange(80))
        truth = {"a": 0.6, "b": 0.8, "q": 0.5}
        return models.regression, simulated(models.regression, truth, 80, seed, 0.1, {"u": u})
    if name == "two states":
        truth = {"a": 0.8, "k": 0.6, "precision": 3.0, "r": 0.3}
        return models.two_states, simulated(models.two_states, truth, 200, seed, 0.1)
    if name == "vector":
        u = np.sin(0.3 * np.arange(150))
        data = simulated(em_models.vector, em_models.VECTOR, 150, seed, 0.1, {"u": u})
        return em_models.vector, data
    if name == "stationary":
        data = simulated(em_models.stationary, em_models.STATIONARY, 150, seed, 0.1)
        return em_models.stationary, data
    if name == "decay":
        dt = np.random.default_rng(seed).uniform(0.1, 2.0, 120)
        return em_models.decay, simulated(
            em_models.decay, em_models.DECAY, 120, seed, 0.1, {"dt": dt}
        )
    two = [simulated(em_models.companion, em_models.COMPANION, n, seed + n, 0.1) for n in (60, 90)]
    return em_models.companion, two


@pytest.mark.parametrize("objective", ["likelihood", "posterior"])
@pytest.mark.parametrize(
    "name", some(["regression", "two states", "vector", "stationary", "decay", "companion"], 2)
)
def test_agrees_with_direct_optimisation(name, objective):
    """Inputs, missing values, two experiments, matrices, a Dirac state; and what does not separate.

    The expected log density of `decay` is no sum of functions of k times statistics.
    """
    model, data = problem_data(name)
    options = {"objective": objective, "progress": False, "seed": 1}
    by_em = ssm.maximize(model, data, ssm.EM(tolerance=1e-9), **options)
    direct = ssm.maximize(model, data, ssm.DirectOptimization(), **options)
    assert by_em.attrs["converged"], by_em.attrs
    for parameter, value in direct.parameters.items():
        np.testing.assert_allclose(by_em.parameters[parameter], value, rtol=1e-6, atol=1e-6)
        errors = by_em.standard_errors[parameter]
        np.testing.assert_allclose(errors, direct.standard_errors[parameter], rtol=1e-4)
    if objective == "likelihood":  # flat there
        assert by_em.log_likelihood == pytest.approx(direct.log_likelihood, abs=1e-9)
    if name == "decay":
        assert "does not separate" in by_em.attrs["m_step"]
    setup = setup_of(model, data, objective=objective)
    assert_never_falls(setup, climb_em(setup, ssm.EM(tolerance=1e-4)))


def test_too_few_steps_are_told():
    data = simulated(em_models.stationary, em_models.STATIONARY, 300, seed_of("slow"))
    found = ssm.maximize(em_models.stationary, data, ssm.EM(iterations=4), progress=False)
    assert found.attrs["converged"] is False
    assert "not converged" in repr(found)
    assert found.attrs["distance"] > 1e-3


# -- a likelihood that never falls
def random_question(number):
    """A random model: which parameters are free, where the others are held, data, a start."""
    rng = np.random.default_rng(seed_of("random model", number))
    model, truth = [
        (em_models.companion, em_models.COMPANION),
        (em_models.vector, em_models.VECTOR),
        (em_models.stationary, em_models.STATIONARY),
        (em_models.decay, em_models.DECAY),
    ][number % 4]
    names = list(truth)
    free = {n for n in names if rng.random() < 0.6} or {names[rng.integers(len(names))]}
    values = {n: _moved(n, np.asarray(v, float), rng) for n, v in truth.items()}
    steps = int(rng.integers(8, 60))
    inputs = {"vector": {"u": rng.standard_normal(steps)},
              "decay": {"dt": rng.uniform(0.05, 3.0, steps)}}.get(model.name)  # fmt: skip
    data = simulated(model, values, steps, int(rng.integers(2**31)), rng.uniform(0, 0.4), inputs)
    held = {n: v for n, v in values.items() if n not in free}
    start = {n: _moved(n, np.asarray(truth[n], float), rng) for n in free}
    return model, data, held, start, ["likelihood", "posterior"][int(rng.random() < 0.3)]


def _moved(name, value, rng):
    """A random value of the parameter's kind."""
    if name == "Q":
        root = 0.6 * rng.standard_normal((2, 2)) + np.eye(2)
        return root @ root.T
    if name == "phi":
        return rng.uniform(-0.95, 0.95)
    if name in ("q", "r", "tau", "k", "s"):
        return value * np.exp(0.7 * rng.standard_normal(value.shape))
    return 0.6 * value + 0.3 * rng.standard_normal(value.shape)


def check_random_models(numbers):
    for number in numbers:
        model, data, held, start, objective = random_question(number)
        for accelerate in (True, False):
            setup = setup_of(model, data, held, start, objective)
            found = climb_em(setup, ssm.EM(iterations=12, accelerate=accelerate))
            assert len(found.iterates) > 1, number
            assert_never_falls(setup, found)


def test_likelihood_never_falls():
    check_random_models(range(12))


@pytest.mark.slow
@pytest.mark.parametrize("models", [60, pytest.param(200, marks=pytest.mark.exhaustive)])
def test_likelihood_never_falls_over_many_models(models):
    check_random_models(range(models))


# -- refusals
def test_refuses_what_is_not_linear():
    with pytest.raises(ssm.ArgumentError, match="EM needs a linear Gaussian model") as caught:
        ssm.maximize(models.varves, {"y": np.ones(5)}, ssm.EM(), progress=False)
    assert "ssm.PSAEM()" in str(caught.value)
    assert caught.value.where.function == "varves_observation"


def test_refuses_a_parameter_that_the_states_determine():
    data = {"y": np.arange(8.0)}
    with pytest.raises(ssm.ArgumentError, match="EM does not apply: the transition of p is Dirac"):
        ssm.maximize(models.vehicle, data, ssm.EM(), progress=False)


def test_refuses_settings_without_sense():
    data = {"y": load("lgss_appendix")["y"]}
    for method, found in ((ssm.EM(iterations=0), "iterations=0"), (ssm.EM(tolerance=0.0), "toler")):
        with pytest.raises(ssm.ArgumentError, match=found):
            ssm.maximize(models.lgss, data, method, progress=False)


def test_a_root_that_a_condition_guards():
    """EM stood still where the other case holds, and called the start its maximum."""
    model = ssm.Model("guarded")
    model.prior(lambda: {"b": ssm.Uniform(-0.95, 0.9), "s": ssm.HalfNormal(sd=1)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x, b, s: {"x": ssm.Normal(np.where(b > 0, np.sqrt(b), b) * x, sd=s)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=0.3)})
    y = ssm.simulate(model, parameters={"b": -0.7, "s": 0.5}, steps=100, seed=3)["y"].values[0]
    found = [
        ssm.maximize(model, {"y": y}, method, start={"b": -0.3, "s": 0.9}, seed=1, progress=False)
        for method in (ssm.EM(), ssm.DirectOptimization())
    ]
    assert found[0].parameters == pytest.approx(found[1].parameters, rel=1e-4)


def test_slow_steps_are_told(monkeypatch):
    """Where the maximum of a step has no closed form, by how long all of them may take."""
    monkeypatch.setattr(em, "PATIENCE", 0.0)
    model = ssm.Model("partly missing")
    model.prior(lambda: {"R": ssm.InverseWishart(4, scale=np.eye(2))})
    model.initial(lambda: {"x": ssm.Normal(np.zeros(2), sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(0.8 * x, sd=0.5)})
    model.observation(lambda x, R: {"y": ssm.MvNormal(x, covariance=R)})
    y = np.random.default_rng(1).normal(size=(20, 2))
    y[[3, 8], 0] = np.nan
    with pytest.warns(UserWarning, match=r"EM may take up to .* no closed form .*DirectOpt"):
        ssm.maximize(model, {"y": y}, ssm.EM(iterations=6), seed=1, progress=False)
