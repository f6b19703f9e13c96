"""From a fresh process to a first log-likelihood of the varves: what each program takes."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import ssmppl

from .tasks import Task, Work

# Other packages get the series from the file itself, so that none waits for ssmppl's import.
SCRIPT = """
import sys, types
import numpy as np
sys.path.insert(0, {bench!r})
if {module!r} != "own":
    datasets = types.ModuleType("ssmppl.datasets")
    datasets.ice_varves = lambda: np.loadtxt({series!r}, delimiter=",", skiprows=1, usecols=-1)
    sys.modules |= {{"ssmppl": types.ModuleType("ssmppl"), "ssmppl.datasets": datasets}}
import importlib
from peers.tasks import Task
program = importlib.import_module("peers.{module}")
program.prepare(Task("bootstrap", 1_000, "", "", 1.0, 1))
"""
PROGRAMS = ("own", "jax_by_hand", "particles_", "cuthbert_", "pypomp_")


def prepare(module: str, task: Task) -> Work | None:
    """Seconds from the interpreter's start to the end of one filter with 1,000 particles.

    Cold: ssmppl's folder of compiled models is empty. Warm: it is as the last start left it. The
    others keep nothing between processes.
    """
    if module not in PROGRAMS:
        return None
    series = Path(ssmppl.__file__).parent / "datasets" / "ice_varves.csv"
    bench = str(Path(__file__).parents[1])
    script = SCRIPT.format(bench=bench, module=module, series=str(series))
    kept = tempfile.TemporaryDirectory()

    def run() -> float:
        with tempfile.TemporaryDirectory() as empty:
            folder = kept.name if task.kind == "start-warm" else empty
            start = time.perf_counter()
            subprocess.run(
                [sys.executable, "-c", script],
                env={**os.environ, "SSMPPL_CACHE": folder},
                check=True,
            )
            return time.perf_counter() - start

    run()
    return run
