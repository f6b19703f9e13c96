"""Error of simulations of the model that a diagnosis hands back, beside that of the true model.

    python -m bench.gap.simulated [--half sealed] [--cell one-20] [--method diagnose]

Both are fitted to the first 70% of the rows: the report's model by the diagnosis, the true one by
`fresh.refitted`. On fresh runs of the true system (`fresh.fresh_runs`) the last 30% of the rows are
cut into windows, each predicted from the rows before it and the inputs: of the true model by its
filter, to which the window is not shown; of the others by simulations from their filtered states,
as the tool itself does. The errors' mean squares, each channel in its standard deviations, over all
runs: the ratio of their roots is kept, of the model before the diagnosis too. Opens the answers;
sets whose class is not right, or that are not of one effect, are left out.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import pandas as pd

from bench.gap.diagnosed import Diagnosed
from bench.gap.filter import predictions
from bench.gap.fresh import (
    CONFIRM,
    arrays,
    estimated,
    fresh_runs,
    handed_back,
    measure_each,
    refitted,
)
from bench.gap.plan import Entry
from bench.gap.records import Record
from bench.gap.run import SETS
from bench.gap.score import Scored, opened
from bench.gap.truth import SYSTEMS, System
from ssmppl.language.model.model import Model
from ssmppl.modelfile import load_model

WINDOW = 50  # rows; of shorter records a quarter of the rows that are predicted
DRAWS = 512  # simulations from each filtered state: their mean adds 0.1% to an error

# Data, and windows as (first row, row behind the last) -> (T, channels) means, NaN outside.
Means = Callable[[pd.DataFrame, Sequence[tuple[int, int]]], np.ndarray]


def simulating(model: Model, parameters: Mapping[str, float], channels: Sequence[str]) -> Means:
    """Simulations of a model from its filtered states."""

    def means(data: pd.DataFrame, windows: Sequence[tuple[int, int]]) -> np.ndarray:
        origins = np.array([first - 1 for first, _ in windows])
        reach = max(last - first for first, last in windows)
        found = Diagnosed.of(model, data, parameters).simulated(origins, reach, DRAWS)
        out = np.full((len(data), len(channels)), np.nan)
        for (first, last), mean in zip(windows, found, strict=True):
            out[first:last] = mean[: last - first]
        return out

    return means


def true_model(system: System, answer: dict, data: pd.DataFrame) -> Means:
    """Predictions of the true model, refitted to the rows before the last 30%."""
    found = refitted(system, answer, *arrays(system, data))

    def means(data: pd.DataFrame, windows: Sequence[tuple[int, int]]) -> np.ndarray:
        U, Y = arrays(system, data)
        out = np.full(Y.shape, np.nan)
        for first, last in windows:
            shown = Y[:last].copy()
            shown[first:] = np.nan
            out[first:last] = predictions(system, found.p, found.e, U[:last], shown)[first:]
        return out

    return means


def windows_of(rows: int) -> list[tuple[int, int]]:
    """The windows of the last 30% of so many rows; the last may be shorter."""
    cut = int(CONFIRM * rows)
    width = min(WINDOW, max((rows - cut) // 4, 1))
    return [(first, min(first + width, rows)) for first in range(cut, rows, width)]


def squares(means: Means, system: System, data: pd.DataFrame, scale: np.ndarray) -> float:
    """Sum of the squared errors in all windows of one run."""
    _, Y = arrays(system, data)
    return float(np.nansum(((Y - means(data, windows_of(len(Y)))) / scale) ** 2))


def of_record(record: Record, answer: dict) -> dict[str, float]:
    """Root mean square errors of the model before and after, over the true model's."""
    folder = SETS / record.id
    data = pd.read_csv(folder / "data.csv")
    system = SYSTEMS[answer["system"]]
    channels = system.channels
    before = load_model(str(folder / "model.py"))
    models = {
        "true": true_model(system, answer, data),
        "before": simulating(before, estimated(record, "before"), channels),
        "after": simulating(handed_back(record), estimated(record, "after"), channels),
    }
    scale = np.nanstd(arrays(system, data)[1], axis=0)
    total = dict.fromkeys(models, 0.0)
    for fresh in fresh_runs(system, answer, data):
        for name, means in models.items():
            total[name] += squares(means, system, fresh, scale)
    return {name: float(np.sqrt(total[name] / total["true"])) for name in ("before", "after")}


def wanted(entry: Entry, record: Record) -> bool:
    """Whether a set is of one effect, and its class right."""
    return len(entry.effects) == 1 and Scored(record, opened([entry.id])[entry.id]).right_class


if __name__ == "__main__":
    measure_each("simulated.json", of_record, wanted, __doc__)
