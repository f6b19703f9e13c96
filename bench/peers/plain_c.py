"""C written by hand: in passes (`c/filters.c`, `c/smoothers.c`)."""

from __future__ import annotations

import subprocess
import tempfile
from pathlib import Path

import numpy as np

from ssmppl.datasets import ice_varves

from .tasks import FFBSI_DRAWS, WALKS, Task, Work, lgss_series, pendulum_series, walk_series

NAME, PACKAGES = "C by hand", ()
HERE = Path(__file__).parents[1]
FLAGS = ["-O3", "-march=native", "-fno-math-errno", "-fno-trapping-math", "-ffp-contract=fast",
         "-Wno-psabi"]  # fmt: skip
MODELS = {"bootstrap": "varves", "guided": "lgss", "pendulum": "pendulum"}
MODELS |= {f"walk{d}": f"walk{d}" for d in WALKS}
_series = Path(tempfile.mkdtemp())


def compiled(name: str) -> Path:
    """The program, compiled for this machine."""
    program = HERE / "build" / name
    program.parent.mkdir(exist_ok=True)
    source = HERE / "c" / f"{name}.c"
    subprocess.run(["gcc", *FLAGS, source, "-o", program, "-lm"], check=True)
    return program


def written(name: str, y: np.ndarray) -> Path:
    """A series as a file."""
    file = _series / f"{name}.txt"
    np.savetxt(file, y, fmt="%.17g")
    return file


def seconds_of(program: Path, *arguments: object) -> float:
    """The second number of the one line that a program prints."""
    out = subprocess.run(
        [program, *map(str, arguments)], capture_output=True, text=True, check=True
    ).stdout
    return float(out.split()[1])


def prepare(task: Task) -> Work | None:
    if task.kind in MODELS:
        program, name = compiled("filters"), MODELS[task.kind]
        if name.startswith("walk"):
            series = walk_series(int(name.removeprefix("walk")))
        else:
            series = {"varves": ice_varves, "lgss": lgss_series, "pendulum": pendulum_series}[
                name
            ]()
        file = written(name, series)
        return lambda: seconds_of(program, name, file, 5, task.n)
    if task.kind in ("csmc", "ffbsi"):
        program, file = compiled("smoothers"), written("varves", ice_varves())
        if task.kind == "csmc":
            return lambda: seconds_of(program, "csmc", file, 400, task.n)
        return lambda: seconds_of(program, "ffbsi", file, 3, task.n, FFBSI_DRAWS)
    return None
