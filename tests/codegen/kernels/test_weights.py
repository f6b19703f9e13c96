"""Normalised weights: against NumPy, and every status."""

import ast
from pathlib import Path

import numpy as np
import pytest

from ssmppl.codegen.kernels.particle import weights
from ssmppl.codegen.kernels.particle.weights import (
    ALL_ZERO,
    INFINITE,
    NAN,
    OK,
    STRETCH,
    draw_relative,
    largest,
    normalise,
    relative_weights,
    rule_out,
)


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


@pytest.mark.parametrize("n", [1, 5, STRETCH, STRETCH + 1, 3 * STRETCH, 500])
def test_the_index_is_the_first_whose_sum_exceeds_the_point(n):
    """Whole-number weights, a third of them zero: sums in any order are the same."""
    rng = np.random.default_rng(n)
    whole = rng.integers(0, 9, n) * (rng.random(n) < 0.7)
    whole[n // 2] += 1
    total = float(whole.sum())
    sums = np.cumsum(whole)
    for u in (np.arange(2 * whole.sum()) + 0.5) / (2 * whole.sum()):
        expected = np.searchsorted(sums, u * total, side="right")
        assert draw_relative(whole.astype(float), total, u) == expected


@pytest.mark.parametrize("n", [3, STRETCH, 2 * STRETCH, 70])
@pytest.mark.parametrize("where", ["first", "last", "middle"])
def test_rounding_leads_to_no_weight_of_zero(n, where):
    """A sum taken in another order may lie above all that is found on the way."""
    w = np.zeros(n)
    place = {"first": 0, "last": n - 1, "middle": n // 2}[where]
    w[place] = 1.0
    for total in (1.0, 1.0 + 1e-12):
        for u in (1e-300, 0.5, 1.0 - 1e-16):
            assert draw_relative(w, total, u) == place


def test_relative_weights_and_their_statuses():
    log_w = np.random.default_rng(1).normal(size=101) * 30
    log_w[::7] = -np.inf
    w = np.empty(101)
    total, status = relative_weights(log_w, w)
    assert status == OK
    np.testing.assert_allclose(w, np.exp(log_w - log_w.max()), rtol=1e-13)
    assert total == pytest.approx(w.sum(), rel=1e-14)
    for bad, code in ((np.nan, NAN), (-np.nan, NAN), (np.inf, INFINITE)):
        log_w[50] = bad
        assert relative_weights(log_w, w)[1] == code
    assert relative_weights(np.full(9, -np.inf), np.empty(9))[1] == ALL_ZERO


def _at(buffer, byte, size):
    return buffer[byte : byte + 8 * size].view(np.float64)


@pytest.mark.parametrize("n", [3, 10, 15, 31, 40])
def test_the_last_digit_does_not_depend_on_where_arrays_lie(n):
    """Short arrays at all distances from each other, before and behind."""
    log_w = np.random.default_rng(n).normal(size=n)
    found = set()
    buffer = np.zeros(4096, dtype=np.uint8)
    for apart in range(8 * n, 8 * n + 400, 8):
        for first, second in ((512, 512 + apart), (512 + apart, 512)):
            given, w = _at(buffer, first, n), _at(buffer, second, n)
            given[:] = log_w
            normalised = (*weights.normalise(given, w), w.tobytes())
            given[:] = log_w
            found.add((normalised, weights.relative_weights(given, w), w.tobytes()))
    assert len(found) == 1


def test_loops_that_add_up_store_nothing():
    """In kernels whose sums may be reordered: see the head of `kernels/particle/weights.py`."""
    folder = Path(weights.__file__).parents[1]
    for file in sorted(folder.rglob("*.py")):
        for function in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if not isinstance(function, ast.FunctionDef):
                continue
            if "kernel" not in [ast.unparse(d) for d in function.decorator_list]:
                continue
            for loop in (n for n in ast.walk(function) if isinstance(n, ast.For)):
                if any(isinstance(n, ast.For) for b in loop.body for n in ast.walk(b)):
                    continue
                inside = [n for b in loop.body for n in ast.walk(b)]
                sums = [
                    n for n in inside if isinstance(n, ast.AugAssign)
                    and isinstance(n.target, ast.Name)
                ]  # fmt: skip
                stores = [
                    n for n in inside if isinstance(n, ast.Subscript)
                    and isinstance(n.ctx, ast.Store)
                ]  # fmt: skip
                assert not (sums and stores), f"{file.name}, line {loop.lineno}"


def test_what_is_no_number_or_infinite_is_ruled_out():
    log_v = np.array([np.nan, np.inf, -np.inf, 1.0])
    rule_out(log_v)
    np.testing.assert_array_equal(log_v, [-np.inf, -np.inf, -np.inf, 1.0])
