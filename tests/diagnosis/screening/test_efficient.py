"""Efficient scores against the formulas of Gaussian vectors, and regressions without each set."""

from __future__ import annotations

import mpmath
import numpy as np
import pytest
from scipy import stats

from ssmppl.diagnosis.screening.efficient_score import (
    CONSTANT,
    DROWNED,
    TAKEN,
    Null,
    efficient,
    normal_score,
    regress,
)
from ssmppl.errors import ArgumentError
from tests.statistics.checks import LEVEL, seed_of

K, P = 6, 4


def rng_of(*name):
    return np.random.default_rng(seed_of("efficient", *name))


def information(rng, size=K + P):
    root = rng.standard_normal((size, size))
    return root @ root.T + np.eye(size)


def gaussian(rng, info, sets):
    drawn = rng.standard_normal((sets, len(info))) @ np.linalg.cholesky(info).T
    return drawn[:, :K], drawn[:, K:]


def test_against_the_formulas():
    """V, kappa and rho of 40,000 sets lie within their Monte Carlo errors of the exact ones."""
    rng, sets = rng_of("formulas"), 40_000
    info = information(rng)
    columns, nuisance = gaussian(rng, info, sets)
    found = efficient(Null.of(columns, nuisance), columns[0], nuisance[0])
    cross, inner = info[:K, K:], info[K:, K:]
    exact = info[:K, :K] - cross @ np.linalg.solve(inner, cross.T)
    v, size = np.diagonal(exact), np.sqrt(np.diagonal(exact))
    limit = stats.norm.isf(LEVEL / (2 * K * (K + 1)))
    assert np.all(np.abs(found.variance / v - 1) < limit * np.sqrt(2 / sets))
    kappa = np.sqrt(v / np.diagonal(info)[:K])
    assert np.all(np.abs(found.kappa - kappa) < limit * kappa / np.sqrt(sets))
    rho = exact / np.outer(size, size)
    assert np.all(np.abs(found.rho - rho) <= limit * (1 - rho**2) / np.sqrt(sets) + 1e-12)
    np.testing.assert_allclose(
        found.covariance, found.rho * np.sqrt(np.outer(*[found.variance] * 2))
    )
    np.testing.assert_allclose(found.z, found.score / np.sqrt(found.variance))
    np.testing.assert_allclose(found.gain, found.z**2 / 2)
    np.testing.assert_allclose(found.strength, found.score / found.variance)
    assert found.status == ("",) * K


def test_the_strength_is_found_whatever_the_parameters_are():
    """Truth lambda and parameters off by delta: the scores' mean is the information times both."""
    rng, sets, strength = rng_of("strength"), 400, 0.7
    info = information(rng)
    off = np.concatenate([[strength], np.zeros(K - 1), rng.standard_normal(P)])
    found = []
    for _ in range(200):
        null = Null.of(*gaussian(rng, info, sets))
        columns, nuisance = (a[0] for a in gaussian(rng, info, 1))
        shift = info @ off
        found.append(efficient(null, columns + shift[:K], nuisance + shift[K:]).strength[0])
    found = np.array(found)
    assert abs(found.mean() - strength) < 4 * found.std() / np.sqrt(len(found))


@pytest.mark.parametrize("intercept", [False, True])
def test_null_statistics_are_those_of_a_regression_without_the_set(intercept):
    rng = rng_of("left out", intercept)
    x, y = rng.standard_normal((40, 3)), rng.standard_normal((40, 2)) + 2.0
    y += x @ rng.standard_normal((3, 2))
    fit = regress(y, x, intercept=intercept)
    design = np.hstack([np.ones((40, 1)), x]) if intercept else x
    for b in (0, 7, 39):
        rest = np.delete(np.arange(40), b)
        coefficients, rss, _, _ = np.linalg.lstsq(design[rest], y[rest], rcond=None)
        error = y[b] - design[b] @ coefficients
        inverse = np.linalg.inv(design[rest].T @ design[rest])
        scale = rss / (39 - design.shape[1]) * (1 + design[b] @ inverse @ design[b])
        np.testing.assert_allclose(fit.left_out[b], error)
        np.testing.assert_allclose(fit.studentised[b], error / np.sqrt(scale))
    inverse = np.linalg.inv(design.T @ design)
    new = rng.standard_normal(3)
    row = np.concatenate([[1.0], new]) if intercept else new
    np.testing.assert_allclose(fit.leverage_of(new), row @ inverse @ row)
    coefficients = np.linalg.lstsq(design, y, rcond=None)[0]
    np.testing.assert_allclose(fit.predict_error(y[0], new), y[0] - row @ coefficients)


def test_the_observed_statistic_is_student_t():
    """60 sets, 5 parameters: one more set of the same law has t with 55 degrees of freedom."""
    rng, found = rng_of("t"), []
    for _ in range(1000):
        x, y = rng.standard_normal((61, 5)), rng.standard_normal((61, 1))
        e = efficient(Null.of(y[:60], x[:60]), y[60], x[60])
        found.append(e.statistic[0])
    assert stats.kstest(found, stats.t(55).cdf).pvalue > LEVEL


def test_repeated_parameters_change_nothing():
    rng = rng_of("repeated")
    columns, nuisance = gaussian(rng, information(rng), 200)
    plain = efficient(Null.of(columns, nuisance), columns[3], nuisance[3])
    wide = np.hstack(
        [nuisance, 1e6 * nuisance[:, :1], np.zeros((200, 1)), nuisance @ np.ones((P, 1))]
    )
    same = efficient(Null.of(columns, wide), columns[3], wide[3])
    for name in ("score", "variance", "z", "kappa", "rho", "statistic", "null"):
        np.testing.assert_allclose(getattr(same, name), getattr(plain, name), rtol=1e-6, atol=1e-9)


def test_without_parameters():
    rng = rng_of("none")
    columns = rng.standard_normal((100, 2))
    found = efficient(Null.of(columns, np.zeros((100, 0))), columns[0], np.zeros(0))
    np.testing.assert_allclose(found.score, columns[0])
    np.testing.assert_allclose(found.kappa, 1.0)


def test_columns_that_say_nothing():
    """Constant, absorbed exactly, absorbed but for the smoother's noise, and all noise."""
    rng, sets = rng_of("status"), 200
    _, nuisance = gaussian(rng, information(rng), sets)
    noise = np.array([0.0, 0.0, 0.25, 0.25, 0.0])
    columns = np.stack([np.zeros(sets), nuisance @ np.arange(1.0, 5.0),
                        nuisance @ np.ones(4) + 0.5 * rng.standard_normal(sets),
                        0.5 * rng.standard_normal(sets), rng.standard_normal(sets)], 1)  # fmt: skip
    found = efficient(Null.of(columns, nuisance, noise=noise), columns[0] + 3.0, nuisance[0])
    assert found.status == (CONSTANT, TAKEN, TAKEN, DROWNED, "")
    silent = np.array([s != "" for s in found.status])
    assert not found.z[silent].any()
    assert not found.null[:, silent].any()
    assert not found.gain[silent].any()
    assert found.kappa[0] == 0.0
    assert found.kappa[1] < 1e-6
    assert all(np.all(np.isfinite(v)) for v in (found.rho, found.strength, found.covariance))


def test_monte_carlo_variance_is_taken_off():
    """Strengths are unbiased with the smoother's variance given, and too small without."""
    rng, sets, noise = rng_of("noise"), 4000, 0.5
    info = information(rng)
    columns, nuisance = gaussian(rng, info, sets)
    exact = 1 / np.linalg.inv(info[np.ix_([0, *range(K, K + P)], [0, *range(K, K + P)])])[0, 0]
    loud = columns + np.sqrt(noise * exact) * rng.standard_normal(columns.shape)
    found = efficient(Null.of(loud, nuisance, noise=noise * exact), loud[0], nuisance[0])
    limit = stats.norm.isf(LEVEL / 2) * np.sqrt(2 / sets) * (1 + noise)
    assert abs(found.variance[0] / exact - 1) < limit
    deaf = efficient(Null.of(loud, nuisance), loud[0], nuisance[0])
    assert abs(deaf.variance[0] / exact - 1 - noise) < limit


def test_one_sided_gains():
    rng = rng_of("sided")
    columns, nuisance = gaussian(rng, information(rng), 200)
    both = efficient(Null.of(columns, nuisance), columns[1], nuisance[1])
    signs = -np.sign(both.z)
    against = efficient(Null.of(columns, nuisance, sided=signs), columns[1], nuisance[1])
    np.testing.assert_array_equal(against.z, both.z)
    assert not against.gain.any()
    along = efficient(Null.of(columns, nuisance, sided=-signs), columns[1], nuisance[1])
    np.testing.assert_array_equal(along.gain, both.gain)


@pytest.mark.parametrize("degrees", [1, 2, 7])
def test_normal_scores_of_chi_square(degrees):
    """Exact for a chi-square law, far into its tail."""
    x = np.array([0.01, 0.5, 1.0, 5.0, 40.0, 400.0, 4000.0])
    t, skewness = (x - degrees) / np.sqrt(2 * degrees), np.sqrt(8 / degrees)
    z = normal_score(t, skewness)
    tail = [mpmath.log(mpmath.gammainc(degrees / 2, v / 2, regularized=True)) for v in x]
    np.testing.assert_allclose(stats.norm.logsf(z), np.array(tail, float), rtol=2e-3, atol=1e-9)
    assert normal_score(-10.0, skewness) == -8.0


@pytest.mark.parametrize(
    ("columns", "nuisance", "match"),
    [
        (np.zeros((50, 2)), np.zeros((40, 1)), r"\(50, 2\)"),
        (np.zeros(50), np.zeros((50, 1)), "one row for each"),
        (np.full((50, 2), np.nan), np.zeros((50, 1)), r"columns\[0, 0\] is nan"),
    ],
)
def test_errors_of_arrays(columns, nuisance, match):
    with pytest.raises(ArgumentError, match=match):
        Null.of(columns, nuisance)


def test_too_few_sets():
    rng = rng_of("few")
    with pytest.raises(ArgumentError, match="at least 35 sets"):
        regress(rng.standard_normal((30, 1)), rng.standard_normal((30, 15)))
