"""Units of coordinates: of Gaussians of any width, at edges, of what is flat, or is from afar."""

import numpy as np
import pytest

from ssmppl.inference.optimisation.units import units_at

ONE, LINE = np.ones(1), np.ones(1, dtype=bool)


def unit_of(function, z=0.0, unit=ONE):
    return float(units_at(lambda v: function(v[0]), np.array([z]), unit, LINE)[0])


def gaussian(sd, top=0.0):
    return lambda x: -0.5 * ((x - top) / sd) ** 2


@pytest.mark.parametrize("sd", [1e-9, 1e-5, 3e-3, 0.011, 0.1, 1.0, 2.5, 9.0, 30.0, 1e5, 1e9])
def test_a_gaussian_has_a_fitting_unit(sd):
    """From its top and from ten thousand standard deviations off alike."""
    found = unit_of(gaussian(sd))
    assert 0.0099 <= sd / found <= 2.6
    assert np.log2(found) % 2.0 == 0.0  # no digit is lost
    assert unit_of(gaussian(sd, top=1e4 * sd)) == found
    assert unit_of(gaussian(sd), unit=np.array([found])) == found
    if 0.011 <= sd <= 2.5:
        assert found == 1.0


@pytest.mark.parametrize("unit", [2.0**-20, 1.0, 2.0**18])
def test_a_unit_goes_with_the_data(unit):
    for sd in (1e-5, 0.1, 1e4):
        assert unit_of(gaussian(sd * unit), unit=np.array([unit])) == unit * unit_of(gaussian(sd))


def test_each_coordinate_has_its_own_and_some_have_none():
    sd = np.array([1e-5, 1e-5, 1e5])

    def function(z):
        return -0.5 * float(np.sum((z / sd) ** 2))

    found = units_at(function, np.zeros(3), np.ones(3), np.array([True, False, True]))
    assert found.tolist() == [unit_of(gaussian(1e-5)), 1.0, unit_of(gaussian(1e5))]


def test_a_flat_function_tells_nothing():
    assert unit_of(lambda x: 3.0 + 1e-3 * np.sin(x)) == 1.0
    assert unit_of(lambda x: -np.inf) == 1.0
    assert unit_of(lambda x: 1e4 * x) == 1.0  # a slope is no width


def test_beside_an_edge_the_other_side_tells():
    found = unit_of(lambda x: gaussian(1e-5)(x) if x >= 0.0 else -np.inf)
    assert found == unit_of(gaussian(1e-5))
    assert unit_of(lambda x: 0.0 if abs(x) < 1e-5 else -np.inf) == pytest.approx(1e-5, rel=30.0)


def test_what_looks_flat_from_far_is_seen_from_near():
    """A mean of two that has no row where it is far: the other one has them all."""
    for sd in (1e-7, 1e-4, 1e4):
        found = unit_of(lambda x, sd=sd: 20.0 * np.exp(-0.5 * (x / sd) ** 2))
        assert found == pytest.approx(unit_of(gaussian(sd)), rel=3.1)


def test_what_fits_is_kept_whatever_is_beyond():
    """A ring, and a wall a thousand times as far."""

    def function(x):
        return -20.0 * np.exp(-(((abs(x) - 1.0) / 0.5) ** 2)) - (x / 1e3) ** 2

    assert unit_of(function) == 1.0
