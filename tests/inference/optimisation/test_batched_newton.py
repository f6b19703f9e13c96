"""Climbs of many points at once: curvatures kept up from slopes, and fewer points for it."""

import numpy as np
import pytest

from ssmppl.inference.optimisation.batched_newton import NEAR, climb_together, information_at
from ssmppl.inference.optimisation.newton import bfgs_update

H = np.array([[3.0, 1.0, 0.2], [1.0, 2.0, -0.3], [0.2, -0.3, 0.7]])
TOP = np.array([0.4, -0.2, 0.1])


def quadratic(points):
    away = points - TOP
    return 5.0 - 0.5 * np.einsum("bi,ij,bj->b", away, H, away)


def test_an_update_has_the_slopes_fall_along_the_step():
    rng = np.random.default_rng(1)
    s = rng.normal(size=3)
    new = bfgs_update(np.eye(3), s, H @ s)
    np.testing.assert_allclose(new @ s, H @ s)
    assert np.linalg.eigvalsh(new).min() > 0.0
    assert np.linalg.eigvalsh(bfgs_update(np.eye(3), s, -s)).min() > 0.0  # damped


@pytest.mark.parametrize("precise", [True, False])
def test_a_quadratic_keeps_its_curvature_on_the_way_up(precise):
    """Where the step to the top is followed by slopes alone, too."""
    found = climb_together(quadratic, np.zeros((1, 3)), precise)
    np.testing.assert_allclose(found.z, TOP, atol=1e-4)
    np.testing.assert_allclose(found.information, H, rtol=1e-4, atol=1e-4)
    assert found.distance < (1e-7 if precise else NEAR)


def test_the_curvature_that_slopes_build_up_is_near_the_true_one():
    """Of a function that is no quadratic, climbed by slopes after the start."""
    asked = []

    def function(points):
        asked.append(len(points))
        away = points - TOP
        return quadratic(points) - 0.1 * np.sum(away**4, axis=1)

    found = climb_together(function, np.array([[2.0, 1.5, -1.8]]), precise=False)
    away = found.z - TOP
    assert 0.5 * away @ H @ away < 10.0 * NEAR
    along = np.array([1.6, 1.7, -1.9])
    assert along @ found.information @ along == pytest.approx(along @ H @ along, rel=0.5)
    newton = 1 + 2 * 3 + 3 * 2  # points of a stencil with second derivatives
    assert min(asked[2:]) < newton


@pytest.mark.parametrize("about", [H, 4.0 * H, np.diag([20.0, 0.3, 0.7])])
def test_a_curvature_that_is_given_takes_no_points(about):
    """Also a wrong one, whose climb gets there as well."""
    asked = []

    def counted(points):
        asked.append(len(points))
        return quadratic(points)

    found = climb_together(counted, np.zeros((1, 3)), False, about)
    away = found.z - TOP
    assert 0.5 * away @ H @ away < 10.0 * NEAR
    assert asked[1] == 1 + 2 * 3  # slopes alone


def test_second_derivatives_at_a_point():
    def function(points):
        return quadratic(points) + 0.1 * np.sum((points - TOP) ** 3, axis=1)

    at = TOP + [0.1, -0.2, 0.3]
    exact = H - 0.6 * np.diag(at - TOP)
    np.testing.assert_allclose(information_at(function, at, H), exact, rtol=1e-6, atol=1e-6)
