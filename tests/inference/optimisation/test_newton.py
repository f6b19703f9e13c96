"""Newton's ascent by differences: quadratics exactly, any units, curved valleys, edges."""

import numpy as np
import pytest

from ssmppl.inference.optimisation.newton import (
    GOOD,
    LITTLE,
    climb,
    climb_by_slope,
    information_at,
    information_by_slope,
    widths,
)
from tests.statistics.checks import seed_of


@pytest.mark.parametrize("units", [1e-8, 1.0, 1e8])
def test_a_quadratic_is_climbed_to_its_top_with_its_curvature(units):
    rng = np.random.default_rng(seed_of("quadratic"))
    root = rng.standard_normal((4, 4))
    h, top = root @ root.T + np.eye(4), rng.standard_normal(4) * units

    def function(z):
        away = (z - top) / units
        return 3.0 - 0.5 * away @ h @ away

    found = climb(function, top + 40.0 * units * rng.standard_normal(4))
    away = (found.z - top) / units
    assert 0.5 * away @ h @ away < GOOD
    np.testing.assert_allclose(found.information * units**2, h, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("units", [1e-6, 1.0, 1e6])
def test_the_information_is_the_curvature_also_where_the_third_derivative_is_large(units):
    """Of a gamma law's logarithm beside a normal one that leans on it: by hand."""

    def function(z):
        a, b = z[0] / units, z[1]
        return 7.0 * a - 7.0 * np.exp(a) - 0.5 * 30.0 * (b - 0.4 * a) ** 2

    at = np.array([0.3 * units, 0.2])
    aa = (7.0 * np.exp(0.3) + 30.0 * 0.16) / units**2
    exact = np.array([[aa, -12.0 / units], [-12.0 / units, 30.0]])
    np.testing.assert_allclose(information_at(function, at), exact, rtol=3e-4)


def test_there_is_no_information_beside_a_point_without_a_value():
    """Not a matrix of zeros, which would read as a likelihood that does not move."""

    def function(z):
        return -0.5 * z @ z if z[0] <= 0.0 else -np.inf

    assert np.all(np.isnan(information_at(function, np.zeros(2))))
    assert np.all(np.isnan(information_at(function, np.ones(2))))
    np.testing.assert_allclose(information_at(function, -np.ones(2)), np.eye(2), atol=1e-5)


def test_a_curved_valley_is_followed_to_its_end():
    """Rosenbrock's, from where Newton's matrix is not definite."""
    found = climb(lambda z: -100.0 * (z[1] - z[0] ** 2) ** 2 - (1.0 - z[0]) ** 2,
                  np.array([-1.2, 1.0]))  # fmt: skip
    assert found.value > -LITTLE
    np.testing.assert_allclose(found.z, 1.0, atol=0.2)


def test_a_place_that_is_no_top_is_left():
    """A saddle has no slope: what is beside it has."""
    found = climb(lambda z: -((z[0] ** 2 - 1.0) ** 2) - z[1] ** 2, np.array([1e-2, 0.3]))
    assert found.value > -GOOD
    assert abs(abs(found.z[0]) - 1.0) < 0.1


def test_next_to_where_there_is_no_value():
    """The top lies on an edge: the climb ends there, with a slope that is one-sided."""

    def function(z):
        return float(z[0]) if z[0] < 2.0 else -np.inf

    found = climb(function, np.array([0.0]))
    assert 1.9 < found.z[0] < 2.0


@pytest.mark.parametrize("huge", [-1e308, 1e308])
def test_values_next_to_overflow_are_none(huge):
    """A likelihood of a model that runs away is a number still, and its differences are none: here
    where two coordinates move at once."""

    def function(z):
        return -float(z @ z) if z.min() < 0.5 else huge

    with np.errstate(all="raise"):
        for start in (0.49, 0.4, 0.2):
            found = climb(function, np.array([start, start]))
            assert found.value == pytest.approx(0.0, abs=GOOD)
            near = information_at(function, np.array([start, start]))
            assert np.isnan(near).all() or near == pytest.approx(2.0 * np.eye(2), abs=1e-3)
        assert climb(function, np.array([3.0, 3.0])) is None


def test_where_there_is_no_value_there_is_no_climb():
    assert climb(lambda z: -np.inf, np.zeros(2)) is None
    found = climb(lambda z: 1.5, np.zeros(0))
    assert (found.value, found.distance) == (1.5, 0.0)


def test_a_width_is_what_changes_the_function_by_about_one():
    scale = np.array([1e-6, 1.0, 300.0])
    found = widths(lambda z: -0.5 * np.sum((z / scale) ** 2), np.zeros(3), 0.0, np.full(3, 0.1))
    change = 0.5 * (found / scale) ** 2
    assert np.all((change[:2] >= 0.05) & (change <= 5.0)[:2])
    assert found[2] == 4.0  # as far as any


def gamma_beside_normal(units):
    """With its gradient: a gamma law's logarithm beside a normal one that leans on it."""

    def function(z):
        a, b = z[0] / units, z[1]
        off = b - 0.4 * a
        if a > 700.0:
            return -np.inf, np.full(2, np.nan)
        value = 7.0 * a - 7.0 * np.exp(a) - 15.0 * off**2
        return value, np.array([(7.0 - 7.0 * np.exp(a) + 12.0 * off) / units, -30.0 * off])

    return function


@pytest.mark.parametrize("units", [1e-6, 1.0, 1e4])
def test_by_the_gradient(units):
    function, exact = gamma_beside_normal(units), np.array([[11.8, -12.0], [-12.0, 30.0]])
    scale = np.diag([1.0 / units, 1.0])
    exact = scale @ exact @ scale
    np.testing.assert_allclose(information_by_slope(function, np.zeros(2)), exact, rtol=2e-3)
    found = climb_by_slope(function, np.array([3.0 * units, -2.0]))
    assert found.value > function(np.array([3.0 * units, -2.0]))[0]
    if units == 1.0:  # far from it the other climb takes over, which measures in widths
        assert found.is_top
        assert found.distance < 1e-7
        assert found.value == pytest.approx(-7.0, abs=1e-6)


def test_by_the_gradient_of_a_quadratic():
    rng = np.random.default_rng(seed_of("by the gradient"))
    root = rng.standard_normal((5, 5))
    h, top = root @ root.T + 0.1 * np.eye(5), rng.standard_normal(5)
    found = climb_by_slope(
        lambda z: (3.0 - 0.5 * (z - top) @ h @ (z - top), -h @ (z - top)), top + 20.0
    )
    np.testing.assert_allclose(found.z, top, atol=1e-3)
    np.testing.assert_allclose(found.information, h, rtol=1e-6, atol=1e-7)


def test_by_the_gradient_where_there_is_none():
    assert climb_by_slope(lambda z: (-np.inf, np.full(2, np.nan)), np.zeros(2)) is None
    found = climb_by_slope(lambda z: (-0.5 * z @ z, np.full(2, np.nan)), np.ones(2))
    assert not found.is_top
    assert found.distance == np.inf
