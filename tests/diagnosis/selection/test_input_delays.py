"""Lengths of an input's delay, by moving the input: against fits with it, and by their rules."""

from types import SimpleNamespace

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.diagnosis.selection import input_delays
from ssmppl.diagnosis.selection.input_delays import (
    best_delay,
    is_input_delay,
    promising_delays,
)
from ssmppl.inference.preparation.space import space_of
from tests.diagnosis.selection.test_shaping import ROWS, candidate, setting
from tests.models import gaps as models

INPUT = models.inputs_of("oscillator", ROWS)["u"]


def late(rows):
    return setting(np.r_[[INPUT[0]] * rows, INPUT[: ROWS - rows]] - INPUT)


@pytest.mark.parametrize("rows", [3, 7])
def test_the_length_is_found_and_its_gain_is_that_of_the_delay_as_an_effect(rows):
    augmented, experiments, base = late(rows)
    c = candidate("input delay", equation="u")
    found = best_delay(augmented.base_fitter, base.theta, c, experiments)
    assert dict(found.candidate.shape)["delay"] == rows
    fitter = augmented.fitter((found.candidate,))
    start = base.by_parameter | {c.strength: np.asarray(1.0)}
    theta = space_of(fitter.problem, fitter.fixed, start).theta
    gain = fitter.value(experiments, theta) - augmented.base_fitter.value(experiments, base.theta)
    assert found.gain == pytest.approx(gain, abs=1e-6)


def test_an_input_may_have_been_off_before_the_record():
    """Then the first rows have none of it, and the effect with that start fits them."""
    rows = 4
    augmented, experiments, base = setting(np.r_[np.zeros(rows), INPUT[: ROWS - rows]] - INPUT)
    c = candidate("input delay", equation="u")
    found = best_delay(augmented.base_fitter, base.theta, c, experiments)
    assert dict(found.candidate.shape) == {"delay": rows, "before": 0}
    values = []
    for before in (0, 1):
        fitter = augmented.fitter((c.with_shape(delay=rows, before=before),))
        start = base.by_parameter | {c.strength: np.asarray(1.0)}
        values.append(
            fitter.value(experiments, space_of(fitter.problem, fitter.fixed, start).theta)
        )
    value = augmented.base_fitter.value(experiments, base.theta)
    assert found.gain == pytest.approx(values[0] - value, abs=1e-6)
    assert values[0] > values[1] + 1.0


def test_what_is_not_late_stays_as_the_screen_has_it():
    augmented, experiments, base = late(0)
    c = candidate("input delay", equation="u").with_shape(delay=2)
    found = best_delay(augmented.base_fitter, base.theta, c, experiments)
    assert found.gain == 0.0
    assert found.candidate == c


def test_estimates_by_particles_choose_no_length(monkeypatch):
    augmented, experiments, base = late(3)
    c = candidate("input delay", equation="u").with_shape(delay=2)
    monkeypatch.setattr(type(augmented.base_fitter), "smooth", False)
    assert best_delay(augmented.base_fitter, base.theta, c, experiments).candidate == c


def test_no_length_beyond_a_share_of_the_record_is_tried(monkeypatch):
    augmented, experiments, base = late(7)
    c = candidate("input delay", equation="u")
    monkeypatch.setattr(input_delays, "SHARE", 5.0 / ROWS)
    found = best_delay(augmented.base_fitter, base.theta, c, experiments)
    assert dict(found.candidate.shape)["delay"] == 5


@pytest.mark.slow
def test_of_several_inputs_each_and_all_together_are_looked_at():
    """Two states, each with an input; the second comes four rows late."""
    model = ssm.Model("two", inputs=("a", "b"))

    @model.prior
    def prior():
        return {"s": ssm.HalfNormal(sd=1)}

    @model.initial
    def initial():
        return {"x": ssm.Normal(0, sd=0.1), "z": ssm.Normal(0, sd=0.1)}

    @model.transition
    def transition(x, z, a, b, s):
        return {"x": ssm.Normal(0.8 * x + a, sd=s), "z": ssm.Normal(0.7 * z + b, sd=s)}

    @model.observation
    def observation(x, z):
        return {"y": ssm.Normal(x, sd=0.1), "w": ssm.Normal(z, sd=0.1)}

    rng = np.random.default_rng(4)
    u = {n: np.convolve(rng.standard_normal(ROWS + 5), np.ones(6) / 3.0, "valid") for n in "ab"}
    late_b = np.r_[[u["b"][0]] * 4, u["b"][:-4]]
    made = ssm.simulate(model, {"s": 0.2}, steps=ROWS, inputs={"a": u["a"], "b": late_b}, seed=2)
    data = {n: made[n].values[0] for n in ("y", "w")} | u
    report = ssm.diagnose(model, data, effects=["input delay"], mode="full", seed=1, progress=False)
    first = report.causes.iloc[0]
    assert (first["effect"], first["equation"]) == ("input delay", "b")
    assert "delay = 4" in first["form"]
    assert first["estimate"] == pytest.approx(1.0, abs=4.0 * first["se"])


def test_promising_ones_are_one_for_each_input_and_gain_enough(monkeypatch):
    c = candidate("input delay", equation="u")
    assert is_input_delay(c)
    friction = candidate("coulomb friction")
    assert not is_input_delay(friction)
    gains = {"u": 9.0, "a": 40.0, "b": 3.0}
    columns = [c, c.with_shape(delay=2), friction]
    columns += [SimpleNamespace(effect=c.effect, held=False, equation=n) for n in ("a", "b")]
    screen = SimpleNamespace(
        design=SimpleNamespace(candidates=columns), groups=np.array([0, 0, 1, 2, 3]),
        efficient=SimpleNamespace(status=[""] * 5),
    )  # fmt: skip
    monkeypatch.setattr(
        input_delays, "best_delay",
        lambda f, theta, c, train: SimpleNamespace(gain=gains[c.equation]),
    )  # fmt: skip
    assert promising_delays(None, None, screen, (), 5.0) == [3, 0]
