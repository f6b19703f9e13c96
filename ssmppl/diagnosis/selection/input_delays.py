"""How long the delay of an input is: by the likelihood of the model with its inputs moved.

The screen tries a few lengths, by their scores at a strength of zero; of a smooth input these are
almost the same, and a short one of twice the strength stands for one of twice the length. With the
whole delay the model is what it is without, on inputs that come later: so the likelihood of every
length is to be had without a fit, and the refit begins with the best.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ssmppl.data import Experiment
from ssmppl.diagnosis.effects.candidate import Candidate
from ssmppl.diagnosis.effects.catalogue_input import input_delay
from ssmppl.diagnosis.fitting.fit import Fitter
from ssmppl.diagnosis.screening.screen import Screen

MOST, SHARE = 16, 0.1  # rows; of the longest record
HOPELESS = 20.0  # nats behind the best, beyond which longer ones are not tried
START = 0.9  # the strength from which the refit begins
PRICE = 1.0  # nats that a length which the screen has not tried has to gain


@dataclass(frozen=True)
class Delayed:
    """A candidate with the best length, and what the model gains with its inputs moved so far."""

    candidate: Candidate
    gain: float


def is_input_delay(c: Candidate) -> bool:
    """Whether it is a delay of an input, whole where its strength is 1."""
    return c.effect is input_delay and not c.held


def best_delay(
    fitter: Fitter, theta: np.ndarray, c: Candidate, train: Sequence[Experiment]
) -> Delayed:
    """The delay `c` with the best of all lengths, in the model of a fitter at theta (P,). As it is,
    with a gain of 0, where none is better than no delay, or where particles estimate the
    likelihood: the best of many estimates would be so by their error."""
    if not fitter.smooth:
        return Delayed(c, 0.0)
    columns = {repr(s): k for k, s in enumerate(fitter.problem.trace.input_symbols)}
    moved = [columns[label] for label in (c.equation, *c.alike)]
    none = best = fitter.value(train, theta)
    out = Delayed(c, 0.0)
    for rows in range(1, min(MOST, int(SHARE * max(e.steps for e in train))) + 1):
        here = -np.inf
        for before in c.effect.shapes["before"].values:
            value = fitter.value([_later(e, moved, rows, before) for e in train], theta)
            if value > best:
                shaped = c.with_shape(delay=rows, before=before)
                best, out = value, Delayed(shaped, value - none)
            here = max(here, value)
        if not here > best - HOPELESS:
            break
    return out


def promising_delays(
    fitter: Fitter, theta: np.ndarray, screen: Screen, train: Sequence[Experiment], worth: float
) -> list[int]:
    """A column of each delay of an input that gains so many nats by moving inputs alone, the best
    first."""
    found: dict[int, float] = {}
    for k, c in enumerate(screen.design.candidates):
        if is_input_delay(c) and not screen.efficient.status[k]:
            if int(screen.groups[k]) not in {int(screen.groups[j]) for j in found}:
                found[k] = best_delay(fitter, theta, c, train).gain
    return sorted((k for k, gain in found.items() if gain >= worth), key=lambda k: -found[k])


def _later(e: Experiment, columns: Sequence[int], rows: int, before: float) -> Experiment:
    """The experiment with these inputs so many rows later; before, so many times their first."""
    u = e.u.copy()
    for k in columns:
        u[:, k] = np.concatenate([np.repeat(before * e.u[:1, k], rows), e.u[:, k]])[: e.steps]
    return replace(e, u=u)
