"""How far simulations of held-out rows are off, before and after, at several horizons.

The filtered states of rows spread over the held-out part are simulated on (`selection/horizons.py`)
by the model as it was and by the one with the effect, fitted to other rows both. The share is that
of the error that is gone, 1 - RMSE after / RMSE before; its interval comes from the origins
resampled in blocks as long as the horizon (the paired circular bootstrap of Politis and Romano
1992), since what is simulated from neighbouring rows is off together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ssmppl.data import Experiment
from ssmppl.diagnosis.fitting.fit import Fit, Fitter
from ssmppl.diagnosis.selection.horizons import HORIZONS, WINDOW, Ahead, Scores, look_ahead

# What is simulated, as the horizons of the table `closed`: from the first row on; from the filtered
# state of one row on, "1 to 50" rows ahead.
FREE_RUN, WINDOWED = "free run", "1 to "
FEWEST = 4  # origins, or blocks, without which a horizon is left out
REPLICATES, LEVEL, SEED = 2000, 0.95, 1994  # of the bootstrap


@dataclass(frozen=True)
class Horizon:
    """What is simulated: so many rows ahead, or all rows up to there."""

    rows: int
    window: bool = False

    def __str__(self) -> str:
        return f"{WINDOWED}{self.rows}" if self.window else str(self.rows)

    def of(self, found: Ahead) -> Scores:
        """The scores of this horizon."""
        return found.window(self.rows) if self.window else found.at(self.rows)


def horizons(
    experiments: Sequence[Experiment], counts: Sequence[np.ndarray], chosen: int | None = None
) -> list[Horizon]:
    """Those that the rows which count, (T,) bool of each experiment, allow; windows last.

    chosen : rows of the windows; None: a tenth of the longest record.
    """
    most = max((int(c.sum()) for c in counts), default=0)
    window = chosen or max(1, round(WINDOW * max(e.steps for e in experiments)))
    single = [Horizon(h) for h in HORIZONS if 2 * h <= most]
    return single + [Horizon(min(window, most), window=True)] * bool(most)


def compared(
    before: tuple[Fitter, Fit], after: tuple[Fitter, Fit], experiments: Sequence[Experiment],
    counts: Sequence[np.ndarray], which: Sequence[Horizon], seed: np.random.SeedSequence,
) -> list[np.ndarray]:  # fmt: skip
    """For each horizon (O, 3): squared errors before and after, and the gain in log predictive
    density a row, of each origin that has all of them; errors in the unit of the data.

    Raises
    ------
    SamplingError : the filter fails at one of the fits.
    """
    reach = max((h.rows for h in which), default=0)
    models = (before, after)
    found = [look_ahead(*m, experiments, counts, reach, seed) for m in models] if reach else []
    out = []
    for h in which:
        old, new = (h.of(f) for f in found)
        square = old.unit**2
        gain = new.density - old.density
        out.append(np.stack([square * old.square, square * new.square, gain], axis=1))
    return out


def table_rows(
    label: str, which: Sequence[Horizon], found: Sequence[np.ndarray], rows: int | None
) -> list[dict[str, Any]]:
    """Rows of the report's table `closed`, one for each horizon with enough origins.

    found : of `compared`. rows : that count, over which the origins are spread; None: each origin
    stands for a block of rows, and is resampled by itself.
    """
    out = []
    for h, values in zip(which, found, strict=True):
        values = values[~np.isnan(values).any(axis=1)]
        n = len(values)
        if n < FEWEST:
            continue
        block = 1 if rows is None else min(1 + h.rows * n // max(rows, 1), n // FEWEST)
        before, after, gain = values.mean(axis=0)
        low, high = _interval(values[:, :2], max(block, 1))
        out.append({
            "effect": label, "horizon": str(h), "rmse_before": _root(before),
            "rmse_after": _root(after), "share": _share(before, after), "low": low, "high": high,
            "nats_per_sample": float(gain),
        })  # fmt: skip
    return out


def _root(square: float) -> float:
    return float(np.sqrt(max(square, 0.0)))


def _share(before: float, after: float) -> float:
    return 1.0 - _root(after) / _root(before) if before > 0.0 else float("nan")


def _interval(squares: np.ndarray, block: int) -> tuple[float, float]:
    """Of the share, from squared errors (O, 2) of origins in order."""
    n, rng = len(squares), np.random.default_rng(SEED)
    count = -(-n // block)
    first = rng.integers(n, size=(REPLICATES, count))
    at = (first[:, :, None] + np.arange(block)) % n
    drawn = squares[at.reshape(REPLICATES, -1)[:, :n]].mean(axis=1)
    with np.errstate(all="ignore"):
        ratio = np.sqrt(np.maximum(drawn[:, 1], 0.0) / np.maximum(drawn[:, 0], 0.0))
    ratio = ratio[np.isfinite(ratio)]
    if not len(ratio):
        return float("nan"), float("nan")
    tail = (1.0 - LEVEL) / 2.0
    high, low = np.quantile(ratio, (tail, 1.0 - tail))
    return float(1.0 - low), float(1.0 - high)
