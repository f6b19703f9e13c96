"""Special functions against mpmath at random arguments over wide ranges."""

import mpmath as mp
import numpy as np
import pytest
from scipy import special as scipy_special

from ssmppl.codegen.kernels.math import scalars, special
from ssmppl.expressions import special as interpreted

RNG = np.random.default_rng(3)
N = 150
REAL = np.concatenate([RNG.uniform(-20, 20, N), 10 ** RNG.uniform(-6, 6, N)])
NORMAL = np.concatenate([RNG.uniform(-37, 6, N), RNG.uniform(-3, 3, N)])
UNIT = np.concatenate([RNG.uniform(0, 1, N), 10 ** RNG.uniform(-300, 0, N)])
SHAPE = 10 ** RNG.uniform(-6, 4, 2 * N)
GAMMA_X = np.concatenate([SHAPE[:N] * 10 ** RNG.uniform(-1, 0.5, N), 10 ** RNG.uniform(-3, 1, N)])
ALPHA, BETA = 10 ** RNG.uniform(-2, 3, (2, N))
BETA_X = np.clip(RNG.beta(np.maximum(ALPHA, 0.1), np.maximum(BETA, 0.1)), 1e-9, 1 - 1e-9)


def lower_gamma(a, x):
    return mp.gammainc(a, 0, x, regularized=True)


def upper_gamma(a, x):
    return mp.gammainc(a, x, mp.inf, regularized=True)


def beta(a, b, x):
    return mp.betainc(a, b, 0, x, regularized=True)


# function, reference, arguments, relative error, absolute error (near zeros of the function)
CASES = [
    (special.erf, mp.erf, (NORMAL,), 1e-14, 0.0),
    (special.erfc, mp.erfc, (NORMAL,), 1e-14, 0.0),
    (special.lgamma, lambda x: mp.log(abs(mp.gamma(x))), (REAL,), 1e-14, 1e-15),
    (special.digamma, mp.digamma, (REAL,), 1e-12, 1e-14),
    (special.trigamma, lambda x: mp.psi(1, x), (REAL,), 1e-12, 0.0),
    (special.i0e, lambda x: mp.besseli(0, x) * mp.exp(-abs(x)), (REAL,), 1e-14, 0.0),
    (special.i1e, lambda x: mp.besseli(1, x) * mp.exp(-abs(x)), (REAL,), 1e-14, 0.0),
    (special.ndtr, mp.ncdf, (NORMAL,), 1e-12, 0.0),
    (special.log_ndtr, lambda x: mp.log(mp.ncdf(x)), (np.r_[NORMAL, -GAMMA_X],), 1e-12, 0.0),
    (special.ndtri, lambda p: scipy_special.ndtri(float(p)), (UNIT,), 1e-13, 1e-15),
    (special.gammainc, lower_gamma, (SHAPE, GAMMA_X), 2e-12, 0.0),
    (special.gammaincc, upper_gamma, (SHAPE, GAMMA_X), 2e-12, 0.0),
    (special.betainc, beta, (ALPHA, BETA, BETA_X), 2e-12, 0.0),
    (special.betaincc, lambda a, b, x: beta(b, a, 1 - x), (ALPHA, BETA, BETA_X), 2e-12, 0.0),
    (scalars.logaddexp, lambda a, b: mp.log(mp.exp(a) + mp.exp(b)), (REAL, -REAL), 1e-14, 1e-15),
]


START = np.concatenate([10 ** RNG.uniform(-3, 17, 2 * N), RNG.uniform(8, 30, N)])
RISE = 10 ** RNG.uniform(-3, 8, START.size)
DIFFERENCES = {
    "gammaln_rise": lambda a, b: mp.loggamma(a + b) - mp.loggamma(a),
    "digamma_rise": lambda a, b: mp.psi(0, a + b) - mp.psi(0, a),
    "betaln": lambda a, b: mp.log(mp.beta(a, b)),
}


@pytest.mark.parametrize("home", [special, interpreted])
@pytest.mark.parametrize("name", sorted(DIFFERENCES))
def test_differences_of_gamma_functions(name, home):
    """Errors are of the differences' size, also where both functions are 1e18."""
    with mp.workdps(60):
        for a, b in zip(START.tolist(), RISE.tolist(), strict=True):
            expected = float(DIFFERENCES[name](mp.mpf(a), mp.mpf(b)))
            small = 2e-14 if a < 30 else 1e-13 * abs(expected)
            found = float(getattr(home, name)(a, b))
            assert found == pytest.approx(expected, rel=2e-14, abs=small), (a, b)


@pytest.mark.parametrize("case", CASES, ids=lambda c: c[0].__name__)
def test_accuracy(case):
    function, reference, arguments, rtol, atol = case
    with mp.workdps(60):
        for point in zip(*(a.tolist() for a in arguments), strict=True):
            expected = float(reference(*(mp.mpf(x) for x in point)))
            value = function(*point)
            assert value == pytest.approx(expected, rel=rtol, abs=max(atol, 1e-300)), point


@pytest.mark.parametrize("small", [0.5, 4.0, 70.0])
@pytest.mark.parametrize("large", [1e6, 1e10, 1e14, 1e16])
def test_beta_integrals_with_one_large_shape(small, large):
    """Those of a gamma law, in both tails; the interpreter's are SciPy's."""
    for u in small * np.array([0.05, 0.5, 1.0, 1.5, 5.0]):
        x, tail = u / (u + large), scipy_special.gammaincc(small, u)
        for home in (special, scipy_special):
            found = home.betaincc(small, large, x)
            assert found == pytest.approx(tail, rel=3e-12 + 300 * u**2 / large, abs=0)
        if tail < 0.999:
            found = special.betainccinv(small, large, special.betaincc(small, large, x))
            assert found == pytest.approx(x, rel=1e-9, abs=0)


@pytest.mark.parametrize("a", [1.01e8, 1e9, 1e11, 1e13, 1e15])
def test_gamma_integrals_of_large_shapes(a):
    """SciPy's, of which the far tails are wrong; there the continued fraction's."""
    for z in (6.0, 30.0):
        x = a + z * np.sqrt(a)
        tail = special.poisson_density(a, x) * a * special._gamma_fraction(a, x)
        assert special.gammaincc(a, x) == pytest.approx(tail, rel=1e-11, abs=0.0)
    near = scipy_special.ndtr(-30.0) * np.exp(-9000.0 / np.sqrt(a))
    assert special.gammainc(a, a - 30 * np.sqrt(a)) == pytest.approx(near, rel=0.15, abs=0.0)
    for z in (-1.0, 0.0, 1.0):
        x = a + z * np.sqrt(a)
        for name in ("gammainc", "gammaincc"):
            found, expected = (getattr(m, name)(a, x) for m in (special, scipy_special))
            assert found == pytest.approx(expected, rel=2e-11, abs=0.0), (name, z)
    assert special.gammainc(a, a) == pytest.approx(0.5 + 1 / np.sqrt(18 * np.pi * a), rel=1e-14)
    assert special.gammaincinv(a, 0.25) == pytest.approx(
        scipy_special.gammaincinv(a, 0.25), rel=2e-13
    )


def test_gamma_quantile():
    for a, p in zip(SHAPE, RNG.uniform(0, 1, SHAPE.size), strict=True):
        x = special.gammaincinv(a, p)
        expected = scipy_special.gammaincinv(a, p)
        assert x == pytest.approx(expected, rel=2e-12, abs=1e-300), (a, p)


def test_beta_quantile():
    """Through the distribution function, because SciPy's own error is 1e-13 and more."""
    for a, b, p in zip(ALPHA, BETA, RNG.uniform(0, 1, N), strict=True):
        x = special.betaincinv(a, b, p)
        if 1e-290 < x < 0.9999:
            assert special.betainc(a, b, x) == pytest.approx(p, rel=1e-12), (a, b, p)
        else:
            expected = scipy_special.betaincinv(a, b, p)
            assert x == pytest.approx(expected, rel=1e-9, abs=1e-290)


TRIALS = RNG.integers(1, 60, N)
KAPPA = 10 ** RNG.uniform(-3, 4, N)
ANGLE = np.where(RNG.uniform(size=N) < 0.5, 1.0, KAPPA**-0.5) * RNG.uniform(-np.pi, np.pi, N)
ANGLE = np.clip(ANGLE, -3.14, 3.14)


def betabinomial_masses(n, a, b):
    return [
        mp.binomial(n, k) * mp.beta(k + a, n - k + b) / mp.beta(a, b) for k in range(int(n) + 1)
    ]


@pytest.mark.parametrize("home", [special, interpreted])
def test_beta_binomial_sums(home):
    with mp.workdps(40):
        for n, a, b, share in zip(TRIALS, ALPHA, BETA, RNG.uniform(0, 1, N), strict=True):
            masses = betabinomial_masses(*map(mp.mpf, (int(n), float(a), float(b))))
            k = int(share * n)
            expected = float(mp.fsum(masses[: k + 1]))
            found = float(home.betabinomial_cdf(float(k), float(n), a, b))
            assert found == pytest.approx(expected, rel=1e-11, abs=1e-300)
            between = float(mp.fsum(masses[:k]) + masses[k] / 2)
            if masses[k] > 1e-9 * between:
                assert home.betabinomial_quantile(float(n), a, b, between) == k


@pytest.mark.parametrize("home", [special, interpreted])
def test_von_mises_integrals(home):
    """Below the mean to full relative accuracy; above it one less that."""
    with mp.workdps(30):
        for kappa, x in zip(KAPPA[:60], ANGLE[:60], strict=True):
            k, edge = mp.mpf(float(kappa)), -abs(mp.mpf(float(x)))
            cuts = [edge - (edge + mp.pi) * mp.mpf(2) ** -j for j in range(16)]
            at_edge = mp.cos(edge)  # out of the integrand: quad's errors are absolute
            lower = mp.quad(lambda t, k=k, c=at_edge: mp.exp(k * (mp.cos(t) - c)), [*cuts, edge])
            lower *= mp.exp(k * (at_edge - 1)) / (2 * mp.pi * mp.besseli(0, k) * mp.exp(-k))
            expected = float(lower if x <= 0 else 1 - lower)
            found = float(home.vonmises_cdf(kappa, x))
            assert found == pytest.approx(expected, rel=1e-12, abs=1e-290), (kappa, x)
            if 1e-280 < expected < 0.9:
                back = float(home.vonmises_quantile(kappa, expected))
                assert home.vonmises_cdf(kappa, back) == pytest.approx(expected, rel=1e-11)


@pytest.mark.parametrize("home", [special, interpreted])
def test_skew_normal_integrals(home):
    """Below the middle to full relative accuracy, of both signs of the shape; above by one less
    that."""
    with mp.workdps(30):
        for shape in (0.0, 1e-6, 0.3, -1.0, 4.0, -20.0, 400.0):
            for z in (-30.0, -5.0, -1.0, -0.1, -1e-3, -1e-6, 0.0, 0.2, 1.7, 6.0):
                s, edge = mp.mpf(shape), -abs(mp.mpf(z))
                s = s if z <= 0 else -s
                width = 1 / (1 + abs(edge) + (s**2 * abs(edge) + abs(s) if s > 0 else 0))
                cuts = [edge - width * mp.mpf(2) ** j for j in range(8, -9, -1)]
                scale = 2 * mp.npdf(edge) * mp.ncdf(s * edge)  # quad's errors are absolute

                def share(t, s=s, scale=scale):
                    return 2 * mp.npdf(t) * mp.ncdf(s * t) / scale

                lower = scale * mp.quad(share, [-mp.inf, *cuts, edge])
                expected = float(lower if z <= 0 else 1 - lower)
                found = float(home.skewnormal_cdf(shape, z))
                assert found == pytest.approx(expected, rel=2e-11, abs=1e-290), (shape, z)
                if 1e-280 < expected < 0.9:
                    back = float(home.skewnormal_quantile(shape, expected))
                    assert home.skewnormal_cdf(shape, back) == pytest.approx(expected, rel=1e-10)


def test_limits():
    for home in (special, interpreted):
        assert home.skewnormal_cdf(2.0, -np.inf) == 0.0
        assert home.skewnormal_cdf(2.0, np.inf) == 1.0
        assert home.skewnormal_quantile(2.0, 1.0) == np.inf
        assert home.skewnormal_quantile(2.0, 0.0) == -np.inf
        assert np.isnan(home.skewnormal_cdf(np.inf, 0.0))
        assert np.isnan(home.skewnormal_quantile(1.0, 1.5))
    assert special.i0e(0.0) == 1.0
    assert special.i1e(0.0) == 0.0
    assert special.i0e(np.inf) == 0.0
    assert special.betabinomial_cdf(-1.0, 5.0, 1.0, 2.0) == 0.0
    assert special.betabinomial_cdf(5.0, 5.0, 1.0, 2.0) == 1.0
    assert special.betabinomial_quantile(5.0, 1.0, 2.0, 1.0) == 5.0
    assert special.vonmises_cdf(2.0, -np.pi) == 0.0
    assert special.vonmises_cdf(2.0, np.pi) == 1.0
    assert special.vonmises_quantile(2.0, 1.0) == pytest.approx(np.pi)
    assert special.lgamma(0.0) == np.inf
    for home in (special, interpreted):
        assert home.gammaln_rise(3.0, 0.0) == home.digamma_rise(30.0, 0.0) == 0.0
        assert home.gammaln_rise(0.0, 2.0) == -np.inf
        assert home.betaln(0.0, 2.0) == home.betaln(2.0, 0.0) == np.inf
    assert special.lgamma(-3.0) == np.inf
    assert special.ndtri(0.0) == -np.inf
    assert special.ndtri(1.0) == np.inf
    assert scalars.logaddexp(-np.inf, -np.inf) == -np.inf
    assert scalars.logaddexp(-np.inf, 1.5) == 1.5
    assert special.log_ndtr(-np.inf) == -np.inf
    assert special.gammainc(2.0, 0.0) == 0.0
    assert special.gammainc(2.0, np.inf) == 1.0
    assert special.gammaincinv(2.0, 1.0) == np.inf
    assert special.betainc(2.0, 3.0, 0.0) == 0.0
    assert special.betainc(2.0, 3.0, 1.0) == 1.0
    assert special.betaincinv(2.0, 3.0, 1.0) == 1.0


def test_outside_the_domain_is_nan():
    values = [
        special.lgamma(np.nan),
        special.digamma(-1.0),
        special.trigamma(0.0),
        *(f(-0.5, 2.0) for f in (special.gammaln_rise, special.digamma_rise, special.betaln)),
        *(f(0.5, -2.0) for f in (special.gammaln_rise, special.digamma_rise, special.betaln)),
        *(f(-0.5, 2.0) for f in (interpreted.gammaln_rise, interpreted.betaln)),
        special.ndtri(-0.1),
        special.ndtri(np.nan),
        special.gammainc(-1.0, 1.0),
        special.gammaincc(1.0, -1.0),
        special.gammaincinv(1.0, np.nan),
        special.betabinomial_cdf(1.0, 2.5, 1.0, 1.0),
        special.betabinomial_cdf(1.0, 2.0, -1.0, 1.0),
        special.betabinomial_quantile(2.0, 1.0, 1.0, 1.5),
        special.vonmises_cdf(-1.0, 0.5),
        special.vonmises_cdf(1.0, 3.5),
        special.vonmises_quantile(1.0, -0.5),
        special.i0e(np.nan),
        special.betainc(1.0, 0.0, 0.5),
        special.betaincinv(1.0, 1.0, 1.5),
        special.betainccinv(1.0, 1.0, -0.5),
        special.betaincc(1.0, 0.0, 0.5),
    ]
    assert np.isnan(values).all()
