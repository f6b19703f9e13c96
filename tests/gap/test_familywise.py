"""Family-wise p-values: against counting, against Sidak, and their level by simulation."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from ssmppl.errors import ArgumentError
from ssmppl.gap.efficient import Null, efficient, regress
from ssmppl.gap.familywise import familywise, heights, tail_p, threshold
from tests.statistics.checks import LEVEL, seed_of


def rng_of(*name):
    return np.random.default_rng(seed_of("familywise", *name))


def test_step_down_is_that_of_westfall_and_young():
    """Against the algorithm written out, for statistics within the simulated range."""
    rng = rng_of("written out")
    null = rng.standard_normal((200, 12)) @ (np.eye(12) + 0.3)
    seen = np.linspace(0.3, 3.0, 12)[rng.permutation(12)]
    found = familywise(seen, null)
    order, running = np.argsort(-seen), 0.0
    for j, k in enumerate(order):
        rest = np.abs(null[:, order[j:]]).max(axis=1)
        running = max(running, (1 + np.sum(rest >= seen[k])) / 201)
        assert found.p[k] == pytest.approx(running)
        assert found.p_single[k] == pytest.approx(
            (1 + np.sum(np.abs(null).max(axis=1) >= seen[k])) / 201
        )


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
@pytest.mark.parametrize("sets", [150, 300])
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
        raw += familywise(centred[-1] / size, centred[:-1] / size, sided=e.sided).p[20] <= 0.05
    assert scored >= 90
    assert raw <= 50
