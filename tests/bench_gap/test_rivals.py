"""The rivals on made-up residuals that hold one term and noise."""

import importlib.util

import numpy as np
import pytest

from bench.gap.names import ITEMS
from bench.gap.rivals import ALPHA, Refit, aic, correlation, sparse
from bench.gap.terms import Residuals, library
from ssmppl.diagnosis.effects.catalogue import effects
from tests.statistics.checks import LEVEL, seed_of


def residuals(seed, term=None, error=None, rows=400):
    """A mass with position x and speed v under a force u; white residuals beside `term`(x, v, u)
    in the speed's equation and `error`(e) in the channel's errors."""
    rng = np.random.default_rng(seed_of("rivals", seed))
    t = np.arange(rows)
    x = np.sin(0.11 * t) + 0.6 * np.sin(0.043 * t + 1)
    v = np.gradient(x)
    u = np.cumsum(rng.standard_normal(rows)) / 10 + np.sin(0.3 * t)
    step = rng.standard_normal(rows - 1)
    if term is not None:
        g = term(x, v, u)[:-1]
        step += g / g.std()
    e = rng.standard_normal(rows)
    e = e if error is None else error(e)
    return Residuals({"x": x, "v": v}, ("x",), {"v": step}, {"y": e}, {"y": x}, {"u": u})


def least_squares(columns, target, threshold):
    """Thresholded least squares, again and again: what pysindy's STLSQ does."""
    kept = np.ones(columns.shape[1], dtype=bool)
    w = np.zeros(columns.shape[1])
    for _ in range(20):
        w[:] = 0
        if kept.any():
            gram = columns[:, kept].T @ columns[:, kept] + 1e-3 * np.eye(kept.sum())
            w[kept] = np.linalg.solve(gram, columns[:, kept].T @ target)
        kept = np.abs(w) >= threshold
    return w


def test_terms_have_the_catalogues_names():
    found = {t.effect for t in library(residuals(0))}
    assert found <= set(effects.names())
    assert len(found & {name for names in ITEMS.values() for name in names}) >= 24


def test_columns_are_as_long_as_what_they_explain():
    for term in library(residuals(0)):
        assert len(term.target) == len(term.column)
        assert np.isfinite(term.column).all()


CASES = [
    ("quadratic drag", "v", {"term": lambda x, v, u: -v * np.abs(v)}),
    ("cubic stiffness", "v", {"term": lambda x, v, u: -(x**3)}),
    ("periodic forcing", "v", {"term": lambda x, v, u: np.sin(2 * np.pi * np.arange(len(x)) / 10)}),
    ("constant load", "v", {"term": lambda x, v, u: 1 + 1e-9 * x}),
    ("input delay", "u", {"term": lambda x, v, u: np.concatenate([u[:1], u[:-1]]) - u}),
]


@pytest.mark.parametrize(("effect", "equation", "made"), CASES[:3])
def test_the_largest_correlation_is_with_the_term_that_is_there(effect, equation, made):
    verdict, p, ranked = correlation(library(residuals(effect, **made)))
    assert verdict == "effect"
    assert p < 1e-6
    assert (effect, equation) in [(r.effect, r.equation) for r in ranked[:3]]
    assert [r.p for r in ranked] == sorted(r.p for r in ranked)


def test_a_constant_residual_is_a_constant_load():
    made = residuals("load")
    made.steps["v"][:] += 1.0
    _, _, ranked = correlation(library(made))
    assert ranked[0].effect == "constant load"


def test_outliers_and_colour_of_errors_are_seen():
    def wild(e):
        e = e.copy()
        e[::40] *= 6
        return e

    def coloured(e):
        return np.convolve(e, [1, 0.7])[: len(e)] / np.sqrt(1.49)

    for effect, error in (("outliers", wild), ("coloured noise", coloured)):
        _, p, ranked = correlation(library(residuals(effect, error=error)))
        assert p < 1e-6
        assert (ranked[0].effect, ranked[0].equation) == (effect, "y")


def test_correlation_keeps_its_level():
    """Bonferroni over white residuals: alarms at most as often as the binomial law allows."""
    from scipy.stats import binom

    alarms = sum(correlation(library(residuals(k)))[0] == "effect" for k in range(60))
    assert binom.sf(alarms - 1, 60, ALPHA) > LEVEL


def test_sparse_regression_keeps_the_term_that_is_there():
    verdict, ranked = sparse(library(residuals("s", CASES[2][2]["term"])), least_squares)
    assert verdict == "effect"
    assert ranked[0].gain > 0
    assert ranked[0].effect == "periodic forcing"


@pytest.mark.skipif(not importlib.util.find_spec("pysindy"), reason="pysindy is not installed")
def test_pysindy_does_what_the_stand_in_does():
    terms = library(residuals("s", CASES[2][2]["term"]))
    ours, theirs = sparse(terms, least_squares), sparse(terms)
    assert [r.effect for r in ours[1][:3]] == [r.effect for r in theirs[1][:3]]


def test_aic_pays_for_parameters():
    refits = {("a", "v"): Refit(12.0), ("b", "v"): Refit(13.0, extra=3), ("c", "v"): Refit(9.0)}
    verdict, ranked = aic(10.0, refits)
    assert verdict == "effect"
    assert [(r.effect, r.gain) for r in ranked] == [("a", 1.0), ("b", 0.0), ("c", -2.0)]
    assert aic(11.5, refits)[0] == "no measurable gap"
