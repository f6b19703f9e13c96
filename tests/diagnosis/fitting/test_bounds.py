"""Numbers that a fit drove to a bound: found, held where it costs next to nothing, and named."""

from dataclasses import replace

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.diagnosis.fitting.bounds import COST, bounds_note, flat_outwards, hold_at_bounds
from ssmppl.diagnosis.fitting.densities import one_by_one
from ssmppl.diagnosis.fitting.fit import FROM_START, Fitter, standard_errors
from ssmppl.diagnosis.model.smoothing import Settings
from ssmppl.inference.run.problem import pose
from ssmppl.inference.run.seeds import seed_sequence
from tests.diagnosis.small import level
from tests.statistics.checks import seed_of


@pytest.mark.parametrize("z", [-27.0, -349.0, -700.0])
def test_a_scale_that_counts_for_nothing_is_held_next_to_where_it_counts(z):
    """log(1 + s^2) lost, s = exp(z): the most that costs 0.05 nats is s = sqrt(e^.05 - 1)."""

    def function(z):
        return -np.log1p(np.exp(2.0 * z[0])) - 0.5 * (z[1] - 3.0) ** 2

    z, mask = hold_at_bounds(one_by_one(function), np.array([z, 3.0]), np.array([True, False]))
    assert mask.tolist() == [True, False]
    assert np.exp(z[0]) == pytest.approx(np.sqrt(np.expm1(COST)), rel=1e-3)
    assert z[1] == 3.0


def test_an_upper_bound_is_one_too():
    function = one_by_one(lambda z: -np.log1p(np.exp(-z[0])))
    z, mask = hold_at_bounds(function, np.array([20.0]), np.array([True]))
    assert mask.all()
    assert np.log1p(np.exp(-z[0])) == pytest.approx(COST, rel=1e-3)


@pytest.mark.parametrize(
    "function",
    [lambda z: -0.5 * z[0] ** 2, lambda z: 0.0, lambda z: -0.5 * (z[0] / 3.0) ** 2],
    ids=["a top inside", "flat", "a wide top inside"],
)
def test_what_is_at_no_bound_is_left(function):
    z, mask = hold_at_bounds(one_by_one(function), np.array([0.4]), np.array([True]))
    assert not mask.any()
    assert z[0] == 0.4


def test_what_falls_at_the_first_step_outwards_is_at_no_bound():
    """The first is at a bound below, the second at one above, the third has its top here, and the
    fourth has no value outside."""

    def one(z):
        off = np.inf if z[3] > 0.5 else 0.5 * z[3] ** 2
        return -np.log1p(np.exp(z[0])) - np.log1p(np.exp(-z[1])) - 0.5 * z[2] ** 2 - off

    z = np.array([-20.0, 20.0, 0.0, 0.2])
    level = flat_outwards(one_by_one(one), z)
    assert level.tolist() == [True, True, False, False]
    _, mask = hold_at_bounds(one_by_one(one), z, np.ones(4, dtype=bool))
    assert mask.tolist() == level.tolist()


def test_many_points_are_looked_at_in_a_call():
    """As of a simulator, where a call of many takes little longer than of one."""
    calls = []

    def function(points):
        calls.append(len(points))
        return -np.log1p(np.exp(2.0 * points[:, 0]))

    _, mask = hold_at_bounds(function, np.array([-27.0]), np.array([True]))
    assert mask.all()
    assert len(calls) < 15
    assert sum(calls) < 150


def fits(model, y, exact=True):
    problem = pose(model, {"y": y})
    fitter = Fitter(problem, {}, Settings(100, "twisted"))
    if not exact:
        fitter.kalman = ssm.errors.NotApplicable("by particles")
    return fitter.fit(problem.experiments, seed_sequence(1), {})


@pytest.mark.parametrize("exact", [True, False])
def test_a_level_that_does_not_move(exact):
    """Over-differenced noise: q is at zero, whatever the seed, and the error of r is that of a
    sample's standard deviation, r / sqrt(2 T)."""
    e = np.random.default_rng(seed_of("white")).standard_normal(201)
    fit = fits(level(), e[1:] - 0.8 * e[:-1], exact)
    errors = standard_errors(fit, {})
    assert fit.bounds == ["q"]
    assert np.isnan(errors["q"])
    assert fit.by_component["q"] > 1e-4
    assert errors["r"] == pytest.approx(
        fit.by_component["r"] / np.sqrt(400.0), rel=0.05 if exact else 0.5
    )


def test_what_is_not_positive_definite_gives_no_error():
    y = np.random.default_rng(seed_of("steps")).standard_normal(60).cumsum()
    fit = fits(level(), y)
    assert np.all(np.isfinite(list(standard_errors(fit, {}).values())))
    for information in (np.ones((2, 2)), np.array([[1.0, 2.0], [2.0, 1.0]]), np.zeros((2, 2))):
        found = standard_errors(replace(fit, information=information), {})
        assert np.all(np.isnan(list(found.values())))


def test_the_note_names_and_gives_the_value():
    text = bounds_note(["q"], {"q": 1.25e-4, "r": 2.0}, "the fit of 'EMPS'")
    assert text.startswith("in the fit of 'EMPS' the estimate of q is on the boundary")
    assert "q = 0.000125" in text
    assert bounds_note([], {}, "a fit") == ""


def test_a_sensor_without_noise_leaves_the_errors_of_the_rest():
    """A servo axis whose position is read exactly: whatever the scale of the sensor's noise begins
    with, also one next to nothing, from which the likelihood is flat a long way."""
    model = ssm.Model("axis", inputs=("u",))

    @model.prior
    def prior():
        return {
            "b": ssm.HalfNormal(sd=5), "d": ssm.HalfNormal(sd=5), "q": ssm.HalfNormal(sd=0.05),
            "r": ssm.HalfNormal(sd=0.01),
        }  # fmt: skip

    @model.initial
    def initial():
        return {"p": ssm.Normal(0, sd=0.01), "v": ssm.Normal(0, sd=0.01)}

    @model.transition
    def transition(p, v, u, b, d, q):
        a = b * u - d * v
        return {"p": ssm.Dirac(p + 0.02 * v + 0.0002 * a), "v": ssm.Normal(v + 0.02 * a, sd=q)}

    @model.observation
    def observation(p, r):
        return {"y": ssm.Normal(p, sd=r)}

    rng = np.random.default_rng(seed_of("axis"))
    u, e = rng.standard_normal((2, 301))
    p, v = np.zeros(301), np.zeros(301)
    for t in range(300):
        a = 1.0 * u[t] - 4.0 * v[t]
        p[t + 1], v[t + 1] = p[t] + 0.02 * v[t] + 0.0002 * a, v[t] + 0.02 * a + 2e-3 * e[t]
    problem = pose(model, {"y": p, "u": u})
    fitter = Fitter(problem, {}, Settings(100, "twisted"))
    found = []
    for r in (1e-3, 1e-12, 1e-150):
        start = {"b": 0.5, "d": 2.0, "q": 1e-3, "r": r}
        fit = fitter.fit(problem.experiments, seed_sequence(1), start, FROM_START)
        assert fit.bounds == ["r"]
        found.append(standard_errors(fit, {}))
    # With w = dp / dt, c = 1 - .01 d and w - .01 b u = c v, the equations are the regression
    # w' - .01 b u' = (1 - .02 d) (w - .01 b u) + .02 b c u + c q e: slopes of its residual.
    v, c = v[:-1], 1.0 - 0.01 * 4.0
    by_b = -0.01 * u[1:] + 0.01 * (1.0 - 0.02 * 4.0) * u[:-1] - 0.02 * c * u[:-1]
    x = np.column_stack([by_b, 0.02 * c * v + 0.0002 * u[:-1]])
    spread = np.sqrt(np.diag(np.linalg.inv(x.T @ x))) * c * 2e-3
    for errors in found:
        assert np.isnan(errors["r"])
        assert [errors["b"], errors["d"]] == pytest.approx(spread, rel=0.1)
