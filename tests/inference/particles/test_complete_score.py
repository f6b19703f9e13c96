"""The complete-data score against central differences of the complete-data log density.

The density is a function of the generated program, which knows nothing of derivatives and sets the
deterministic components by their own law at the shifted parameters.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy import special

import ssmppl as ssm
from ssmppl.analysis.density import Missing
from ssmppl.codegen.modules.program import compile_trace
from ssmppl.data import unpack_parameters
from ssmppl.data.parameters import pack
from ssmppl.errors import ArgumentError
from ssmppl.expressions.calculus import NotDifferentiable
from ssmppl.inference.particles.scores import complete_scores
from ssmppl.inference.preparation.space import space_of
from ssmppl.inference.run.problem import Problem, pose
from ssmppl.language.tracing import trace
from tests.models import standard as models
from tests.models.statements import build
from tests.statistics.checks import seed_of

# A deterministic state that moves with parameters in itself and in its start, whose noisy
# neighbour starts deterministically: every case of the recursion of sensitivities, twice over.
oscillator = ssm.Model("oscillator", inputs=("force",))


@oscillator.prior
def oscillator_prior():
    return {
        "k": ssm.Normal(0.5, sd=0.2),
        "h": ssm.Normal(0.3, sd=0.1),
        "p0": ssm.Normal(0, sd=1),
        "q": ssm.HalfNormal(sd=1),
        "r": ssm.HalfNormal(sd=1),
    }


@oscillator.initial
def oscillator_initial(p0, k):
    return {"p": ssm.Dirac(p0), "v": ssm.Dirac(k * p0), "w": ssm.Normal(0, sd=1)}


@oscillator.transition
def oscillator_transition(p, v, w, force, k, h, q):
    return {
        "p": ssm.Dirac(p + h * v + 0.1 * h * h * w),
        "v": ssm.Normal(v - h * k * np.sin(p) + h * force, sd=q),
        "w": ssm.Normal(0.5 * w + 0.1 * p, sd=1),
    }


@oscillator.observation
def oscillator_observation(p, r):
    return {"y": ssm.Normal(p, sd=r)}


def bent(x, a):
    """a x / (1 + x^2), by way of a function that has no derivative in its first argument."""
    one = special.gammainc(1.0 + a * a, 1.0) + special.gammaincc(1.0 + a * a, 1.0)
    return one * a * x / (1.0 + x * x)


opaque = ssm.Model("opaque")


@opaque.prior
def opaque_prior():
    return {"a": ssm.Normal(1, sd=0.5), "q": ssm.HalfNormal(sd=1)}


@opaque.initial
def opaque_initial():
    return {"x": ssm.Normal(0, sd=1)}


@opaque.transition
def opaque_transition(x, a, q):
    return {"x": ssm.Normal(bent(x, a), sd=q)}


@opaque.observation
def opaque_observation(x):
    return {"y": ssm.Normal(x, sd=0.5)}


MODELS = {
    "varves": models.varves,
    "oscillator": oscillator,
    "vehicle": models.vehicle,
    "echo": models.echo,
    "regression": models.regression,
    "counts": models.counts,
    **{name: build(name) for name in ("linear_vector", "wishart_noise", "simplex", "matrices")},
}
QUICK = ("varves", "oscillator", "simplex")  # the others take long to compile


def posed(model, seed, steps=12, experiments=2, missing=True):
    """A problem with simulated data, a parameter vector inside its support, and trajectories."""
    rng = np.random.default_rng(seed)
    traced = trace(model)
    inputs = {n: rng.normal(size=(steps, *shape)) for n, shape in traced.inputs.items()}
    first = Problem(traced, (), compile_trace(traced, Missing()))
    space = space_of(first, {}, {})
    values = unpack_parameters(traced, space.theta)
    made = ssm.simulate(model, values, steps=steps, inputs=inputs or None, draws=4 * experiments,
                        seed=seed)  # fmt: skip
    data, paths = [], []
    for i in range(experiments):
        series = {n: np.array(made[n][i], dtype=float) for n in traced.observations}
        if missing:
            for y in series.values():
                y[3] = np.nan
        data.append(series | inputs)
        group = {n: made[n].values[i::experiments] for n in traced.initial}
        paths.append(np.ascontiguousarray(pack(traced.initial.values(), group)))
    problem = pose(model, data)
    theta, _ = space.parameters(
        space.z[space.positions] + 0.1 * rng.normal(size=len(space.positions))
    )
    return problem, theta.copy(), paths


def slopes(function, theta, step):
    """Richardson's extrapolation of central differences, error of order step^4."""
    out = []
    for i in range(len(theta)):
        h = step * max(abs(theta[i]), 0.1)
        unit = np.eye(len(theta))[i]
        once = [(function(theta + k * h * unit) - function(theta - k * h * unit)) / (2 * k * h)
                for k in (1.0, 2.0)]  # fmt: skip
        out.append((4.0 * once[0] - once[1]) / 3.0)
    return np.stack(out, axis=-1)


@pytest.mark.parametrize(
    "name", [n if n in QUICK else pytest.param(n, marks=pytest.mark.slow) for n in MODELS]
)
def test_first_and_second_derivatives(name):
    problem, theta, paths = posed(MODELS[name], seed_of("complete score", name))
    scores = complete_scores(problem)
    assert not scores.differences
    value, gradient = scores.value_and_gradient(theta, paths)
    np.testing.assert_allclose(value, scores.log_density(theta, paths), rtol=1e-10)
    np.testing.assert_array_equal(gradient, scores.gradient(theta, paths))
    expected = slopes(lambda v: scores.log_density(v, paths), theta, 1e-3)
    size = np.abs(scores.log_density(theta, paths)).max() + np.abs(expected).max()
    np.testing.assert_allclose(gradient, expected, atol=1e-8 * size)
    assert np.all(np.abs(gradient).max(axis=0) > 0), "a score that says nothing"
    hessian = scores.hessian(theta, paths)
    expected = slopes(lambda v: scores.gradient(v, paths), theta, 1e-3)
    np.testing.assert_allclose(hessian, expected, atol=1e-8 * (size + np.abs(expected).max()))
    np.testing.assert_array_equal(hessian, np.swapaxes(hessian, 1, 2))


def test_parameters_left_out_have_no_score():
    problem, theta, paths = posed(models.varves, seed_of("left out"))
    whole, part = complete_scores(problem), complete_scores(problem, fixed={"phi"})
    gradient = part.gradient(theta, paths)
    np.testing.assert_allclose(gradient[:, 1], whole.gradient(theta, paths)[:, 1], rtol=1e-12)
    assert np.all(gradient[:, 0] == 0.0)
    np.testing.assert_array_equal(part.hessian(theta, paths)[:, 0], 0.0)
    nothing = complete_scores(problem, fixed={"phi", "tau"})
    assert not nothing.gradient(theta, paths).any()
    assert not nothing.hessian(theta, paths).any()


def test_the_callers_trajectories_stay_as_they_are():
    problem, theta, paths = posed(models.vehicle, seed_of("vehicle paths"))
    before = [p.copy() for p in paths]
    complete_scores(problem).gradient(theta, paths)
    assert all(np.array_equal(a, b) for a, b in zip(paths, before, strict=True))


def test_a_law_without_a_derivative_is_differenced_and_says_so():
    """Against the same law written out, whose derivatives are symbolic."""
    plain = ssm.Model("plain")
    plain.prior(opaque_prior)
    plain.initial(opaque_initial)

    @plain.transition
    def plain_transition(x, a, q):
        return {"x": ssm.Normal(a * x / (1.0 + x * x), sd=q)}

    plain.observation(opaque_observation)
    problem, theta, paths = posed(plain, seed_of("opaque"))
    data = [{"y": e.observed["y"]} for e in problem.experiments]
    exact, differenced = complete_scores(problem), complete_scores(pose(opaque, data))
    assert not exact.differences
    assert "no derivative" in differenced.differences["score"]
    expected = exact.gradient(theta, paths)
    np.testing.assert_allclose(
        differenced.gradient(theta, paths), expected, rtol=1e-6, atol=1e-6
    )  # fmt: skip
    hessian = exact.hessian(theta, paths)
    np.testing.assert_allclose(
        differenced.hessian(theta, paths), hessian, atol=1e-4 * np.abs(hessian).max()
    )
    with pytest.raises(NotDifferentiable):
        differenced.derived.gradient()


def spread_model(law):
    model = ssm.Model("spread")
    model.prior(lambda: {"a": ssm.HalfNormal(sd=1)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x, a: {"x": law(x, a)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=1)})
    return model


@pytest.mark.parametrize(
    ("law", "reason"),
    [
        (lambda x, a: ssm.Uniform(x, x + a), "support of x"),
        (lambda x, a: ssm.Truncated(ssm.Normal(x, sd=1), lower=a), "support of x"),
        (lambda x, a: ssm.Normal(np.where(x > a, x, 0.5), sd=1), "by steps"),
        (lambda x, a: ssm.Normal(np.floor(a) * x, sd=1), "by steps"),
    ],
)
def test_where_the_identity_fails_it_is_refused(law, reason):
    problem = pose(spread_model(law), {"y": np.zeros(4)})
    with pytest.raises(ArgumentError, match=reason) as raised:
        complete_scores(problem)
    assert raised.value.where is not None
    assert "fix 'a'" in raised.value.fix
    complete_scores(problem, fixed={"a"})


def test_a_step_in_the_states_alone_is_allowed():
    law = lambda x, a: ssm.Normal(np.where(x > 0, a * x, 0.2 * x), sd=1)  # noqa: E731
    complete_scores(pose(spread_model(law), {"y": np.zeros(4)}))
