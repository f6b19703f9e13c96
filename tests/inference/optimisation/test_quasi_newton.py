"""The quasi-Newton climb: quadratics, a curved valley, places without a value."""

import numpy as np
import pytest

from ssmppl.inference.optimisation.quasi_newton import quasi_newton
from tests.statistics.checks import seed_of


def climbed(function, start, steps=200):
    """The last iterate, how many there were, and why it ended."""
    seen = []
    reason = quasi_newton(function, start, steps, lambda z: seen.append(z.copy()))
    return seen[-1], len(seen), reason


@pytest.mark.parametrize("units", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("d", [1, 4, 25])
def test_a_quadratic_is_climbed_to_its_top(d, units):
    rng = np.random.default_rng(seed_of("quasi-newton", d))
    half = rng.normal(size=(d, d))
    h, top = (half @ half.T + np.eye(d)) / units**2, units * rng.normal(size=d)

    def function(z):
        return -0.5 * (z - top) @ h @ (z - top), -h @ (z - top)

    found, count, _ = climbed(function, np.zeros(d))
    assert -function(found)[0] < 1e-7  # what is left to gain, whatever the units
    assert count < 200


def valley(z):
    """Minus Rosenbrock's function, which has no value where the second number is below -2."""
    if z[1] < -2.0:
        return -np.inf, np.zeros(2)
    value = -100.0 * (z[1] - z[0] ** 2) ** 2 - (1.0 - z[0]) ** 2
    slope = 400.0 * z[0] * (z[1] - z[0] ** 2) + 2.0 * (1.0 - z[0])
    return value, np.array([slope, -200.0 * (z[1] - z[0] ** 2)])


def test_a_curved_valley_beside_a_place_without_a_value():
    found, _, _ = climbed(valley, np.array([-1.2, -1.9]))
    np.testing.assert_allclose(found, [1.0, 1.0], atol=1e-6)


def test_why_it_ends():
    assert climbed(valley, np.array([1.0, 1.0]))[1:] == (1, "the gradient is zero")
    assert climbed(valley, np.array([0.0, -3.0]))[1:] == (1, "there is no value at the start")
    assert climbed(valley, np.array([-1.2, 1.0]), 3)[1:] == (4, "the steps are used up")

    def turned(z):  # a gradient that points down
        return -(z @ z), 2.0 * z

    assert climbed(turned, np.ones(2))[1:] == (1, "no step climbs any more")
