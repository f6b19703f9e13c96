"""Mechanisms that a score at a strength of zero does not see, tried at finite strengths."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.diagnosis.fitting.augmented_models import AugmentedModels
from ssmppl.diagnosis.model.scales import Scales
from ssmppl.diagnosis.model.smoothing import Settings
from ssmppl.diagnosis.run.checkpoint import Checkpoint
from ssmppl.diagnosis.screening.screen import ScreenDesign, run_screen
from ssmppl.diagnosis.selection import overlooked as module
from ssmppl.diagnosis.selection.overlooked import (
    best_start,
    elsewhere,
    most_promising,
    overlooked,
    trials,
)
from ssmppl.diagnosis.selection.refit import Refit
from ssmppl.diagnosis.selection.shapes import shape_bounds
from ssmppl.inference.run.problem import missing_of, pose
from ssmppl.inference.run.seeds import random_state, seed_sequence
from tests.statistics.checks import seed_of

EFFECTS = ["hard stop", "quadratic drag", "missing input", "parameter drift", "sensor bias"]
STOP = 1.0
SHORT, LONG = 0.05, 400  # step, rows


def mass():
    model = ssm.Model("mass", inputs=("u",))
    model.prior(
        lambda: {"d": ssm.HalfNormal(sd=2), "q": ssm.HalfNormal(sd=1), "r": ssm.HalfNormal(sd=0.1)}
    )
    model.initial(lambda: {"x": ssm.Normal(0, sd=0.1), "v": ssm.Normal(0, sd=0.1)})

    @model.transition
    def transition(x, v, u, d, q):
        return {
            "x": ssm.Dirac(x + SHORT * v),
            "v": ssm.Normal(v + SHORT * (u - d * v - x), sd=q),
        }

    model.observation(lambda x, r: {"y": ssm.Normal(x, sd=r)})
    return model


def screened(u, y, effects):
    """The mass fitted to a record, and its screen: augmented models, fit, screen, experiments."""
    problem = pose(mass(), {"u": u, "y": y})
    train, missing = problem.experiments, missing_of(problem.experiments)
    augmented = AugmentedModels(problem.trace, missing, {}, Settings())
    base = augmented.base_fitter.fit(train, seed_sequence(1), {})
    states = augmented.base_fitter.states(train[0], base.theta, random_state(seed_sequence(2)))
    scales = Scales.of(problem.trace, states, train[0].y, train[0].u, LONG)
    design = ScreenDesign(problem.trace, scales, missing, (), Settings(), effects)
    screen = run_screen(design, train, base.theta, 60, seed_sequence(3), Checkpoint(None, {}))
    return augmented, base, screen, train


@pytest.fixture(scope="module")
def stopped():
    """A mass on a spring that hits an inelastic stop on one side."""
    rng, (x, v), y = np.random.default_rng(seed_of("stop")), (0.0, 0.0), np.empty(LONG)
    t = SHORT * np.arange(LONG)
    u = 1.2 * np.sin(0.9 * t) + 0.9 * np.sin(2.1 * t + 1.0)
    for k in range(LONG):
        y[k] = x + 0.003 * rng.standard_normal()
        for _ in range(25):
            beyond = max(x - STOP, 0.0)
            v += SHORT / 25 * (u[k] - 0.4 * v - x - (60.0 * beyond + 4.0 * v * (beyond > 0.0)))
            x += SHORT / 25 * v
        v += 0.01 * rng.standard_normal()
    return screened(u, y, EFFECTS)


def column(screen, effect, equation, form=""):
    return next(
        k for k, c in enumerate(screen.design.candidates)
        if (c.effect.name, c.equation) == (effect, equation) and form in c.form
    )  # fmt: skip


def refit(screen, k, gain=100.0):
    """A refit that gains so much, one row ahead alone."""
    return Refit((k,), (screen.design.candidates[k],), None, None, gain)


def told(screen, found):
    return {(c.effect.name, c.form, c.equation)
            for shapes in found for c in (screen.design.candidates[k] for k in shapes)}  # fmt: skip


def test_the_mechanisms_of_the_equation_that_is_only_described(stopped):
    screen = stopped[2]
    ar1 = refit(screen, column(screen, "missing input", "v", "ar1"))
    found = overlooked(screen, [ar1], 10.0)
    assert ("hard stop", "upper", "v") in told(screen, found)
    assert {(e, q) for e, _, q in told(screen, found)} <= {
        ("hard stop", "v"),
        ("quadratic drag", "v"),
    }
    shapes = [len(f) for f in found if screen.design.candidates[f[0]].form == "upper"]
    assert shapes == [3]
    # a noise scale is in the same equation; a bias of the sensor in none of a state
    scale = refit(screen, column(screen, "parameter drift", "q"))
    assert told(screen, overlooked(screen, [scale], 10.0)) == told(screen, found)
    reading = refit(screen, column(screen, "parameter drift", "r"))
    assert overlooked(screen, [reading], 10.0) == []


def test_none_where_a_mechanism_gains_most_or_nothing_gains_enough(stopped):
    screen = stopped[2]
    ar1 = refit(screen, column(screen, "missing input", "v", "ar1"), gain=50.0)
    stop = refit(screen, column(screen, "hard stop", "v", "upper"), gain=60.0)
    assert overlooked(screen, [ar1, stop], 10.0) == []
    assert overlooked(screen, [ar1, replace(stop, gain=26.0)], 10.0) == []  # named before
    assert overlooked(screen, [ar1], 51.0) == []
    assert overlooked(screen, [], 0.0) == []
    drag = refit(screen, column(screen, "quadratic drag", "v"), gain=20.0)
    behind = overlooked(screen, [ar1, replace(stop, gain=24.0), drag], 10.0)
    assert ("quadratic drag", "", "v") not in told(screen, behind)  # refitted already
    assert ("hard stop", "upper", "v") in told(screen, behind)  # elsewhere it may gain more


def test_no_mechanism_whose_score_has_the_sign_that_is_not_allowed(stopped):
    screen = stopped[2]
    ar1 = refit(screen, column(screen, "missing input", "v", "ar1"))
    lower = [k for k, c in enumerate(screen.design.candidates) if c.form == "lower"]
    z = screen.efficient.z.copy()
    z[lower] = -module.AGAINST - 0.1
    against = SimpleNamespace(
        family=screen.family, groups=screen.groups, design=screen.design,
        efficient=replace(screen.efficient, z=z),
    )  # fmt: skip
    assert ("hard stop", "lower", "v") not in told(screen, overlooked(against, [ar1], 10.0))
    assert ("hard stop", "lower", "v") in told(screen, overlooked(screen, [ar1], 10.0))


def test_a_stop_that_simulated_sets_go_beyond_is_found_at_a_finite_strength(stopped):
    """The best of all strengths and shapes tried, by the exact likelihood of the model with it, and
    far beyond what the score promises."""
    augmented, base, screen, train = stopped
    shapes = [k for k, c in enumerate(screen.design.candidates)
              if c.form == "upper" and c.effect.name == "hard stop"]  # fmt: skip
    found = best_start(augmented, base, [trials(screen, shapes)], train, 0)
    k, strength = int(found["column"]), float(found["strength"])
    c = screen.design.candidates[k]
    h = elsewhere(found).get("h", dict(c.shape)["h"])
    assert h > 0.8 * STOP

    def gain(k, strength, **shape):
        c = screen.design.candidates[k].with_shape(**shape)
        fitter = augmented.fitter((c,))
        values = base.by_component | {c.strength: strength, f"{c.strength}_h": dict(c.shape)["h"]}
        theta = np.array([values[repr(s)] for s in fitter.problem.trace.parameter_symbols])
        return fitter.value(train, theta) - augmented.base_fitter.value(train, base.theta)

    best = gain(k, strength, h=h)
    assert float(found["gain"]) == pytest.approx(best - module.PRICE * bool(elsewhere(found)))
    assert best > 5.0 * max(screen.efficient.gain[shapes])
    assert best > max(gain(k, 0.2 * strength, h=h), gain(k, 5.0 * strength, h=h))
    low, high = shape_bounds(c, screen.design.scales)["h"]
    tried = np.linspace(low, high, module.ELSEWHERE + 2)[1:-1]
    assert best >= max(gain(k, strength, h=v) for v in tried) - module.PRICE


def test_a_shape_beyond_those_of_the_screen_is_tried_and_has_its_price(stopped, monkeypatch):
    """Where the screen's thresholds are all far inside, one further out is found."""
    augmented, base, screen, train = stopped
    k = min(
        (k for k, c in enumerate(screen.design.candidates)
         if c.form == "upper" and c.effect.name == "hard stop"),
        key=lambda k: dict(screen.design.candidates[k].shape)["h"],
    )  # fmt: skip
    found = best_start(augmented, base, [trials(screen, [k])], train, 0)
    low, high = shape_bounds(screen.design.candidates[k], screen.design.scales)["h"]
    assert elsewhere(found)["h"] in np.linspace(low, high, module.ELSEWHERE + 2)[1:-1]
    assert elsewhere(found)["h"] > dict(screen.design.candidates[k].shape)["h"]
    monkeypatch.setattr(module, "PRICE", 1e9)
    assert elsewhere(best_start(augmented, base, [trials(screen, [k])], train, 0)) == {}


def test_no_start_where_every_strength_costs(stopped):
    augmented, base, screen, train = stopped
    shapes = [k for k, c in enumerate(screen.design.candidates) if c.form == "lower"]
    k = max(shapes, key=lambda k: dict(screen.design.candidates[k].shape)["h"])
    assert best_start(augmented, base, [trials(screen, [k])], train, 0) == {}


def test_those_that_gain_most_are_fitted(stopped, monkeypatch):
    starts = [{}, *(
        {"gain": np.array(g), "column": np.array(k)} for k, g in enumerate((1.0, 5.0, 3.0))
    )]  # fmt: skip
    trace = stopped[0].trace
    assert [float(n["gain"]) for n in most_promising(starts, trace)] == [5.0, 3.0, 1.0]
    refitted = most_promising(starts, trace, {1: 6.0, 2: 2.0})  # what a refit has reached already
    assert [float(n["gain"]) for n in refitted] == [3.0, 1.0]
    monkeypatch.setattr(module, "FITTED", 2)
    assert [float(n["gain"]) for n in most_promising(starts, trace)] == [5.0, 3.0]


# -- what limits the range of a sensor
@pytest.fixture(scope="module")
def clipped():
    """The mass with a sensor that shows nothing above 0.8."""
    rng, (x, v), y = np.random.default_rng(seed_of("clipped")), (0.0, 0.0), np.empty(LONG)
    t = SHORT * np.arange(LONG)
    u = 1.2 * np.sin(0.9 * t) + 0.9 * np.sin(2.1 * t + 1.0)
    for k in range(LONG):
        y[k] = min(x, 0.8) + 0.003 * rng.standard_normal()
        x, v = x + SHORT * v, v + SHORT * (u[k] - 0.4 * v - x) + 0.01 * rng.standard_normal()
    effects = ["sensor clipping", "sensor gain nonlinearity", "missing input", "quadratic drag"]
    return screened(u, y, effects)


def test_the_range_of_a_sensor_is_looked_at_whatever_leads(clipped):
    screen = clipped[2]
    drag = refit(screen, column(screen, "quadratic drag", "v"))
    found = told(screen, overlooked(screen, [drag], 10.0))
    assert {(e, f) for e, f, _ in found} == {
        ("sensor clipping", "upper"), ("sensor clipping", "lower"),
        ("sensor clipping", "both ends"), ("sensor gain nonlinearity", "saturating"),
    }  # fmt: skip


def test_a_limit_that_no_filtered_state_goes_beyond_is_found_at_its_place(clipped):
    augmented, base, screen, train = clipped
    shapes = [k for k, c in enumerate(screen.design.candidates)
              if (c.effect.name, c.form) == ("sensor clipping", "upper")]  # fmt: skip
    found = best_start(augmented, base, [trials(screen, shapes)], train, 0)
    c = screen.design.candidates[int(found["column"])]
    assert 0.5 < elsewhere(found).get("c", dict(c.shape)["c"]) < 0.85
    assert float(found["gain"]) > 10.0
    assert float(found["strength"]) in module.BENT
