"""How long a diagnosis will take, from passes over the data that were timed."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass

from ssmppl.inference.executors import workers_of

REFITS = 24  # of single effects, their shapes, pairs and the reference, about
FIT_PASSES = 36  # over the data in a fit, about
SCREENS = 2.0  # as long as the first one that follow it: for further effects, under other inputs
FOLD_REFITS = 5


@dataclass(frozen=True)
class Timed:
    """Seconds. screen_pass : over the data with all candidates. fit_pass : with the parameters
    only. generating : the code that a fit needs, made anew for each kind of effect."""

    screen_pass: float
    fit_pass: float
    generating: float


def timed(run: Callable[[], object]) -> tuple[float, float]:
    """Seconds of a second call, and what the first one took longer: code was compiled for it."""
    begin = time.perf_counter()
    run()
    middle = time.perf_counter()
    run()
    end = time.perf_counter()
    return end - middle, max(middle - begin - (end - middle), 0.0)


def seconds(found: Timed, sets: int, mode: str, folds: int, executor: Executor | None) -> float:
    """Expected, from the end of the first fit on.

    sets : simulated in the screen. folds : blocks that are left out in turn, 0 for three parts.
    """
    workers = workers_of(executor) or _cores()
    screen = sets * found.screen_pass / workers
    if mode == "fast":
        return screen
    one = FIT_PASSES * found.fit_pass + found.generating
    total = screen * (1.0 + SCREENS) + REFITS * one / workers
    return total + folds * (0.5 * screen + FOLD_REFITS * one)


def in_words(value: float) -> str:
    """ "about 40 s", "about 3 min"."""
    if value < 90.0:
        return f"about {max(5, 5 * round(value / 5.0))} s"
    if value < 5400.0:
        return f"about {round(value / 60.0)} min"
    return f"about {value / 3600.0:.1f} h"


def _cores() -> int:
    """That this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1
