"""The decision between the verdicts.

There is an effect where one was chosen; there is none of these where something stands out that the
catalogue does not explain; else there is no measurable gap. Held-out rows may revise what the rows
before them said.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ssmppl.diagnosis.effects.candidate import Candidate
from ssmppl.diagnosis.effects.effect import NOISE_LAW
from ssmppl.diagnosis.heldout.gain_ratio import HeldOutGain
from ssmppl.diagnosis.heldout.reference import residual_groups
from ssmppl.diagnosis.heldout.simulation import WINDOWED
from ssmppl.diagnosis.screening.screen import Screen
from ssmppl.diagnosis.verdict.results import Results
from ssmppl.diagnosis.verdict.verdicts import EFFECT, NO_GAP, NONE_OF_THESE

if TYPE_CHECKING:
    import pandas as pd

SIGNIFICANT_GAIN_SE = 2.0  # standard errors of a gain beyond the catalogue that is no chance
# By the catalogue, of the gap one row ahead and of the error that curves take off simulations,
# before it is "none of these": an effect that closes most of a gap is what a user has to know.
LEAST_SHARE_LEFT, LEAST_ERROR_LEFT = 0.3, 0.15
FAR_MORE = 2.0  # times what the chosen effects gain, by curves in their place: "none of these"
RESIDUAL_ALPHA_SHARE = 0.2  # of alpha, for what the catalogue leaves where nothing is held out

Place = tuple[str, str]  # equation and moment


@dataclass(frozen=True)
class Decision:
    """verdict : one of `VERDICTS`. curve : the mean whose missing curve goes with it, None if none
    does. others : candidates that are projected out of that curve."""

    verdict: str
    curve: Place | None = None
    others: tuple[Candidate, ...] = ()


def decide(r: Results, where: pd.DataFrame, checks: pd.DataFrame) -> Decision:
    """The verdict, in the light of the gain on held-out rows and of what else stands out.

    where, checks : the tables `where` and `detection` of the report.
    """
    found = _by_effects(r, where)
    rows = r.held_out.rows if r.held_out else []
    # Few held-out rows leave the share open where the test of the effect does not; what gains
    # nothing on them, one row ahead nor in simulations, was chance, and what curves gain beyond it
    # is as open. Where blocks are left out in turn, no row is far from those that chose: there an
    # effect that makes simulations measurably worse is not what is missing.
    if rows and not np.isfinite(rows[0]["F"]):
        low, high = simulated_better(rows)
        gains = rows[0]["nats_per_sample"] > 0.0 or low > 0.0
        unlike = found.verdict == NONE_OF_THESE
        if r.blocks:
            if high < 0.0 and r.chosen is not None:
                found = Decision(NONE_OF_THESE, strongest_mean(where))
        elif not gains or (unlike and r.chosen is None):
            found = Decision(NO_GAP)
        elif unlike:
            found = Decision(EFFECT, strongest_mean(where))
    if found.verdict == EFFECT and (place := _open_mean(r)) is not None:
        found = _none_of_these(place, r.chosen.candidates if r.chosen else ())
    # Places and checks that are of a fit which was not the best one say nothing.
    if found.verdict == NO_GAP and r.screen_is_current and stands_out(r.alpha, where, checks):
        found = Decision(NONE_OF_THESE, strongest_mean(where))
    return found


def _by_effects(r: Results, where: pd.DataFrame) -> Decision:
    """The decision but for whether a gap can be measured at all."""
    least = float(np.min(r.screen.family.p, initial=1.0))
    refitted = r.selection is not None and r.mode == "full" and r.unfitted is None
    if r.held_out is not None and curves_beat(r.held_out, r.chosen is not None):
        best = r.chosen or (r.refits[0] if r.refits else None)
        tried = list(best.candidates) if best else []
        residual, place = strongest_residual(r.screen, tried)
        if residual <= r.alpha and place is not None:
            return _none_of_these(place, tried)
    if r.chosen is not None or (least <= r.alpha and not refitted):
        return Decision(EFFECT, strongest_mean(where))
    if not refitted:  # nothing is held out: what all of the catalogue leaves
        tried = testable_candidates(r.screen)
        residual, place = strongest_residual(r.screen, tried)
        if residual <= RESIDUAL_ALPHA_SHARE * r.alpha and place is not None:
            return _none_of_these(place, tried)
    return Decision(NO_GAP)


def _open_mean(r: Results) -> Place | None:
    """The mean that something is missing from which the chosen effects are not: it stands out
    beside them, and either they are laws of the noise alone and curves predict rows that they were
    not fitted to (noise that grows with what moves a state describes any missing term of that), or
    curves in their place explain far more of the rows of the fit."""
    if r.chosen is None:
        return None
    noise = all(c.effect.cause == NOISE_LAW for c in r.chosen.candidates)
    described = noise and r.held_out is not None and r.held_out.curves
    if not described and r.curves_alone < FAR_MORE * r.chosen.penalised_gain:
        return None
    residual, place = strongest_residual(r.screen, r.chosen.candidates)
    return place if residual <= r.alpha and place is not None and place[1] == "mean" else None


def _none_of_these(place: Place, tried: Sequence[Candidate]) -> Decision:
    return Decision(NONE_OF_THESE, place if place[1] == "mean" else None, tuple(tried))


def strongest_mean(where: pd.DataFrame) -> Place | None:
    """The place where most is missing, if that is in the mean of an equation."""
    if not len(where) or where.iloc[0]["moment"] != "mean":
        return None
    return where.iloc[0]["equation"], "mean"


def simulated_better(rows: Sequence[Mapping[str, Any]]) -> tuple[float, float]:
    """The interval of the share of the error of simulations over windows that an effect takes off,
    from the rows of the table `closed`; NaN where that was not measured."""
    for row in rows:
        if str(row.get("horizon", "")).startswith(WINDOWED):
            return float(row["low"]), float(row["high"])
    return float("nan"), float("nan")


def stands_out(alpha: float, *found: pd.DataFrame) -> bool:
    """Whether a place or a check of the predictions is more than chance: then there is a gap."""
    return any(len(t) > 0 and float(np.nanmin(t["p"], initial=1.0)) <= alpha for t in found)


def curves_beat(far: HeldOutGain, chosen: bool) -> bool:
    """Whether smooth curves predict the held-out rows better than the best of the catalogue: more
    than chance explains, and, where effects were chosen, by more than a trifle of the gap, one row
    ahead and in simulations. Curves that one row confirms and simulations do not are no cause."""
    if (
        far.beyond_catalogue is None
        or not far.beyond_catalogue.nats > SIGNIFICANT_GAIN_SE * far.beyond_catalogue.error
    ):
        return False
    share = float(far.rows[0]["F"]) if chosen and far.rows else np.nan
    if share > 1.0 - LEAST_SHARE_LEFT:
        return False
    if not chosen or far.simulated_beyond is None:
        return True
    better, low = far.simulated_beyond
    return low > 0.0 and better > LEAST_ERROR_LEFT


def testable_candidates(screen: Screen) -> list[Candidate]:
    """The candidates with a score that the parameters do not absorb."""
    candidates = screen.design.candidates
    return [c for c, s in zip(candidates, screen.efficient.status, strict=True) if not s]


def strongest_residual(screen: Screen, others: Sequence[Candidate]) -> tuple[float, Place | None]:
    """(family-wise p, equation and moment) of what of the basis stands out most with `others`
    projected out."""
    groups = residual_groups(screen, others)
    if not groups:
        return 1.0, None
    best = max(groups, key=lambda key: groups[key].z)
    return groups[best].p, best[:2]
