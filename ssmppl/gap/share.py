"""How far the gap closes on rows that took no part in fitting or choosing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ssmppl.data import Experiment
from ssmppl.errors import SSMError
from ssmppl.gap.checkpoint import Checkpoint
from ssmppl.gap.closed import Closed, Gain, closed
from ssmppl.gap.confirm import FreeRun, free_run, gain_of_mean, predict, rmse
from ssmppl.gap.fit import Fit, Fitter
from ssmppl.gap.parts import Parts
from ssmppl.gap.reference import fit_reference
from ssmppl.gap.refit import Refit
from ssmppl.gap.screen import Screen
from ssmppl.gap.workshop import Workshop

NOT_GIVEN = "the share of the gap that is closed is not given: {}"
SAME = 1e-3  # relative difference of two gains up to which they are the same model's


@dataclass
class HowFar:
    """Rows of the report's table, free runs of each experiment before and after, and notes.

    beyond : what the reference gains over the best of the catalogue, chosen or not.
    """

    rows: list[dict[str, Any]] = field(default_factory=list)
    beyond: Gain | None = None
    before: list[FreeRun] = field(default_factory=list)
    after: list[FreeRun] | None = None
    notes: list[str] = field(default_factory=list)

    def runs(
        self, base: tuple[Fitter, Fit], experiments: Sequence[Experiment], chosen: Refit | None,
        seed: np.random.SeedSequence,
    ) -> None:  # fmt: skip
        """Simulate freely before and after."""
        self.before = [free_run(*base, e, seed) for e in experiments]
        if chosen is not None:
            self.after = [free_run(chosen.fitter, chosen.fit, e, seed) for e in experiments]


def how_far(
    workshop: Workshop, parts: Parts, experiments: Sequence[Experiment],
    base: tuple[Fitter, Fit], screen: Screen, chosen: Refit | None, leader: Refit | None,
    label: str, seed: np.random.SeedSequence, kept: Checkpoint,
) -> HowFar:  # fmt: skip
    """The chosen model, or, where none was chosen, the reference itself, against the base model.

    leader : the best refit, chosen or not.
    """
    out = HowFar()
    out.runs(base, experiments, chosen, seed)
    try:
        _measure(out, workshop, parts, experiments, base, screen, chosen, leader, label, seed, kept)
    except SSMError as error:  # a held-out row may be impossible under what was fitted to others
        out.notes.append(NOT_GIVEN.format(error.found))
    return out


def _measure(
    out: HowFar, workshop: Workshop, parts: Parts, experiments: Sequence[Experiment],
    base: tuple[Fitter, Fit], screen: Screen, chosen: Refit | None, leader: Refit | None,
    label: str, seed: np.random.SeedSequence, kept: Checkpoint,
) -> None:  # fmt: skip
    """The share, and what the reference gains beyond, into `out`.

    Raises
    ------
    SSMError : a model cannot predict the held-out rows, or there are too few.
    """
    counts = parts.confirm
    plain = predict(*base, experiments, counts, seed)
    try:
        reference = fit_reference(
            workshop, chosen.candidates if chosen else (), chosen.fit if chosen else base[1],
            screen, parts.train, seed, kept, parts,
        )  # fmt: skip
        best = predict(*reference, experiments, counts, seed)
    except SSMError as error:
        out.notes.append(f"no reference to measure the gap against: {error.found}")
        return
    model = (chosen.fitter, chosen.fit) if chosen else reference
    same = reference[1] is model[1]  # nothing was found beyond the chosen effects
    found = best if same else predict(*model, experiments, counts, seed)
    share = closed(plain.log_density, found.log_density, best.log_density, starts=plain.starts)
    rival = found
    if chosen is None:
        rival = predict(leader.fitter, leader.fit, experiments, counts, seed) if leader else plain
    out.beyond = closed(
        rival.log_density, best.log_density, best.log_density, starts=plain.starts
    ).gain
    runs = out.after or [free_run(*model, e, seed) for e in experiments]
    mean = gain_of_mean(plain, found)
    low, high = interval_of(share)
    out.rows.append({
        "effect": label, "F": share.F, "F_low": low, "F_high": high,
        "nats_per_sample": share.gain.nats_per_sample, "gain_mean": mean,
        "gain_noise": share.gain.nats - mean,
        "rmse_before": rmse(out.before, experiments, counts),
        "rmse_after": rmse(runs, experiments, counts),
    })  # fmt: skip
    out.notes += notes_of(share, chosen is not None)


def own_reference(share: Closed) -> bool:
    """Whether the reference is the chosen model itself, so that the share is no comparison."""
    return abs(share.gain.nats - share.reference.nats) <= SAME * abs(share.reference.nats)


def interval_of(share: Closed) -> tuple[float, float]:
    """The interval of the share; NaN where it compares a model with itself."""
    return (np.nan, np.nan) if own_reference(share) else (share.low, share.high)


def notes_of(share: Closed, chosen: bool) -> list[str]:
    """What has to be known beside the share."""
    if share.reason:
        return [share.reason]
    if not own_reference(share):
        return []
    low, high = (share.gain.nats + s * 1.96 * share.gain.error for s in (-1.0, 1.0))
    what = "nothing beyond the chosen effect was found" if chosen else "no effect was chosen"
    return [
        f"{what}, so that the share is of its own gain: {share.gain.nats:.1f} nats on held-out "
        f"rows (95% interval {low:.1f} to {high:.1f})"
    ]
