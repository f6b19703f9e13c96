"""Maximum likelihood in any unit of the data: a regression over an AR(1), and two regimes.

Scaling the data and the priors by s moves the maximum and its standard errors by s, and the
log-likelihood by -log s for each observation.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

import ssmppl as ssm
from ssmppl.inference.maximum.ascent import Maximization
from ssmppl.inference.maximum.direct_optimization import ExactClimb, _positive_definite
from tests.statistics.checks import seed_of

ROWS = 150
RECORDS = [0, 2]  # the likelihood of record 1 has a second top, 0.3 below, in any unit
SCALES = [1e-6, 1e-5, 1e5]
MEANS = ("b0", "b1", "b2", "c")  # the parameters of the regression that have the unit of the data,
NOISES = ("q", "r")  # as these


def regression(s, of_prior=None):
    """In the unit s, the priors too, or these in one of their own."""
    p = of_prior or s
    model = ssm.Model("regression", inputs=("w0", "w1", "w2"))
    model.prior(lambda: {
        **{f"b{i}": ssm.Normal(0, sd=p) for i in range(3)}, "c": ssm.Normal(0, sd=10 * p),
        "a": ssm.Normal(0.5, sd=0.3), "q": ssm.HalfNormal(sd=p), "r": ssm.HalfNormal(sd=p),
    })  # fmt: skip
    model.initial(lambda: {"x": ssm.Normal(0, sd=s)})
    model.transition(lambda x, a, q: {"x": ssm.Normal(a * x, sd=q)})
    model.observation(
        lambda x, w0, w1, w2, b0, b1, b2, c, r: {
            "y": ssm.Normal(x + c + b0 * w0 + b1 * w1 + b2 * w2, sd=r)
        }
    )
    return model


def regression_rows(s, record=0):
    rng = np.random.default_rng(seed_of("units of a regression", record))
    w, x = rng.standard_normal((ROWS, 3)), np.zeros(ROWS)
    for t in range(1, ROWS):
        x[t] = 0.95 * x[t - 1] + 0.2 * rng.standard_normal()
    y = 7.0 + x + w @ [0.5, -1.0, 0.0] + 0.3 * rng.standard_normal(ROWS)
    return {"y": s * y, "w0": w[:, 0], "w1": w[:, 1], "w2": w[:, 2]}


def log_likelihood(rows, b0, b1, b2, c, a, q, r):
    """By a scalar Kalman filter, at s = 1."""
    total, m, p = 0.0, 0.0, 1.0
    for e in rows["y"] - c - b0 * rows["w0"] - b1 * rows["w1"] - b2 * rows["w2"]:
        s = p + r**2
        total -= 0.5 * (np.log(2.0 * np.pi * s) + (e - m) ** 2 / s)
        m, p = m + p / s * (e - m), p * r**2 / s
        m, p = a * m, a**2 * p + q**2
    return total


def top_of(record):
    """(the parameters at the maximum, by name; the log-likelihood there), by a simplex."""
    rows = regression_rows(1.0, record)

    def downhill(v):
        return -log_likelihood(rows, *v[:5], *np.exp(v[5:]))

    v = np.array([0.5, -1.0, 0.0, 7.0, 0.9, -1.5, -1.0])
    for _ in range(5):
        found = minimize(downhill, v, method="Nelder-Mead",
                         options={"xatol": 1e-9, "fatol": 1e-11, "maxfev": 5000})  # fmt: skip
        v = found.x
    return dict(zip((*MEANS, "a", *NOISES), [*v[:5], *np.exp(v[5:])], strict=True)), -found.fun


def assert_top(found, s, parameters, value):
    assert found.attrs["converged"]
    assert found.log_likelihood + ROWS * np.log(s) == pytest.approx(value, abs=1e-6)
    for name, expected in parameters.items():
        unit = s if name in (*MEANS, *NOISES) else 1.0
        assert found.parameters[name] / unit == pytest.approx(expected, rel=1e-3, abs=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("s", [1.0, *SCALES])
@pytest.mark.parametrize("record", RECORDS)
def test_a_regression_has_its_maximum_in_any_unit(s, record):
    model, rows, top = regression(s), regression_rows(s, record), top_of(record)
    for seed in range(4):
        assert_top(ssm.maximize(model, rows, seed=seed, progress=False), s, *top)


@pytest.mark.parametrize("s", [1e-9, 1e9])
def test_newton_s_steps_and_errors_go_with_the_unit(s):
    """The information has entries of 1e18 beside some of 1: rounding must not take it for that of
    no maximum."""
    plain = ssm.maximize(regression(1.0), regression_rows(1.0), seed=1, progress=False)
    found = ssm.maximize(regression(s), regression_rows(s), seed=1, progress=False)
    units = {name: s if name in (*MEANS, *NOISES) else 1.0 for name in plain.parameters}
    parameters = {name: plain.parameters[name] for name in units}
    assert_top(found, s, parameters, plain.log_likelihood)
    for name, unit in units.items():
        expected = unit * plain.standard_errors[name]
        assert found.standard_errors[name] == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("s", [1e-9, 1.0, 1e9])
def test_a_saddle_is_no_maximum_in_any_unit(s):
    unit = np.diag([1.0, s, 1.0])
    top = np.array([[2.0, 0.9, 0.0], [0.9, 0.5, 0.0], [0.0, 0.0, 1e-7]])
    saddle = np.array([[2.0, 1.1, 0.0], [1.1, 0.5, 0.0], [0.0, 0.0, 1e-7]])
    assert _positive_definite(unit @ top @ unit)
    assert not _positive_definite(unit @ saddle @ unit)
    assert not _positive_definite(np.diag([1.0, -s, 1.0]))
    assert not _positive_definite(np.diag([1.0, 0.0, s]))
    assert not _positive_definite(np.diag([1.0, np.nan, s]))


def test_a_climb_goes_on_in_the_units_of_its_end():
    """Priors of another unit begin it where the noise is a ten-millionth of what it is."""
    s, record = 1e7, 5
    model, method = regression(s, of_prior=1.0), ssm.DirectOptimization(restarts=0)
    found = ssm.maximize(model, regression_rows(s, record), method, seed=1, progress=False)
    assert_top(found, s, *top_of(record))


def test_what_is_looked_at_grows_little_with_the_unit(monkeypatch):
    """Numbers of the whole line have no edge, nor is a likelihood flat in a unit that is none."""
    plain, count = Maximization.exact_objective, [0]

    def counted(self, z):
        count[0] += 1
        return plain(self, z)

    monkeypatch.setattr(Maximization, "exact_objective", counted)
    looked_at = []
    for s in (1.0, 1e5):
        count[0] = 0
        ssm.maximize(regression(s), regression_rows(s), seed=1, progress=False)
        looked_at.append(count[0])
    assert looked_at[1] < 4 * looked_at[0]


@pytest.mark.parametrize("s", [1.0, *SCALES])
def test_climbs_begin_in_units_of_the_data(s, monkeypatch):
    """The first and its restarts, and the short climbs of regimes."""
    plain, begun = ExactClimb._in_units, []

    def recorded(self, start, steps, visit):
        begun.append((start, self.unit))
        return plain(self, start, steps, visit)

    monkeypatch.setattr(ExactClimb, "_in_units", recorded)
    rows = {"y": s * np.random.default_rng(seed_of("short climbs")).normal(3.0, 1.0, 40)}
    cases = (
        (regression(s), regression_rows(s), MEANS, NOISES),
        (regimes(s), rows, ("low", "high"), ("r", "stay", "go")),
    )
    for model, data, means, ones in cases:
        begun.clear()
        found = ssm.maximize(model, data, seed=1, progress=False)
        line = [list(found.parameters).index(name) for name in means]
        starts, units = (np.array(each)[:, line] for each in zip(*begun, strict=True))
        away = np.abs(starts - starts[0]).max(axis=0)
        assert np.all((0.05 * s < away) & (away < 1e3 * s))
        assert np.all((0.01 * s < units) & (units < 100.0 * s))
        logs = [list(found.parameters).index(name) for name in ones]
        assert np.all(np.array([unit[logs] for _, unit in begun]) == 1.0)


def regimes(s):
    model = ssm.Model("regimes")
    model.prior(lambda: {
        "low": ssm.Normal(-s, sd=2 * s), "high": ssm.Normal(s, sd=2 * s), "r": ssm.HalfNormal(sd=s),
        "stay": ssm.Beta(1, 1), "go": ssm.Beta(1, 1),
    })  # fmt: skip
    model.initial(lambda: {"k": ssm.Bernoulli(0.5)})
    model.transition(lambda k, stay, go: {"k": ssm.Bernoulli(stay * k + go * (1 - k))})
    model.observation(lambda k, low, high, r: {"y": ssm.Normal(low * (1 - k) + high * k, sd=r)})
    return model


@pytest.mark.slow
@pytest.mark.parametrize("objective", ["likelihood", "posterior"])
def test_regimes_are_told_apart_in_any_unit(objective):
    rng = np.random.default_rng(seed_of("units of regimes"))
    k, y = 0, []
    for _ in range(ROWS):
        y.append(rng.normal([2.0, 4.5][k], 0.6))
        k = int(rng.random() < [0.1, 0.9][k])
    plain = {"objective": objective, "progress": False}
    one = ssm.maximize(regimes(1.0), {"y": np.array(y)}, seed=0, **plain)
    levels = sorted([one.parameters["low"], one.parameters["high"]])
    assert levels == pytest.approx([2.0, 4.5], abs=0.4)
    for s in SCALES:
        for seed in range(3):
            found = ssm.maximize(regimes(s), {"y": s * np.array(y)}, seed=seed, **plain)
            assert found.attrs["converged"]
            shifted = found.log_likelihood + ROWS * np.log(s)
            if objective == "likelihood":
                assert shifted == pytest.approx(one.log_likelihood, abs=1e-6)
            there = sorted([found.parameters["low"] / s, found.parameters["high"] / s])
            assert there == pytest.approx(levels, rel=1e-4)
