"""Numbers that a fit drove to a bound: found, held where it costs next to nothing, and named."""

from dataclasses import replace

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.diagnosis.model.smoothing import Settings
from ssmppl.diagnosis.selection.fit import COST, Fitter, bounds_note, hold_at_bounds
from ssmppl.diagnosis.selection.refit import standard_errors
from ssmppl.inference.run.problem import pose
from ssmppl.inference.run.seeds import seed_sequence
from tests.diagnosis.small import level
from tests.statistics.checks import seed_of


def test_a_scale_that_counts_for_nothing_is_held_next_to_where_it_counts():
    """log(1 + s^2) lost, s = exp(z): the most that costs 0.05 nats is s = sqrt(e^.05 - 1)."""

    def function(z):
        return -np.log1p(np.exp(2.0 * z[0])) - 0.5 * (z[1] - 3.0) ** 2

    z, mask = hold_at_bounds(function, np.array([-27.0, 3.0]), np.array([True, False]))
    assert mask.tolist() == [True, False]
    assert np.exp(z[0]) == pytest.approx(np.sqrt(np.expm1(COST)), rel=1e-3)
    assert z[1] == 3.0


def test_an_upper_bound_is_one_too():
    z, mask = hold_at_bounds(lambda z: -np.log1p(np.exp(-z[0])), np.array([20.0]), np.array([True]))
    assert mask.all()
    assert np.log1p(np.exp(-z[0])) == pytest.approx(COST, rel=1e-3)


@pytest.mark.parametrize(
    "function",
    [lambda z: -0.5 * z[0] ** 2, lambda z: 0.0, lambda z: -0.5 * (z[0] / 3.0) ** 2],
    ids=["a top inside", "flat", "a wide top inside"],
)
def test_what_is_at_no_bound_is_left(function):
    z, mask = hold_at_bounds(function, np.array([0.4]), np.array([True]))
    assert not mask.any()
    assert z[0] == 0.4


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
    assert fit.values()["q"] > 1e-4
    assert errors["r"] == pytest.approx(
        fit.values()["r"] / np.sqrt(400.0), rel=0.05 if exact else 0.5
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
    assert text.startswith("in the fit of 'EMPS' the best value of q is a bound: held")
    assert "q at 0.000125" in text
    assert bounds_note([], {}, "a fit") == ""
