"""Lags and delays at the other end, beside the best one: which, and where their refits begin."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from ssmppl.diagnosis.selection import other_end
from ssmppl.diagnosis.selection import refit as module
from ssmppl.diagnosis.selection.input_delays import START, best_delay
from ssmppl.diagnosis.selection.other_end import at_the_other_end
from ssmppl.diagnosis.selection.refit import Begin, Refit, refit, start_of
from ssmppl.errors import SamplingError
from ssmppl.inference.preparation.space import space_of
from tests.diagnosis.selection.test_input_delays import late
from tests.diagnosis.selection.test_shaping import candidate, refitted

ROWS = 7
LAG, DELAY = candidate("actuator lag", equation="u"), candidate("input delay", equation="u")
SENSOR_LAG = candidate("sensor lag", equation="y")
SENSOR_DELAY = candidate("sensor delay", equation="y").with_shape(delay=ROWS)
ALL = [SENSOR_LAG, SENSOR_DELAY, LAG, DELAY, candidate("coulomb friction")]


def screen(status=("", "", "", "", "")):
    return SimpleNamespace(
        design=SimpleNamespace(candidates=ALL), groups=np.arange(len(ALL)),
        family=SimpleNamespace(leaders=[4, 0, 1, 2, 3]),
        efficient=SimpleNamespace(status=list(status)),
    )  # fmt: skip


@pytest.fixture(scope="module")
def input_late():
    """An oscillator whose input comes `ROWS` rows late, refitted with a delay of its sensor."""
    augmented, experiments, base = late(ROWS)
    made = refitted(augmented, base, SENSOR_DELAY, experiments, 0.9)
    return augmented, experiments, base, replace(made, index=(1,))


def test_delays_of_the_inputs_beside_that_of_a_sensor_begin_at_its_parameters(input_late):
    augmented, experiments, base, seen = input_late
    found = at_the_other_end(augmented.base_fitter, screen(), [seen], experiments, 1.0)
    assert [ALL[k] for k, _ in found] == [LAG, DELAY]
    lag, delay = (begin for _, begin in found)
    own = base.by_parameter.keys()
    theta = space_of(
        base.problem, {}, {n: v for n, v in seen.fit.by_parameter.items() if n in own}
    ).theta
    moved = best_delay(augmented.base_fitter, theta, DELAY, experiments)
    assert moved.gain > 5.0  # the base fit's own parameters have taken the delay on
    assert delay.shape == dict(moved.candidate.shape)
    assert lag.shape["k"] == pytest.approx(ROWS * seen.strengths[0], rel=1e-6)
    for begin in (lag, delay):
        assert set(begin.parameters) == set(base.by_parameter)
        for name, value in begin.parameters.items():
            assert value == pytest.approx(seen.fit.by_parameter[name])


def test_the_sensors_beside_a_lag_of_an_input():
    augmented, experiments, base = late(0)
    made = SimpleNamespace(
        by_parameter=base.by_parameter | {LAG.strength: np.asarray(1.5)},
        by_component={LAG.strength: 1.5},
    )
    slow = Refit((2,), (LAG.with_shape(k=4.0),), None, made, 50.0)
    found = at_the_other_end(augmented.base_fitter, screen(), [slow], experiments, 5.0)
    assert [ALL[k] for k, _ in found] == [SENSOR_LAG, SENSOR_DELAY]
    assert [dict(b.shape) for _, b in found] == [{"k": 6.0}, {"delay": 6}]
    assert LAG.strength not in found[0][1].parameters


def test_none_without_one_that_gains_enough_and_none_that_did_as_well(input_late, monkeypatch):
    augmented, experiments, _, seen = input_late

    def told(refits, worth=1.0, **options):
        found = at_the_other_end(
            augmented.base_fitter, screen(**options), refits, experiments, worth
        )
        return [k for k, _ in found]

    assert told([]) == []
    assert told([seen], worth=seen.score + 1.0) == []
    friction = Refit((4,), (ALL[4],), None, seen.fit, 1e3)
    assert told([friction]) == []
    equal = Refit((3,), (DELAY,), None, seen.fit, seen.gain)
    weaker = Refit((3,), (DELAY,), None, seen.fit, seen.gain - 0.5)
    assert told([seen, equal]) == [2]
    assert told([seen, weaker]) == [2, 3]
    assert told([seen], status=("", "", "constant", "", "")) == [3]
    monkeypatch.setattr(other_end, "MOST", 1)
    assert told([seen]) == [2]


def test_a_delay_of_another_length_than_the_screens_starts_at_a_strength_of_its_own(monkeypatch):
    """The score that was of another length says nothing of it."""
    monkeypatch.setattr(module, "start_at", lambda *_: {DELAY.strength: 0.2})
    monkeypatch.setattr(module, "_information", lambda *_: None)
    own = start_of(None, screen(), (3,), (), (DELAY,))
    other = start_of(None, screen(), (3,), (), (DELAY.with_shape(delay=ROWS + 2),))
    assert own.values[DELAY.strength] == 0.2
    assert other.values[DELAY.strength] == START


def test_a_refit_begins_at_the_parameters_that_are_given(input_late, monkeypatch):
    """Those of the fit with the sensor's delay, where the model's own have taken the delay on."""
    augmented, experiments, base, seen = input_late
    fitter, begun = augmented.fitter((DELAY,)), []

    def stop(experiments, seed, start, *_, **__):
        begun.append(start)
        raise SamplingError("enough", fix="none")

    monkeypatch.setattr(fitter, "fit", stop)
    only = SimpleNamespace(base_fitter=augmented.base_fitter, fitter=lambda candidates: fitter)
    names = list(base.by_parameter)
    given = {n: 1.01 * seen.fit.by_parameter[n] for n in names}
    start = start_of(base, screen(), (3,), experiments, (DELAY,), begin=Begin(0.9, {}, given))
    refit(only, base, (3,), (DELAY,), experiments, None, start)
    assert begun[0] == given | {DELAY.strength: 0.9}
