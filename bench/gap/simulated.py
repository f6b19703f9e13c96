"""Error of simulations of the model that a diagnosis hands back, beside that of the true model.

    python -m bench.gap.simulated [--half sealed] [--cell one-20] [--method diagnose]

Both are fitted to the first 70% of the rows: the report's model by the diagnosis, the true one by
`fresh.reference`. On fresh runs of the true system (`fresh.fresh_runs`) the last 30% of the rows
are cut into windows, of which every other one is not shown to the filters: each row in it is
predicted from the rows before the window, and the inputs. Twice, so that each window is predicted
once. The errors' mean squares, each channel in its standard deviations, over all runs: the ratio of
their roots is kept, of the model before the diagnosis too. Opens the answers; sets whose class is
not right, or that are not of one effect, are left out.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence

import numpy as np
import pandas as pd

import ssmppl as ssm
from bench.gap.filter import predictions
from bench.gap.fresh import (
    CONFIRM,
    arrays,
    estimated,
    fresh_runs,
    handed_back,
    refitted,
)
from bench.gap.plan import CELLS, SPLIT, entries
from bench.gap.records import CACHE, Record
from bench.gap.run import SETS
from bench.gap.score import Scored, opened, records
from bench.gap.truth import SYSTEMS, System
from ssmppl.language.model.model import Model
from ssmppl.modelfile import load_model

PARTICLES = 200  # of which the mean adds at most 0.3% to an error
WINDOW = 50  # rows; of shorter records a quarter of the rows that are predicted

Means = Callable[[pd.DataFrame], np.ndarray]  # data -> (T, channels), of missing rows too


def through(model: Model, parameters: dict[str, float], channels: Sequence[str]) -> Means:
    """Predictions of a model by its particle filter."""

    def means(data: pd.DataFrame) -> np.ndarray:
        found = ssm.particle_filter(model, data, parameters, particles=PARTICLES, seed=1)
        assert not isinstance(found, list)  # one experiment, one Dataset
        return np.stack([found[f"{c}_predicted"].values[0] for c in channels], axis=-1)

    return means


def true_model(system: System, answer: dict, data: pd.DataFrame) -> Means:
    """The same of the true model, refitted to the rows before the last 30%."""
    found = refitted(system, answer, *arrays(system, data))
    return lambda shown: predictions(system, found.p, found.e, *arrays(system, shown))


def windows(rows: int) -> list[np.ndarray]:
    """Two masks (rows,): the windows that are predicted in the first and in the second pass."""
    cut = int(CONFIRM * rows)
    width = min(WINDOW, max((rows - cut) // 4, 1))
    number = np.maximum(np.arange(rows) - cut, -1) // width
    return [(number >= 0) & (number % 2 == k) for k in range(2)]


def squares(means: Means, system: System, data: pd.DataFrame, scale: np.ndarray) -> float:
    """Sum of the squared errors in all windows of one run."""
    channels, total = list(system.channels), 0.0
    for hidden in windows(len(data)):
        shown = data.copy()
        shown.loc[hidden, channels] = np.nan
        error = (data[channels].to_numpy(float) - means(shown))[hidden] / scale
        total += float(np.nansum(error**2))
    return total


def of_record(record: Record, answer: dict) -> dict[str, float]:
    """Root mean square errors of the model before and after, over the true model's."""
    folder = SETS / record.id
    data = pd.read_csv(folder / "data.csv")
    system = SYSTEMS[answer["system"]]
    channels = system.channels
    before = load_model(str(folder / "model.py"))
    models = {
        "true": true_model(system, answer, data),
        "before": through(before, estimated(record, "before"), channels),
        "after": through(handed_back(record), estimated(record, "after"), channels),
    }
    scale = np.nanstd(arrays(system, data)[1], axis=0)
    total = dict.fromkeys(models, 0.0)
    for fresh in fresh_runs(system, answer, data):
        for name, means in models.items():
            total[name] += squares(means, system, fresh, scale)
    return {name: float(np.sqrt(total[name] / total["true"])) for name in ("before", "after")}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--half", choices=list(SPLIT["halves"]))
    parser.add_argument("--cell", choices=CELLS)
    parser.add_argument("--method", default="diagnose")
    options = parser.parse_args()
    path = CACHE / "simulated.json"
    done = json.loads(path.read_text()) if path.exists() else {}
    mine = done.setdefault(options.method, {})
    kept = records(options.method)
    for entry in entries():
        record = kept.get(entry.id)
        wanted = options.half in (None, entry.half) and options.cell in (None, entry.cell)
        if not wanted or entry.system not in SYSTEMS or record is None or not record.model_text:
            continue
        if len(entry.effects) != 1 or mine.get(entry.id, {}).get("digest") == record.digest:
            continue
        answer = opened([entry.id])[entry.id]
        if not Scored(record, answer).right_class:
            continue
        found = of_record(record, answer)
        mine[entry.id] = {**found, "digest": record.digest}
        path.write_text(json.dumps(done, indent=1))
        print(entry.id, {k: round(v, 3) for k, v in found.items()}, flush=True)


if __name__ == "__main__":
    main()
