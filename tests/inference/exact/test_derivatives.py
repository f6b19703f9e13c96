"""The observed information by differences of a gradient: exact figures, and how many gradients."""

import numpy as np
import pytest

from ssmppl.inference.exact.derivatives import observed_information


class Counted:
    """The gradient of 700 z_0 - 700 exp(z_0) - 1500 (z_1 - 0.4 z_0)^2 with z = theta / units."""

    def __init__(self, units):
        self.units, self.calls = np.array(units), 0

    def __call__(self, theta):
        self.calls += 1
        a, b = theta / self.units
        lean = 3000.0 * (b - 0.4 * a)
        return np.array([700.0 - 700.0 * np.exp(a) + 0.4 * lean, -lean]) / self.units

    def exact(self, theta):
        a = theta[0] / self.units[0]
        z = np.array([[700.0 * np.exp(a) + 480.0, -1200.0], [-1200.0, 3000.0]])
        return z / np.outer(self.units, self.units)


@pytest.mark.parametrize("units", [(1.0, 1.0), (1e-6, 1e6), (1e5, 1e-5)])
@pytest.mark.parametrize("place", [(0.0, 0.0), (0.3, -0.2)])
def test_four_gradients_a_parameter_and_a_few_that_look_for_the_step(units, place):
    gradient = Counted(units)
    theta = np.array(place) * units
    found, error = observed_information(gradient, theta, np.ones(2, dtype=bool))
    exact = gradient.exact(theta)
    scale = np.sqrt(np.outer(np.diag(exact), np.diag(exact)))
    assert (abs(found - exact) < 1e-8 * scale).all()
    assert (error < 1e-7 * scale).all()
    assert gradient.calls <= 2 * 16


def test_what_bends_too_much_is_looked_at_more_closely():
    """A third derivative that is large over the width of the density."""

    def gradient(theta):
        return -theta - 400.0 * np.sin(40.0 * theta) / 40.0

    found, _ = observed_information(gradient, np.array([0.013]), np.array([True]))
    exact = 1.0 + 400.0 * np.cos(40.0 * 0.013)
    assert found[0, 0] == pytest.approx(exact, rel=1e-7)


def test_parts_that_are_not_free_and_places_without_a_gradient():
    free = np.array([True, False])
    found, error = observed_information(Counted((1.0, 1.0)), np.zeros(2), free)
    assert not found[1].any()
    assert not error[:, 1].any()
    assert found[0, 0] == pytest.approx(1180.0, rel=1e-8)
    nothing, _ = observed_information(lambda v: np.full(2, np.nan), np.ones(2), free)
    assert np.isnan(nothing[0, 0])
