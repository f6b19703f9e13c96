"""F of the chosen effects against the true model, its interval, and F* on fresh data.

    python -m bench.gap.fresh [--half confirm] [--cell one-20] [--method diagnose]

The reference C is the true model, refitted to the first 70% of the rows (its parameters and its
effects' strengths). F of the report's model and its interval are made by the tool's own
`ssmppl.diagnosis.heldout.gain_ratio` on the held-out rows. F* is the same ratio at the same fitted
parameters, over the held-out rows of 20 fresh runs of the true system with the same inputs (in a
closed loop, with the same references).
Opens the answers:
run it after the diagnosis, before `score.py`, which reads `cache/fresh.json`.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pandas as pd

from bench.gap.diagnosed import Diagnosed
from bench.gap.filter import terms
from bench.gap.fit import Fitted, fit
from bench.gap.plan import CELLS, SPLIT, Entry, entries
from bench.gap.records import CACHE, Record
from bench.gap.run import SETS
from bench.gap.score import opened, records
from bench.gap.truth import SYSTEMS, System
from ssmppl.diagnosis.heldout.gain_ratio import gain_ratio
from ssmppl.language.model.model import Model
from ssmppl.modelfile import load_model

CONFIRM = 0.7  # share of the rows before the confirm part
RUNS = 20  # fresh runs
REPEATS = 8  # runs of a particle filter on the set itself


@dataclass(frozen=True)
class Predictive:
    """Log predictive densities of the rows behind `CONFIRM`: of stretches or rows, (repeats, T)
    with 0 before them, by repeated runs of a filter; and of all of them."""

    rows: Callable[[pd.DataFrame, int], np.ndarray]
    total: Callable[[pd.DataFrame], float]


def through(model: Model, parameters: Mapping[str, float]) -> Predictive:
    """Of a model by the filter that a diagnosis has for it."""

    def rows(data: pd.DataFrame, repeats: int) -> np.ndarray:
        behind = np.arange(len(data)) >= cut_of(data)
        return Diagnosed.of(model, data, parameters).predictive(behind, repeats)

    return Predictive(rows, lambda data: Diagnosed.of(model, data, parameters).later(cut_of(data)))


def cut_of(data: pd.DataFrame) -> int:
    """The first of the rows that no fit used."""
    return int(CONFIRM * len(data))


def reference(system: System, answer: dict, U: np.ndarray, Y: np.ndarray) -> Predictive:
    """The same of the true model, refitted to the first 70% of a set's rows."""
    found = refitted(system, answer, U, Y)

    def rows(data: pd.DataFrame, repeats: int) -> np.ndarray:
        U, Y = arrays(system, data)
        ll = terms(system, found.p, found.e, U, Y)[0].sum(axis=1)
        ll[: cut_of(data)] = 0.0
        return np.repeat(ll[None], repeats, axis=0)

    return Predictive(rows, lambda data: float(rows(data, 1).sum()))


def refitted(system: System, answer: dict, U: np.ndarray, Y: np.ndarray) -> Fitted:
    """The true model's parameters and strengths by the first 70% of a set's rows."""
    keys = tuple(e["key"] for e in answer["effects"])
    strengths = {e["key"]: e["strength"] for e in answer["effects"]}
    p = parameters(system, answer)
    return fit(system, U, Y, keys, p, system.strengths(strengths), int(CONFIRM * len(Y)))


def parameters(system: System, answer: dict) -> np.ndarray:
    """(P,) true values in the system's order; an answer has its keys sorted."""
    return np.array([answer["parameters"][name] for name in system.parameters])


def arrays(system: System, data: pd.DataFrame) -> tuple[np.ndarray, np.ndarray]:
    """Inputs (T, inputs) and observations (T, channels) of a table."""
    return (data[list(system.inputs)].to_numpy(float), data[list(system.channels)].to_numpy(float))


def share(
    base: Predictive,
    effect: Predictive,
    true: Predictive,
    system: System,
    answer: dict,
    data: pd.DataFrame,
) -> dict[str, float]:
    """F, its interval and F* of one model (NaN where no gap is measurable)."""
    models, cut = (base, effect, true), cut_of(data)
    parts = [m.rows(data, REPEATS)[:, cut:] for m in models]
    found = gain_ratio(*parts)
    total = np.zeros(2)
    for fresh in fresh_runs(system, answer, data):
        l0, lk, lc = (m.total(fresh) for m in models)
        total += lk - l0, lc - l0
    return {
        "F": found.F,
        "low": found.low,
        "high": found.high,
        "F_star": float(total[0] / total[1]) if total[1] else math.nan,
    }


def fresh_runs(system: System, answer: dict, data: pd.DataFrame) -> Iterator[pd.DataFrame]:
    """Tables like `data` of `RUNS` further runs of the true system."""
    p = parameters(system, answer)
    e = system.strengths({x["key"]: x["strength"] for x in answer["effects"]})
    excited, _ = arrays(system, data)
    if system.control is not None:  # the same references: the commands are each run's own
        again = np.random.default_rng(answer["seed"])
        system.drawn_parameters(again)
        excited = system.excite(again, len(data))
    for k in range(RUNS):
        rng = np.random.default_rng([answer["seed"], 1 + k])
        U, _, Y = system.recorded(p, e, excited, rng)
        fresh = data.copy()
        fresh[list(system.inputs)] = U
        fresh[list(system.channels)] = Y
        yield fresh


def estimated(record: Record, when: str) -> dict[str, float]:
    """The parameters of the model "before" or "after" the diagnosis."""
    return {name: pair[0] for name, pair in record.estimates[when].items()}


def handed_back(record: Record) -> Model:
    """The model with the chosen effects that a diagnosis handed back."""
    with TemporaryDirectory() as scratch:
        path = Path(scratch) / f"augmented_{record.id}.py"
        path.write_text(record.model_text)
        return load_model(str(path))


def of_record(record: Record, answer: dict) -> dict[str, float]:
    """F and F* of the model that a diagnosis handed back."""
    folder = SETS / record.id
    data = pd.read_csv(folder / "data.csv")
    system = SYSTEMS[answer["system"]]
    return share(
        through(load_model(str(folder / "model.py")), estimated(record, "before")),
        through(handed_back(record), estimated(record, "after")),
        reference(system, answer, *arrays(system, data)),
        system,
        answer,
        data,
    )


Measured = Callable[[Record, dict], dict[str, float]]  # record and its answer -> numbers to keep


def measure_each(
    kept_in: str, of_record: Measured, wanted: Callable[[Entry, Record], bool], about: str | None
) -> None:
    """Measure the records that the command line asks for and that are not in the cache's file yet;
    of the arm none, which has no filter of its own."""
    parser = argparse.ArgumentParser(description=about)
    parser.add_argument("--half", choices=list(SPLIT["halves"]))
    parser.add_argument("--cell", choices=CELLS)
    parser.add_argument("--method", default="diagnose")
    options = parser.parse_args()
    path = CACHE / kept_in
    done: dict[str, dict[str, dict[str, Any]]] = (
        json.loads(path.read_text()) if path.exists() else {}
    )
    mine = done.setdefault(options.method, {})
    kept = records(options.method)
    for entry in entries():
        record = kept.get(entry.id)
        asked = options.half in (None, entry.half) and options.cell in (None, entry.cell)
        if not asked or entry.system not in SYSTEMS or record is None or not record.model_text:
            continue
        if mine.get(entry.id, {}).get("digest") == record.digest or not wanted(entry, record):
            continue
        found = of_record(record, opened([entry.id])[entry.id])
        mine[entry.id] = {**found, "digest": record.digest}
        path.write_text(json.dumps(done, indent=1))
        print(entry.id, {k: round(v, 3) for k, v in found.items()}, flush=True)


if __name__ == "__main__":
    measure_each("fresh.json", of_record, lambda entry, _: bool(entry.effects), __doc__)
