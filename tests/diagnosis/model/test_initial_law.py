"""Models with a flat start to which an effect is added that they cannot have with it."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import norm

import ssmppl as ssm
from ssmppl.diagnosis.fitting.augmented_models import AugmentedModels
from ssmppl.diagnosis.heldout.predictions import predict
from ssmppl.diagnosis.model.candidates import offers
from ssmppl.diagnosis.model.initial_law import (
    InitialStateMeans,
    ProperInitialLaw,
    needs_proper_initial_law,
    proper_initial_law,
)
from ssmppl.diagnosis.model.scales import Scales
from ssmppl.diagnosis.model.smoothing import Settings
from ssmppl.diagnosis.report.build import _written
from ssmppl.diagnosis.run.checkpoint import Checkpoint
from ssmppl.diagnosis.screening.screen import ScreenDesign, run_screen
from ssmppl.diagnosis.selection.refit import refit_all
from ssmppl.inference.exact.kalman import kalman_model
from ssmppl.inference.run.problem import pose
from ssmppl.inference.run.seeds import random_state, seed_sequence
from tests.statistics.checks import seed_of

VALUES = {"q": 0.2, "r": 0.1, "a": 0.9, "b": 0.5}
DRAG = 0.06


def driven(start=None):
    """A speed that is driven; started flat, unless another law is given."""
    model = ssm.Model("driven", inputs=("u",))

    @model.prior
    def prior():
        return {"q": ssm.LogNormal(0, sd=1), "r": ssm.LogNormal(0, sd=1), "a": ssm.Uniform(0, 1),
                "b": ssm.Normal(0, sd=2)}  # fmt: skip

    @model.initial
    def initial():
        return {"v": start or ssm.Flat()}

    @model.transition
    def transition(v, u, q, a, b):
        return {"v": ssm.Normal(a * v + b * u, sd=q)}

    @model.observation
    def observation(v, r):
        return {"y": ssm.Normal(v, sd=r)}

    return model


def recorded(steps, drag=DRAG, first=3.0):
    rng = np.random.default_rng(seed_of("driven", steps))
    u = 2.0 * np.repeat(rng.standard_normal(-(-steps // 10)), 10)[:steps]
    v = np.full(steps, first)
    for k in range(1, steps):
        drawn = VALUES["q"] * rng.standard_normal()
        v[k] = 0.9 * v[k - 1] - drag * v[k - 1] * abs(v[k - 1]) + 0.5 * u[k - 1] + drawn
    return {"y": v + VALUES["r"] * rng.standard_normal(steps), "u": u}


def on_a_grid(data, drag):
    """(log p(y) with a flat law of density 1, mean of x_1 given all y), by quadrature."""
    y, u, grid = data["y"], data["u"], np.linspace(-12.0, 12.0, 3001)
    width = grid[1] - grid[0]
    like = norm.pdf(y[:, None], grid, VALUES["r"])
    mean = 0.9 * grid - drag * grid * np.abs(grid)
    beta = np.ones(len(grid))  # p(y_{t+1:T} | x_t)
    for t in range(len(y) - 1, 0, -1):
        step = norm.pdf(grid, mean[:, None] + 0.5 * u[t - 1], VALUES["q"])
        beta = step @ (like[t] * beta) * width
    joint = like[0] * beta
    return float(np.log(joint.sum() * width)), float(grid @ joint / joint.sum())


def dragged(data, particles=1000):
    """(fitter of the model with drag, its theta, experiments) with a start from the data."""
    problem = pose(driven(), data)
    e = problem.experiments[0]
    missing = replace(problem.program.missing, none=False)
    start = proper_initial_law(problem.trace, [e.y[0]], [e.y])
    augmented = AugmentedModels(problem.trace, missing, {}, Settings(particles), start)
    scales = Scales.of(problem.trace, e.y, e.y, e.u, e.steps)
    (c,), _ = offers(problem.trace, scales, ["quadratic drag"])
    fitter = augmented.fitter([c])
    own = {**VALUES, c.strength: DRAG}
    names = [s.data[1] for s in fitter.problem.trace.parameter_symbols]
    return fitter, np.array([own[n] for n in names]), problem.experiments


def test_the_height_puts_a_wide_law_on_the_scale_of_the_flat_one():
    """Of a linear Gaussian model: p(y) is E exp(-(x_1 - m)^2 / 2s^2) times the flat one's."""
    problem = pose(driven(), recorded(12, 0.0))
    e, theta = problem.experiments[0], np.array([0.2, 0.1, 0.9, 0.5])
    flat = kalman_model(problem.trace)
    first = flat.smooth(e, theta)
    m, s = 1.0, 2.0
    start = ProperInitialLaw({"v": (np.array(m), np.array(s))})
    other = (
        kalman_model(start.applied_to(problem.trace)).log_likelihood([e], theta)
        + start.log_correction
    )
    at, p = first.mean[0, 0], first.covariance[0, 0, 0]
    lost = -0.5 * np.log1p(p / s**2) - 0.5 * (at - m) ** 2 / (s**2 + p)
    assert other - flat.log_likelihood([e], theta) == pytest.approx(lost, abs=1e-9)


@pytest.mark.slow
def test_the_likelihood_with_an_effect_is_that_of_a_flat_start():
    data = recorded(15)
    fitter, theta, experiments = dragged(data)
    assert not fitter.exact
    exact, mean = on_a_grid(data, DRAG)
    (spread,) = (s for _, s in fitter.initial_law.laws.values())
    near = 0.5 * ((mean - fitter.initial_law.laws["v"][0]) ** 2 + 0.1**2) / spread**2
    value, error = fitter.log_likelihood(experiments, theta, seed_sequence(1))
    assert abs(value - exact) < 4.0 * error + near
    # The held-out rows have it too, the first among them.
    fit = fitter.restored(experiments, {
        "theta": theta, "z": np.zeros(5), "log_likelihood": 0.0, "error": 0.0,
        "information": np.eye(5), "distance": 0.0, "converged": True,
        "at_bound": np.zeros(5),
    })  # fmt: skip
    told = predict(fitter, fit, experiments, [np.ones(15, bool)], seed_sequence(2))
    total = told.log_density.sum(axis=1)
    assert abs(total.mean() - exact) < 4.0 * total.std() / np.sqrt(len(total)) + near + 0.01


@pytest.mark.slow
def test_what_is_simulated_starts_where_the_data_do():
    data = recorded(15)
    fitter, theta, experiments = dragged(data)
    exact = on_a_grid(data, DRAG)[1]
    found = InitialStateMeans(fitter.smoother)(experiments[0], theta)
    assert abs(found[0] - exact) < 4.0 * VALUES["r"] / np.sqrt(100)
    drawn = fitter.simulator.observations(
        experiments[0], theta, random_state(seed_sequence(3)), 400
    )
    assert drawn[0, 0].mean() == pytest.approx(found[0], abs=4.0 * VALUES["r"] / 20.0)
    assert drawn[0, 0].std() == pytest.approx(VALUES["r"], rel=4.0 / np.sqrt(800))


def test_a_start_is_given_only_where_a_flat_one_cannot_be():
    flat, other = (pose(m, recorded(15)).trace for m in (driven(), driven(ssm.Normal(0, sd=2))))
    assert not needs_proper_initial_law(flat)
    assert proper_initial_law(other, [np.zeros(1)], [np.ones((4, 1))]) is None
    start = proper_initial_law(
        flat, [np.array([100.0]), np.array([104.0])], [np.full((4, 1), 112.0)] * 2
    )
    mean, spread = start.laws["v"]
    assert (mean, spread) == (102.0, 50.0)  # five times as far as the states are from the mean
    assert str(start) == "v ~ Normal(102, sd=50)"
    problem = pose(driven(), recorded(15))
    augmented = AugmentedModels(problem.trace, problem.program.missing, {}, Settings(), start)
    scales = Scales.of(problem.trace, np.ones((9, 1)), np.ones((9, 1)), np.ones((9, 1)), 15)
    (load,), _ = offers(problem.trace, scales, ["constant load"])
    fitter = augmented.fitter([load])
    assert fitter.exact
    assert fitter.initial_law is None


@pytest.mark.slow
def test_drag_is_refitted_though_the_model_starts_flat():
    """And the model that is handed back can be used, with the likelihood of the refit."""
    data = recorded(150)
    problem = pose(driven(), data)
    (e,), missing, settings = problem.experiments, problem.program.missing, Settings(200)
    base = AugmentedModels(problem.trace, missing, {}, settings).base_fitter
    fit = base.fit([e], seed_sequence(1), {})
    states = base.states(e, fit.theta, random_state(seed_sequence(2)))
    start = proper_initial_law(problem.trace, [states[0].mean(axis=0)], [states])
    augmented = AugmentedModels(problem.trace, missing, {}, settings, start)
    scales = Scales.of(problem.trace, states, e.y, e.u, e.steps)
    design = ScreenDesign(problem.trace, scales, missing, (), settings, ["quadratic drag"])
    kept = Checkpoint(None, {})
    screen = run_screen(design, [e], fit.theta, 60, seed_sequence(3), kept)
    (found,), failed = refit_all(
        augmented, fit, screen, [[0]], [e], seed_sequence(4), kept, "refitting"
    )
    assert not failed
    found = replace(found, fit=found.fitter.with_information(found.fit, seed_sequence(5)))
    error = found.errors["quadratic_drag_v"]
    assert abs(found.strengths[0] - DRAG) < 4.0 * error < 2.0 * DRAG
    assert found.gain > 10.0
    notes = []
    model, text = _written(
        SimpleNamespace(trace=problem.trace, names=["quadratic drag"]), found, notes
    )
    assert not notes
    assert "ssm.Flat()" not in text.split("@model.initial")[1]
    given = {n: v for n, v in found.fit.by_component.items() if not n.startswith("size")}
    told = ssm.log_likelihood(model, data, given, particles=2000, seed=1)[0] + start.log_correction
    assert told == pytest.approx(found.fit.log_likelihood, abs=4.0 * (found.fit.error + 0.1))


@pytest.mark.parametrize("places", [(100.0, -100.0), (100.0, *[0.0] * 19)])
def test_starts_that_lie_apart_lose_nothing(places):
    """Where states come to rest, these say little of where experiments begin."""
    rng = np.random.default_rng(seed_of("apart", len(places)))
    data = []
    for first in places:
        x, u = np.full(200, first), np.zeros(200)
        for t in range(1, 200):
            x[t] = 0.9 * x[t - 1] + 0.2 * rng.standard_normal()
        data.append({"y": x + 0.1 * rng.standard_normal(200), "u": u})
    problem = pose(driven(), data)
    flat, theta = kalman_model(problem.trace), np.array([0.2, 0.1, 0.9, 0.5])
    es = problem.experiments
    start = proper_initial_law(problem.trace, [e.y[0] for e in es], [e.y for e in es])
    other = kalman_model(start.applied_to(problem.trace)).log_likelihood(es, theta)
    lost = other + len(es) * start.log_correction - flat.log_likelihood(es, theta)
    assert -0.03 < lost < 0.0
