"""Normalised weights: against NumPy, and every status."""

import numpy as np
import pytest

from ssmppl.codegen.kernels.weights import ALL_ZERO, INFINITE, NAN, OK, largest, normalise


@pytest.mark.parametrize("n", [1, 2, 3, 7, 64, 1001])
@pytest.mark.parametrize("spread", [0.0, 1.0, 300.0])
@pytest.mark.parametrize("shift", [0.0, -1e5, 1e300])
def test_against_numpy(n, spread, shift):
    log_w = spread * np.random.default_rng(n).normal(size=n) + shift
    w = np.empty(n)
    log_sum, ess, status = normalise(log_w, w)
    raw = np.exp(log_w - log_w.max())
    assert status == OK
    assert largest(log_w) == log_w.max()
    assert log_sum == pytest.approx(log_w.max() + np.log(raw.sum()), rel=1e-14)
    assert ess == pytest.approx(raw.sum() ** 2 / (raw**2).sum(), rel=1e-13)
    np.testing.assert_allclose(w, raw / raw.sum(), rtol=1e-13, atol=1e-320)


def test_zero_weights_are_exactly_zero():
    log_w = np.array([-np.inf, 0.0, -np.inf, np.log(3.0)] * 5)
    w = np.empty(20)
    log_sum, _, status = normalise(log_w, w)
    assert status == OK
    assert log_sum == pytest.approx(np.log(20.0))
    assert (w[::2] == 0.0).all()
    np.testing.assert_allclose(w[[1, 3]], [0.05, 0.15], rtol=1e-15)


# Both signs of NaN: 0/0 on x86 makes the negative one.
@pytest.mark.parametrize("nan", [np.nan, -np.nan])
@pytest.mark.parametrize("others", [0.0, -np.inf, np.inf])
@pytest.mark.parametrize("n", [1, 5, 100])
def test_a_nan_anywhere_is_reported(nan, others, n):
    for place in {0, n // 2, n - 1}:
        log_w = np.full(n, others)
        log_w[place] = nan
        log_sum, ess, status = normalise(log_w, np.empty(n))
        assert status == NAN
        assert np.isnan(log_sum)
        assert np.isnan(ess)


@pytest.mark.parametrize("n", [1, 5, 100])
def test_no_particle_left_and_infinite_weight(n):
    log_w = np.full(n, -np.inf)
    assert normalise(log_w, np.empty(n)) == (-np.inf, 0.0, ALL_ZERO)
    log_w[n // 2] = np.inf
    assert normalise(log_w, np.empty(n))[2] == INFINITE
