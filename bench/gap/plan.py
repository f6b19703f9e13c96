"""Which data sets there are: every one's half, cell, system, effects and seed.

All of it follows from `split.json`, which was written before anything was run. Within a half and a
cell the systems take turns and each system's effects take turns, from a random start, so that all
are met about equally often. Ids are shuffled: they tell neither the cell nor the system's effect.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations, cycle
from pathlib import Path

import numpy as np

from bench.gap import arm
from bench.gap.truth import SYSTEMS

SPLIT = json.loads((Path(__file__).parent / "split.json").read_text())
ONE, TWO, OUTSIDE = ("one-20", "one-50"), "two-50", "outside-50"
NONE = ("none", "none-start", "none-noise")
CELLS = (*SPLIT["cells"], arm.CELL, arm.CELL_NONE)
# Effects that no strength brings to 50 nats: the stronger they are the less moves that shows them.
# (The free pendulum's drag reaches them, by stopping it after a quarter of the rows.)
UNREACHABLE: frozenset[str] = frozenset(
    {
        "cart_pole/dead zone",
        "cart_pole/drag",
        "cart_pole/outliers",
        "chemostat/loss",
        "oscillator/coloured",
        "predator_prey/saturation",
        "swing/drag",
        "two_tanks/saturation",
    }
)


@dataclass(frozen=True)
class Entry:
    """One data set: `effects` are keys of its system's effects, `level` the nats of each (0 where
    they are not solved for)."""

    id: str
    half: str
    cell: str
    system: str
    effects: tuple[str, ...]
    level: int
    seed: int
    ci: bool = False

    @property
    def guess(self) -> float:
        """Factor on the centres of the priors in the model given."""
        return 3.0 if self.cell == "none-start" else 1.0

    @property
    def noise(self) -> float:
        """Factor on the centres of the noise scales' priors in the model given."""
        return 8.0 if self.cell == "none-noise" else 1.0


@cache
def entries() -> tuple[Entry, ...]:
    """All data sets, ordered by id."""
    made: list[Entry] = []
    for half, what in SPLIT["halves"].items():
        rng = np.random.default_rng(what["seed"])
        drawn: list[tuple[str, str, tuple[str, ...]]] = []
        for cell, counts in SPLIT["cells"].items():
            turns = {name: _turns(name, cell, what["seed"]) for name in what["systems"]}
            first = int(rng.integers(len(what["systems"])))
            for k in range(counts[half]):
                name = what["systems"][(first + k) % len(what["systems"])]
                drawn.append((cell, name, next(turns[name])))
        ids = rng.permutation(len(drawn))
        seeds = rng.integers(2**31, size=len(drawn))
        for (cell, name, effects), number, seed in zip(drawn, ids, seeds, strict=True):
            level = int(cell.rpartition("-")[2]) if effects else 0
            made.append(
                Entry(f"{half[0]}{number:03d}", half, cell, name, effects, level, int(seed))
            )
    made += _arms()
    chosen = _ci(made)
    marked = [replace(e, ci=e.id in chosen) for e in made]
    return tuple(sorted(marked, key=lambda e: e.id))


def _arms() -> list[Entry]:
    """The sets of the arm in MuJoCo, which no cell of the systems has."""
    what = SPLIT["arm"]
    drawn = [(arm.CELL, held) for held in arm.turns(what[arm.CELL])]
    drawn += [(arm.CELL_NONE, ())] * what[arm.CELL_NONE]
    rng = np.random.default_rng(what["seed"])
    ids, seeds = rng.permutation(len(drawn)), rng.integers(2**31, size=len(drawn))
    return [
        Entry(f"a{number:03d}", what["half"], cell, arm.NAME, effects, 0, int(seed))
        for (cell, effects), number, seed in zip(drawn, ids, seeds, strict=True)
    ]


def _turns(name: str, cell: str, seed: int) -> Iterator[tuple[str, ...]]:
    """Endless turns over what a cell's sets of one system hold.

    The two cells of one effect go through one order from both ends, so that together they meet
    every effect. What is drawn for one system depends on that system's effects alone.
    """
    system = SYSTEMS[name]
    rng = np.random.default_rng([seed, zlib.crc32(name.encode()), cell == TWO])
    inside = [k for k in system.inside if cell == ONE[0] or f"{name}/{k}" not in UNREACHABLE]
    held: list[tuple[str, ...]] = [()]
    if cell == OUTSIDE:
        held = [(key,) for key in system.outside]
    elif cell == TWO:
        held = list(combinations(inside, 2))
        held = [held[k] for k in rng.permutation(len(held))]
    elif cell in ONE:
        order = list(rng.permutation(list(system.inside)))
        held = [(str(k),) for k in order if k in inside]
        held = held if cell == ONE[0] else held[::-1]
    return cycle(held)


def _ci(made: list[Entry]) -> set[str]:
    """The fixed subset that runs with the project's checks: of each cell so many, evenly over the
    systems. From the tuning half only, so that looking at its results tunes nothing."""
    chosen: dict[str, str] = {}
    for cell, count in SPLIT["ci"].items():
        group = [e for e in made if e.cell == cell and e.half == "tuning"]
        for _ in range(count):
            used = list(chosen.values())
            best = min((e for e in group if e.id not in chosen),
                       key=lambda e: (used.count(e.system), e.id))  # fmt: skip
            chosen[best.id] = best.system
    return set(chosen)
