"""Mechanisms that the screen overlooks, in an equation whose misfit is described, not explained.

A score looks at a strength of zero, with the parameters as they are. Where the noise has grown and
a parameter has taken on part of the effect, that tells little: a drag that the linear damping
stands in for, or a stop, beyond which the simulated sets go and the data never do. So where what
only describes a misfit gains most, the mechanisms of the same equation are fitted too, each from
the best of a few strengths and shapes.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np

from ssmppl.analysis.structure import simulators
from ssmppl.data import Experiment
from ssmppl.diagnosis.effects.candidate import Candidate
from ssmppl.diagnosis.effects.effect import MECHANISM
from ssmppl.diagnosis.fitting.augmented_models import AugmentedModels
from ssmppl.diagnosis.fitting.fit import Fit
from ssmppl.diagnosis.run.checkpoint import Numbers
from ssmppl.diagnosis.screening.screen import Screen
from ssmppl.diagnosis.screening.statistics import typical_squares
from ssmppl.diagnosis.selection.refit import Refit, only_by_particles, preferred
from ssmppl.errors import SSMError
from ssmppl.expressions.expr import symbols_of
from ssmppl.inference.preparation.space import space_of
from ssmppl.language.model.trace import Trace

MOST = 20  # mechanisms whose likelihood is looked at
FITTED, FITTED_CALLED = 8, 5  # of these that are fitted; of a model that calls a simulator
AGAINST = 2.0  # standard deviations by which a score may have the sign that is not allowed
GRID = (1.0, 4.0, 16.0, 64.0)  # strengths, in standard errors by the data's own information
HOPELESS = 20.0  # nats below the model as it is, beyond which larger strengths are not tried


def overlooked(screen: Screen, refits: Sequence[Refit], worth: float) -> list[list[int]]:
    """The shapes of each mechanism, by their columns, that was not refitted and acts in the
    equation of the refit that would be named, where that is none; the highest in the screen first.

    worth : nats that the best one has to gain.
    """
    if not refits or (best := preferred(refits, worth)[0]).penalised_gain < worth:
        return []
    c, done = best.candidates[0], {int(screen.groups[r.index[0]]) for r in refits}
    if c.effect.cause == MECHANISM:
        return []
    places, out = _equations(c, screen.design.trace), []
    for head in screen.family.leaders:
        group = int(screen.groups[head])
        if group in done or not _acts(screen.design.candidates[head], places):
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
    return not found.status[k] and found.sided[k] * found.z[k] >= -AGAINST


def best_start(
    augmented: AugmentedModels, base: Fit, screen: Screen, shapes: Sequence[Sequence[int]],
    train: Sequence[Experiment], i: int,
) -> Numbers:  # fmt: skip
    """The column and the strength with which the mechanism i fits best, the parameters as they are,
    and its gain; none where no strength fits better than the model as it is."""
    level = augmented.base_fitter.value(train, base.theta)
    best, out = level, dict[str, float]()
    for k in shapes[i]:
        c = screen.design.candidates[k]
        try:
            fitter = augmented.fitter((c,))
            if only_by_particles(augmented, fitter):
                continue
            for sign in _signs(c):
                for strength in sign * _strengths(screen, k):
                    start = base.by_parameter | {c.strength: np.asarray(strength)}
                    theta = space_of(fitter.problem, fitter.fixed, start).theta
                    with warnings.catch_warnings():  # of a simulator that is pushed too hard
                        warnings.simplefilter("ignore")
                        value = fitter.value(train, theta)
                    if value > best:
                        best = value
                        out = {"column": k, "strength": strength, "gain": value - level}
                    if not value > level - HOPELESS:
                        break
        except SSMError:
            continue
    return {name: np.array(value) for name, value in out.items()}


def most_promising(starts: Sequence[Numbers], trace: Trace) -> list[Numbers]:
    """Of what `best_start` found, the best ones."""
    found = sorted((n for n in starts if "gain" in n), key=lambda n: -float(n["gain"]))
    return found[: FITTED_CALLED if simulators(trace) else FITTED]


def _signs(c: Candidate) -> tuple[int, ...]:
    return (c.sided,) if c.sided else (1, -1)


def _strengths(screen: Screen, k: int) -> np.ndarray:
    """Strengths (without sign) of a column, inside its bounds, the smallest first."""
    squares = screen.simulated.squares[:, [k]]
    share = float(screen.observed.squares[k] / typical_squares(squares)[0])
    share = min(share, 1.0) if share > 0.0 else 1.0
    effect = screen.design.candidates[k].effect
    size = np.array(GRID) / np.sqrt(screen.efficient.variance[k] * share)
    most = max(abs(effect.lower), abs(effect.upper)) if np.isfinite(effect.upper) else np.inf
    return size[size < most] if np.any(size < most) else np.array([0.5 * most])
