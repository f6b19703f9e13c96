"""Mechanisms that the screen overlooks, in an equation whose misfit is described, not explained.

A score looks at a strength of zero, with the parameters as they are. Where the noise has grown and
a parameter has taken on part of the effect, that tells little: a drag that the linear damping
stands in for, or a stop, beyond which the simulated sets go and the data never do. So where what
only describes a misfit gains most, the mechanisms of the same equation are fitted too, each from
the best of a few strengths and shapes: those of the screen, and others all over the range of each,
as a stop that is touched twice lies further out than the screen looks. The range of each sensor is
looked at whatever leads, but for a model that calls a simulator.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ssmppl.analysis.structure import simulators
from ssmppl.data import Experiment
from ssmppl.diagnosis.effects.candidate import Candidate
from ssmppl.diagnosis.effects.catalogue_sensor import (
    both_clippings,
    lower_clipping,
    saturating_gain,
    upper_clipping,
)
from ssmppl.diagnosis.effects.effect import MECHANISM
from ssmppl.diagnosis.fitting.augmented_models import AugmentedModels
from ssmppl.diagnosis.fitting.fit import Fit
from ssmppl.diagnosis.run.checkpoint import Numbers
from ssmppl.diagnosis.screening.screen import Screen
from ssmppl.diagnosis.screening.statistics import typical_squares
from ssmppl.diagnosis.selection.refit import Refit, only_by_particles, preferred
from ssmppl.diagnosis.selection.shapes import shape_bounds
from ssmppl.errors import SSMError
from ssmppl.expressions.expr import symbols_of
from ssmppl.inference.preparation.space import space_of
from ssmppl.language.model.trace import Trace

MOST = 20  # mechanisms whose likelihood is looked at
FITTED, FITTED_CALLED = 8, 5  # of these that are fitted; of a model that calls a simulator
AGAINST = 2.0  # standard deviations by which a score may have the sign that is not allowed
GRID = (1.0, 4.0, 16.0, 64.0)  # strengths, in standard errors by the data's own information
ELSEWHERE = 7  # values of a shape between its bounds
PRICE = 1.0  # nats that a shape elsewhere has to gain
# Further ones, where it still rises: a threshold further out has larger standard errors.
BEYOND = (256.0, 1024.0, 4096.0, 16384.0)
# A filter follows what a sensor shows, and so never goes beyond the end of its range; and what the
# readings bend is, at a strength of zero, often taken up by the parameters.
RANGES = (upper_clipping, lower_clipping, both_clippings, saturating_gain)
BENT = (0.05, 0.15, 0.45, 0.9)  # strengths of these, of which 1 is the whole
HOPELESS = 20.0  # nats below the model as it is, beyond which larger strengths are not tried


def overlooked(screen: Screen, refits: Sequence[Refit], worth: float) -> list[list[int]]:
    """The shapes of each mechanism, by their columns, that acts in the equation of the refit that
    would be named, where that is none, and of what limits the range of a sensor; the highest in the
    screen first. Of those that were refitted the ones that have shapes to estimate.

    worth : nats that the best one has to gain.
    """
    if not refits or (best := preferred(refits, worth)[0]).penalised_gain < worth:
        return []
    c, done = best.candidates[0], {int(screen.groups[r.index[0]]) for r in refits}
    known, trace = c.effect.cause == MECHANISM, screen.design.trace
    if known and simulators(trace):  # each likelihood takes long
        return []
    places, out = set() if known else _equations(c, trace), []
    for head in screen.family.leaders:
        group, c = int(screen.groups[head]), screen.design.candidates[head]
        if not (_acts(c, places) or c.effect in RANGES):
            continue
        if group in done and not shape_bounds(c, screen.design.scales):
            continue
        shapes = [k for k in np.flatnonzero(screen.groups == group).tolist() if _allowed(screen, k)]
        if shapes:
            out.append(shapes)
    return out[:MOST]


def _equations(c: Candidate, trace: Trace) -> set[str]:
    """Where what an effect describes shows: in its own equation, or in all that hold its
    parameter."""
    if c.role != "parameter":
        return {c.equation}
    out = set()
    for name, site in trace.transition.items():
        inside = symbols_of(site.distribution.arguments())
        if any(repr(s) == c.equation for s in inside if s.data[0] == "parameter"):
            out |= {repr(s) for s in site.components} | {name}
    return out


def _acts(c: Candidate, places: set[str]) -> bool:
    return c.effect.cause == MECHANISM and c.change == "transition" and c.equation in places


def _allowed(screen: Screen, k: int) -> bool:
    found = screen.efficient
    if screen.design.candidates[k].effect in RANGES:
        return True
    return not found.status[k] and found.sided[k] * found.z[k] >= -AGAINST


@dataclass(frozen=True)
class Trial:
    """Strengths of one shape of a mechanism whose likelihood is looked at. strengths : without
    sign, the smallest first. elsewhere : its shape, where that is none of the screen's."""

    column: int
    candidate: Candidate
    strengths: np.ndarray
    elsewhere: Mapping[str, float]


def trials(screen: Screen, columns: Sequence[int]) -> list[Trial]:
    """Each shape of a mechanism as it is, and the first with others elsewhere, one at a time."""
    candidates, first = screen.design.candidates, columns[0]
    out = [Trial(k, candidates[k], _strengths(screen, k), {}) for k in columns]
    for name, (low, high) in shape_bounds(candidates[first], screen.design.scales).items():
        for value in np.linspace(low, high, ELSEWHERE + 2)[1:-1]:
            shape = {name: float(value)}
            c = candidates[first].with_shape(**shape)
            out.append(Trial(first, c, out[0].strengths, shape))
    return out


def best_start(
    augmented: AugmentedModels, base: Fit, tried: Sequence[Sequence[Trial]],
    train: Sequence[Experiment], i: int,
) -> Numbers:  # fmt: skip
    """The column, the strength and the shape elsewhere, if any, with which the mechanism i fits
    best, the parameters as they are, and its gain; none where no strength fits better than the
    model as it is."""
    level = augmented.base_fitter.value(train, base.theta)
    best, out = level, dict[str, Any]()
    for trial in tried[i]:
        c, price = trial.candidate, PRICE * bool(trial.elsewhere)
        try:
            fitter = augmented.fitter((c,))
            if only_by_particles(augmented, fitter):
                continue
            for sign in _signs(c):
                highest = -np.inf
                for n, strength in enumerate(sign * trial.strengths):
                    start = base.by_parameter | {c.strength: np.asarray(strength)}
                    theta = space_of(fitter.problem, fitter.fixed, start).theta
                    with warnings.catch_warnings():  # of a simulator that is pushed too hard
                        warnings.simplefilter("ignore")
                        value = fitter.value(train, theta)
                    if value - price > best:
                        best = value - price
                        out = {"column": trial.column, "strength": strength, "gain": best - level}
                        out |= {f"shape {name}": v for name, v in trial.elsewhere.items()}
                    falls, highest = not value > highest, max(value, highest)
                    if not value > level - HOPELESS or (falls and n + 1 >= len(GRID)):
                        break
        except SSMError:
            continue
    return {name: np.array(value) for name, value in out.items()}


def elsewhere(numbers: Numbers) -> dict[str, float]:
    """The shape that `best_start` found, where it is none of the screen's."""
    return {
        name.removeprefix("shape "): float(value) for name, value in numbers.items()
        if name.startswith("shape ")
    }  # fmt: skip


def most_promising(
    starts: Sequence[Numbers], trace: Trace, refitted: Mapping[int, float] | None = None
) -> list[Numbers]:
    """Of what `best_start` found, the best ones, that gain more than the refit of their column
    did."""
    refitted = refitted or {}
    found = [n for n in starts if "gain" in n]
    found = [n for n in found if float(n["gain"]) > refitted.get(int(n["column"]), 0.0)]
    found.sort(key=lambda n: -float(n["gain"]))
    return found[: FITTED_CALLED if simulators(trace) else FITTED]


def _signs(c: Candidate) -> tuple[int, ...]:
    return (c.sided,) if c.sided else (1,) if c.effect in RANGES else (1, -1)


def _strengths(screen: Screen, k: int) -> np.ndarray:
    """Strengths (without sign) of a column, inside its bounds, the smallest first; behind the grid
    those that are tried while the likelihood rises."""
    if screen.design.candidates[k].effect in RANGES:
        return np.array(BENT)
    squares = screen.simulated.squares[:, [k]]
    share = float(screen.observed.squares[k] / typical_squares(squares)[0])
    share = min(share, 1.0) if share > 0.0 else 1.0
    effect = screen.design.candidates[k].effect
    size = np.array([*GRID, *BEYOND]) / np.sqrt(screen.efficient.variance[k] * share)
    most = max(abs(effect.lower), abs(effect.upper)) if np.isfinite(effect.upper) else np.inf
    return size[size < most] if np.any(size < most) else np.array([0.5 * most])
