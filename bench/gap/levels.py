"""Screens at lower levels of the process noise, which were tried and left out (`RESULTS.md`).

    python -m bench.gap.levels c050 c001 ...

For each set, of the halves that are open: the score tests as in a diagnosis, and with the scales of
the process noise at 0.3 and 0.1 of what was fitted, all else as it was. The simulated sets are the
same at every level. Their scores at a level are regressed on the nuisance scores at the fit, which
are those that a refit makes zero, with an intercept, as their means need not be zero there. Printed
are processor seconds and, of each level, the six groups that stand highest: their height on the
common scale and their family-wise p.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

import ssmppl.diagnosis.diagnose as diagnosis
from bench.gap.plan import entries
from bench.gap.run import SETS
from ssmppl.diagnosis.run.failures import Failures
from ssmppl.diagnosis.screening.efficient_score import Null, efficient
from ssmppl.diagnosis.screening.familywise import FamilyWise, familywise
from ssmppl.diagnosis.screening.screen import OWN_RUNS, Screen, ScreenDesign
from ssmppl.diagnosis.screening.statistics import information_scale, typical_squares
from ssmppl.diagnosis.selection.simulation_fit import process_noises
from ssmppl.errors import SamplingError
from ssmppl.inference.run.seeds import random_state
from ssmppl.modelfile import load_model, read_csv

LEVELS, SHOWN = (0.3, 0.1), 6


@dataclass
class Asked:
    """What a screen was asked with, and its answer."""

    design: ScreenDesign
    training: Sequence
    theta: np.ndarray
    sets: int
    seed: np.random.SeedSequence
    screen: Screen


def screened(id: str) -> tuple[Asked, list[str]]:
    """The screen of a diagnosis in full mode, and the scales of its model's process noise."""
    folder, kept, plain = SETS / id, [], diagnosis.run_screen

    def keep(design, training, theta, sets, seed, *others):
        found = plain(design, training, theta, sets, seed, *others)
        kept.append(Asked(design, training, theta, sets, seed, found))
        return found

    diagnosis.run_screen = keep
    try:
        model, data = load_model(str(folder / "model.py")), read_csv(folder / "data.csv")
        run = diagnosis._Diagnosis(
            model, data, None, "full", 0.05, None, None, None, None, False, 1, Failures(), None
        )
        results = run._screen()
    finally:
        diagnosis.run_screen = plain
    return kept[0], process_noises(results.base)


def at_level(asked: Asked, names: Sequence[str], level: float) -> FamilyWise:
    """The family-wise comparison with these scales at a share of what was fitted."""
    design, symbols = asked.design, asked.design.columns.base.parameter_symbols
    low = [level if s.data[1] in names else 1.0 for s in symbols]
    fitted, theta = design.theta(asked.theta), design.theta(asked.theta * low)
    found = []
    for k in range(OWN_RUNS + asked.sets):
        stream, data = random_state(asked.seed, k), list(asked.training)
        try:
            if k >= OWN_RUNS:
                data = design.simulator.sets(asked.training, fitted[: len(symbols)], stream)
            passes = design.smoother.run(data, theta, stream, predicted=False)
        except SamplingError:
            continue
        s = design.statistics(data, passes, stream, False)
        found.append((k, s.candidate_scores, s.squares))
    own = [f for f in found if f[0] < OWN_RUNS]
    drawn = [f for f in found if f[0] >= OWN_RUNS]
    nuisance = asked.screen.simulated.nuisance
    if len(nuisance) != len(drawn):
        raise SamplingError("other sets went through than at the fit", fix="take another set")
    scores, squares = (np.stack([f[i] for f in drawn]) for i in (1, 2))
    seen, size = (np.mean([f[i] for f in own], axis=0) for i in (1, 2))
    typical = typical_squares(squares)
    null = Null.of(
        scores / information_scale(squares, typical), nuisance, quadratic=True, sided=design.sided
    )
    by = information_scale(size, typical)
    e = efficient(null, seen / by, asked.screen.observed.nuisance)
    return familywise(e.statistic, e.null, sided=e.sided, groups=asked.screen.groups)


def told(asked: Asked, found: FamilyWise) -> str:
    out = []
    for g in np.argsort(-found.height)[:SHOWN]:
        c = asked.design.candidates[found.best[g]]
        out.append(f"{c.effect.name} {c.equation} {found.height[g]:.2f} p={found.p[g]:.3f}")
    return "; ".join(out)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("ids", nargs="+")
    known = {e.id: e for e in entries() if e.half != "sealed"}
    for id in parser.parse_args().ids:
        asked, names = screened(id)
        print(id, known[id].cell, known[id].system, known[id].effects, flush=True)
        print("  as fitted:", told(asked, asked.screen.family), flush=True)
        for level in LEVELS:
            begun = time.process_time()
            found = at_level(asked, names, level)
            print(f"  at {level} ({time.process_time() - begun:.0f} CPU s):", told(asked, found),
                  flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
