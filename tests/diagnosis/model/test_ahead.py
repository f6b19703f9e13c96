"""Predictions several rows ahead: the CRPS against its integral, simulations against exact laws."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

import ssmppl as ssm
from ssmppl.analysis.density import Missing
from ssmppl.codegen.modules.program import compile_trace
from ssmppl.data import bind
from ssmppl.diagnosis.model.smoothing import FEWEST, HORIZONS, crps, crps_ahead, mean_scores
from ssmppl.errors import ArgumentError
from ssmppl.inference.run.seeds import random_state, seed_sequence
from ssmppl.inference.verbs.simulate import feeds_back
from ssmppl.language.tracing import trace
from tests.statistics.checks import LEVEL, seed_of

A, B, Q, R = 0.8, 0.5, 0.5, 0.4


def rng_of(*name):
    return np.random.default_rng(seed_of("ahead", *name))


def autoregression(feedback):
    """x follows itself, or what was measured of it; u moves both."""
    model = ssm.Model("autoregression", inputs=("u",))
    model.initial(lambda: {"x": ssm.Normal(0.0, sd=1.0)})
    if feedback:
        model.transition(lambda y, u: {"x": ssm.Normal(A * y + B * u, sd=Q)})
    else:
        model.transition(lambda x, u: {"x": ssm.Normal(A * x + B * u, sd=Q)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=R)})
    return trace(model)


# --- the score -----------------------------------------------------------------------------------


def test_crps_is_its_double_sum():
    rng = rng_of("double sum")
    x, y = rng.standard_normal((6, 9)), rng.standard_normal(6)
    pairs = np.abs(x[:, :, None] - x[:, None, :]).sum(axis=(1, 2)) / (2 * 9 * 8)
    np.testing.assert_allclose(crps(x, y), np.abs(x - y[:, None]).mean(axis=1) - pairs)
    with pytest.raises(ArgumentError, match="M at least 2"):
        crps(x[:, :1], y)


@pytest.mark.parametrize("samples", [2, 20])
def test_crps_is_unbiased_for_the_law(samples):
    """Of N(0, 1): y (2 Phi(y) - 1) + 2 phi(y) - 1 / sqrt(pi), however few samples there are."""
    rng, times = rng_of("fair", samples), 40_000
    for y in (0.0, 1.3):
        exact = y * (2 * stats.norm.cdf(y) - 1) + 2 * stats.norm.pdf(y) - 1 / np.sqrt(np.pi)
        found = crps(rng.standard_normal((times, samples)), np.full(times, y))
        assert abs(found.mean() - exact) < 4 * found.std() / np.sqrt(times)


# --- simulations from a row on -------------------------------------------------------------------


@pytest.mark.parametrize("feedback", [False, True])
def test_rows_that_are_simulated_on_have_their_exact_moments(feedback):
    """Mean and variance of y, h rows after a known x, with an input of its own at every row."""
    traced, n, first, x0, y0 = autoregression(feedback), 20_000, 3, 1.5, -0.7
    assert feeds_back(traced) == feedback
    program = compile_trace(traced, Missing(none=True))
    u = rng_of("inputs").standard_normal((12, 1))
    y = np.zeros((12, 1))
    y[first - 1] = y0
    states, drawn = np.empty((6, 1, n)), np.empty((6, 1, n))
    stream = random_state(seed_sequence(seed_of("on", feedback)))
    program.entry("simulate_on")(
        np.empty(0), y, np.ones_like(y), u, first, np.full((1, n), x0), stream, states, drawn,
        feedback,
    )  # fmt: skip
    mean, variance = (y0 if feedback else x0), 0.0
    for h in range(6):
        mean, variance = A * mean + B * u[first + h - 1, 0], A**2 * variance + Q**2
        if feedback:  # what comes next starts from y
            variance += R**2
        seen = variance + (0.0 if feedback else R**2)
        found = drawn[h, 0]
        assert abs(found.mean() - mean) < stats.norm.isf(LEVEL / 24) * np.sqrt(seen / n)
        statistic = n * found.var() / seen
        assert stats.chi2.cdf(statistic, n) > LEVEL / 24 < stats.chi2.sf(statistic, n)
        assert abs(np.mean(drawn[h] - states[h])) < stats.norm.isf(LEVEL / 24) * R / np.sqrt(n)


@pytest.mark.parametrize("feedback", [False, True])
def test_scores_of_the_true_law_are_its_expectation(feedback):
    """E CRPS of the law N(m, s^2) under itself is s / sqrt(pi). With x known at each row s^2 has a
    formula; of the one every tenth value is missing."""
    traced, rng = autoregression(feedback), rng_of("expectation", feedback)
    program, steps = compile_trace(traced, Missing()), 300
    stream, found = random_state(seed_sequence(seed_of("scores", feedback))), []
    for _ in range(60):
        u = rng.standard_normal(steps)
        x, y = np.empty(steps), np.empty(steps)
        for t in range(steps):
            before = (y if feedback else x)[t - 1] if t else 0.0
            x[t] = A * before + (B * u[t - 1] if t else 0.0) + Q * rng.standard_normal()
            y[t] = x[t] + R * rng.standard_normal()
        if not feedback:  # which needs them all
            y[5::10] = np.nan
        (e,) = bind(traced, {"u": u, "y": y})
        particles = np.repeat(x[:, None, None], 7, axis=2)
        scores = crps_ahead(
            program, e, np.empty(0), particles, np.full((steps, 7), 1 / 7), stream, feedback
        )
        found.append(np.nanmean(scores[:, :, 0], axis=0))
    found = np.stack(found)
    for h, horizon in enumerate(HORIZONS):
        own = sum(A ** (2 * k) for k in range(horizon))
        spread = own * (Q**2 + (R**2 if feedback else 0.0)) + (0.0 if feedback else R**2)
        error = found[:, h].std(ddof=1) / np.sqrt(len(found))
        exact = np.sqrt(spread / np.pi)
        assert abs(found[:, h].mean() - exact) < stats.t.isf(LEVEL / 6, len(found) - 1) * error


def test_rows_that_cannot_be_simulated_on_have_no_score():
    """A start that is not known, a value that the transition needs, rows after the record."""
    traced, values = autoregression(feedback=True), np.zeros(30)
    program = compile_trace(traced, Missing())
    (e,) = bind(traced, {"u": np.zeros(30), "y": values})
    seen = np.ones((30, 1))
    seen[::2] = 0.0
    e = replace(e, seen=seen)
    particles = np.zeros((30, 1, 5))
    particles[:4] = np.nan
    stream = random_state(seed_sequence(1))
    scores = crps_ahead(program, e, np.empty(0), particles, np.ones((30, 5)), stream, True)
    origins = np.arange(29)
    usable = (origins % 2 == 1) & (origins >= 4)
    known = np.isfinite(scores[:, :, 0])
    np.testing.assert_array_equal(known[:, 1], usable & (origins + 10 < 30))
    assert not known[:, [0, 2]].any()
    assert np.all(e.y == 0.0)  # what is drawn is not written into the data


def test_means_by_channel_and_horizon():
    """Over experiments; a horizon with fewer rows than `FEWEST` counts as nothing."""
    rng = rng_of("means")
    scores = [rng.random((20, 3, 2)), rng.random((20, 3, 2))]
    scores[0][:, 2] = scores[1][FEWEST - 1 :, 2] = np.nan
    scores[1][3, 0, 1] = np.nan
    found = mean_scores(scores, ["a", "b"])
    assert list(found["a"]) == ["CRPS 1 row ahead", "CRPS 10 rows ahead", "CRPS 100 rows ahead"]
    together = np.concatenate(scores)
    assert found["b"]["CRPS 1 row ahead"] == pytest.approx(np.nanmean(together[:, 0, 1]))
    assert found["a"]["CRPS 10 rows ahead"] == pytest.approx(together[:, 1, 0].mean())
    assert found["a"]["CRPS 100 rows ahead"] == 0.0
    assert mean_scores([], ["a"])["a"]["CRPS 1 row ahead"] == 0.0


def test_samples_that_are_infinite_have_no_score():
    samples = np.array([[0.0, 1.0, np.inf], [-np.inf, 0.0, np.inf], [0.0, 1.0, 2.0]])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = crps(samples, np.zeros(3))
    assert np.isnan(found[:2]).all()
    assert found[2] == pytest.approx(1.0 - 4.0 / 6.0)
