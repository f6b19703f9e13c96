"""Tests of Monte Carlo estimates against exact values, with errors computed from the draws.

Every seed comes from the name of the check, so that none was chosen because it passes.
"""

from __future__ import annotations

import zlib

import arviz as az
import numpy as np
import pytest
from scipy import stats

LEVEL = 0.001  # chance of a false alarm, over a whole table of checks
MCSE = 4.0  # Monte Carlo standard errors that a posterior may lie off


def some(cases, count, mark=pytest.mark.slow):
    """Cases of a parametrised test, all but `count` of them, evenly spread, with a mark that
    leaves them to another stage."""
    cases = list(cases)
    kept = {round(i * (len(cases) - 1) / max(count - 1, 1)) for i in range(count)}
    return [c if i in kept else _marked(c, mark) for i, c in enumerate(cases)]


def _marked(case, mark):
    if hasattr(case, "marks"):  # a pytest.param already
        return pytest.param(*case.values, marks=[*case.marks, mark], id=case.id)
    values = case if isinstance(case, tuple) else (case,)
    return pytest.param(*values, marks=mark)


def seed_of(*name) -> int:
    """A seed from the name of a check."""
    return zlib.crc32(" ".join(map(str, name)).encode())


def mean_one_p(log_ratio) -> float:
    """Two-sided p value of "exp(log_ratio) has mean 1".

    Student's t corrected for skewness by P. Hall's monotone transformation (*JRSS B* 54, 1992,
    page 223): exp of an approximate normal is skew, and without the correction the lower tail of
    t would be several times too heavy at the levels used here.
    """
    ratio = np.exp(np.asarray(log_ratio))
    n, mean, sd = len(ratio), ratio.mean(), ratio.std(ddof=1)
    if sd == 0:
        return 1.0 if mean == 1.0 else 0.0
    a = float(stats.skew(ratio))
    s = (mean - 1.0) / sd
    t = np.sqrt(n) * (s + a * s**2 / 3 + a**2 * s**3 / 27 + a / (6 * n))
    return float(2 * stats.t.sf(abs(t), n - 1))


def mcse_mean(draws) -> float:
    """Monte Carlo standard error of the mean of draws (chain, draw)."""
    draws = np.asarray(draws, float)
    return float(draws.std(ddof=1) / np.sqrt(az.ess(draws, method="mean")))


def influence_of_sd(draws):
    """A series whose mean's error is that of the standard deviation (delta method)."""
    draws = np.asarray(draws, float)
    return (draws - draws.mean()) ** 2 / (2 * draws.std())


def influence_of_correlation(a, b):
    """A series whose mean's error is that of the correlation (delta method)."""
    a, b = ((np.asarray(v, float) - np.mean(v)) / np.std(v) for v in (a, b))
    r = float(np.mean(a * b))
    return a * b - 0.5 * r * (a**2 + b**2)


def deviations(draws, mean=None, sd=None, quantiles=None) -> dict[str, float]:
    """How many Monte Carlo standard errors the draws (chain, draw) lie off exact values."""
    draws, out = np.asarray(draws, float), {}
    if mean is not None:
        out["mean"] = (draws.mean() - mean) / mcse_mean(draws)
    if sd is not None:
        out["sd"] = (draws.std() - sd) / mcse_mean(influence_of_sd(draws))
    for level, value in (quantiles or {}).items():
        below = (draws < value).astype(float)
        out[f"P(<{value:.3g})"] = (below.mean() - float(level)) / mcse_mean(below)
    return out


def assert_within(found: dict[str, float], limit: float = MCSE) -> None:
    """All deviations within `limit` Monte Carlo standard errors; they are printed."""
    print(", ".join(f"{k}: {v:+.2f} MCSE" for k, v in found.items()))
    worst = max(found, key=lambda k: abs(found[k]))
    assert abs(found[worst]) <= limit, f"{worst} lies {found[worst]:+.2f} MCSE off; all: {found}"


def moment_deviations(draws, mean, sd, lag_one) -> list[float]:
    """Deviations, in Monte Carlo standard errors, of draws (chain, draw, T, D) of trajectories.

    mean, sd : (T, D). lag_one : (T - 1, D), covariance of each state with itself a step later.
    """
    draws, z = np.asarray(draws, float), []
    for t, i in np.ndindex(*mean.shape):
        x = draws[:, :, t, i]
        if sd[t, i] < 1e-12:  # the initial value of a deterministic component
            np.testing.assert_allclose(x, mean[t, i], atol=1e-12)
            continue
        z += deviations(x, mean=mean[t, i], sd=sd[t, i]).values()
        if t + 1 < len(mean):
            product = (x - mean[t, i]) * (draws[:, :, t + 1, i] - mean[t + 1, i])
            z.append((product.mean() - lag_one[t, i]) / mcse_mean(product))
    return z


def assert_moments(draws, exact, label, tables) -> None:
    """Trajectories (chain, draw, T, D) have the moments of a `DenseGaussian`.

    Bonferroni at `LEVEL` over all of them, and over the `tables` tests of this kind.
    """
    z = moment_deviations(draws, exact.mean, exact.sd, exact.lag_one)
    limit = float(stats.norm.isf(LEVEL / (2 * len(z) * tables)))
    print(f"{label}: {len(z)} moments, largest deviation {np.max(np.abs(z)):.2f} of {limit:.2f}")
    assert np.max(np.abs(z)) <= limit, (label, np.round(z, 1))
