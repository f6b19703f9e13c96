"""The expected time of a diagnosis, from passes over the data that were timed."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass

from ssmppl.inference.run.executors import workers_of

REFITS = 24  # of single effects, overlooked ones, shapes, pairs and the reference, about
EVALUATIONS, FIT_PASSES = 1500, 60  # likelihoods and passes over the data in a fit, about
TOGETHER = 150  # likelihoods in a fit where many are looked at in one call
APPROXIMATE = 300  # likelihoods in an approximate fit
RECOVERY = 10_000  # likelihoods in fits of the leading effects to data simulated with each
SCREENS = 1.0  # as long as the first one that follow it: for further effects, under other inputs
TEXT = 0.3  # of the time that the screen's code took, which a fit's takes, one at a time
BESIDE = 1.5  # times as long as what is timed here alone: Python between the passes, and waiting
SIMULATED = 3 * 50  # approximate fits of simulated data in short records, about
FOLD_FITS, FOLD_PASSES = 8, 12  # approximate fits, and passes, for a block that is left out


@dataclass(frozen=True)
class Timed:
    """Seconds. screen_pass : over the data with all candidates. fit_pass : with the parameters
    only. generating : the screen's code. likelihood : one evaluation of those that climbs make."""

    screen_pass: float
    fit_pass: float
    generating: float
    likelihood: float = 0.0


def timed(run: Callable[[], object]) -> tuple[float, float]:
    """Seconds of a second call, and what the first one took longer: code was compiled for it."""
    begin = time.perf_counter()
    run()
    middle = time.perf_counter()
    run()
    end = time.perf_counter()
    return end - middle, max(middle - begin - (end - middle), 0.0)


def seconds(
    found: Timed, sets: int, mode: str, folds: int, executor: Executor | None, *,
    simulator: bool = False,
) -> float:  # fmt: skip
    """Expected, from the end of the first fit on.

    sets : simulated in the screen. folds : blocks that are left out in turn, 0 for three parts.
    simulator : whether the model calls one: its climbs look at many points at once, and take fewer
    in all, and simulated data are not refitted.
    """
    workers = workers_of(executor) or _cores()
    screen = sets * found.screen_pass / workers
    if mode == "fast":
        return screen
    evaluations = TOGETHER if simulator else EVALUATIONS
    one = evaluations * found.likelihood + FIT_PASSES * found.fit_pass * (not simulator)
    approximate, text = APPROXIMATE * found.likelihood, TEXT * found.generating
    total = screen * (1.0 + SCREENS) + REFITS * (one / workers + text)
    total += RECOVERY * found.likelihood / workers * (not simulator)
    if folds:
        if not simulator:
            total += SIMULATED * (approximate + found.screen_pass) / workers
        block = FOLD_FITS * approximate + FOLD_PASSES * found.screen_pass
        total += folds * (block / workers + 2.0 * text)
    return BESIDE * total


def in_words(value: float) -> str:
    """ "about 40 s", "about 3 min"."""
    if value < 90.0:
        return f"about {max(5, 5 * round(value / 5.0))} s"
    if value < 5400.0:
        return f"about {round(value / 60.0)} min"
    return f"about {value / 3600.0:.1f} h"


def _cores() -> int:
    """Number of cores that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1
