"""Elementary functions: errors against mpmath, special values, and that loops vectorise."""

import inspect
import platform
import re

import mpmath as mp
import numba
import numpy as np
import pytest

from ssmppl.codegen.kernels.math import elementary
from ssmppl.codegen.kernels.math.flags import kernel

from .coefficients import table

# name: (largest error in units in the last place, ranges)
ACCURACY = {
    "exp": (1.5, [(-745.0, 709.7), (-1.0, 1.0), (-1e-9, 1e-9)]),
    "expm1": (2.5, [(-40.0, 709.7), (-1.0, 1.0), (-1e-9, 1e-9)]),
    "log": (1.5, [(1e-320, 1e-307), (1e-3, 1e3), (0.99, 1.01), (1e300, 1.7e308)]),
    "log1p": (2.0, [(-0.9999, 10.0), (-1e-3, 1e-3), (1e10, 1e300)]),
    "sin": (2.0, [(-10.0, 10.0), (-1e5, 1e5), (-1e12, 1e12)]),
    "cos": (2.0, [(-10.0, 10.0), (-1e5, 1e5), (-1e12, 1e12)]),
    "tanh": (4.0, [(-20.0, 20.0), (-1.0, 1.0), (-1e-9, 1e-9)]),
    "sinh": (4.0, [(-710.0, 710.0), (-1.0, 1.0), (-1e-9, 1e-9)]),
    "cosh": (4.0, [(-710.0, 710.0), (-2.0, 2.0)]),
    "arctan": (1.5, [(-1.0, 1.0), (-5.0, 5.0), (-1e6, 1e6)]),
    "sqrt": (0.51, [(0.0, 10.0), (0.0, 1e300)]),
}
REFERENCE = {"arctan": mp.atan}


def loop_over(function):
    @kernel
    def loop(a, out):
        for i in range(a.size):
            out[i] = function(a[i])

    return loop


@pytest.mark.parametrize("name", ACCURACY)
def test_accuracy(name):
    bound, ranges = ACCURACY[name]
    reference = REFERENCE.get(name) or getattr(mp, name)
    loop = loop_over(getattr(elementary, name))
    rng = np.random.default_rng(1)
    for low, high in ranges:
        x = rng.uniform(low, high, 1000)
        out = np.empty_like(x)
        loop(x, out)
        with mp.workprec(200):
            for argument, value in zip(x.tolist(), out.tolist(), strict=True):
                expected = reference(mp.mpf(argument))
                error = abs(mp.mpf(value) - expected) / mp.mpf(float(np.spacing(abs(value))))
                assert error <= bound, (argument, value)


@pytest.mark.parametrize("name", ACCURACY)
def test_special_values(name):
    loop = loop_over(getattr(elementary, name))
    x = np.array([0.0, np.inf, -np.inf, np.nan, -np.nan, -1.0, -3.0, 720.0, -746.0, 1e-310] * 2)
    out = np.empty_like(x)
    loop(x, out)
    with np.errstate(all="ignore"):
        expected = getattr(np, name)(x)
    np.testing.assert_allclose(out, expected, rtol=1e-15, atol=5e-324)


def test_exp_of_minus_infinity_is_exactly_zero():
    assert elementary.exp(-np.inf) == 0.0
    assert elementary.exp(np.inf) == np.inf


@pytest.mark.parametrize("name", ["sin", "cos"])
def test_trigonometric_limit(name):
    """Near multiples of pi/2, where the reduction cancels most, and beyond the limit."""
    function = getattr(elementary, name)
    k = np.random.default_rng(2).integers(1, 6 * 10**11, 1000)
    with mp.workprec(300):
        for x in [float(mp.mpf(int(j)) * mp.pi / 2) for j in k]:
            expected = float(getattr(mp, name)(mp.mpf(x)))
            assert function(x) == pytest.approx(expected, rel=5e-16, abs=0.0)
    assert np.isnan(function(1.001e12))


@pytest.mark.parametrize("name", ["exp", "log", "sin", "cos", "arctan"])
def test_coefficients_can_be_recomputed(name):
    function = {"log": "_log_bits", "sin": "sin_cos_reduced", "cos": "sin_cos_reduced"}
    function |= {"exp": "_exp_reduce", "arctan": "arctan"}
    compiled = getattr(elementary, function[name])
    source = inspect.getsource(getattr(compiled, "py_func", compiled))
    numbers = [abs(float(n)) for n in re.findall(r"\d+\.\d+(?:e[-+]?\d+)?", source)]
    for coefficient in table()[name]:
        nearest = min(numbers, key=lambda n: abs(n - abs(coefficient)))
        assert nearest == pytest.approx(abs(coefficient), rel=1e-13)


@pytest.mark.skipif(
    numba.config.DISABLE_JIT or platform.machine().lower() not in ("x86_64", "amd64"),
    reason="reads x86 assembly",
)
@pytest.mark.parametrize("name", sorted(ACCURACY.keys() - {"sqrt"}))
def test_loops_vectorise(name):
    loop = loop_over(getattr(elementary, name))
    a = np.linspace(0.1, 1.0, 64)
    loop(a, np.empty_like(a))
    (assembly,) = loop.inspect_asm().values()
    packed = re.findall(r"v?(?:mul|f?n?madd\d*|add|sqrt|fmadd\d+)pd", assembly)
    scalar_calls = re.findall(r"\$(?:exp|log|sin|cos|tanh|sinh|cosh|atan)\b", assembly)
    assert packed
    assert not scalar_calls
