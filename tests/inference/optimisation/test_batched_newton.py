"""Climbs of many points at once: curvatures kept up from slopes, and fewer points for it."""

import numpy as np
import pytest

from ssmppl.inference.optimisation import batched_newton
from ssmppl.inference.optimisation.batched_newton import (
    NEAR,
    climb_together,
    information_at,
)
from ssmppl.inference.optimisation.newton import bfgs_update
from ssmppl.inference.optimisation.parts import Parts, summed

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


def regression(rows=400):
    """Increments of the log-likelihood of a Poisson regression, and its prior: minus the second
    derivatives are X' diag(mean) X + 1 / 4, and the outer products of slopes are about that."""
    rng = np.random.default_rng(7)
    x = np.column_stack([np.ones(rows), rng.normal(size=(rows, 2))])
    y = rng.poisson(np.exp(x @ TOP))

    def parts(z):
        eta = z @ x.T
        return Parts(np.column_stack([y * eta - np.exp(eta), -0.125 * np.sum(z**2, axis=1)]))

    def information(z):
        return (x * np.exp(x @ z)[:, None]).T @ x + 0.25 * np.eye(3)

    def spread(z):  # sd of a sum of products of two slopes
        slopes = x * (y - np.exp(x @ z))[:, None]
        products = slopes[:, :, None] * slopes[:, None, :]
        return np.sqrt(rows) * products.std(axis=0)

    return parts, information, spread


@pytest.mark.parametrize("precise", [True, False])
def test_increments_tell_of_second_derivatives_without_points_of_their_own(precise):
    function, information, spread = regression()
    asked = []

    def counted(points):
        asked.append(len(points))
        return function(points)

    found = climb_together(counted, np.zeros((1, 3)), precise)
    both_sides, one_side, shares = 1 + 2 * 3, 1 + 3, 4
    assert asked[:2] == [1, both_sides]
    if not precise:
        assert set(asked[2:]) <= {one_side, both_sides, shares}
        assert one_side in asked
    exact = information(found.z)
    top = climb_together(lambda z: summed(function(z)), np.zeros((1, 3)))
    assert 0.5 * (found.z - top.z) @ exact @ (found.z - top.z) < (1e-6 if precise else 5 * NEAR)
    error = 1e-4 * np.abs(exact) if precise else 4.0 * spread(found.z)
    assert np.all(np.abs(found.information - exact) <= error)


def test_a_part_without_a_value_is_none():
    """A cliff beside the start: slopes on one side, and no step beyond it."""
    function, *_ = regression()

    def cut(z):
        out = function(z)
        out.rows[z[:, 0] > 0.41] = -np.inf
        return out

    found = climb_together(cut, np.array([[0.409, 0.0, 0.0]]), precise=False)
    assert found.z[0] <= 0.41
    assert summed(function(found.z[None]))[0] > summed(function(np.array([[0.409, 0.0, 0.0]])))[0]


def test_second_derivatives_at_a_point():
    def function(points):
        return quadratic(points) + 0.1 * np.sum((points - TOP) ** 3, axis=1)

    at = TOP + [0.1, -0.2, 0.3]
    exact = H - 0.6 * np.diag(at - TOP)
    np.testing.assert_allclose(information_at(function, at, H), exact, rtol=1e-6, atol=1e-6)


def test_a_prior_counts_with_its_second_derivatives():
    """Of a coordinate that the data say nothing of, at the prior's top: slopes there are zero."""

    def parts(z):
        rows = -0.5 * (z[:, :1] - np.linspace(-1.0, 3.0, 20)) ** 2
        return Parts(np.column_stack([rows, -0.5 * 7.0 * z[:, 1] ** 2]))

    found = climb_together(parts, np.zeros((1, 2)), precise=False)
    assert found.information[1, 1] == pytest.approx(7.0, rel=1e-6)
    assert found.z[0] == pytest.approx(1.0, abs=0.05)


def residuals(z):
    """Increments of normal residuals, their mean and log sd: far too small an sd at the start."""
    y = np.random.default_rng(3).normal(2.0, 1.5, 200)
    with np.errstate(over="ignore"):
        rows = -z[:, 1:] - 0.5 * (y - z[:, :1]) ** 2 * np.exp(-2.0 * z[:, 1:])
    return Parts(np.column_stack([rows, np.zeros(len(z))]))


def points_of(starts, monkeypatch, **constants):
    asked = []
    for name, value in constants.items():
        monkeypatch.setattr(batched_newton, name, value)

    def counted(z):
        asked.append(len(z))
        return residuals(z)

    found = climb_together(counted, np.array(starts), precise=False)
    monkeypatch.undo()
    return found, sum(asked)


@pytest.mark.parametrize("scale", [1e-3, 1.0])
def test_a_climb_does_not_end_where_old_outer_products_say_so(monkeypatch, scale):
    """Those of the start are many times too large, and the steps do not see all directions."""
    y = np.random.default_rng(3).normal(2.0, 1.5, 200)
    top = [y.mean(), np.log(y.std())]
    found, _ = points_of([[0.0, -3.0]], monkeypatch, LEAST_SCALE=scale)
    away = found.z - top
    assert 0.5 * 200.0 * (away[0] ** 2 / y.var() + 2.0 * away[1] ** 2) < 5.0 * NEAR


def test_outer_products_that_are_far_too_large_cost_fewer_steps_when_brought_down(monkeypatch):
    _, points = points_of([[0.0, -3.0]], monkeypatch)
    _, more = points_of([[0.0, -3.0]], monkeypatch, LEAST_SCALE=1.0)
    assert points < more


def test_climbs_that_cannot_reach_the_highest_wait(monkeypatch):
    starts = [[0.0, -3.0], [0.0, -6.0], [5.0, -6.0]]
    found, points = points_of(starts, monkeypatch)
    same, more = points_of(starts, monkeypatch, EARLY=10**6)
    assert points < more
    np.testing.assert_allclose(found.z, same.z, atol=0.05)


def test_a_climb_goes_on_to_the_top_of_a_long_ridge():
    """Two coordinates of which the sum is known and the difference hardly, and the sum bends by
    other amounts either way: differences to one side see a slope along the ridge that is none."""
    k = np.linspace(0.8, 1.2, 100)

    def parts(z):
        total, apart = z[:, 0] + z[:, 1], z[:, 0] - z[:, 1] - 1.0
        across = np.expm1(total) - total  # about total^2 / 2
        rows = -k * 40.0 * across[:, None] - 0.005 * k * apart[:, None] ** 2
        return Parts(np.column_stack([rows, np.zeros(len(z))]))

    found = climb_together(parts, np.array([[-0.4, 0.7]]), precise=False)
    assert -summed(parts(found.z[None]))[0] < 5.0 * NEAR


def test_a_climb_does_not_crawl_along_a_winding_valley(monkeypatch):
    """Where the top is a fifth of a nat away, and steps follow the valley for a hundredth each."""

    def winding(z):
        return -10.0 * (z[:, 1] - np.sin(2.0 * z[:, 0])) ** 2 - 0.05 * (z[:, 0] - 3.0) ** 2

    def points(patience):
        monkeypatch.setattr(batched_newton, "PATIENCE", patience)
        asked = []

        def counted(z):
            asked.append(len(z))
            return winding(z)

        climb_together(counted, np.zeros((1, 2)), precise=False)
        return sum(asked)

    assert points(batched_newton.PATIENCE) < points(10**6)
