"""The difference of two Poisson counts against mpmath, in both homes.

Where order and argument of the Bessel function are large, the reference is the inversion integral
of the generating function through its saddle point, by the trapezoidal rule, which is exact but for
e^-300 of it; a tail has 1 / (1 - e^s) beside it.
"""

import mpmath as mp
import numpy as np
import pytest

from ssmppl.codegen.kernels.math import skellam
from ssmppl.expressions import special as interpreted
from ssmppl.expressions.calculus import gradient
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import apply, symbol

HOMES = pytest.mark.parametrize("home", [skellam, interpreted])
RATES = [
    (0.0, 0.3), (5.0, 0.0), (0.0, 1e4), (1e-8, 1e-8), (1e-8, 5.0), (1e6, 1e-8), (0.3, 0.3),
    (0.3, 5.0), (5.0, 5.0), (5.0, 200.0), (200.0, 200.0), (49.0, 51.0), (1e4, 200.0), (1e4, 1e4),
    (1e6, 1e4), (1e6, 1e6), (2.0, 1e6),
]  # fmt: skip
AWAY = (-30.0, -8.0, -2.0, -0.3, 0.0, 1.0, 5.0, 30.0)  # of the mean, in standard deviations


def inverted(k, a, b, tail):
    m = mp.sqrt(k * k + 4 * a * b)
    tilt = mp.log((k + m) / (2 * a)) if k > 0 else mp.log(2 * b / (m - k))
    tilt -= 3 / mp.sqrt(m) if tail else 0  # away from the pole
    step = 1 / (5 * mp.sqrt(m))
    total = mp.mpf(0)
    for j in range(90):
        s = mp.mpc(tilt, j * step)
        part = mp.exp(a * mp.expm1(s) + b * mp.expm1(-s) - k * s)
        part = part / -mp.expm1(s) if tail else part
        total += part.real / (1 if j else 2)
    return total * step / mp.pi


def mass(k, a, b):
    if a * b > 0 and k * k + 4 * a * b > 1e4:
        return inverted(k, a, b, False)
    if k < 0:
        k, a, b = -k, b, a
    return mp.exp(-a - b) * a**k / mp.factorial(k) * mp.hyp0f1(k + 1, a * b)


def lower(k, a, b):
    """P(N1 - N2 <= k)."""
    if k >= a - b:
        return 1 - lower(-k - 1, b, a)
    if a * b > 0 and k * k + 4 * a * b > 1e4:
        return inverted(k, a, b, True)
    if a == 0:
        return mp.gammainc(-k, 0, b, regularized=True)
    if b == 0:
        return mp.gammainc(k + 1, a, regularized=True) if k >= 0 else mp.mpf(0)
    total = part = mass(k, a, b)
    while part > total * mp.mpf(10) ** -25:
        k -= 1
        part = mass(k, a, b)
        total += part
    return total


def whole_numbers(a, b):
    near = [int(np.floor(a - b + s * np.sqrt(a + b))) for s in AWAY]
    return sorted({*near, -1, 0, 1} if a + b < 100 else set(near))


@HOMES
@pytest.mark.parametrize(("a", "b"), RATES)
def test_masses(home, a, b):
    with mp.workdps(30):
        for k in whole_numbers(a, b):
            expected = mass(k, mp.mpf(a), mp.mpf(b))
            found = float(home.skellam_log_mass(float(k), a, b))
            if expected == 0:
                assert found == -np.inf
                continue
            log_mass = float(mp.log(expected))
            assert found == pytest.approx(log_mass, rel=1e-14, abs=3e-13), k
            turned = float(home.skellam_log_mass(float(-k), b, a))
            assert turned == found


@HOMES
@pytest.mark.parametrize(("a", "b"), RATES)
def test_distribution_functions(home, a, b):
    """Below the mean to full relative accuracy, above it one less the rest; quantiles come back."""
    with mp.workdps(30):
        for k in whole_numbers(a, b):
            expected = float(lower(k, mp.mpf(a), mp.mpf(b)))
            assert home.skellam_cdf(k + 0.5, a, b) == home.skellam_cdf(float(k), a, b)
            found = float(home.skellam_cdf(float(k), a, b))
            assert found == pytest.approx(expected, rel=4e-12, abs=1e-290), k
            if 1e-280 < expected < 0.999:
                # between the values at k and below it
                below = float(home.skellam_cdf(k - 1.0, a, b))
                q = found - 0.3 * (found - below)
                assert home.skellam_quantile(a, b, q) == k
                assert home.skellam_quantile(a, b, found) <= k


@HOMES
def test_very_large_rates(home):
    """What takes the place of sums."""
    for a, b in ((6e7, 6e7), (1.1e8, 3.0), (6e9, 6e9), (1e15, 2.0), (3e12, 1e13)):
        for s in (-30.0, -5.0, -1.2, -0.7, -1e-4, 2.0):
            k = float(np.floor(a - b + s * np.sqrt(a + b)))
            with mp.workdps(40):
                expected = float(lower(int(k), mp.mpf(a), mp.mpf(b)))
            found = float(home.skellam_cdf(k, a, b))
            assert found == pytest.approx(expected, rel=3e-10), (a, b, s)
            back = float(home.skellam_quantile(a, b, expected))
            assert back == pytest.approx(k, abs=1 + 1e-9 * np.sqrt(a + b))


def test_both_homes_agree():
    rng = np.random.default_rng(5)
    a, b = 10 ** rng.uniform(-9, 5, (2, 300))
    k = np.floor(a - b + np.sqrt(a + b) * rng.uniform(-9, 9, 300)) + rng.integers(-3, 4, 300)
    q = rng.uniform(0, 1, 300) ** 6
    for name, arguments, rtol in [
        ("log_mass", (k, a, b), 1e-14), ("cdf", (k, a, b), 1e-12), ("quantile", (a, b, q), 0.0),
    ]:  # fmt: skip
        function = getattr(skellam, f"skellam_{name}")
        found = [function(*point) for point in zip(*(v.tolist() for v in arguments), strict=True)]
        vector = getattr(interpreted, f"skellam_{name}")(*arguments)
        np.testing.assert_allclose(vector, found, rtol=rtol, atol=rtol)


@HOMES
def test_limits(home):
    for b in (0.0, 2.0):
        assert home.skellam_log_mass(np.inf, 3.0, b) == -np.inf
        assert home.skellam_log_mass(-np.inf, 3.0, b) == -np.inf
        assert home.skellam_cdf(np.inf, 3.0, b) == 1.0
        assert home.skellam_cdf(-np.inf, 3.0, b) == 0.0
        assert home.skellam_quantile(3.0, b, 1.0) == np.inf
        assert home.skellam_quantile(3.0, b, 0.0) == (-np.inf if b else 0.0)
    assert home.skellam_quantile(0.0, 3.0, 1.0) == 0.0
    assert home.skellam_log_mass(0.0, 0.0, 0.0) == 0.0
    assert home.skellam_log_mass(-1.0, 0.0, 0.0) == -np.inf
    assert [home.skellam_cdf(k, 0.0, 0.0) for k in (-1.0, 0.0)] == [0.0, 1.0]
    assert home.skellam_quantile(0.0, 0.0, 0.4) == 0.0


@HOMES
def test_outside_the_domain_is_nan(home):
    for a, b in ((-1e-3, 1.0), (1.0, -1e-3), (np.inf, 1.0), (1.0, np.inf), (np.nan, 1.0)):
        assert np.isnan(home.skellam_log_mass(1.0, a, b))
        assert np.isnan(home.skellam_cdf(1.0, a, b))
        assert np.isnan(home.skellam_quantile(a, b, 0.5))
    assert np.isnan(home.skellam_log_mass(np.nan, 1.0, 1.0))
    assert np.isnan(home.skellam_cdf(np.nan, 1.0, 1.0))
    for q in (-0.1, 1.1, np.nan):
        assert np.isnan(home.skellam_quantile(1.0, 1.0, q))


@pytest.mark.parametrize(("k", "a", "b"), [(0, 0.3, 5), (-7, 2, 3), (12, 1, 0.2), (3, 200, 190),
                                           (-150, 1e6, 1e6)])  # fmt: skip
def test_slopes_in_the_rates(k, a, b):
    """Of the log mass and of the distribution function, at whole numbers of both signs."""
    rates = [symbol("parameter", n) for n in "ab"]
    at = dict(zip(rates, (float(a), float(b)), strict=True))
    with mp.workdps(40):
        for name, reference in (
            ("skellam_log_mass", lambda a, b: mp.log(mass(k, a, b))),
            ("skellam_cdf", lambda a, b: lower(k, a, b)),
        ):
            found = [float(evaluate(g, at)) for g in gradient(apply(name, float(k), *rates), rates)]
            for place in range(2):
                order = [(1, 0), (0, 1)][place]
                size = mp.mpf(10) ** -12 * (a, b)[place]
                expected = mp.diff(reference, (mp.mpf(a), mp.mpf(b)), order, h=size)
                assert found[place] == pytest.approx(float(expected), rel=1e-8, abs=1e-12)
