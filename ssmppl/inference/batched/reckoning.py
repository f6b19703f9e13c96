"""What calls of a simulator will cost, told before they are made."""

from __future__ import annotations

import sys
import time
from dataclasses import replace

import numpy as np

from ssmppl.analysis.structure import simulators
from ssmppl.errors import NotApplicable
from ssmppl.inference.batched.extended import extended_model
from ssmppl.inference.run.problem import Problem

ROWS, VECTORS = 3, 16  # that are timed
SHORT = 0.1  # seconds of a pass below which nothing is told


def reckon(title: str, problem: Problem, theta: np.ndarray, passes: float, shown: bool) -> None:
    """Print what so many passes over the data take, timed on the first rows; where there is a
    simulator, and it is no matter of a blink."""
    functions = simulators(problem.trace)
    if not shown or not functions:
        return
    model = extended_model(problem.trace)
    if isinstance(model, NotApplicable):
        return
    first = problem.experiments[0]
    n = min(ROWS, first.steps)
    few = replace(
        first, y=first.y[:n], seen=first.seen[:n], u=first.u[:n], steps=n,
        time=None if first.time is None else first.time[:n],
    )  # fmt: skip
    many = np.tile(theta, (VECTORS, 1))
    model.log_likelihoods([few], many)  # builds what is built once, and checks the simulator
    calls, begun = sum(f.calls for f in functions), time.perf_counter()
    points = sum(f.points for f in functions)
    model.log_likelihoods([few], many)
    seconds = (time.perf_counter() - begun) / n
    calls = sum(f.calls for f in functions) - calls
    points = sum(f.points for f in functions) - points
    rows = max(e.steps for e in problem.experiments)
    whole = calls * max(rows - 1, 1) // max(n - 1, 1)
    if seconds * rows < SHORT or not calls:
        return
    names = ", ".join(f.title for f in functions)
    print(
        f"{title}: the simulator {names}, {1e3 * seconds:.2g} ms a row with {points // calls} "
        f"points a call; about {whole} calls a pass over {rows} rows, and "
        f"{passes:.0f} passes: {_spelled(seconds * rows * passes)}",
        file=sys.stderr, flush=True,
    )  # fmt: skip


def _spelled(seconds: float) -> str:
    if seconds < 90:
        return f"about {max(seconds, 1):.0f} s"
    return f"about {seconds / 60:.0f} min" if seconds < 5400 else f"about {seconds / 3600:.1f} h"
