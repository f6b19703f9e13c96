"""Equivalence classes, cuts and separating inputs, against normal vectors simulated anew."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from ssmppl.diagnosis.selection.equivalence import (
    SEPARATING,
    classes_by_similarity,
    confidence_set,
    cuts,
    distinguishable,
    equivalence_classes,
    separating_gain,
    similarity,
)
from tests.statistics.checks import LEVEL, seed_of


def rng_of(*name):
    return np.random.default_rng(seed_of("classes", *name))


def one_factor(width, rho):
    return np.full((width, width), rho) + (1 - rho) * np.eye(width)


@pytest.mark.parametrize("rho", [0.5, 0.9, -0.8])
def test_at_the_needed_gain_a_rival_wins_once_in_twenty(rho):
    rng, times = rng_of("needed", rho), 20_000
    delta = np.sqrt(2 * separating_gain(rho))
    root = np.linalg.cholesky(np.array([[1.0, rho], [rho, 1.0]]))
    z = rng.standard_normal((times, 2)) @ root.T + delta * np.array([1.0, rho])
    wins = int(np.sum(np.abs(z[:, 1]) > np.abs(z[:, 0])))
    assert stats.binomtest(wins, times, stats.norm.sf(np.sqrt(SEPARATING))).pvalue > LEVEL
    assert stats.norm.sf(np.sqrt(SEPARATING)) == pytest.approx(0.05, abs=2e-3)


def test_needed_gain():
    np.testing.assert_allclose(
        separating_gain(np.array([0.0, 0.9, -0.9, 1.0])), [2.7, 27, 27, np.inf]
    )
    assert distinguishable(27.1, 0.9)
    assert not distinguishable(26.9, -0.9)
    assert not distinguishable(1e9, 1.0)


def test_classes_of_a_small_example():
    """Leader 2 (20 nats) takes what correlates above 1 - 2.7 / 20 = 0.865; then 0 takes 4."""
    rho = np.eye(5)
    for (i, j), value in {(1, 2): -0.9, (2, 3): 0.8, (0, 4): 0.7, (0, 3): 0.1}.items():
        rho[i, j] = rho[j, i] = value
    gains = np.array([6.0, 15.0, 20.0, 14.0, 3.0])
    found = classes_by_similarity(rho, gains)
    np.testing.assert_array_equal(found.class_id, [3, 1, 1, 2, 3])
    np.testing.assert_array_equal(found.leader, [0, 2, 2, 3, 0])
    np.testing.assert_allclose(found.rho, [1.0, -0.9, 1.0, 1.0, 0.7])
    np.testing.assert_array_equal(found.members(1), [2, 1])
    weaker = classes_by_similarity(rho, gains / 3)  # less is known: 2 takes 3 as well, and so on
    assert weaker.class_id.max() < found.class_id.max()


def test_one_sided_rivals_of_the_wrong_sign_are_no_rivals():
    rho = np.array([[1.0, -0.95], [-0.95, 1.0]])
    np.testing.assert_array_equal(similarity(rho, np.array([1, 1])), np.eye(2))
    np.testing.assert_array_equal(similarity(rho, np.array([1, -1])), np.abs(rho))
    np.testing.assert_array_equal(similarity(rho, np.array([1, 0])), np.abs(rho))
    gains = np.array([20.0, 19.0])
    assert classes_by_similarity(rho, gains, np.array([1, 1])).class_id.tolist() == [1, 2]
    assert classes_by_similarity(rho, gains).class_id.tolist() == [1, 1]


def test_a_cut_of_two_is_enough_for_two():
    """One rival, correlation 0.9: the excess is at most its part beyond the truth, chi-square."""
    found = cuts(one_factor(2, 0.9), np.array([20.0, 18.0]), [0, 1])
    np.testing.assert_allclose(found, 2.0)


@pytest.mark.parametrize(("width", "rho"), [(5, 0.9), (60, 0.95), (60, 0.5)])
def test_the_confidence_set_holds_the_truth(width, rho):
    """With the cut from the gains of the data themselves, at least 95% at 6 nats."""
    rng, times, held, fixed = rng_of("set", width, rho), 200, 0, 0
    matrix = one_factor(width, rho)
    root = np.linalg.cholesky(matrix)
    for _ in range(times):
        z = root @ rng.standard_normal(width) + np.sqrt(12.0) * matrix[0]
        gain = z**2 / 2
        cut = cuts(matrix, gain, [0], draws=1000)[0]
        held += bool(confidence_set(gain, cut)[0])
        fixed += bool(confidence_set(gain, 2.0)[0])
    print(f"{width}, {rho}: {held / times:.3f}, with a cut of 2 nats {fixed / times:.3f}")
    assert stats.binomtest(held, times, 0.95, alternative="less").pvalue > LEVEL
    if width == 60:
        assert stats.binomtest(fixed, times, 0.95, alternative="less").pvalue < LEVEL


def test_cuts_against_a_direct_simulation():
    """Three rivals, one-sided, one of them a shape of the truth: the quantile of the definition."""
    rng = rng_of("direct")
    rho = np.array([[1.0, 0.7, 0.2, -0.6], [0.7, 1.0, 0.5, -0.2], [0.2, 0.5, 1.0, 0.3],
                    [-0.6, -0.2, 0.3, 1.0]])  # fmt: skip
    gains, signs, groups = np.array([3.0, 2.5, 1.0, 2.0]), np.array([1, 0, 1, -1]), [0, 1, 0, 2]
    drawn = rng.standard_normal((200_000, 4)) @ np.linalg.cholesky(rho).T + np.sqrt(5.0) * rho[0]
    g = np.where(signs == 0, np.abs(drawn), np.maximum(signs * drawn, 0)) ** 2 / 2
    excess = g.max(axis=1) - g[:, [0, 2]].max(axis=1)
    options = {"sided": signs, "groups": np.array(groups), "draws": 100_000}
    found = cuts(rho, gains, [0], level=0.99, **options)[0]
    share = np.mean(excess <= found)
    assert abs(share - 0.99) < 4 * np.sqrt(0.99 * 0.01 * (1 / 200_000 + 1 / 100_000))
    assert found > 2.0


def test_a_confidence_set_with_its_own_cuts():
    np.testing.assert_array_equal(
        confidence_set(np.array([10.0, 7.5, 7.5, np.nan]), np.array([2.0, 2.0, 3.0, 2.0])),
        [True, False, True, False],
    )


def test_what_simulated_data_do_not_tell_from_the_best_is_in_its_class():
    """Two refits that neither correlate nor come near each other: apart, but where data simulated
    with them say otherwise."""
    candidates = [SimpleNamespace(effect=SimpleNamespace(cause=c)) for c in ("a", "b", "c")]
    screen = SimpleNamespace(
        efficient=SimpleNamespace(rho=np.eye(3), sided=np.zeros(3, int), gain=np.zeros(3)),
        design=SimpleNamespace(candidates=candidates),
    )
    refits = [SimpleNamespace(index=(2,), score=90.0), SimpleNamespace(index=(0,), score=40.0)]
    order = [2, 0, 1]
    apart = equivalence_classes(screen, refits, order)
    assert apart.class_id[0] != apart.class_id[1]
    together = equivalence_classes(screen, refits, order, {2, 0})
    assert together.class_id[0] == together.class_id[1] == 1
    assert together.class_id[2] != 1
