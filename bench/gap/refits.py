"""The gains that the rival `aic` chooses by: those of the diagnosis, whose refits cost most.

    python -m bench.gap.rivals --methods aic --refits bench.gap.refits:of_diagnosis

A candidate that the diagnosis has refitted counts with what the refit gained, any other with what
the score predicts, z^2 / 2: for a small effect the same. AIC so has the same likelihoods as the
diagnosis, and differs in what it makes of them: one parameter is paid for with one nat, whatever
the number of candidates.
"""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path

from bench.gap.records import Record
from bench.gap.rivals import Refit
from bench.gap.score import records


@cache
def _diagnoses() -> dict[str, Record]:
    return records("diagnose")


def of_diagnosis(folder: Path) -> tuple[float, dict[tuple[str, str], Refit]]:
    """0 for the base model, and each effect's gain over it.

    Raises
    ------
    ValueError : the diagnosis has not been run on the set.
    """
    record = _diagnoses().get(folder.name)
    if record is None or record.failed:
        raise ValueError(f"{folder.name} has no diagnosis: run python -m bench.gap.run")
    best: dict[tuple[str, str], float] = {}
    for r in record.ranked:
        key = (r.effect, r.equation)
        if not math.isnan(r.gain):
            best[key] = max(best.get(key, -math.inf), r.gain)
    return 0.0, {key: Refit(gain) for key, gain in best.items()}
