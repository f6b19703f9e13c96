"""How far the gap closes on rows that took no part in fitting or choosing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ssmppl.data import Experiment
from ssmppl.errors import ArgumentError, SamplingError
from ssmppl.gap.closed import closed
from ssmppl.gap.confirm import FreeRun, free_run, gain_of_mean, predict, rmse
from ssmppl.gap.fit import Fit, Fitter
from ssmppl.gap.parts import Parts
from ssmppl.gap.reference import fit_reference
from ssmppl.gap.refit import Refit, Workshop
from ssmppl.gap.screen import Screen


@dataclass
class HowFar:
    """Rows of the report's table, free runs of each experiment before and after, and notes."""

    rows: list[dict[str, Any]] = field(default_factory=list)
    before: list[FreeRun] = field(default_factory=list)
    after: list[FreeRun] | None = None
    notes: list[str] = field(default_factory=list)


def how_far(
    workshop: Workshop, parts: Parts | None, experiments: Sequence[Experiment],
    base: tuple[Fitter, Fit], screen: Screen, chosen: Refit | None, label: str,
    seed: np.random.SeedSequence,
) -> HowFar:  # fmt: skip
    """The chosen model, or, where none was chosen, the reference itself, against the base model."""
    out = HowFar()
    out.before = [free_run(*base, e, seed) for e in experiments]
    if chosen is not None:
        out.after = [free_run(chosen.fitter, chosen.fit, e, seed) for e in experiments]
    if parts is None:
        out.notes.append(
            f"with {sum(e.steps for e in experiments)} rows none were held out: the share of the "
            "gap that is closed is not given"
        )
        return out
    counts = parts.confirm
    plain = predict(*base, experiments, counts, seed)
    try:
        reference = fit_reference(
            workshop, chosen.candidates if chosen else (), chosen.fit if chosen else base[1],
            screen, parts.train, seed,
        )  # fmt: skip
        best = predict(*reference, experiments, counts, seed)
    except (ArgumentError, SamplingError) as error:
        out.notes.append(f"no reference to measure the gap against: {error.found}")
        return out
    model = (chosen.fitter, chosen.fit) if chosen else reference
    found = predict(*model, experiments, counts, seed)
    share = closed(plain.log_density, found.log_density, best.log_density, starts=plain.starts)
    runs = out.after or [free_run(*model, e, seed) for e in experiments]
    mean = gain_of_mean(plain, found)
    out.rows.append({
        "effect": label, "F": share.F, "F_low": share.low, "F_high": share.high,
        "nats_per_sample": share.gain.nats_per_sample, "gain_mean": mean,
        "gain_noise": share.gain.nats - mean,
        "rmse_before": _rmse(out.before, experiments, counts),
        "rmse_after": _rmse(runs, experiments, counts),
    })  # fmt: skip
    if share.reason:
        out.notes.append(share.reason)
    return out


def _rmse(
    runs: Sequence[FreeRun], experiments: Sequence[Experiment], counts: Sequence[np.ndarray]
) -> float:
    each = [rmse(r, e, c) for r, e, c in zip(runs, experiments, counts, strict=True)]
    return float(np.sqrt(np.mean(np.square(each))))
