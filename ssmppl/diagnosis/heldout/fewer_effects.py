"""Whether several effects are named, or fewer: each further one has to carry to other rows.

A second effect is sought in what the first one leaves. No formula is the machine's own, so that
something is left, and among so many candidates one fits it, on these rows. A cause goes on acting:
fitted to the first rows alone, it predicts the later ones better than the model without it. And
several together have to do better than none on the held-out rows, one row ahead and in simulations.
"""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np

from ssmppl.diagnosis.effects.candidate import is_dated
from ssmppl.diagnosis.fitting.fit import Fit, Fitter
from ssmppl.diagnosis.heldout.predictions import Predictions, predict, predicted_later
from ssmppl.diagnosis.heldout.row_split import RowSplit
from ssmppl.diagnosis.heldout.simulation import compared, horizons, table_rows
from ssmppl.diagnosis.run.checkpoint import Checkpoint, Numbers
from ssmppl.diagnosis.selection.effect_selection import SelectionResult, add_standard_errors
from ssmppl.diagnosis.selection.refit import Refit
from ssmppl.errors import SSMError

LEAST = 1.0  # nats that a further effect has to gain on the later rows


def drop_by_later_rows(
    found: SelectionResult, split: RowSplit, seed: np.random.SeedSequence, checkpoint: Checkpoint
) -> None:
    """Go back to fewer effects, with a note, while with the last one, fitted to the first rows, the
    later ones of those by which it was chosen are not predicted better than without.

    What happens at a date is not in both parts, and stays. So does what the model without it cannot
    predict at all.
    """
    while found.chosen is not None and found.fewer:
        last, fewer = found.chosen, found.fewer[-1]
        if any(is_dated(c) for c in last.candidates if c not in fewer.candidates):
            return
        without = _later(fewer, split, seed, checkpoint)
        if not np.isfinite(without):
            return
        gain = _later(last, split, seed, checkpoint) - without
        if gain > LEAST:
            return
        found.chosen = found.fewer.pop()
        add_standard_errors(found, seed, checkpoint)
        few = _names(fewer)
        found.notes.append(
            f"{_names(last)} fit better together, but fitted to the first rows they do not predict "
            f"the later ones better than {few} ({gain:+.1f} nats); retained: {few}"
        )


@dataclass(frozen=True)
class HeldOutTest:
    """What a choice of several effects is held against.

    base, simulator : the model as it is, by likelihood and as it is simulated. horizon : rows of
    the windows that are simulated; None: a tenth of the longest record. seed : of all held-out
    rows. executor : for runs of a particle filter.
    """

    base: tuple[Fitter, Fit]
    simulator: tuple[Fitter, Fit]
    split: RowSplit
    horizon: int | None
    seed: np.random.SeedSequence
    executor: Executor | None = None

    def predictions(self, fitter: Fitter, fit: Fit) -> Predictions:
        """One row ahead."""
        experiments, counts = self.split.experiments, self.split.held_out
        return predict(fitter, fit, experiments, counts, self.seed, self.executor)

    def simulated_worse(self, chosen: Refit) -> float:
        """The share by which simulations over windows are further off with the effects than
        without, where that is more than chance explains; else 0."""
        experiments, counts = self.split.experiments, self.split.held_out
        which = horizons(experiments, counts, self.horizon)[-1:]
        found = compared(self.simulator, chosen.simulator, experiments, counts, which, self.seed)
        rows = table_rows("", which, found, int(sum(c.sum() for c in counts)))
        return -rows[0]["share"] if rows and rows[0]["high"] < 0.0 else 0.0


def drop_by_held_out_rows(
    found: SelectionResult, test: HeldOutTest, seed: np.random.SeedSequence, checkpoint: Checkpoint
) -> None:
    """Drop effects of several chosen together while all of them predict the held-out rows no better
    than the model itself, or simulate them worse: what they fitted was chance, or ended with the
    rows that they were fitted to. It is a choice made on these rows, and the report says so."""
    if found.chosen is None or not found.fewer:
        return
    try:
        plain = test.predictions(*test.base)
    except SSMError:  # as will be said where the gain is measured
        return
    while found.fewer:
        last = found.chosen
        try:
            seen = test.predictions(last.fitter, last.fit)
            gain = seen.log_density.sum(axis=1).mean() - plain.log_density.sum(axis=1).mean()
            worse = test.simulated_worse(last) if gain > 0.0 else 0.0
        except SSMError as error:
            found.notes.append(
                f"{_names(last)} fit better together, and whether they predict held-out rows "
                f"better is not known: {error.found}"
            )
            return
        if gain > 0.0 and not worse:
            return
        found.chosen, found.left_out = found.fewer.pop(), True
        add_standard_errors(found, seed, checkpoint)
        why = f"have lower held-out predictive density than the base model ({gain:.1f} nats)"
        if worse:
            why = f"simulate held-out rows worse than the base model (error {worse:+.0%})"
        found.notes.append(
            f"{_names(last)} fit better together, and {why}; retained: {_names(found.chosen)}"
        )


def _later(
    refit: Refit, split: RowSplit, seed: np.random.SeedSequence, checkpoint: Checkpoint
) -> float:
    """Log predictive density of the later rows; minus infinity where there is none."""

    def numbers() -> Numbers:
        try:
            value = predicted_later(
                refit.fitter, refit.fit.by_parameter, split, seed, checkpoint.executor
            )
        except SSMError:
            value = -np.inf
        return {"value": np.asarray(value if np.isfinite(value) else -np.inf)}

    return float(checkpoint.computed(f"later rows with {_names(refit)}", numbers)["value"])


def _names(refit: Refit) -> str:
    return " and ".join(map(str, refit.candidates))
