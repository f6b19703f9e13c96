"""ssmppl against C, JAX by hand and other packages: the same work in turns, medians with spread.

    python bench/against.py [kind ...]

The other packages are the extra `peers` (`pip install -e '.[peers]'`); which are missing is said.
Each figure is the median of several turns, in which all programs run one after the other, with the
quartiles; in brackets its ratio to ssmppl: above 1, ssmppl is that many times as fast. The figures
are kept in docs/figures/against.csv, for the page on performance; with kinds of work for arguments
(bootstrap, pmmh, ...) only these are done, and their rows replaced.
"""

from __future__ import annotations

import csv
import importlib
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
from peers import starts
from peers.tasks import TASKS, Task, Work
from table import machine, show, versions

TABLE = Path(__file__).parents[1] / "docs" / "figures" / "against.csv"
HEADER = ("work", "unit", "more is better", "program", "lower quartile", "median", "upper quartile")
SHORT = 0.05  # seconds
PROGRAMS = (
    "own", "plain_c", "jax_by_hand", "particles_", "cuthbert_", "pypomp_", "dynamax_",
)  # fmt: skip


def programs() -> tuple[list[ModuleType], list[str]]:
    """Those that can be imported, and why others cannot."""
    found, missing = [], []
    for name in PROGRAMS:
        try:
            found.append(importlib.import_module(f"peers.{name}"))
        except ImportError as error:
            missing.append(f"{name.strip('_').replace('_', ' ')}: {error}")
    return found, missing


def measured(task: Task, all_of_them: list[ModuleType], failed: list[str]) -> dict[str, np.ndarray]:
    """By program, the figures of each turn; what fails in another program is noted in `failed`."""
    works: dict[str, Work] = {}
    for program in all_of_them:
        try:
            if task.kind.startswith("start-"):
                work = starts.prepare(program.__name__.split(".")[-1], task)
            else:
                work = program.prepare(task)
        except Exception as error:
            if program.NAME == "ssmppl":
                raise
            failed.append(f"{program.NAME}, {task.label}: {type(error).__name__}: {error}")
            continue
        if work is not None:
            works[program.NAME] = work
    figures: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(task.rounds):
        for name, work in works.items():
            figures[name].append(task.figure(_timed(work)))
    return {name: np.array(values) for name, values in figures.items()}


def _timed(work: Work) -> float:
    """Seconds of one unit: the median of five where that is short."""
    first = work()
    return first if first > SHORT else float(np.median([first, *(work() for _ in range(4))]))


def main(kinds: list[str]) -> None:
    found, missing = programs()
    rows, kept = [], _kept()
    for task in TASKS:
        if kinds and task.kind not in kinds:
            continue
        figures = measured(task, found, missing)
        own = np.median(figures["ssmppl"])
        row, kept[task.label] = [task.label, task.unit], []
        for program in found:
            if program.NAME not in figures:
                row.append("")
                continue
            low, middle, high = np.quantile(figures[program.NAME], [0.25, 0.5, 0.75])
            ratio = own / middle if task.rate else middle / own
            text = f"{_short(middle)} ({_short(low)} to {_short(high)})"
            figures_kept = (f"{x:.4g}" for x in (low, middle, high))
            kept[task.label].append((task.label, task.unit, task.rate, program.NAME, *figures_kept))
            row.append(text if program.NAME == "ssmppl" else f"{text} [{ratio:.3g}]")
        rows.append(row)
        print(*row, sep=" | ", file=sys.stderr, flush=True)
    with TABLE.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(HEADER)
        writer.writerows(row for task in TASKS for row in kept.get(task.label, ()))
    packages = [p for program in found for p in program.PACKAGES]
    print(f"{machine()}; {versions(*packages)}. One process, as many threads as each takes.\n")
    show(["work", "unit", *(program.NAME for program in found)], rows)
    for line in missing:
        print(f"\nMissing: {line}")


def _kept() -> dict[str, list[tuple]]:
    """The rows of earlier runs, by work."""
    found: dict[str, list[tuple]] = {}
    if TABLE.exists():
        with TABLE.open(newline="", encoding="utf-8") as file:
            for row in list(csv.reader(file))[1:]:
                found.setdefault(row[0], []).append(tuple(row))
    return found


def _short(x: float) -> str:
    return f"{x:.0f}" if x >= 100 else f"{x:.3g}"


if __name__ == "__main__":
    main(sys.argv[1:])
