"""What the stages of a diagnosis have found so far."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from ssmppl.data import Experiment
from ssmppl.diagnosis.effects.candidate import Candidate
from ssmppl.diagnosis.experiment.design import Separation
from ssmppl.diagnosis.experiment.recovery import Recovery
from ssmppl.diagnosis.fitting.fit import Fit, Fitter
from ssmppl.diagnosis.heldout.gain_ratio import HeldOutGain
from ssmppl.diagnosis.heldout.row_split import RowSplit
from ssmppl.diagnosis.run.failures import Failures
from ssmppl.diagnosis.screening.screen import Screen
from ssmppl.diagnosis.selection.effect_selection import SelectionResult
from ssmppl.diagnosis.selection.equivalence import Classes, equivalence_classes, group_leaders
from ssmppl.diagnosis.selection.refit import Begin, Refit
from ssmppl.diagnosis.verdict.verdicts import CURVES
from ssmppl.language.model.trace import Trace


@dataclass
class Results:
    """The results of the stages so far. selection, held_out : None where not done.

    blocks : left out in turn, 0 for three parts. recovery : of the leading effects in data that are
    simulated with each; None where there is none. separation : of the first class, None where it
    was not looked for. curves_alone : nats that curves gain in place of what was chosen, as of
    `gain_of_curves`.
    """

    trace: Trace
    experiments: Sequence[Experiment]
    split: RowSplit | None
    mode: str
    alpha: float
    base: Fitter
    fit: Fit
    screen: Screen
    settings: dict[str, Any]
    notes: list[str]
    selection: SelectionResult | None = None
    held_out: HeldOutGain | None = None
    blocks: int = 0
    recovery: Recovery | None = None
    separation: Separation | None = None
    curves_alone: float = 0.0
    interrupted: bool = False
    failures: Failures = field(default_factory=Failures)

    @property
    def refits(self) -> list[Refit]:
        return self.selection.refits if self.selection else []

    @property
    def chosen(self) -> Refit | None:
        return self.selection.chosen if self.selection else None

    @property
    def simulator(self) -> tuple[Fitter, Fit]:
        """The model as it is, with its parameters for simulation."""
        found = self.selection.simulating if self.selection else None
        return found.model if found else (self.base, self.fit)

    @property
    def searched(self) -> list[tuple[Candidate, Begin]]:
        """The chosen effects, as the screen has them, whose refits began where a search said."""
        groups = {c.group for c in self.chosen.candidates} if self.chosen else set()
        begun = [(self.screen.design.candidates[r.index[0]], r.begin) for r in self.refits]
        return [(c, begin) for c, begin in begun if begin and c.group in groups]

    @property
    def names(self) -> list[str]:
        """Labels of the chosen effects."""
        offered = self.screen.design.candidates
        return labels(self.chosen.candidates, offered) if self.chosen else []

    @property
    def label(self) -> str:
        """What the share that is closed is about."""
        return " + ".join(self.names) if self.chosen else CURVES

    @property
    def unfitted(self) -> int | None:
        """Column of the effect that the verdict rests on, though it was not refitted."""
        return self.selection.unfitted if self.selection else None

    @property
    def screen_is_current(self) -> bool:
        """Whether the screen was run at the model's fit as it is known now."""
        return not (self.selection and self.selection.rebased)

    @property
    def tested(self) -> dict[int, float] | None:
        """p of the refits that were tested themselves, by column; None if none was to be."""
        return self.selection.p if self.selection else None

    def classes(self) -> tuple[list[int], Classes]:
        """The leading shapes of all groups, best first, and their classes."""
        order = group_leaders(self.screen, self.refits)
        alike = self.recovery.inside if self.recovery else set()
        return order, equivalence_classes(self.screen, self.refits, order, alike)


def labels(candidates: Sequence[Candidate], offered: Sequence[Candidate]) -> list[str]:
    """Names of effects, with their equations where one of that name is offered for several."""
    places: dict[str, set[str]] = {}
    for c in (*offered, *candidates):
        places.setdefault(c.effect.name, set()).add(c.place)
    return [c.effect.name if len(places[c.effect.name]) == 1
            else f"{c.effect.name} on {c.place}"
            for c in candidates]  # fmt: skip
