"""Detection on a model that can be fitted by hand."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from scipy.signal import lfilter

from ssmppl.diagnosis.screening.detection import (
    LONG,
    PredictionChecks,
    detection,
    normal_scores,
    statistics,
)
from ssmppl.errors import ArgumentError
from tests.statistics.checks import LEVEL, seed_of


def rng_of(*name):
    return np.random.default_rng(seed_of("detect", *name))


def uniform(z):
    return stats.norm.cdf(z)


def value(found, channel, name):
    return found.values[found.names.index((channel, name))]


def test_white_noise_has_statistics_of_unit_variance():
    """Mean 0 and variance 1 of each over 400 series, but for the joint ones: their means are the
    numbers of their lags."""
    rng, times = rng_of("white"), 400
    found = []
    for _ in range(times):
        u = rng.standard_normal((200, 1))
        found.append(statistics(uniform(rng.standard_normal((200, 1))), ["y"], u, ["u"]))
    values = np.stack([f.values for f in found])
    joint = found[0].quadratic
    sums = [name for (_, name), q in zip(found[0].names, joint, strict=True) if q]
    assert sums == [f"autocorrelation, {LONG} lags", f"mean with u, {LONG} lags"]
    limit = stats.norm.isf(LEVEL / (2 * values.shape[1]))
    plain = values[:, ~joint]
    assert np.all(np.abs(plain.mean(axis=0)) < limit * plain.std(axis=0) / np.sqrt(times))
    fourth = np.mean((plain - plain.mean(axis=0)) ** 4, axis=0)
    error = np.sqrt((fourth - plain.var(axis=0) ** 2) / times)
    assert np.all(np.abs(plain.var(axis=0) - 1.0) < limit * error + 0.02)
    error = values[:, joint].std(axis=0) / np.sqrt(times)
    assert np.all(np.abs(values[:, joint].mean(axis=0) - [LONG, LONG + 1]) < limit * error)


def test_each_statistic_is_what_its_name_says():
    rng = rng_of("names")
    z, u = rng.standard_normal((300, 2)), rng.standard_normal((300, 1))
    found = statistics(uniform(z), ["a", "b"], u, ["u"], lags=2, delays=2)
    for c, channel in enumerate("ab"):
        e = z[:, c]
        assert value(found, channel, "mean") == pytest.approx(e.sum() / np.sqrt(300))
        assert value(found, channel, "variance") == pytest.approx(np.sum(e**2 - 1) / np.sqrt(600))
        assert value(found, channel, "tails") == pytest.approx(
            np.sum(e**4 - 6 * e**2 + 3) / np.sqrt(24 * 300)
        )
        lagged = [np.sum(e[k:] * e[:-k]) / np.sqrt(300 - k) for k in range(1, LONG + 1)]
        assert value(found, channel, "autocorrelation at lag 2") == pytest.approx(lagged[1])
        assert value(found, channel, f"autocorrelation, {LONG} lags") == pytest.approx(
            np.sum(np.square(lagged))
        )
        w = (u[:, 0] - u.mean()) / u.std()
        assert value(found, channel, "mean with u, 2 steps before") == pytest.approx(
            np.sum(e[2:] * w[:-2]) / np.sqrt(298)
        )
        w = (u[:, 0] ** 2 - np.mean(u**2)) / np.std(u**2)
        assert value(found, channel, "variance with u squared") == pytest.approx(
            np.sum((e**2 - 1) * w) / np.sqrt(600)
        )


def test_missing_values_experiments_and_constant_inputs():
    rng = rng_of("missing")
    z, u = rng.standard_normal((120, 1)), np.full((120, 1), 3.0)
    z[[3, 50, 51], 0] = np.nan
    found = statistics(uniform(z), ["y"], u, ["u"], starts=(0, 40))
    e = z[:, 0]
    products = np.concatenate([e[1:40] * e[:39], e[41:] * e[40:-1]])
    known = products[np.isfinite(products)]
    assert value(found, "y", "autocorrelation at lag 1") == pytest.approx(
        known.sum() / np.sqrt(known.size)
    )
    assert value(found, "y", "mean with u") == 0.0
    assert np.all(np.isfinite(found.values))
    nothing = statistics(np.full((20, 1), np.nan), ["y"])
    assert not nothing.values.any()


def test_pit_values_at_the_ends():
    z = normal_scores(np.array([0.0, 1.0, 0.5, np.nan]))
    assert np.all(np.abs(z[:2]) < 6.0)
    assert z[2] == 0.0
    assert np.isnan(z[3])


def test_shapes_that_do_not_fit():
    with pytest.raises(ArgumentError, match="2 channels"):
        statistics(np.full((20, 1), 0.5), ["a", "b"])


# --- the table, on y_t = m + b u_t + s e_t fitted by least squares --------------------------------

ROWS = 200
U = rng_of("input").standard_normal(ROWS)
X = np.stack([np.ones(ROWS), U], axis=1)


def fit(y):
    b = np.linalg.lstsq(X, y, rcond=None)[0]
    return b, np.sqrt(np.mean((y - X @ b) ** 2))


def measured(y, b, s):
    """Statistics of the standardised errors, and the score in (m, b, log s)."""
    z = (y - X @ b) / s
    score = np.append(X.T @ z / s, np.sum(z**2 - 1))
    return statistics(uniform(z)[:, None], ["y"], U[:, None], ["u"]), score


@pytest.fixture(scope="module")
def pool():
    """Sets at b = 0, s = 1: the errors are pivotal, so that they serve every fit."""
    rng = rng_of("pool")
    sets = [measured(rng.standard_normal(ROWS), np.zeros(2), 1.0) for _ in range(800)]
    return np.stack([f.values for f, _ in sets]), np.stack([n for _, n in sets])


def table(rng, y, pool):
    """Detection of y from 150 sets simulated at its fit, without a refit."""
    b, s = fit(y)
    observed, score = measured(y, b, s)
    drawn = rng.choice(len(pool[0]), 150, replace=False)
    return detection(observed, pool[0][drawn], score, pool[1][drawn] / np.array([s, s, 1.0]))


@pytest.mark.slow
def test_false_alarms_with_fitted_parameters(pool):
    """The level is kept by all statistics together, although the sets are not refitted."""
    rng, times = rng_of("level"), 200
    p = [table(rng, 1.0 + 2.0 * U + 3.0 * rng.standard_normal(ROWS), pool)["p"].min()
         for _ in range(times)]  # fmt: skip
    assert stats.binomtest(int(np.sum(np.array(p) <= 0.05)), times, 0.05).pvalue > LEVEL


def heavy(rng):
    return rng.standard_t(3, ROWS)


def coloured(rng):
    return lfilter([1.0], [1.0, -0.5], rng.standard_normal(ROWS + 50))[50:]


def by_input(rng):
    return rng.standard_normal(ROWS) * np.exp(0.3 * np.minimum(U**2, 4))


def delayed(rng):
    return 0.5 * np.roll(U, 2) + rng.standard_normal(ROWS)


@pytest.mark.parametrize(
    ("noise", "names"),
    [
        (heavy, {"tails"}),
        (coloured, {"autocorrelation at lag 1", f"autocorrelation, {LONG} lags"}),
        (by_input, {"variance with u squared", "tails"}),
        (delayed, {"mean with u, 2 steps before", f"mean with u, {LONG} lags"}),
    ],
)
def test_what_is_wrong_stands_first(noise, names, pool):
    rng = rng_of(noise.__name__)
    found = [table(rng, noise(rng), pool).iloc[0] for _ in range(12)]
    right = sum(f["statistic"] in names and f["p"] <= 0.05 for f in found)
    assert right >= stats.binom.ppf(LEVEL, 12, 0.9)


def test_more_statistics_can_be_added():
    base = PredictionChecks((("y", "mean"),), np.array([1.0]), np.array([False]))
    more = base.with_values("y", {"CRPS 10 ahead": 0.4})
    assert more.names == (("y", "mean"), ("y", "CRPS 10 ahead"))
    np.testing.assert_array_equal(more.values, [1.0, 0.4])
    np.testing.assert_array_equal(more.quadratic, [False, False])
