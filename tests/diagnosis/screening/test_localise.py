"""Groups of scores: their level and power by simulation, what is projected out, and the curve."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy import stats

from ssmppl.diagnosis.model.basis import bases
from ssmppl.diagnosis.screening.location import curve, group_score, localise, regions
from ssmppl.errors import ArgumentError
from tests.statistics.checks import LEVEL, seed_of

B, P = 200, 5


def rng_of(*name):
    return np.random.default_rng(seed_of("localise", *name))


class World:
    """Scores of groups of given sizes and of P parameters, all correlated."""

    def __init__(self, rng, sizes, heavy=False):
        self.rng, self.heavy, n = rng, heavy, sum(sizes)
        self.edges = np.cumsum([0, *sizes])
        self.mix = 0.5 * rng.standard_normal((n, n)) / np.sqrt(n) + np.eye(n)
        self.absorbed = rng.standard_normal((P, n))
        self.efficient = self.mix.T @ self.mix

    def __call__(self, sets, strengths=None):
        """Scores and nuisance scores of sets; under a truth of these strengths, after a refit."""
        draw = (lambda s: self.rng.standard_t(5, s)) if self.heavy else self.rng.standard_normal
        nuisance = draw((sets, P))
        scores = draw((sets, len(self.mix))) @ self.mix + nuisance @ self.absorbed
        return scores + (0.0 if strengths is None else self.efficient @ strengths), nuisance

    def groups(self, scores, seen):
        return {
            (f"eq{i}", "mean"): (scores[:, a:b], seen[a:b])
            for i, (a, b) in enumerate(pairwise(self.edges))
        }


def assert_level(p, alpha):
    p = np.asarray(p)
    count = int(np.sum(p <= alpha))
    assert stats.binomtest(count, len(p), alpha).pvalue > LEVEL, (count / len(p), alpha)


@pytest.mark.parametrize("size", [1, 12])
def test_level_of_one_group(size):
    """12 basis functions, 200 sets: 5% and 10% are kept."""
    rng, p = rng_of("one", size), []
    world = World(rng, [size])
    for _ in range(500):
        s, n = world(B + 1)
        p.append(group_score(s[:B], s[B], n[:B], n[B]).p)
    assert_level(p, 0.05)
    assert_level(p, 0.1)


@pytest.mark.slow
@pytest.mark.parametrize("heavy", [False, pytest.param(True, marks=pytest.mark.exhaustive)])
def test_level_over_groups(heavy):
    rng, together, alone, either, each = rng_of("many", heavy), [], [], [], []
    world = World(rng, [12, 12, 6, 12, 8], heavy)
    for _ in range(500):
        s, n = world(B + 1)
        table, found = localise(world.groups(s[:B], s[B]), n[:B], n[B])
        together.append(table["p"].min())
        alone.append(table["p_alone"].min())
        either.append(table["p_either"].min())
        each.append([g.p for g in found.values()])
    for alpha in (0.05, 0.1):
        assert_level(together, alpha)
        assert_level(alone, alpha)
        assert_level(either, alpha)
        for p in np.transpose(each):
            assert_level(p, alpha)


def test_of_two_looks_one_p():
    """Between the smaller of both and twice that (Bonferroni); of a single group both looks are the
    same one, and cost nothing."""
    rng = rng_of("either")
    world = World(rng, [3, 3])
    for _ in range(4):
        s, n = world(B + 1)
        groups = world.groups(s[:B], s[B])
        least = localise(groups, n[:B], n[B])[0]
        smaller = least[["p", "p_alone"]].min().min()
        assert 0.8 * smaller <= least["p_either"].min() <= 2.5 * smaller
        one, _ = localise({"a": groups["eq0", "mean"]}, n[:B], n[B])
        np.testing.assert_array_equal(one["p_either"], one["p"])


def test_the_equation_is_told():
    """A term in the second equation: found there; in the others, false alarms as without it."""
    rng, times, found, others = rng_of("equation"), 60, 0, []
    world = World(rng, [6, 6, 6])
    strengths = np.zeros(18)
    strengths[6:12] = rng.standard_normal(6)
    own = np.linalg.inv(np.linalg.inv(world.efficient)[6:12, 6:12])
    strengths *= np.sqrt(2 * 25 / (strengths[6:12] @ own @ strengths[6:12]))  # 25 nats
    for _ in range(times):
        s, n = world(B)
        seen, seen_n = (a[0] for a in world(1, strengths))
        table, groups = localise(world.groups(s, seen), n, seen_n)
        found += table["p"][1] <= 0.05
        others += [groups["eq0", "mean"].p, groups["eq2", "mean"].p]
        assert table["key"][1] == ("eq1", "mean")
    assert found >= stats.binom.ppf(LEVEL, times, 0.95)
    assert_level(others, 0.05)


def test_groups_that_cannot_be_told_apart():
    """Two equations with the same scores: alone each is significant, apart neither is."""
    rng = rng_of("same")
    s, n = rng.standard_normal((B + 1, 3)), rng.standard_normal((B + 1, P))
    s[B] += 5.0
    pair = {"a": (s[:B], s[B]), "b": (2 * s[:B], 2 * s[B])}
    table, groups = localise(pair, n[:B], n[B])
    assert (table["p_alone"] < 0.01).all()
    assert (table["p"] > 0.05).all()
    assert all(g.kappa < 0.05 for g in groups.values())


def test_two_groups_of_one_place_do_not_take_from_each_other():
    """Curves and waves of one equation say much the same: each is looked at beside other places."""
    rng = rng_of("one place")
    s, n = rng.standard_normal((B + 1, 3)), rng.standard_normal((B + 1, P))
    s[B] += 5.0
    other = rng.standard_normal((B + 1, 3))
    groups = {"curves": (s[:B], s[B]), "waves": (2 * s[:B], 2 * s[B]), "c": (other[:B], other[B])}
    places = {"curves": "a", "waves": "a", "c": "c"}
    table, found = localise(groups, n[:B], n[B], places)
    assert (table["p"][:2] < 0.01).all()
    without, _ = localise({k: groups[k] for k in ("curves", "c")}, n[:B], n[B])
    assert table["z"][0] == pytest.approx(without["z"][0])
    assert found["c"].kappa > 0.9


def test_without_shrinkage_it_is_hotellings():
    """With many sets the statistic is S~' V^-1 S~ of the exact V."""
    rng = rng_of("hotelling")
    world = World(rng, [4])
    s, n = world(50_000)
    g = group_score(s, s[0], n, n[0])
    left = s[0] - n[0] @ world.absorbed
    exact = left @ np.linalg.solve(world.efficient, left)
    assert g.rank == 4
    assert g.shrinkage < 0.01
    assert g.statistic == pytest.approx(exact, rel=0.05)


def test_absorbed_directions_are_cut():
    """A basis of which two directions lie in the span of the parameters: rank D - 2, finite."""
    rng = rng_of("absorbed")
    n = rng.standard_normal((B + 1, P))
    s = np.hstack([rng.standard_normal((B + 1, 3)), n[:, :2] @ rng.standard_normal((2, 2))])
    s = s @ rng.standard_normal((5, 5))
    g = group_score(s[:B], s[B], n[:B], n[B])
    assert g.rank == 3
    assert np.all(np.isfinite(g.estimate))
    empty = group_score(np.zeros((B, 2)), np.zeros(2), n[:B], n[B])
    assert empty.rank == 0
    assert empty.p == 1.0 or empty.z == 0.0


def catalogue_world(rng):
    decay = (0.8 ** np.arange(60))[:, None]
    effects, basis = rng.standard_normal((60, 150)) * decay, rng.standard_normal((60, 10)) * decay

    def draw(sets):
        f = rng.standard_normal((sets, 60))
        nuisance = rng.standard_normal((sets, P))
        columns = f @ effects + 0.05 * rng.standard_normal((sets, 150)) + nuisance[:, :1]
        return columns, f @ basis + 0.5 * rng.standard_normal((sets, 10)), nuisance

    return draw, effects, basis


@pytest.mark.slow
@pytest.mark.parametrize("nats", [0.0, 18.0])
def test_what_the_catalogue_explains_is_not_left(nats):
    """150 effects projected out of 10 basis functions by 200 sets: one of them at work leaves
    nothing behind."""
    rng, p = rng_of("catalogue", nats), []
    draw, effects, basis = catalogue_world(rng)
    size = effects[:, 0] @ effects[:, 0] + 0.05**2
    strength = np.sqrt(2 * nats / size)
    for _ in range(250):
        c, g, n = draw(B + 1)
        seen = c[B] + strength * (effects.T @ effects[:, 0] + 0.05**2 * np.eye(150)[0])
        p.append(group_score(g[:B], g[B] + strength * basis.T @ effects[:, 0], n[:B], n[B],
                             c[:B], seen).p)  # fmt: skip
    assert_level(p, 0.05)


def test_what_the_catalogue_does_not_explain_is_left():
    """A term orthogonal to the catalogue, 25 nats."""
    rng, found = rng_of("left"), 0
    draw, _, _ = catalogue_world(rng)
    for _ in range(30):
        c, g, n = draw(B + 1)
        seen = g[B] + 0.25 * np.sqrt(2 * 25 / (10 * 0.25)) * np.ones(10)
        found += group_score(g[:B], seen, n[:B], n[B], c[:B], c[B]).p <= 0.05
    assert found >= stats.binom.ppf(LEVEL, 30, 0.9)


def test_the_curve_and_its_band():
    """At the truth's strengths, values over errors are standard normal: 95% bands hold 95%."""
    rng = rng_of("curve")
    world, strengths = World(rng, [5]), rng.standard_normal(5)
    design, z, inside = rng.standard_normal((3, 5)), [], []
    s, n = world(20_000)
    for _ in range(300):
        seen, seen_n = (a[0] for a in world(1, strengths))
        found = curve(group_score(s[:2000], seen, n[:2000], seen_n), design)
        z.append((found.estimate - design @ strengths) / found.error)
        inside.append((found.low <= design @ strengths) & (design @ strengths <= found.high))
    z = np.array(z)
    assert np.all(np.abs(z.mean(axis=0)) < 4 / np.sqrt(300))
    for k in range(3):
        count = int(np.sum(inside, axis=0)[k])
        assert stats.binomtest(count, 300, 0.95).pvalue > LEVEL


def test_regions_say_where_the_term_is():
    """Scores of a regression y = g(x) + e with g only at large x, no parameters."""
    rng = rng_of("regions")
    x = rng.uniform(-2, 2, 2000)
    functions = bases(x, 6)
    b = np.stack([f(x) for f in functions], axis=1)
    null = rng.standard_normal((B, 2000)) @ b
    y = 1.5 * np.exp(-((x - 1.6) ** 2) / 0.1) + rng.standard_normal(2000)
    g = group_score(null, y @ b, np.zeros((B, 0)), np.zeros(0))
    table = regions(g, functions, x, "v", 5)
    assert list(table["region"])[-1].startswith("v in 1.")
    assert table["z"].abs().idxmax() == 4
    assert table["estimate"][4] == pytest.approx(
        np.mean(1.5 * np.exp(-((x[x > 1.2] - 1.6) ** 2) / 0.1)), abs=5 * table["se"][4] + 0.1
    )


def test_shapes_that_do_not_fit():
    with pytest.raises(ArgumentError, match=r"observed \(3,\)"):
        group_score(np.zeros((50, 2)), np.zeros(3), np.zeros((50, 1)), np.zeros(1))
