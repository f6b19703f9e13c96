"""Laplace's approximation: exact where the model is linear and Gaussian, and elsewhere what NumPy
makes of a log density written by hand, maximised by SciPy and differenced twice."""

import sys

import numpy as np
import pytest
from numba.core.registry import CPUDispatcher
from scipy import optimize, stats

import ssmppl as ssm
from ssmppl.codegen.modules.program import compile_trace
from ssmppl.codegen.native.loading import Loaded
from ssmppl.codegen.store.folder import cache_folder
from ssmppl.data import check_parameters
from ssmppl.errors import NotApplicable
from ssmppl.inference.exact.kalman import kalman_model
from ssmppl.inference.gaussian.likelihood import LaplaceLikelihood
from ssmppl.inference.gaussian.likelihood import approximate_log_likelihood as by
from ssmppl.inference.preparation.exact_models import exact_log_likelihood
from ssmppl.inference.preparation.exact_score import exact_score
from ssmppl.inference.run.problem import pose
from ssmppl.language.tracing import trace
from tests.codegen.harness import Numbers
from tests.codegen.test_functions import missing_of
from tests.models.statements import MODELS, build
from tests.statistics.checks import seed_of


def approximate_log_likelihood(problem, theta, kind):
    return by(problem, theta, problem.program.gaussian, kind)


def posed(model, data, parameters):
    problem = pose(model, data)
    return problem, check_parameters(problem.trace, parameters, support=False)


def linear():
    model = ssm.Model("linear", inputs=("u",))
    model.prior(lambda: {"a": ssm.Uniform(-1, 1), "r": ssm.HalfNormal(sd=1)})
    model.initial(lambda: {"x": ssm.MvNormal(np.array([0.3, -0.2]), covariance=np.eye(2)),
                           "z": ssm.Normal(1, sd=2)})  # fmt: skip

    def transition(x, z, u, a):
        new = np.array([[a, 0.2], [-0.1, 0.7]]) @ x + np.array([0.0, 1.0]) * u
        covariance = np.array([[0.5, 0.2], [0.2, 0.4]])
        return {"x": ssm.MvNormal(new, covariance=covariance), "z": ssm.Dirac(z + 0.1 * x[0])}

    def observation(x, z, r):
        return {"y": ssm.Normal(x[0] + x[1], sd=r), "w": ssm.Normal(z, sd=0.3)}

    model.transition(transition)
    model.observation(observation)
    return model


def with_gaps(name):
    """Two experiments of the linear model."""
    rng, data = np.random.default_rng(seed_of(name)), []
    for steps in (30, 7):
        y, w, u = rng.standard_normal((3, steps))
        y[2:5] = w[4] = np.nan
        data.append({"y": y, "w": w, "u": u})
    return data


def test_linear_gaussian_models_exactly():
    problem, theta = posed(linear(), with_gaps("linear"), {"a": 0.9, "r": 0.4})
    exact = exact_log_likelihood(problem.trace, problem.experiments, theta)
    for kind in ("laplace", "extended"):
        assert approximate_log_likelihood(problem, theta, kind) == pytest.approx(exact, rel=1e-12)


def dense(log_density, starts):
    """Laplace's log of the integral of exp(log_density(e)), by differences at the highest mode."""
    best, size = None, len(starts[0])
    for start in starts:
        found = optimize.minimize(lambda e: -log_density(e), start, method="BFGS",
                                  options={"gtol": 1e-9, "maxiter": 2000})  # fmt: skip
        if best is None or found.fun < best.fun - 1e-9:
            best = found
    h, eye = 1e-3, np.eye(size)
    curve = np.empty((size, size))
    for i in range(size):
        for j in range(i + 1):
            a, b = h * eye[i], h * eye[j]

            def at(s, t, a=a, b=b):
                return log_density(best.x + s * a + t * b)

            fourth = sum(
                c * d * at(s, t)
                for s, c in ((-2, 1), (-1, -8), (1, 8), (2, -1))
                for t, d in ((-2, 1), (-1, -8), (1, 8), (2, -1))
            )
            curve[i, j] = curve[j, i] = -fourth / (144.0 * h * h)
    sign, log_det = np.linalg.slogdet(curve)
    assert sign > 0
    return -best.fun + 0.5 * size * np.log(2 * np.pi) - 0.5 * log_det


def curved_noise():
    """A state whose noise grows with it, seen through counts."""
    model = ssm.Model("curved noise")
    model.prior(lambda: {"a": ssm.Normal(0, sd=1)})
    model.initial(lambda: {"x": ssm.Normal(0.3, sd=1.2)})
    model.transition(
        lambda x, a: {"x": ssm.Normal(a * np.sin(x) + x / 2, sd=0.5 * np.exp(0.2 * x))}
    )
    model.observation(lambda x: {"y": ssm.Poisson(np.exp(0.5 * x))})
    y = np.array([1.0, 0, 2, 5, np.nan, 0, 3, 1])

    def log_density(e, a=0.9):
        x, total = 0.3 + 1.2 * e[0], np.sum(stats.norm.logpdf(e))
        for t, seen in enumerate(y):
            if t:
                x = a * np.sin(x) + x / 2 + 0.5 * np.exp(0.2 * x) * e[t]
            if np.isfinite(seen):
                total += stats.poisson.logpmf(seen, np.exp(0.5 * x))
        return total

    return model, {"y": y}, {"a": 0.9}, log_density, len(y)


def pendulum():
    """A position without noise of its own, heavy tails, an initial law of another size."""
    model = ssm.Model("pendulum", inputs=("u",))
    model.prior(lambda: {"d": ssm.HalfNormal(sd=1)})
    model.initial(lambda: {"q": ssm.Normal(0, sd=0.5), "v": ssm.Normal(0.1, sd=0.4)})

    def transition(q, v, u, d):
        new = v + 0.1 * (u - 9 * np.sin(q) - d * v)
        return {"q": ssm.Dirac(q + 0.1 * v), "v": ssm.Normal(new, sd=0.3)}

    model.transition(transition)
    model.observation(lambda q: {"y": ssm.StudentT(4, q, scale=0.2)})
    rng = np.random.default_rng(seed_of("pendulum"))
    y, u = 0.4 * rng.standard_normal(9), rng.standard_normal(9)

    def log_density(e, d=0.9):
        q, v = 0.5 * e[0], 0.1 + 0.4 * e[1]
        total = np.sum(stats.norm.logpdf(e)) + stats.t.logpdf(y[0], 4, q, 0.2)
        for t in range(1, 9):
            q, v = q + 0.1 * v, v + 0.1 * (u[t - 1] - 9 * np.sin(q) - d * v) + 0.3 * e[t + 1]
            total += stats.t.logpdf(y[t], 4, q, 0.2)
        return total

    return model, {"y": y, "u": u}, {"d": 0.9}, log_density, 10


def product():
    """Two states of which the product is seen: their start is a saddle."""
    model = ssm.Model("product")
    model.prior(lambda: {"a": ssm.Normal(0, sd=1)})
    model.initial(lambda: {"x": ssm.MvNormal(np.zeros(2), covariance=np.eye(2))})
    covariance = np.array([[1.0, 0.3], [0.3, 0.5]])

    def transition(x, a):
        bent = np.array([0.1 * np.sin(x[0] * x[1]), 0.0])
        mean = np.array([[a, 0.2], [-0.1, 0.7]]) @ x + bent
        return {"x": ssm.MvNormal(mean, covariance=covariance)}

    model.transition(transition)
    model.observation(lambda x: {"y": ssm.Normal(x[0] * x[1], sd=0.5)})
    y = np.array([1.2, 2.1, 1.6, 2.4, 0.9])
    root = np.linalg.cholesky(covariance)

    def log_density(e, a=0.8):
        e = e.reshape(5, 2)
        x, total = e[0], np.sum(stats.norm.logpdf(e))
        for t in range(5):
            if t:
                bent = np.array([0.1 * np.sin(x[0] * x[1]), 0.0])
                x = np.array([[a, 0.2], [-0.1, 0.7]]) @ x + bent + root @ e[t]
            total += stats.norm.logpdf(y[t], x[0] * x[1], 0.5)
        return total

    return model, {"y": y}, {"a": 0.8}, log_density, 10


@pytest.mark.parametrize("case", [curved_noise, pendulum])
def test_what_numpy_makes_of_the_density(case):
    model, data, parameters, log_density, size = case()
    problem, theta = posed(model, data, parameters)
    found = approximate_log_likelihood(problem, theta, "laplace")
    starts = 0.5 * np.random.default_rng(1).standard_normal((4, size))
    assert found == pytest.approx(dense(log_density, starts), abs=1e-5)


def test_a_saddle_is_left_for_a_mode():
    """One of several: that of the density near it."""
    model, data, parameters, log_density, size = product()
    problem, theta = posed(model, data, parameters)
    e = problem.experiments[0]
    mode = problem.program.gaussian.laplace(theta, e.y, e.seen, e.u, np.zeros((5, 2)))
    near = mode.e.ravel()
    assert mode.log_likelihood == pytest.approx(dense(log_density, [near]), abs=1e-5)
    assert log_density(near) > log_density(np.zeros(size)) + 1.0


def test_from_the_last_mode_it_is_the_same():
    model, data, _, _, _ = pendulum()
    problem, theta = posed(model, data, {"d": 0.5})
    warm = LaplaceLikelihood(problem, problem.program.gaussian)
    for d in (0.5, 0.51, 3.0, 0.01, 0.5):
        theta = check_parameters(problem.trace, {"d": d}, support=False)
        fresh = approximate_log_likelihood(problem, theta, "laplace")
        assert warm(theta) == pytest.approx(fresh, abs=1e-7)


def test_where_nothing_can_be_it_is_minus_infinity():
    model, data, _, _, _ = curved_noise()
    problem, theta = posed(model, data, {"a": 1e308})
    for kind in ("laplace", "extended"):
        assert approximate_log_likelihood(problem, theta, kind) == -np.inf


def differences_of(likelihood, theta):
    """(P,) of a function of theta by differences, and their error."""
    value = likelihood(theta)

    def along(k, h):
        out = []
        for sign in (1.0, -1.0):
            there = theta.copy()
            there[k] += sign * h
            out.append(likelihood(there))
        return (out[0] - out[1]) / (2.0 * h)

    differences, bound = [], []
    for k, size in enumerate(theta):
        h = 1e-3 * max(abs(size), 1e-2)
        wide, narrow = along(k, h), along(k, h / 2.0)
        differences.append((4.0 * narrow - wide) / 3.0)
        # Rounding, and what extrapolation leaves: less than the difference of the two.
        bound.append(0.1 * abs(wide - narrow) + 1e-12 * (1.0 + abs(value)) / h)
    return np.array(differences), np.array(bound)


@pytest.mark.parametrize("make", [curved_noise, pendulum, product])
def test_the_gradient_is_exact(make):
    model, data, parameters, *_ = make()
    problem, theta = posed(model, data, parameters)
    likelihood = LaplaceLikelihood(problem, problem.program.gaussian)
    assert likelihood.differentiable

    def settled(theta):  # from the mode itself once more: what is left there is rounding
        likelihood(theta)
        return likelihood(theta)

    settled(theta)
    value, found = likelihood.score(theta)
    assert value == pytest.approx(likelihood(theta), rel=1e-12)
    differences, bound = differences_of(settled, theta)
    assert np.all(np.abs(found - differences) < bound + 1e-7 * np.abs(found))


@pytest.mark.parametrize("gaps", [pytest.param(False, marks=pytest.mark.slow), True])
@pytest.mark.parametrize("name", sorted(MODELS))
def test_the_gradient_of_every_statement(name, gaps):
    """Of all that the language has words for."""
    traced = trace(build(name))
    program = compile_trace(traced, missing_of(traced, gaps))
    found = program.gaussian
    if isinstance(found, NotApplicable) or not isinstance(found.by_adjoint, Loaded):
        return
    n = Numbers(traced, np.random.default_rng(5), gaps)
    given = n.y, n.seen, n.u
    mode = found.laplace(n.theta, *given)
    if mode is None or not len(n.theta):
        return

    def value(theta):
        return found.laplace(theta, *given, found.laplace(theta, *given, mode.e).e).log_likelihood

    gradient = found.laplace_gradient(n.theta, *given, found.laplace(n.theta, *given, mode.e))
    differences, bound = differences_of(value, n.theta)
    assert np.all(np.abs(gradient - differences) < bound + 1e-6 * np.abs(gradient)), (
        gradient, differences, bound
    )  # fmt: skip


def test_the_gradient_of_a_linear_model():
    """With a joint law, gaps, an input, two experiments, and a state without noise."""
    problem, theta = posed(linear(), with_gaps("gradient"), {"a": 0.9, "r": 0.4})
    found = LaplaceLikelihood(problem, problem.program.gaussian).score(theta)
    model = kalman_model(problem.trace)
    free = np.ones(len(theta), dtype=bool)
    exact = exact_score(model, problem.experiments, free, theta).score(theta)
    assert found[0] == pytest.approx(exact[0], rel=1e-12)
    np.testing.assert_allclose(found[1], exact[1], rtol=1e-9)


def test_what_is_compiled_is_kept_for_the_next_process():
    model, data, parameters, *_ = curved_noise()
    problem, theta = posed(model, data, parameters)
    LaplaceLikelihood(problem, problem.program.gaussian).score(theta)
    approximate_log_likelihood(problem, theta, "extended")
    assert isinstance(problem.program.gaussian.by_mode, Loaded)
    compiled = [
        name.rpartition(".")[2] for name, module in list(sys.modules.items())
        if "_by_address_" in name and any(
            isinstance(v, CPUDispatcher) and v.signatures and v.py_func.__module__ == name
            and v.targetoptions.get("nogil") for v in vars(module).values()
        )
    ]  # fmt: skip
    assert any(name.startswith("gaussian_mode") for name in compiled)
    for name in compiled:
        assert list(cache_folder().glob(f"{name}.*.nbc")), name
