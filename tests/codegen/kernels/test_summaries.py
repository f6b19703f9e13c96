"""Sums over weighted particles: some undefined, some far from zero."""

import numpy as np
import pytest

from ssmppl.codegen.kernels.math.flags import interpreted
from ssmppl.codegen.kernels.particle.particle_filter import add
from ssmppl.codegen.kernels.particle.simulation import mix_channels
from ssmppl.codegen.kernels.particle.weights import weighted_mean, weighted_product
from tests.statistics.checks import seed_of


def rows_of(function):
    """A kernel as it is compiled, and in plain Python."""
    return [function, interpreted(function.py_func)]


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_what_has_no_weight_adds_nothing(bad):
    rng = np.random.default_rng(seed_of("no weight"))
    n = 67
    values, other, w = rng.normal(size=n), rng.normal(size=n), rng.random(n)
    w[::3] = 0.0
    w /= w.sum()
    mean, product = w @ values, w @ ((values - 0.3) * (other + 0.2))
    values[::3], other[::6] = bad, bad
    for compiled in rows_of(weighted_mean):
        assert compiled(values, w) == pytest.approx(mean, rel=1e-13)
    for compiled in rows_of(weighted_product):
        assert compiled(values, 0.3, other, -0.2, w) == pytest.approx(product, rel=1e-13)
    told, out = np.vstack([values, other**2, values, other]), np.empty((4, 1))
    mix_channels(told, w, out)
    assert np.all(np.isfinite(out))
    values[1] = bad  # with weight it counts
    for compiled in rows_of(weighted_mean):
        np.testing.assert_equal(compiled(values, w), bad)


def test_log_weights_that_are_ruled_out_stay_so():
    inf, nan = np.inf, np.nan
    pairs = np.array([(a, b) for a in (-inf, 1.5, nan, inf) for b in (-inf, 2.0, nan, inf)] * 5)
    wanted = [-inf if -inf in (a, b) else a + b for a, b in pairs]
    for compiled in rows_of(add):
        found = pairs[:, 0].copy()
        compiled(found, pairs[:, 1].copy())
        np.testing.assert_array_equal(found, wanted)


def test_the_spread_of_a_mixture_far_from_zero():
    """Two laws of variance 0.01 about 1e9 and 1e9 + 1."""
    told = np.array([[1e9, 1e9 + 1.0], [0.01, 0.01], [0.2, 1.0], [0.1, 1.0]])
    w, out = np.array([0.3, 0.7]), np.empty((4, 1))
    for compiled in rows_of(mix_channels):
        compiled(told, w, out)
        np.testing.assert_allclose(out[:, 0], [1e9 + 0.7, 0.01 + 0.21, 0.76, 0.73], rtol=1e-6)
