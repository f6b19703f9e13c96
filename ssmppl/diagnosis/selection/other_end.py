"""Lags and delays at the other end: of the inputs for those of a sensor, and the other way round.

Of what a linear system answers late, no data tell whether its input or its sensor was late, if
there is one of each. But a fit without either has taken on what it could of it, and there the score
and the likelihood with the input moved may see one end and not the other. So beside the best lag or
delay that was refitted, those of the other end are, from its parameters and with its length.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ssmppl.data import Experiment
from ssmppl.diagnosis.effects.candidate import Candidate
from ssmppl.diagnosis.effects.catalogue_input import actuator_lag, input_delay
from ssmppl.diagnosis.effects.catalogue_sensor import sensor_delay, sensor_lag
from ssmppl.diagnosis.fitting.fit import Fitter
from ssmppl.diagnosis.screening.screen import Screen
from ssmppl.diagnosis.selection.input_delays import START, best_delay, is_input_delay
from ssmppl.diagnosis.selection.refit import Begin, Refit
from ssmppl.inference.preparation.space import space_of

INPUTS, SENSORS = (actuator_lag, input_delay), (sensor_lag, sensor_delay)
MOST = 4  # that are refitted


def at_the_other_end(
    fitter: Fitter, screen: Screen, refits: Sequence[Refit], train: Sequence[Experiment],
    worth: float,
) -> list[tuple[int, Begin]]:  # fmt: skip
    """The columns of the lags and delays at the other end than the best one's, and where their
    refits begin; those that were refitted and gained as much are left out.

    fitter : of the model without effects. worth : nats that the best one has to gain.
    """
    late = [r for r in refits if _end_of(r.candidates[0]) and r.score >= worth]
    if not late:
        return []
    best = max(late, key=lambda r: r.score)
    others = INPUTS if _end_of(best.candidates[0]) is SENSORS else SENSORS
    done = {int(screen.groups[r.index[0]]) for r in refits if r.score >= best.score}
    parameters = {
        n: v for n, v in best.fit.by_parameter.items() if n in fitter.problem.trace.parameters
    }
    theta, out = space_of(fitter.problem, fitter.fixed, parameters).theta, []
    for k in screen.family.leaders:
        c = screen.design.candidates[k]
        if c.effect not in others or int(screen.groups[k]) in done or screen.efficient.status[k]:
            continue
        shape = _shape(c, _rows(best))
        if is_input_delay(c):
            moved = best_delay(fitter, theta, c, train)
            if moved.gain > 0.0:
                shape = dict(moved.candidate.shape)
        out.append((k, Begin(START, shape, parameters)))
    return out[:MOST]


def _end_of(c: Candidate) -> tuple[object, ...]:
    """INPUTS or SENSORS; nothing of another effect."""
    return next((end for end in (INPUTS, SENSORS) if c.effect in end), ())


def _rows(r: Refit) -> float:
    """How late it makes the model, in rows."""
    shape = dict(r.candidates[0].shape)
    return float(r.strengths[0]) * float(shape.get("k", shape.get("delay", 0.0)))


def _shape(c: Candidate, rows: float) -> Mapping[str, float]:
    """The length of a lag or a delay, near so many rows."""
    if "delay" in c.effect.shapes:
        return {"delay": max(1, round(rows))}
    low, high = c.effect.shapes["k"].between or (rows, rows)
    return {"k": float(np.clip(rows, 1.1 * low, 0.9 * high))}
