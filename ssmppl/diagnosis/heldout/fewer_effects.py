"""Whether several effects are named, or fewer: each further one has to carry to other rows.

A second effect is sought in what the first one leaves. No formula is the machine's own, so that
something is left, and among so many candidates one fits it, on these rows. A cause goes on acting:
fitted to the first rows alone, it predicts the later ones better than the model without it.
"""

from __future__ import annotations

import numpy as np

from ssmppl.diagnosis.effects.candidate import is_dated
from ssmppl.diagnosis.heldout.predictions import predicted_later
from ssmppl.diagnosis.heldout.row_split import RowSplit
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


def _later(
    refit: Refit, split: RowSplit, seed: np.random.SeedSequence, checkpoint: Checkpoint
) -> float:
    """Log predictive density of the later rows; minus infinity where there is none."""

    def numbers() -> Numbers:
        try:
            value = predicted_later(refit.fitter, refit.fit.by_parameter, split, seed)
        except SSMError:
            value = -np.inf
        return {"value": np.asarray(value if np.isfinite(value) else -np.inf)}

    return float(checkpoint.computed(f"later rows with {_names(refit)}", numbers)["value"])


def _names(refit: Refit) -> str:
    return " and ".join(map(str, refit.candidates))
