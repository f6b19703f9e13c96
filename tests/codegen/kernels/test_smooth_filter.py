"""The parts of the continuous filter: sorting, and the piecewise linear distribution function."""

from __future__ import annotations

import numpy as np
import pytest

from ssmppl.codegen.kernels.particle.continuous_filters import invert, sort_order
from tests.statistics.checks import seed_of


def ordered(x):
    order = np.empty(x.size, dtype=np.int64)
    sort_order(x, np.empty(x.size, dtype=np.int64), np.empty(x.size + 1, dtype=np.int64), order)
    return order


def inverted(x, w, points):
    out = np.empty(x.size)
    invert(x, w, ordered(x), points, out)
    return out


@pytest.mark.parametrize("kind", ["normal", "outlier", "ties", "constant", "sorted", "one"])
def test_order(kind):
    rng = np.random.default_rng(seed_of("order", kind))
    x = {
        "normal": rng.normal(size=501),
        "outlier": np.append(rng.normal(size=200), [1e12, -1e300]),
        "ties": rng.integers(0, 5, size=90).astype(float),
        "constant": np.full(7, 2.5),
        "sorted": np.arange(40.0),
        "one": np.array([3.0]),
    }[kind]
    order = ordered(x)
    assert sorted(order) == list(range(x.size))
    np.testing.assert_array_equal(x[order], np.sort(x))


def test_what_is_not_finite_breaks_nothing():
    x = np.array([0.3, np.nan, -np.inf, 2.0, np.inf, 1.0])
    assert sorted(ordered(x)) == list(range(6))


def test_inversion_is_that_of_the_piecewise_linear_distribution():
    rng = np.random.default_rng(seed_of("invert"))
    for n in (2, 5, 300):
        x, w, points = rng.normal(size=n), rng.gamma(0.3, size=n), rng.uniform(size=n)
        w /= w.sum()
        order = np.argsort(x)
        s, v = x[order], w[order]
        cumulative = np.cumsum(v) - 0.5 * v  # up to the middle of each particle's weight
        expected = np.interp((np.arange(n) + points) / n, cumulative, s)
        np.testing.assert_allclose(inverted(x, w, points), expected, atol=1e-12)


def test_particles_without_weight_attract_nothing():
    x, w = np.array([0.0, 1.0, 2.0, 9.0, 9.5]), np.array([0.5, 0.5, 0.0, 0.0, 0.0])
    out = inverted(x, w, np.full(5, 0.5))
    assert np.all(np.isfinite(out))
    assert np.all(out <= 2.0)


def test_the_quantiles_stay_when_particles_of_equal_weight_change_places():
    rng = np.random.default_rng(seed_of("crossing"))
    x, w, points = rng.normal(size=50), rng.gamma(1.0, size=50), rng.uniform(size=50)
    order = np.argsort(x)
    i, j = order[20], order[21]
    w[j] = w[i]
    w /= w.sum()
    middle = 0.5 * (x[i] + x[j])
    before, after = x.copy(), x.copy()
    before[i], before[j] = middle - 1e-9, middle + 1e-9
    after[i], after[j] = middle + 1e-9, middle - 1e-9
    np.testing.assert_allclose(inverted(before, w, points), inverted(after, w, points), atol=1e-8)
