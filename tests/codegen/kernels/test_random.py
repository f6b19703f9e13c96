"""The generator and the samplers: distribution tests at a computed level with a fixed seed.

Every p-value of this file is compared with LEVEL = 1e-3 over the number of tests (Bonferroni):
were the samplers right, a fresh seed would fail the whole file with probability below 0.001.
"""

import numba
import numpy as np
import pytest
from scipy import stats

from ssmppl.codegen.kernels.math import random
from ssmppl.codegen.kernels.math.flags import kernel

TESTS = 150  # at least as many as p-values are computed below
LEVEL = 1e-3 / TESTS
N = 2000 if numba.config.DISABLE_JIT else 100_000


def new_state(*entropy):
    return random.new_state(np.random.SeedSequence([2024, *entropy]))


def draw(function, *parameters, n=N, entropy=0):
    @kernel
    def fill(state, out, *parameters):
        for i in range(out.size):
            out[i] = function(state, *parameters)

    out = np.empty(n)
    fill(new_state(entropy), out, *parameters)
    return out


def p_value_of_mean(x, mean, variance):
    return 2 * stats.norm.sf(abs(x.mean() - mean) / np.sqrt(variance / x.size))


def p_value_discrete(x, law):
    """Chi-squared test over cells of expected count >= 10."""
    low, high = law.ppf(1e-4), law.ppf(1 - 1e-4)
    edges = np.unique(np.floor(np.linspace(low, high, 60)))
    cdf = np.concatenate([[0.0], law.cdf(edges), [1.0]])
    cells = np.searchsorted(edges, x, side="left")
    observed = np.bincount(cells, minlength=edges.size + 1).astype(float)
    expected = np.diff(cdf) * x.size
    merged_o, merged_e, o, e = [], [], 0.0, 0.0
    for a, b in zip(observed, expected, strict=True):
        o, e = o + a, e + b
        if e >= 10:
            merged_o.append(o)
            merged_e.append(e)
            o = e = 0.0
    merged_o[-1] += o
    merged_e[-1] += e
    statistic = sum((a - b) ** 2 / b for a, b in zip(merged_o, merged_e, strict=True))
    return stats.chi2.sf(statistic, max(len(merged_e) - 1, 1))


@kernel
def gamma_by(state, shape):
    """With the normal and the uniform that a loop would have in its buffers."""
    return random.gamma_by(state, shape, random.normal(state), random.uniform(state))


CONTINUOUS = [
    (random.uniform, (), stats.uniform()),
    (random.normal, (), stats.norm()),
    (random.exponential, (), stats.expon()),
    *((random.gamma, (a,), stats.gamma(a)) for a in (0.1, 0.5, 0.99, 1.0, 1.5, 7.0, 1e3, 1e6)),
    *((gamma_by, (a,), stats.gamma(a)) for a in (0.3, 1.0, 1.3, 40.0)),
    *((random.log_gamma_draw, (a,), stats.loggamma(a)) for a in (1e-3, 0.02, 0.3, 1.0, 20.0)),
    *((random.vonmises, (k,), stats.vonmises(k)) for k in (1e-9, 1e-4, 0.3, 2.0, 40.0, 1e3, 1e9)),
]


@pytest.mark.parametrize("case", CONTINUOUS, ids=lambda c: f"{c[0].__name__}{c[1]}")
def test_continuous(case):
    function, parameters, law = case
    x = draw(function, *parameters)
    if parameters and parameters[0] < 0.05:
        # SciPy's loggamma loses its tail there: G^shape is uniform up to O(shape).
        assert np.isfinite(x).all()
        p = 2 * stats.norm.sf(abs(x.mean() - law.mean()) / np.sqrt(law.var() / x.size))
        assert p > LEVEL
        return
    assert stats.kstest(x, law.cdf).pvalue > LEVEL
    assert p_value_of_mean(x, law.mean(), law.var()) > LEVEL
    # The variance of a sample variance is (m4 - var^2)/n.
    centred = (x - law.mean()) ** 2
    if function is random.vonmises:  # whose fourth moment SciPy has not
        assert np.abs(x).max() <= np.pi
        return
    fourth = (law.stats("k") + 3) * law.var() ** 2
    assert p_value_of_mean(centred, law.var(), fourth - law.var() ** 2) > LEVEL


DISCRETE = [
    *((random.poisson, (m,), stats.poisson(m)) for m in (0.01, 0.7, 5.0, 9.99, 10.0, 11.5, 40.0)),
    *((random.poisson, (m,), stats.poisson(m)) for m in (1e3, 1e6, 1e9)),
    *(
        (random.binomial, (float(n), p), stats.binom(n, p))
        for n, p in [
            (1, 0.3),
            (10, 0.5),
            (10, 0.97),
            (19, 0.5),
            (20, 0.5),
            (25, 0.41),
            (1000, 0.002),
            (1000, 0.9),
            (10**6, 0.3),
            (10**9, 0.7),
        ]
    ),
]


@pytest.mark.parametrize("case", DISCRETE, ids=lambda c: f"{c[0].__name__}{c[1]}")
def test_discrete(case):
    function, parameters, law = case
    x = draw(function, *parameters)
    assert (x == np.floor(x)).all()
    assert p_value_discrete(x, law) > LEVEL
    assert p_value_of_mean(x, law.mean(), law.var()) > LEVEL
    centred = (x - law.mean()) ** 2
    fourth = (law.stats("k") + 3) * law.var() ** 2
    assert p_value_of_mean(centred, law.var(), fourth - law.var() ** 2) > LEVEL


@pytest.mark.parametrize("n", [0, 1, 2, 3, 17, 1000])
def test_bulk_normals(n):
    state = new_state(1)
    out = np.full(n, np.nan)
    random.fill_normal(state, out)
    assert np.isfinite(out).all()
    assert state[random.COUNTER] == 2 * ((n + 1) // 2)
    assert np.unique(out).size == n


def test_bulk_distributions():
    state = new_state(2)
    normals = np.empty(20 * N + 1)
    random.fill_normal(state, normals)
    assert stats.kstest(normals, "norm").pvalue > LEVEL
    moments = [0.0, 1.0, 0.0, 3.0, 0.0, 15.0, 0.0, 105.0, 0.0, 945.0, 0.0, 10395.0]
    for order in range(1, 7):
        mean, square = moments[order - 1], moments[2 * order - 1]
        assert p_value_of_mean(normals**order, mean, square - mean**2) > LEVEL
    # Far tail, where a coarse uniform would show: expected count of |z| > 4.
    expected = 2 * stats.norm.sf(4.0) * normals.size
    count = int((np.abs(normals) > 4.0).sum())
    assert (
        2 * min(stats.poisson.cdf(count, expected), stats.poisson.sf(count - 1, expected)) > LEVEL
    )
    uniforms = np.empty(20 * N)
    random.fill_uniform(state, uniforms)
    assert uniforms.min() > 0.0
    assert uniforms.max() < 1.0
    assert stats.kstest(uniforms, "uniform").pvalue > LEVEL


def p_value_of_correlation(x, y):
    return 2 * stats.norm.sf(abs(np.corrcoef(x, y)[0, 1]) * np.sqrt(x.size))


@pytest.mark.parametrize("lag", [1, 2, 3, 50_000])
def test_serial_correlation(lag):
    x = np.empty(20 * N if lag < N else 4 * N)
    random.fill_normal(new_state(3), x)
    lag = min(lag, N // 2)
    for f in (lambda v: v, np.abs):
        assert p_value_of_correlation(f(x[:-lag]), f(x[lag:])) > LEVEL


def test_the_two_normals_of_a_pair_are_independent():
    x = np.empty(4 * N)
    random.fill_normal(new_state(4), x)
    a, b = x[: 2 * N], x[2 * N :]
    for f in (lambda v: v, np.abs, np.square):
        assert p_value_of_correlation(f(a), f(b)) > LEVEL
    assert stats.kstest(np.arctan2(a, b), stats.uniform(-np.pi, 2 * np.pi).cdf).pvalue > LEVEL


GOLDEN = 0x9E3779B97F4A7C15


def neighbours():
    """Pairs of states whose words would be correlated, were the hash weak."""
    base = new_state(5)
    changes = [(0, 1 << bit, 0) for bit in (0, 1, 27, 32, 62, 63)]
    for change in [(1, 0, 0), (1 << 63, 0, 0), (0, 0, 1 << 63), *changes]:
        other = base.copy()
        other[:3] ^= np.array(change, dtype=np.uint64)
        yield f"flip{change}", base, other
    shifted = base.copy()
    with np.errstate(over="ignore"):
        shifted[0] += np.uint64(GOLDEN)
    shifted[1] ^= np.uint64(1)
    yield "overlapping counters", base, shifted


@pytest.mark.parametrize("pair", list(neighbours()), ids=lambda p: p[0])
def test_neighbouring_streams(pair):
    _, first, second = pair
    n = 4 * N
    a, b = np.empty(n), np.empty(n)
    random.fill_uniform(first.copy(), a)
    random.fill_uniform(second.copy(), b)
    for lag in (0, 1):
        x, y = a[lag:], b[: n - lag]
        assert p_value_of_correlation(x, y) > LEVEL
        # Every bit of the words: the XOR of two of them is 1 half of the time.
        bits = ((x * 2.0**52).astype(np.uint64) ^ (y * 2.0**52).astype(np.uint64))[:20_000]
        ones = ((bits[:, None] >> np.arange(52, dtype=np.uint64)) & np.uint64(1)).sum(axis=0)
        z = (ones.astype(float) - bits.size / 2) / np.sqrt(bits.size / 4)
        assert stats.chi2.sf((z**2).sum(), 52) > LEVEL


def test_one_flipped_counter_bit_changes_half_of_the_word():
    state = new_state(6)
    for bit in range(0, 64, 7):
        changed = 0
        for i in range(200):
            with np.errstate(over="ignore"):
                a = random.word(state[0], state[1], np.uint64(i))
                b = random.word(state[0], state[1], np.uint64(i) ^ np.uint64(1 << bit))
            changed += (int(a) ^ int(b)).bit_count()
        # 200 x 64 fair bits.
        assert abs(changed - 6400) < stats.norm.isf(LEVEL / 20) * np.sqrt(200 * 64 / 4)


def test_cutting_into_calls_does_not_matter():
    whole, parts = np.empty(30), np.empty(30)
    random.fill_uniform(new_state(8), whole)
    state = new_state(8)
    random.fill_uniform(state, parts[:7])
    parts[7] = random.uniform(state)
    random.fill_uniform(state, parts[8:])
    np.testing.assert_array_equal(whole, parts)


def test_streams_follow_the_seed_sequence():
    a, b = (random.new_state(s) for s in np.random.SeedSequence(1).spawn(2))
    assert a.shape == (4,)
    assert a.dtype == np.uint64
    assert (a[:2] != b[:2]).all()
    np.testing.assert_array_equal(a, random.new_state(np.random.SeedSequence(1).spawn(1)[0]))


def test_invalid_parameters_give_nan():
    state = new_state(9)
    for bad in (np.nan, -1.0, np.inf):
        assert np.isnan(random.gamma(state, bad))
        assert np.isnan(random.log_gamma_draw(state, bad))
        assert np.isnan(random.poisson(state, bad))
        assert np.isnan(random.binomial(state, bad, 0.5))
        assert np.isnan(random.binomial(state, 5.0, bad))
    assert np.isnan(random.gamma(state, 0.0))
    assert np.isnan(random.binomial(state, 2.5, 0.5))


def test_degenerate_parameters():
    state = new_state(10)
    assert random.poisson(state, 0.0) == 0.0
    assert random.binomial(state, 0.0, 0.5) == 0.0
    assert random.binomial(state, 7.0, 0.0) == 0.0
    assert random.binomial(state, 7.0, 1.0) == 7.0
    assert np.isfinite(random.log_gamma_draw(state, 1e-8))
    assert random.gamma(state, 1e300) == pytest.approx(1e300, rel=1e-3)
