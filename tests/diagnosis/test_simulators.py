"""`diagnose` on a simulator that is a function of NumPy: what it lacks acts through its force."""

from contextlib import nullcontext

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.diagnosis.fitting.augmented_models import AugmentedModels
from ssmppl.diagnosis.fitting.fit import Fitter
from ssmppl.diagnosis.model import smoothing
from ssmppl.diagnosis.model.candidates import offers
from ssmppl.diagnosis.model.scales import Scales
from ssmppl.diagnosis.model.score_columns import score_columns
from ssmppl.diagnosis.model.smoothing import Settings, Smoother
from ssmppl.diagnosis.selection.refit import only_by_particles, refit
from ssmppl.errors import NotApplicable
from ssmppl.inference.batched.extended import extended_model
from ssmppl.inference.run.problem import pose
from ssmppl.inference.run.seeds import random_state, seed_sequence
from ssmppl.language.tracing import trace

T, H, STEPS = 150, 0.01, 5


def swung(state, torque, k, d, dry=0.0):
    q, v = state.T
    for _ in range(STEPS):
        v = v + H * (torque - k * np.sin(q) - d * v - dry * np.tanh(v / 0.05))
        q = q + H * v
    return np.stack([q, v], axis=1)


@ssm.simulator(state=["q", "v"], inputs=["u", "push"], parameters=["k", "d"], forces={"push": "v"})
def pendulum(state, inputs, parameters):
    return swung(state, inputs.sum(axis=1), *parameters.T)


def model():
    made = ssm.Model("pendulum", inputs=("u",))
    made.prior(lambda: {"k": ssm.LogNormal(2, sd=0.5), "d": ssm.LogNormal(-1, sd=1),
                        "s": ssm.LogNormal(-3, sd=1)})  # fmt: skip
    made.initial(lambda: {"q": ssm.Normal(0, sd=0.1), "v": ssm.Normal(0, sd=0.1)})

    @made.transition
    def transition(q, v, u, k, d, s):
        new = pendulum([q, v], [u, 0.0], [k, d])
        return {"q": ssm.Dirac(new.q), "v": ssm.Normal(new.v, sd=s)}

    made.observation(lambda q: {"y": ssm.Normal(q, sd=0.01)})
    return made


def record(dry, seed):
    rng = np.random.default_rng(seed)
    u = 4.0 * np.sin(np.arange(T) / 5.0) + 2.0 * np.sin(np.arange(T) / 1.9)
    x, y = np.zeros((1, 2)), []
    for torque in u:
        y.append(x[0, 0] + 0.01 * rng.standard_normal())
        x = swung(x, torque, 9.0, 0.3, dry) + [[0.0, 0.04 * rng.standard_normal()]]
    return {"y": np.array(y), "u": u}


def trend(function):
    """A level and a slope, which `function` moves."""
    made = ssm.Model("trend")
    made.prior(lambda: {"a": ssm.Uniform(0, 1), "s": ssm.LogNormal(-1, sd=1)})
    made.initial(lambda: {"x": ssm.Normal(0, sd=1), "v": ssm.Normal(0, sd=0.5)})

    @made.transition
    def transition(x, v, a, s):
        level, slope = function(x, v, a)
        return {"x": ssm.Normal(level, sd=0.3), "v": ssm.Normal(slope, sd=s)}

    made.observation(lambda x: {"y": ssm.Normal(x, sd=0.4)})
    return made


def test_starts_are_compared_by_the_filter_of_many_points():
    """By one call of it; of a model without a simulator by the particle filter with one set of
    random numbers."""
    points = np.array([[0.8, 0.2], [0.9, 0.3], [0.5, 0.2]])
    y = np.random.default_rng(4).normal(size=40)

    @ssm.simulator(state=["x", "v"], parameters=["a"])
    def moved(state, inputs, parameters):
        x, v = state.T
        return np.stack([x + v, parameters[:, 0] * v], axis=1)

    problem = pose(trend(lambda x, v, a: moved([x, v], [], [a]).values()), {"y": y})
    fitter = Fitter(problem, {}, Settings(100, "twisted"))
    stream = random_state(seed_sequence(3))
    values = fitter.estimates(problem.experiments, points, stream.copy())
    extended = extended_model(problem.trace)
    exact = [extended.log_likelihood(problem.experiments, p) for p in points]
    np.testing.assert_allclose(values, exact, rtol=1e-6)
    problem = pose(trend(lambda x, v, a: (x + v, np.sin(a * v))), {"y": y})
    fitter = Fitter(problem, {}, Settings(50, "bootstrap"))
    values = fitter.estimates(problem.experiments, points, stream.copy())
    again = [fitter.estimate(problem.experiments, p, stream.copy()) for p in points]
    np.testing.assert_array_equal(values, again)


def passed(model, y):
    problem = pose(model, {"y": y})
    t, missing = problem.trace, problem.program.missing
    smoother = Smoother(score_columns(t, t, (), (), missing), missing, Settings(100, "twisted"))
    (found,) = smoother.run(
        problem.experiments, np.array([0.8, 0.2]), random_state(seed_sequence(3))
    )
    return found


def test_predictions_of_a_linear_simulator_are_those_of_the_exact_filter():
    """The mean to rounding, as draws are mirrored; the variance by 64 pairs of them."""

    @ssm.simulator(state=["x", "v"], parameters=["a"])
    def called(state, inputs, parameters):
        x, v = state.T
        return np.stack([x + v, parameters[:, 0] * v], axis=1)

    def step(x, v, a):
        new = called([x, v], [], [a])
        return new.x, new.v

    y = np.cumsum(np.random.default_rng(4).normal(size=40))
    y[[5, 6, 20]] = np.nan
    found, exact = passed(trend(step), y), passed(trend(lambda x, v, a: (x + v, a * v)), y)
    np.testing.assert_allclose(found.log_increments, exact.log_increments, atol=1e-5)
    seen = np.isfinite(y)
    mean, variance, below, _ = found.prediction[seen, :, 0].T
    m, v, p, _ = exact.prediction[seen, :, 0].T
    np.testing.assert_allclose(mean, m, atol=1e-5)
    # of the sample variance of 64 normal draws, whose sd is sqrt(2 / 64) of it
    assert np.all(np.abs(variance / v - 1.0) < 4.5 * np.sqrt(2.0 / 64))
    assert np.all(np.abs(below - p) < 0.1)


def test_rows_ask_the_simulator_together(monkeypatch):
    """Scores of its parameters are those of calls row by row, in a fraction of the calls."""
    calls = []

    @ssm.simulator(state=["x", "v"], parameters=["a"])
    def called(state, inputs, parameters):
        calls.append(len(state))
        x, v = state.T
        return np.stack([x + np.sin(v), parameters[:, 0] * v], axis=1)

    def step(x, v, a):
        new = called([x, v], [], [a])
        return new.x, new.v

    y, found = np.cumsum(np.random.default_rng(4).normal(size=80)), []
    for context in (smoothing.gathered, nullcontext):
        monkeypatch.setattr(smoothing, "gathered", context)
        before = len(calls)
        found.append((passed(trend(step), y).rows, len(calls) - before))
    (together, few), (apart, many) = found
    assert np.abs(together).max() > 1.0
    np.testing.assert_array_equal(together, apart)
    assert few < many - 80


def test_a_sensor_that_jumps_is_not_tried():
    """The extended filter's slope of a sawtooth says nothing of its jumps: on records with nothing
    missing, quantisation gained 32 nats by that. A written-out model has it tried."""
    for made, wanted in ((model(), 0), (trend(lambda x, v, a: (x + v, a * v)), 1)):
        t = trace(made)
        rng = np.random.default_rng(1)
        states, y = rng.normal(size=(T, 4, 2)), rng.normal(size=(T, 1))
        scales = Scales.of(t, states, y, rng.normal(size=(T, len(t.input_symbols))), T)
        found, refused = offers(t, scales, ["quantisation", "sensor clipping"])
        assert len({c.effect.name for c in found}) == 1 + wanted
        assert [r.effect for r in refused if "jumps" in r.reason] == ["quantisation"] * (1 - wanted)


def test_what_only_particles_can_fit_is_not_refitted():
    """Outliers of a state have no Gaussian filter; a refit of them took a quarter of an hour. A
    written-out model has them refitted."""
    for made, called in ((model(), True), (trend(lambda x, v, a: (x + v, a * v)), False)):
        problem = pose(made, {n: record(0.8, 1)[n] for n in ("y", *trace(made).inputs)})
        t, missing = problem.trace, problem.program.missing
        rng = np.random.default_rng(1)
        states, y = rng.normal(size=(T, 4, 2)), problem.experiments[0].y
        scales = Scales.of(t, states, y, rng.normal(size=(T, len(t.input_symbols))), T)
        tried, _ = offers(t, scales, ["outliers", "sensor bias"])
        augmented = AugmentedModels(t, missing, {}, Settings(100, "twisted"))
        found = {str(c): only_by_particles(augmented, augmented.fitter([c])) for c in tried}
        assert found.pop("outliers in v") == called
        assert not any(found.values())
        assert {"outliers in y", "sensor bias in y"} <= set(found)
        if called:
            outliers = [c for c in tried if str(c) == "outliers in v"]
            refused = refit(augmented, None, [0], outliers, problem.experiments, None, None)
            assert isinstance(refused, NotApplicable)
            assert "outliers in v: only a particle filter" in refused.reason


@pytest.mark.slow
def test_dry_friction_is_named_and_acts_through_the_force():
    report = ssm.diagnose(model(), record(0.8, 1), mode="fast", progress=False, debug=True)
    best = report.causes.iloc[0]
    assert report.verdict == "effect"
    members = report.causes[report.causes["class_id"] == best["class_id"]]
    (dry,) = members.index[members["effect"] == "coulomb friction"]
    assert "through push" in report.causes.loc[dry, "form"]
    assert report.causes.loc[dry, "equation"] == "v"
    assert abs(report.causes.loc[dry, "estimate"] - 0.8) < 4.0 * report.causes.loc[dry, "se"]
    assert report.attributes == {}


@pytest.mark.slow
def test_nothing_is_found_where_nothing_is_missing():
    report = ssm.diagnose(model(), record(0.0, 2), mode="fast", progress=False, debug=True)
    assert report.verdict == "no measurable gap"


@pytest.mark.slow
def test_full_mode_hands_the_model_back_and_leaves_nothing_out():
    """With refits, a second screen and blocks of a short record that are left out."""
    report = ssm.diagnose(model(), record(0.8, 1), progress=False, debug=True)
    assert report.verdict == "effect"
    assert len(report.left_out) == 0
    best = report.causes.iloc[0]
    members = report.causes[report.causes["class_id"] == best["class_id"]]
    assert "coulomb friction" in set(members["effect"])
    assert set(report.chosen) & set(members["effect"])
    inputs = {"u": record(0.8, 1)["u"]}
    values = {n: v for n, (v, _) in report.estimates["after"].items()}
    again = ssm.simulate(report.model, values, steps=T, inputs=inputs, seed=1)
    assert np.isfinite(again["q"]).all()
