"""Shapes as parameters of the refits: between which bounds, what they are worth, where they end."""

from dataclasses import replace

import numpy as np
import pytest

from ssmppl.diagnosis.fitting.augmented_models import AugmentedModels, range_fraction
from ssmppl.diagnosis.fitting.fit import FROM_START
from ssmppl.diagnosis.model.candidates import offers
from ssmppl.diagnosis.model.smoothing import Settings
from ssmppl.diagnosis.run.checkpoint import Checkpoint
from ssmppl.diagnosis.selection import shapes
from ssmppl.diagnosis.selection.refit import Refit
from ssmppl.diagnosis.selection.shapes import PRICE, shape_bounds, shaped_all
from ssmppl.inference.run.problem import missing_of, pose
from ssmppl.inference.run.seeds import seed_sequence
from tests.diagnosis.harness import scales, traced
from tests.models import gaps as models

ROWS = 200


def candidate(name, form="", model="oscillator", equation="v"):
    t = traced("gap", model)
    found, _ = offers(t, scales(t, ROWS), [name])
    return next(c for c in found if c.form == form and c.equation == equation)


def bounds(c, model="oscillator"):
    return shape_bounds(c, scales(traced("gap", model), ROWS))


def test_bounds_are_what_the_effect_declares_in_the_units_of_its_variable():
    scale = scales(traced("gap", "oscillator"), ROWS).scale
    assert bounds(candidate("missing input", "ar1")) == {"memory": (0.3, 0.995)}
    stop = bounds(candidate("hard stop", "upper"))
    expected = [scale["x"].quantile(level) for level in (0.5, 0.99)]
    assert stop["h"] == pytest.approx(expected, rel=1e-3)
    friction = bounds(candidate("coulomb friction"))
    assert friction["v0"] == pytest.approx([0.025 * scale["v"].sd, scale["v"].sd], rel=1e-3)


def test_what_has_no_bounds_stays():
    for name, form, equation in (
        ("input delay", "", "u"), ("level break", "", "v"), ("quadratic drag", "", "v"),
        ("heteroscedastic noise", "with its own size", "v"),
    ):  # fmt: skip
        assert bounds(candidate(name, form, equation=equation)) == {}
    beyond = candidate("hard stop", "upper").with_shape(h=1e3)
    assert bounds(beyond) == {}


def test_a_period_moves_within_the_resolution_of_the_record():
    c = candidate("periodic forcing").with_shape(period=40.0, phase=1.0)
    low, high = bounds(c)["period"]
    assert 1.0 / low == pytest.approx(1.0 / 40.0 + 1.0 / ROWS)
    assert 1.0 / high == pytest.approx(1.0 / 40.0 - 1.0 / ROWS)
    assert bounds(c)["phase"] == (1.0 - np.pi, 1.0 + np.pi)
    longest = bounds(c.with_shape(period=float(ROWS)))["period"][1]
    assert longest == 2.0 * ROWS  # half a turn in the record, and not infinity


# -- fitted, the likelihoods exact
def setting(extra):
    """An oscillator with `extra` (T,) added to its force: its data, fit and augmented models."""
    inputs = models.inputs_of("oscillator", ROWS)
    force = {"u": inputs["u"] + extra}
    model, theta = models.build("oscillator"), models.THETA["oscillator"]
    drawn = models.ssm.simulate(model, theta, steps=ROWS, inputs=force, seed=5)
    problem = pose(model, inputs | {"y": drawn["y"].values[0]})
    augmented = AugmentedModels(problem.trace, missing_of(problem.experiments), {}, Settings())
    return augmented, problem.experiments, augmented.base_fitter.fit(
        problem.experiments, seed_sequence(1), {}
    )  # fmt: skip


def refitted(augmented, base, c, experiments, strength):
    fitter = augmented.fitter((c,))
    start = base.by_parameter | {c.strength: np.asarray(strength)}
    fit = fitter.fit(experiments, seed_sequence(2), start, FROM_START)
    return Refit((0,), (c,), fitter, fit, fit.log_likelihood - base.log_likelihood)


@pytest.fixture(scope="module")
def forced():
    """A forcing of period 33.3, found at 36: an eighth of a turn in each 60 rows off."""
    t = np.arange(1.0, ROWS + 1.0)
    augmented, experiments, base = setting(3.0 * np.cos(2 * np.pi * t / 33.3 - 0.7))
    c = candidate("periodic forcing").with_shape(period=36.0, phase=0.2)
    return augmented, experiments, base, refitted(augmented, base, c, experiments, 0.1)


def shapes_of(forced, refits=None):
    augmented, experiments, base, found = forced
    where = scales(augmented.trace, ROWS)
    kept = Checkpoint(None, {})
    return shaped_all(augmented, base, where, refits or [found], experiments, seed_sequence(3),
                      kept, "shapes")  # fmt: skip


def test_a_share_of_the_way_between_bounds_is_the_shape(forced):
    """The code with free shapes, held at one place, has the likelihood of that shape's own."""
    augmented, experiments, _, found = forced
    (c,) = found.candidates
    limits = {f"{c.strength}_{n}": b for n, b in bounds(c).items()}
    free = augmented.with_free_shapes((c,), limits)
    values = found.fit.by_component
    for n, (low, high) in limits.items():
        name = n.removeprefix(f"{c.strength}_")
        values |= {range_fraction(n): (dict(c.shape)[name] - low) / (high - low)}
        values |= {f"{n}_from": low, f"{n}_range": high - low}
    theta = np.array([values[repr(s)] for s in free.problem.trace.parameter_symbols])
    assert free.kalman.log_likelihood(experiments, theta) == pytest.approx(
        found.fit.log_likelihood, abs=1e-8
    )


def test_the_period_ends_where_the_likelihood_is_highest(forced):
    augmented, experiments, base, found = forced
    (new,) = shapes_of(forced)
    (c,) = new.candidates
    shape = dict(c.shape)
    assert shape["period"] == pytest.approx(33.3, abs=0.5)
    assert new.gain > found.gain + 10.0
    assert new.cost == found.cost + 2.0 * PRICE
    assert new.fit.log_likelihood == pytest.approx(
        new.fitter.kalman.log_likelihood(experiments, new.fit.theta), abs=1e-8
    )
    for change in (-0.3, 0.3):  # all else fitted again: a top in the period too
        other = c.with_shape(period=shape["period"] + change)
        again = refitted(augmented, base, other, experiments, 0.1)
        assert again.fit.log_likelihood < new.fit.log_likelihood
    measured = new.fitter.with_information(new.fit, seed_sequence(4))
    assert measured.information.shape == (len(new.fit.z),) * 2
    assert np.all(np.linalg.eigvalsh(measured.information) > 0.0)


def test_a_length_may_move_where_the_other_shapes_cannot_be_estimated(monkeypatch):
    """Then these stay what they were, and cost nothing."""
    u = models.inputs_of("oscillator", ROWS)["u"]
    augmented, experiments, base = setting(np.r_[[u[0]] * 4, u[:-4]] - u)
    late, friction = candidate("input delay", equation="u"), candidate("coulomb friction")
    pair = late.with_shape(delay=2), friction
    fitter = augmented.fitter(pair)
    start = base.by_parameter | {late.strength: np.asarray(1.0), friction.strength: np.asarray(0.1)}
    fit = fitter.fit(experiments, seed_sequence(2), start, FROM_START)
    found = Refit((0, 1), pair, fitter, fit, fit.log_likelihood - base.log_likelihood)
    monkeypatch.setattr(shapes, "_shaped", lambda *_: {})
    (new,) = shapes_of((augmented, experiments, base, found))
    assert dict(new.candidates[0].shape) == {"delay": 4, "before": 1}
    assert new.candidates[1] == friction
    assert new.cost == found.cost + PRICE
    assert new.gain > found.gain + 1.0


@pytest.mark.parametrize(("short", "moves"), [(1.5, False), (2.5, True)])
def test_two_shapes_have_to_gain_two_nats(forced, short, moves):
    """A refit that is said to lie so many nats below its top."""
    found = forced[-1]
    (top,) = shapes_of(forced)
    low = replace(found, gain=top.gain - short)
    (new,) = shapes_of(forced, [low])
    assert (new is not low) == moves


def test_the_best_first_and_those_far_behind_as_they_were(forced):
    found = forced[-1]
    ahead, behind = replace(found, gain=found.gain + 1.0, index=(1,)), replace(found, index=(2,))
    far = replace(behind, gain=found.gain - 100.0, index=(3,))
    new = shapes_of(forced, [ahead, behind, far])
    assert [r.index for r in new][-1] == (3,)
    assert new[-1] is far
    assert [r.penalised_gain for r in new] == sorted((r.penalised_gain for r in new), reverse=True)


def test_an_estimate_that_runs_to_its_bound_is_none(forced, monkeypatch):
    """The period that is true lies beyond the bound: nothing is kept of the way towards it."""
    found = forced[-1]
    (c,) = found.candidates
    own = bounds(c)
    for low, kept in ((34.5, True), (31.0, False)):
        limits = own | {"period": (low, 37.5)}
        monkeypatch.setattr(shapes, "shape_bounds", lambda *_, limits=limits: limits)
        (new,) = shapes_of(forced)
        assert (new is found) == kept


# -- whole numbers
@pytest.fixture(scope="module")
def delayed():
    """An input that comes three rows late."""
    u = models.inputs_of("oscillator", ROWS)["u"]
    return setting(np.r_[[u[0]] * 3, u[:-3]] - u)


@pytest.mark.parametrize(("rows", "price"), [(1, PRICE), (5, PRICE), (3, 0.0)])
def test_a_delay_is_counted_row_by_row(delayed, rows, price):
    augmented, experiments, base = delayed
    c = candidate("input delay", equation="u").with_shape(delay=rows)
    found = refitted(augmented, base, c, experiments, 0.5)
    (new,) = shapes_of((augmented, experiments, base, found))
    assert dict(new.candidates[0].shape)["delay"] == 3
    assert new.cost - found.cost == price
    assert new.strengths == pytest.approx([1.0], abs=0.1)
    assert new.fit.log_likelihood == pytest.approx(
        new.fitter.kalman.log_likelihood(experiments, new.fit.theta), abs=1e-8
    )


def test_no_delay_is_longer_than_four_times_what_the_screen_tries(delayed, monkeypatch):
    augmented, experiments, base = delayed
    c = candidate("input delay", equation="u").with_shape(delay=2)
    found = refitted(augmented, base, c, experiments, 0.5)
    monkeypatch.setattr(shapes, "FURTHEST", 0.5)  # of four rows
    (new,) = shapes_of((augmented, experiments, base, found))
    assert dict(new.candidates[0].shape)["delay"] == 2


def test_a_width_does_not_shrink_to_nothing():
    t = traced("gap", "oscillator")
    c = candidate("dead zone", equation="u")
    low, high = shape_bounds(c, scales(t, ROWS))["c"]
    least = min(dict(o.shape)["c"] for o in offers(t, scales(t, ROWS), ["dead zone"])[0])
    assert low >= 0.5 * least
    assert high > dict(c.shape)["c"]
