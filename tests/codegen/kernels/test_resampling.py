"""Resampling: unbiasedness, the law of each scheme, and safety under rounding.

Monte Carlo bounds are computed: a z- or chi-squared test at LEVEL = 1e-3 / number of tests.
"""

import numba
import numpy as np
import pytest
from scipy import stats

from ssmppl.codegen.kernels.math.flags import kernel
from ssmppl.codegen.kernels.math.random import new_state
from ssmppl.codegen.kernels.particle.resampling import (
    MULTINOMIAL,
    PADDING,
    RESIDUAL,
    STRATIFIED,
    SYSTEMATIC,
    conditional_systematic,
    resample,
)

SCHEMES = {
    "systematic": SYSTEMATIC,
    "stratified": STRATIFIED,
    "residual": RESIDUAL,
    "multinomial": MULTINOMIAL,
}
LEVEL = 1e-3 / 100
REPEATS = 1000 if numba.config.DISABLE_JIT else 40_000


@kernel
def repeat(scheme, state, w, ancestors, counts):
    """counts[r, j]: copies of j in repeat r."""
    for r in range(counts.shape[0]):
        resample(scheme, state, w, ancestors)
        for m in range(ancestors.size - PADDING):
            counts[r, ancestors[m]] += 1


@kernel
def repeat_conditional(state, w, keep, ancestors, out):
    for r in range(out.shape[0]):
        conditional_systematic(state, w, keep, ancestors)
        for m in range(out.shape[1]):
            out[r, m] = ancestors[m]


def state(*entropy):
    return new_state(np.random.SeedSequence([77, *entropy]))


def buffer(m):
    return np.full(m + PADDING, -1, dtype=np.int32)


def normalised(*w):
    w = np.array(w, dtype=float)
    return w / w.sum()


WEIGHTS = {
    "mixed": normalised(0.3, 0.0, 1.7, 0.05, 2.0, 0.0, 0.9),
    "equal": np.full(6, 1 / 6),
    "dominant": normalised(1e-3, 1.0, 1e-3, 1e-9, 0.0),
    "two": normalised(0.25, 0.75),
}


def p_value_of_means(counts, expected):
    """Are the means of the columns the expected ones?  Smallest two-sided p, Bonferroni."""
    error = counts.std(axis=0) / np.sqrt(counts.shape[0])
    z = np.abs(counts.mean(axis=0) - expected)
    p = 2 * stats.norm.sf(z / np.where(error > 0, error, 1))
    # The same count in every repeat says only that another one is rare.
    p = np.where(error > 0, p, np.exp(-z * counts.shape[0]))
    return p.min() * p.size


@pytest.mark.parametrize("m", [1, 2, 5, 12])
@pytest.mark.parametrize("weights", WEIGHTS)
@pytest.mark.parametrize("scheme", SCHEMES)
def test_unbiased(scheme, weights, m):
    w = WEIGHTS[weights]
    counts = np.zeros((REPEATS // 2, w.size), dtype=np.int64)
    repeat(SCHEMES[scheme], state(m), w, buffer(m), counts)
    assert (counts.sum(axis=1) == m).all()
    assert (counts[:, w == 0] == 0).all()
    assert p_value_of_means(counts, m * w) > LEVEL
    if scheme == "systematic":
        assert (np.abs(counts - m * w) < 1 + 1e-9).all()
    if scheme == "stratified":
        assert (np.abs(counts - m * w) < 2 + 1e-9).all()
    if scheme == "residual":
        assert (counts >= np.floor(m * w - 1e-12)).all()
    if scheme == "multinomial":
        # Not only the mean: the covariance m (diag w - w w').
        for j in range(w.size):
            law = stats.binom(m, w[j])
            deviation = (counts[:, j] - law.mean()) ** 2
            if law.var() * counts.shape[0] > 1000:
                z = (deviation.mean() - law.var()) / (deviation.std() / np.sqrt(len(deviation)))
                assert 2 * stats.norm.sf(abs(z)) > LEVEL / w.size


def stratified_counts(w, m, u):
    """By its definition: stratum k has the one point (k + u_k)/m."""
    points = (np.arange(m) + u) / m
    return np.bincount(np.searchsorted(np.cumsum(w), points, side="right"), minlength=w.size)


@pytest.mark.parametrize("scheme", ["systematic", "stratified"])
def test_pair_law_against_the_definition(scheme):
    """E[counts_i counts_j] against a direct simulation of the definition."""
    w, m = WEIGHTS["mixed"], 5
    counts = np.zeros((REPEATS, w.size), dtype=np.int64)
    repeat(SCHEMES[scheme], state(1), w, buffer(m), counts)
    rng = np.random.default_rng(5)
    u = rng.random((20_000, 1 if scheme == "systematic" else m))
    direct = np.array([stratified_counts(w, m, row) for row in u])
    for i in range(w.size):
        for j in range(i):
            a, b = counts[:, i] * counts[:, j], direct[:, i] * direct[:, j]
            error = np.sqrt(a.var() / a.size + b.var() / b.size)
            if error > 0:
                assert 2 * stats.norm.sf(abs(a.mean() - b.mean()) / error) > LEVEL / 21


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("n", [1, 2, 3, 5, 1000])
def test_every_slot_is_filled_in_range(scheme, n):
    rng = np.random.default_rng(n)
    generator = state(n)
    for trial in range(60):
        w = np.exp(rng.normal(size=n) * rng.choice([0.0, 1.0, 30.0]))
        w[rng.random(n) < 0.3] = 0.0
        w[-1] = 0.0 if n > 1 and trial % 2 else w[-1]
        if w.sum() == 0.0:
            w[0] = 1.0
        # Sums off by rounding, and by more than that.
        w *= rng.choice([1.0, 1 - 1e-15, 1 + 1e-15, 0.999, 1.001]) / w.sum()
        m = int(rng.choice([1, n, 2 * n + 1]))
        ancestors = buffer(m)
        resample(SCHEMES[scheme], generator, w, ancestors)
        chosen = ancestors[:m]
        assert chosen.min() >= 0
        assert chosen.max() < n
        assert (w[chosen] > 0).all()
        assert (np.diff(chosen) >= 0).all()


@pytest.mark.parametrize("scheme", SCHEMES)
def test_all_weight_on_one(scheme):
    for n in (1, 2, 9, 100):
        for j in {0, n // 2, n - 1}:
            w = np.zeros(n)
            w[j] = 1.0
            ancestors = buffer(n)
            resample(SCHEMES[scheme], state(j), w, ancestors)
            assert (ancestors[:n] == j).all()


@pytest.mark.parametrize("scheme", SCHEMES)
def test_writes_stay_inside_even_for_bad_weights(scheme):
    for bad in (np.nan, np.inf, 1e300, 0.0):
        store = np.full(64, -7, dtype=np.int32)
        resample(SCHEMES[scheme], state(3), np.full(20, bad), store[20 : 40 + PADDING])
        assert (store[:20] == -7).all()
        assert (store[40 + PADDING :] == -7).all()
        assert ((store[20:40] >= 0) & (store[20:40] < 20)).all()


@pytest.mark.parametrize("weights", WEIGHTS)
def test_conditional_systematic_law(weights):
    """Against unconditional systematic resampling, restricted to the event that the offspring in
    a slot chosen at random has the parent `keep`: the law of the vector of copies."""
    w = WEIGHTS[weights]
    n = w.size
    rng = np.random.default_rng(11)
    u = rng.random(REPEATS)
    direct = np.array([stratified_counts(w, n, v) for v in u])
    slot = rng.integers(n, size=REPEATS)
    parent = (np.cumsum(direct, axis=1) <= slot[:, None]).sum(axis=1)
    tested = 0
    for keep in np.flatnonzero(w * REPEATS > 100):
        restricted = direct[parent == keep]
        out = np.empty((REPEATS, n), dtype=np.int64)
        repeat_conditional(state(keep), w, keep, buffer(n), out)
        assert (out[:, -1] == keep).all()
        counts = np.array([np.bincount(row, minlength=n) for row in out])
        patterns = {}
        for row, sample in ((0, restricted), (1, counts)):
            keys, numbers = np.unique(sample, axis=0, return_counts=True)
            for key, number in zip(map(tuple, keys), numbers, strict=True):
                patterns.setdefault(key, [0, 0])[row] = number
        table = np.array(list(patterns.values())).T
        common = table.sum(axis=0) >= 30
        table = np.c_[table[:, common], table[:, ~common].sum(axis=1)]
        table = table[:, table.sum(axis=0) > 0]
        if table.shape[1] > 1:
            assert stats.chi2_contingency(table, correction=False).pvalue > LEVEL
        tested += 1
    assert tested >= 1


def test_conditional_systematic_marginals():
    """With the kept index drawn from w, every slot has the marginal law w: the law is that of
    systematic resampling under a uniform rotation (Chopin and Singh's condition)."""
    w = WEIGHTS["mixed"]
    n = w.size
    total = np.zeros((n, n))
    variance = np.zeros((n, n))
    for keep in np.flatnonzero(w > 0):
        out = np.empty((REPEATS, n), dtype=np.int64)
        repeat_conditional(state(50, keep), w, keep, buffer(n), out)
        share = np.array([np.bincount(out[:, m], minlength=n) for m in range(n)]) / REPEATS
        total += w[keep] * share
        variance += w[keep] ** 2 * share * (1 - share) / REPEATS
    z = np.abs(total - w) / np.sqrt(np.maximum(variance, 1e-30))
    wrong = np.where(variance > 0, 2 * stats.norm.sf(z), np.abs(total - w) < 1e-12)
    assert wrong.min() > LEVEL / n**2


def test_conditional_order_is_cyclic():
    w = normalised(1, 2, 3, 4, 5, 6, 7)
    ancestors = buffer(7)
    generator = state(60)
    for keep in list(range(7)) * 20:
        conditional_systematic(generator, w, keep, ancestors)
        # From keep on, once round the circle of particles and back to keep.
        turned = np.r_[keep, ancestors[:7]]
        assert (np.diff(turned) % 7).sum() in (0, 7)


@pytest.mark.parametrize("n", [1, 2, 3, 50, 1000])
def test_conditional_systematic_is_safe(n):
    rng = np.random.default_rng(n)
    generator = state(61, n)
    for _ in range(60):
        w = np.exp(rng.normal(size=n) * rng.choice([0.0, 1.0, 30.0]))
        w[rng.random(n) < 0.3] = 0.0
        if w.sum() == 0.0:
            w[0] = 1.0
        w *= rng.choice([1.0, 1 - 1e-15, 1 + 1e-15]) / w.sum()
        keep = int(rng.choice(np.flatnonzero(w > 0)))
        store = np.full(n + PADDING + 4, -7, dtype=np.int32)
        conditional_systematic(generator, w, keep, store[: n + PADDING])
        chosen = store[:n]
        assert chosen[-1] == keep
        assert ((chosen >= 0) & (chosen < n)).all()
        assert (w[chosen] > 0).all()
        assert (store[n + PADDING :] == -7).all()
        copies = np.bincount(chosen, minlength=n)
        assert (np.abs(copies - n * w) < 1 + 1e-6).all()
