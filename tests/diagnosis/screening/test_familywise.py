"""Family-wise p-values: against counting, against Sidak, and their level by simulation."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import special, stats

from ssmppl.diagnosis.screening.efficient_score import Null, efficient, regress
from ssmppl.diagnosis.screening.familywise import NullScale, familywise, heights, tail_p, threshold
from ssmppl.errors import ArgumentError
from tests.statistics.checks import LEVEL, seed_of


def rng_of(*name):
    return np.random.default_rng(seed_of("familywise", *name))


def test_step_down_is_that_of_westfall_and_young():
    """Against the algorithm written out, for statistics within the simulated range."""
    rng = rng_of("written out")
    null = rng.standard_normal((200, 12)) @ (np.eye(12) + 0.3)
    seen = np.linspace(0.3, 3.0, 12)[rng.permutation(12)]
    found = familywise(seen, null)
    # on the common scale, which is checked below
    scale = NullScale.of(np.abs(null))
    seen, null = scale.put(seen), scale.put(np.abs(null))
    order, running = np.argsort(-seen), 0.0
    for j, k in enumerate(order):
        rest = null[:, order[j:]].max(axis=1)
        running = max(running, (1 + np.sum(rest >= seen[k])) / 201)
        assert found.p[k] == pytest.approx(running)
        assert found.p_single[k] == pytest.approx((1 + np.sum(null.max(axis=1) >= seen[k])) / 201)


def test_a_family_of_shapes_counts_once():
    rng = rng_of("shapes")
    null, seen = rng.standard_normal((200, 6)), np.array([0.5, 2.0, -2.5, 0.1, 1.0, -1.5])
    groups, sided = np.array([7, 7, 7, 3, 3, 3]), np.array([0, 0, 0, 1, 1, 1])
    found = familywise(seen, null, sided=sided, groups=groups)
    tops = np.stack([null[:, 3:].max(axis=1), np.abs(null[:, :3]).max(axis=1)], axis=1)
    direct = familywise(np.array([1.0, 2.5]), tops, sided=1)
    np.testing.assert_array_equal(found.labels, [3, 7])
    np.testing.assert_array_equal(found.best, [4, 2])
    np.testing.assert_allclose(found.p, direct.p)
    np.testing.assert_allclose(found.of_columns(groups), found.p[[1, 1, 1, 0, 0, 0]])


def test_heights():
    np.testing.assert_array_equal(
        heights(np.array([-2.0, -2.0, -2.0]), np.array([0, 1, -1])), [2.0, -2.0, 2.0]
    )


@pytest.mark.parametrize("z", [4.5, 5.5, 6.5])
def test_beyond_the_simulated_range(z):
    """Of 60 independent normals, the p of z is Sidak's: 200 sets give it or more, still small."""
    rng = rng_of("tail", z)
    exact = -np.expm1(60 * np.log1p(-2 * stats.norm.sf(z)))
    found = [tail_p(z, np.abs(rng.standard_normal((200, 60))).max(axis=1)) for _ in range(100)]
    assert np.mean(np.array(found) >= exact) > 0.9
    assert np.median(found) < min(50 * exact + 1e-4, 1 / 201)


def test_p_falls_with_the_statistic_and_threshold_inverts_it():
    rng = rng_of("monotone")
    maxima = np.abs(rng.standard_normal((150, 40))).max(axis=1)
    p = [tail_p(v, maxima) for v in np.linspace(0, 12, 400)]
    assert np.all(np.diff(p) <= 1e-12)
    assert p[0] == 1.0
    for alpha in (0.2, 0.05, 1e-3):
        at = threshold(maxima, alpha)
        assert tail_p(at + 1e-6, maxima) <= alpha < tail_p(at - 0.05, maxima) + 0.02


def test_maxima_that_do_not_vary():
    assert tail_p(5.0, np.zeros(100)) == pytest.approx(1 / 101)


def test_shapes_that_do_not_fit():
    with pytest.raises(ArgumentError, match=r"\(3,\)"):
        familywise(np.zeros(3), np.zeros((10, 2)))


def family_p(rng, sets, law, times):
    """Smallest p under no effect, by `familywise` and with every set in its own standardisation."""
    width, parameters, found, naive = 80, 8, [], []
    mix = rng.standard_normal((10, width))
    absorbed = rng.standard_normal((parameters, width))
    quadratic = np.arange(width) < (30 if law == "squares" else 0)
    for _ in range(times):
        nuisance = rng.standard_normal((sets + 1, parameters))
        if law == "t5":
            s = rng.standard_t(5, (sets + 1, 10)) @ mix + 2 * rng.standard_t(5, (sets + 1, width))
        else:
            s = rng.standard_normal((sets + 1, 10)) @ mix
            s = s + 2 * rng.standard_normal((sets + 1, width))
        s[:, quadratic] = rng.chisquare(np.where(np.arange(30) < 15, 1, 4)[: quadratic.sum()],
                                        (sets + 1, quadratic.sum()))  # fmt: skip
        s += nuisance @ absorbed
        null = Null.of(s[:-1], nuisance[:-1], quadratic=quadratic)
        e = efficient(null, s[-1], nuisance[-1])
        found.append(familywise(e.statistic, e.null, sided=e.sided).p.min())
        fit = regress(s[:-1], nuisance[:-1])
        size = np.sqrt(fit.spread)
        inside = np.abs(fit.residuals / size).max(axis=1)
        outside = np.abs(fit.predict_error(s[-1], nuisance[-1]) / size).max()
        naive.append((1 + np.sum(inside >= outside)) / (sets + 1))
    return np.array(found), np.array(naive)


def assert_level(p, alpha, times):
    """The share of p <= alpha is alpha within binomial error, and below that no larger."""
    count = int(np.sum(p <= alpha))
    assert stats.binomtest(count, times, alpha).pvalue > LEVEL, (count / times, alpha)
    small = int(np.sum(p <= alpha / 10))
    assert stats.binomtest(small, times, alpha / 10, alternative="greater").pvalue > LEVEL


def test_false_alarms():
    """150 sets, 80 columns, 8 parameters: the level is kept; with each set in its own
    standardisation the false alarms are well above it (about 9% to 12% where 5% are meant)."""
    p, naive = family_p(rng_of("level"), 150, "normal", 400)
    assert_level(p, 0.05, 400)
    above = stats.binomtest(int(np.sum(naive <= 0.05)), 400, 0.05, alternative="greater")
    print(f"level {np.mean(p <= 0.05):.3f}, standardised by itself {np.mean(naive <= 0.05):.3f}")
    assert above.pvalue < LEVEL


@pytest.mark.slow
@pytest.mark.parametrize("law", ["normal", "t5", "squares"])
@pytest.mark.parametrize("sets", [pytest.param(150, marks=pytest.mark.exhaustive), 300])
def test_false_alarms_of_other_laws(law, sets):
    p, _ = family_p(rng_of("level", law, sets), sets, law, 1000)
    assert_level(p, 0.05, 1000)
    assert_level(p, 0.1, 1000)


def test_power():
    """A gain of 20 nats among 80 columns: Phi(sqrt(40) - threshold) is above 0.99."""
    rng, hits = rng_of("power"), 0
    for _ in range(100):
        null = rng.standard_normal((200, 80))
        seen = rng.standard_normal(80)
        seen[5] += np.sqrt(40.0)
        found = familywise(seen, null)
        hits += found.p[5] <= 0.05
    assert hits >= stats.binom.ppf(LEVEL, 100, 0.99)


def test_one_skew_statistic_does_not_hide_the_others():
    """Raw, squared normals set the threshold of all; as normal scores they do not."""
    rng, raw, scored = rng_of("balance"), 0, 0
    quadratic = np.arange(40) < 10
    for _ in range(100):
        s = rng.standard_normal((201, 40))
        s[:, :10] = rng.chisquare(1, (201, 10))
        s[-1, 20] = 4.5
        e = efficient(Null.of(s[:-1], np.zeros((200, 0)), quadratic=quadratic), s[-1], np.zeros(0))
        scored += familywise(e.statistic, e.null, sided=e.sided).p[20] <= 0.05
        centred = s - np.where(quadratic, s[:-1].mean(axis=0), 0.0)
        size = centred[:-1].std(axis=0)
        maxima = heights(centred[:-1] / size, e.sided).max(axis=1)
        raw += tail_p(abs(centred[-1, 20] / size[20]), maxima) <= 0.05
    assert scored >= 90
    assert raw <= 50


@pytest.mark.parametrize(("shapes", "sided"), [(1, 1), (1, 0), (40, 0), (300, 1)])
def test_the_common_scale_is_that_of_one_normal(shapes, sided):
    """The largest of independent normals, put on the scale, is |normal|: its quantiles within their
    own error and that of the scale, which has them from as many sets."""
    rng, sets = rng_of("scale", shapes, sided), 4000

    def largest():
        z = rng.standard_normal((sets, shapes))
        return (z if sided else np.abs(z)).max(axis=1)[:, None]

    scale = NullScale.of(largest())
    put = scale.put(largest())[:, 0]
    for level in (0.5, 0.8, 0.95, 0.99):
        at = stats.norm.isf((1.0 - level) / 2.0)
        error = np.sqrt(2.0 * level * (1.0 - level) / sets)
        # powers of Phi are not quite the law of |normal|: up to 0.01 of it
        assert abs(np.mean(put <= at) - level) < 5.0 * error + 0.01, level
    one = (0.9, 1.1) if sided else (1.8, 2.6)  # |normal| is two of them far out
    assert one[0] * shapes < scale.number[0] < one[1] * shapes
    assert 1.0 <= scale.stretch[0] < 1.1


def test_the_common_scale_far_out():
    scale = NullScale(np.array([2.4, 600.0]), np.array([1.0, 1.2]))
    high = np.array([0.0, 1.0, 3.0, 8.0, 20.0, 40.0])
    put = scale.put(np.stack([high, high], axis=1))
    assert np.all(np.isfinite(put))
    assert np.all(np.diff(put, axis=0) >= 0.0)
    assert np.all(np.diff(put[2:], axis=0) > 0.0)
    # 1 - Phi(z)^n is n (1 - Phi(z)) there
    for z in (8.0, 20.0):
        direct = -special.ndtri_exp(special.log_ndtr(-z) + np.log(600.0 / 2.0)) / 1.2
        assert scale.put(np.array([z, z]))[1] == pytest.approx(direct, rel=1e-9)
    assert np.all(scale.put(np.array([-30.0, -30.0])) >= 0.0)


def test_many_shapes_of_one_effect_do_not_hide_the_others():
    """Beside a family of 300 shapes 7 nats in one statistic are found nearly as often as without
    it; with the largest of all taken as they are, seldom."""
    rng, hits = rng_of("hidden"), {"common": 0, "as they are": 0, "alone": 0}
    groups = np.concatenate([np.zeros(300, int), 1 + np.arange(20)])
    for _ in range(100):
        s = rng.standard_normal((201, 320))
        s[-1, 305] = np.sqrt(2.0 * 7.0)
        hits["common"] += familywise(s[-1], s[:-1], groups=groups).p[6] <= 0.05
        hits["alone"] += familywise(s[-1, 300:], s[:-1, 300:]).p[5] <= 0.05
        maxima = np.abs(s[:-1]).max(axis=1)
        hits["as they are"] += tail_p(abs(s[-1, 305]), maxima) <= 0.05
    print(hits)
    assert hits["alone"] >= 90
    assert hits["common"] >= 85
    assert hits["as they are"] <= 60


@pytest.mark.parametrize("times", [400, pytest.param(2000, marks=pytest.mark.slow)])
def test_level_of_families_of_unlike_size(times):
    """300 correlated shapes of one effect, 20 heavy-tailed statistics, 20 normal ones."""
    rng, found = rng_of("unlike", times), []
    groups = np.concatenate([np.zeros(300, int), 1 + np.arange(40)])
    smooth = np.exp(-0.5 * (np.subtract.outer(np.arange(300), np.arange(300)) / 4.0) ** 2)
    root = np.linalg.cholesky(smooth + 1e-6 * np.eye(300)).T
    for _ in range(times):
        s = np.concatenate([
            rng.standard_normal((201, 300)) @ root,
            rng.standard_t(5, (201, 20)) / np.sqrt(5 / 3), rng.standard_normal((201, 20)),
        ], axis=1)  # fmt: skip
        found.append(familywise(s[-1], s[:-1], groups=groups).p.min())
    assert_level(np.array(found), 0.05, times)
