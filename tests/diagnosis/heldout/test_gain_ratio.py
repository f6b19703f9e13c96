"""The share of the gap that is closed: Fieller's sets, block lengths, coverage by simulation."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from scipy.signal import lfilter

from ssmppl.diagnosis.heldout.gain_ratio import ConfidenceSet, block_length, fieller, gain_ratio
from ssmppl.errors import ArgumentError
from tests.statistics.checks import LEVEL, seed_of


def rng_of(*name):
    return np.random.default_rng(seed_of("closed", *name))


def autoregressive(rng, rho, shape):
    """Stationary AR(1) of variance 1 along the last axis."""
    e = rng.standard_normal((*shape[:-1], shape[-1] + 300)) * np.sqrt(1 - rho**2)
    return lfilter([1.0], [1.0, -rho], e, axis=-1)[..., 300:]


# --- Fieller -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("n", "d", "covariance", "kind"),
    [
        (3.0, 5.0, [[1.0, 0.3], [0.3, 1.0]], "bounded"),
        (-3.0, 5.0, [[2.0, -0.3], [-0.3, 1.5]], "bounded"),
        (5.0, 1.0, [[1.0, 0.0], [0.0, 1.0]], "complement"),
        (-5.0, 1.0, [[1.0, 0.5], [0.5, 1.0]], "complement"),
        (0.5, 1.0, [[1.0, 0.0], [0.0, 1.0]], "unbounded"),
        (0.0, 5.0, [[1.0, 0.0], [0.0, 1.0]], "bounded"),
    ],
)
def test_fieller_is_the_set_it_claims(n, d, covariance, kind):
    """Membership at 2,001 ratios is that of |N - F D| <= q sd(N - F D)."""
    found = fieller(n, d, np.array(covariance), 1.96)
    assert found.kind == kind
    (a, c), (_, b) = covariance
    for ratio in np.linspace(-20.0, 20.0, 2001):
        inside = abs(n - ratio * d) <= 1.96 * np.sqrt(a - 2 * c * ratio + b * ratio**2)
        assert found.holds(ratio) == inside, ratio


def test_fieller_without_error_in_the_denominator():
    found = fieller(3.0, 6.0, np.array([[1.0, 0.0], [0.0, 0.0]]), 2.0)
    assert found == ConfidenceSet("bounded", pytest.approx(1 / 6), pytest.approx(5 / 6))


@pytest.mark.parametrize(("n", "d"), [(20.0, 25.0), (5.0, 1.0), (0.3, 0.5)])
def test_fieller_covers(n, d):
    """95%, whatever the denominator."""
    rng, covariance = rng_of("fieller", n), np.array([[1.5, 0.8], [0.8, 1.0]])
    drawn = rng.multivariate_normal([n, d], covariance, 3000)
    count = sum(fieller(a, b, covariance, 1.959964).holds(n / d) for a, b in drawn)
    assert stats.binomtest(count, 3000, 0.95).pvalue > LEVEL


# --- block length --------------------------------------------------------------------------------


@pytest.mark.parametrize("rho", [0.3, 0.6])
def test_block_length_of_an_autoregression(rho):
    """The optimum has G = 2 rho / (1 - rho)^2 ... of the AR(1), Politis and White (2004), 3.2."""
    rows, rng = 20_000, rng_of("length", rho)
    k = np.arange(1, 2000)
    g, spectrum = 2 * np.sum(k * rho**k), (1 + rho) / (1 - rho)
    exact = (2 * g**2 / (4 / 3 * spectrum**2)) ** (1 / 3) * rows ** (1 / 3)
    found = [block_length(x) for x in autoregressive(rng, rho, (15, rows))]
    assert np.median(found) == pytest.approx(exact, rel=0.2)


def test_block_length_of_noise_is_short_and_blocks_remain():
    rng = rng_of("noise")
    assert np.median([block_length(x) for x in rng.standard_normal((40, 500))]) <= 4
    assert block_length(np.cumsum(rng.standard_normal(100))) <= 10
    assert block_length(np.zeros((2, 50))) == 1
    assert block_length(np.cumsum(rng.standard_normal(100)), (0, 94)) <= 3


# --- F and its interval --------------------------------------------------------------------------


def gains(rng, rows, rho, nats, share, heavy=False):
    """Log predictive gains of effect and reference: sums `share * nats` and `nats` on average, the
    reference's with the standard deviation sqrt(2 nats) that a gain has."""
    x = autoregressive(rng, rho, (2, rows))
    if heavy:
        x = stats.t.ppf(stats.norm.cdf(x), 4) / np.sqrt(2)
    size = np.sqrt(2 * nats / rows * (1 - rho) / (1 + rho))
    reference = nats / rows + size * x[0]
    return share * nats / rows + size * (share * x[0] + 0.4 * x[1]), reference


def coverage(name, rows, rho, nats, share, heavy, times):
    rng, held, measurable = rng_of("coverage", name), 0, 0
    for r in range(times):
        effect, reference = gains(rng, rows, rho, nats, share, heavy)
        base = rng.standard_normal(rows)
        found = gain_ratio(base, base + effect, base + reference, seed=r, replicates=500)
        measurable += found.measurable
        held += found.measurable and found.low <= share <= found.high
    print(f"{name}: covers {held / measurable:.3f} of {measurable}")
    return held, measurable


def test_the_interval_covers():
    """The target of the method's table: 90% to 98%."""
    held, n = coverage("fast", 200, 0.3, 50.0, 0.8, False, 250)
    assert n > 0.99 * 250
    low, high = stats.binom.ppf([LEVEL / 2, 1 - LEVEL / 2], n, [0.90, 0.98])
    assert low <= held <= high


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rows", "rho", "nats", "share", "heavy"),
    [
        (200, 0.0, 20, 0.8, False), (200, 0.5, 20, 0.8, False), (300, 0.5, 50, 0.9, False),
        (300, 0.0, 20, 0.0, False), (1000, 0.8, 60, 0.8, False), (200, 0.3, 20, 0.8, True),
        (150, 0.0, 50, 1.2, False),
    ],
)  # fmt: skip
def test_coverage(rows, rho, nats, share, heavy):
    held, n = coverage((rows, rho, nats), rows, rho, nats, share, heavy, 1500)
    low, high = stats.binom.ppf([LEVEL / 2, 1 - LEVEL / 2], n, [0.92, 0.97])
    assert low <= held <= high


def test_no_measurable_gap():
    """Nothing to be closed: said so 97.5% of the time, the rest being the interval's level."""
    rng, silent = rng_of("nothing"), 0
    for r in range(200):
        base = rng.standard_normal(100)
        x = rng.standard_normal((2, 100))
        found = gain_ratio(base, base + x[0], base + x[1], seed=r, replicates=300)
        assert found.measurable == np.isfinite(found.F)
        assert found.measurable != found.reason.startswith("no measurable gap")
        silent += not found.measurable
    assert stats.binomtest(silent, 200, 0.975).pvalue > LEVEL


def test_shares_are_reported_as_they_are():
    rng = rng_of("shares")
    effect, reference = gains(rng, 400, 0.0, 80.0, 1.0)
    base = rng.standard_normal(400)
    for share in (-0.5, 1.4):
        found = gain_ratio(base, base + share * effect, base + reference)
        assert pytest.approx(share * effect.sum() / reference.sum()) == found.F
        assert found.low < found.F < found.high
        assert found.gain.nats_per_sample == pytest.approx(share * effect.mean())
    measured = np.arange(400) % 4 == 0  # rows without data are 0 in all three
    holed = gain_ratio(*(measured * v for v in (base, base + effect, base + reference)), block=20)
    assert holed.gain.nats_per_sample == pytest.approx(effect[measured].mean())
    same = gain_ratio(base, base + reference, base + reference)
    assert (same.F, same.low, same.high) == pytest.approx((1.0, 1.0, 1.0))


def test_error_of_a_total_is_that_of_independent_blocks():
    """block=1: the rows are blocks already; sqrt(n) times their standard deviation."""
    rng = rng_of("blocks")
    base, x = np.zeros(60), 1.0 + rng.standard_normal((2, 60))
    found = gain_ratio(base, x[0], x[1], block=1, replicates=20_000)
    np.testing.assert_allclose(found.covariance, 60 * np.cov(x), rtol=0.06, atol=1.5)


def test_monte_carlo_noise_enters_the_covariance():
    """Runs of the filter differ by independent errors: their variance of the mean is added."""
    rng, runs = rng_of("runs"), 400
    base = np.zeros((runs, 50)) + 2.0 * rng.standard_normal((runs, 1))
    effect = 1.0 + rng.standard_normal((runs, 1)) + np.zeros(50)
    reference = 2.0 + np.zeros((runs, 50))
    found = gain_ratio(base, effect, reference, block=1)
    exact = 50**2 / runs * np.array([[5.0, 4.0], [4.0, 4.0]])
    assert np.all(np.abs(found.covariance / exact - 1) < 4 * np.sqrt(2 / runs))
    stated = gain_ratio(base[0], effect[0], reference[0], block=1, noise=(0.2, 0.1, 0.3))
    np.testing.assert_allclose(stated.covariance, [[0.05, 0.04], [0.04, 0.13]], atol=1e-12)


def test_experiments_are_not_mixed():
    """Two experiments whose levels differ: only the spread within them counts."""
    rng = rng_of("experiments")
    x = rng.standard_normal(200) + np.repeat([0.0, 50.0], 100)
    found = gain_ratio(np.zeros(200), x, x + 1.0, block=2, starts=(0, 100))
    assert found.gain.error == pytest.approx(np.sqrt(200.0), rel=0.3)


@pytest.mark.parametrize(
    ("arrays", "options", "match"),
    [
        ((np.zeros(50), np.zeros(50), np.zeros(49)), {}, "same rows"),
        ((np.zeros(50), np.full(50, np.nan), np.zeros(50)), {}, "effect model .* not finite"),
        ((np.zeros(50), np.zeros(50), np.zeros(50)), {"block": 20}, "2.5 blocks of 20"),
    ],
)
def test_errors(arrays, options, match):
    with pytest.raises(ArgumentError, match=match):
        gain_ratio(*arrays, **options)
