"""Cold, edited and warm start, in seconds per stage, each in a fresh process: the ice varves up to
a first draw, and a model of ten states up to its likelihoods.

Beside the time on the clock stands, in brackets, the processor time of the process: on a machine
that does other work too, the clock tells how busy that was.

Cold: an empty cache of compiled models. Edited: the cache that the start of another model left, as
after every change of one's own; the change here is too small to alter a choice that depends on
numbers. Warm: the cache that the same model left. The varves end with the result of `sample` with
one draw, for which ArviZ is imported. Numba's own start is part of the import of ssmppl, Python's
compiling of the package is not.

    python bench/start.py

The medians are kept in docs/figures/start.csv, for the page on performance.
"""

from __future__ import annotations

import csv
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from table import show

TABLE = Path(__file__).parents[1] / "docs" / "figures" / "start.csv"
REPEATS = 3
HEAD = """
import importlib, json, time
import numpy as np
def now():
    return np.array([time.perf_counter(), time.process_time()])
times, last = {}, now()
def stage(name):
    global last
    times[name] = list(now() - last)
    last = now()
import ssmppl as ssm
stage("import ssmppl")
from ssmppl.inference.run.problem import pose
"""
VARVES = """
from ssmppl.datasets import ice_varves
varves = ssm.Model("varves")
varves.prior(lambda: {"phi": ssm.Uniform(-1, 1), "tau": ssm.Gamma(0.01, rate=0.01)})
varves.initial(lambda phi, tau: {"x": ssm.Normal(0, precision=(1 - phi**2) * tau)})
varves.transition(lambda x, phi, tau: {"x": ssm.Normal(phi * x, precision=tau)})
varves.observation(lambda x: {"y": ssm.Gamma(SHAPE, rate=0.256 * np.exp(-x))})
y = {"y": ice_varves()}
stage("data, model")
pose(varves, y)
stage("trace, derive, generate")
at = {"phi": 0.95, "tau": 50.0}
ssm.log_likelihood(varves, y, at, proposal="bootstrap", seed=1)
stage("first log-likelihood, N = 1,000")
ssm.log_likelihood(varves, y, at, proposal="bootstrap", seed=1)
stage("second log-likelihood")
verb = importlib.import_module("ssmppl.inference.verbs.sample")
result = verb._to_arviz
def drawn(*args, **more):
    stage("first draw of sample, METHOD")
    return result(*args, **more)
verb._to_arviz = drawn
ssm.sample(varves, y, ssm.METHOD(), draws=1, warmup=0, chains=1, seed=1, progress=False)
stage("ArviZ's import, the result")
print(json.dumps(times))
"""
TEN_STATES = """
import sys
sys.path.insert(0, BENCH)
from models import lorenz
model = lorenz(10, STEP)
y = {"y": np.random.default_rng(1).normal(2.0, 3.0, size=(50, 5))}
stage("data, model")
pose(model, y)
stage("trace, derive, generate")
for proposal in ("bootstrap", "guided", "auto"):
    ssm.log_likelihood(model, y, {}, proposal=proposal, seed=1)
    stage(f"first log-likelihood, {proposal}")
print(json.dumps(times))
"""


def varves(method: str, edited: bool) -> str:
    """The script for the varves up to a first draw."""
    text = VARVES.replace("METHOD", method)
    return HEAD + text.replace("SHAPE", "6.25 + 1e-9" if edited else "6.25")


def ten_states(edited: bool) -> str:
    """The script for a Lorenz-96 model with ten states, five of them seen, 50 rows."""
    text = TEN_STATES.replace("BENCH", repr(str(Path(__file__).parent)))
    return HEAD + text.replace("STEP", "0.05 + 1e-9" if edited else "0.05")


def run(folder: str, script: str) -> dict[str, np.ndarray]:
    """Stage -> seconds on the clock and of the processor, in a process of its own."""
    env = {**os.environ, "SSMPPL_CACHE": folder, "PYTHONDONTWRITEBYTECODE": ""}
    out = subprocess.run([sys.executable, "-c", script], env=env, capture_output=True, text=True)
    if out.returncode:
        raise SystemExit(out.stderr)
    found = json.loads(out.stdout.splitlines()[-1])
    return {stage: np.array(seconds) for stage, seconds in found.items()}


def _import_once() -> None:
    """Python's own compiling of the package."""
    env = {**os.environ, "PYTHONDONTWRITEBYTECODE": ""}
    subprocess.run([sys.executable, "-c", "import ssmppl"], env=env, check=True)


def _text(seconds: np.ndarray) -> str:
    return f"{seconds[0]:.2f} ({seconds[1]:.2f})"


def measured(title: str, script: Callable[[bool], str]) -> dict[str, dict[str, np.ndarray]]:
    """Medians by start and stage."""
    found: dict[str, list[dict[str, np.ndarray]]] = {}
    for _ in range(REPEATS):
        with tempfile.TemporaryDirectory() as folder:
            found.setdefault(f"{title} cold", []).append(run(folder, script(False)))
            found.setdefault(f"{title} edited", []).append(run(folder, script(True)))
            found.setdefault(f"{title} warm", []).append(run(folder, script(False)))
    return {
        name: {k: np.median([r[k] for r in runs], axis=0) for k in runs[0]}
        for name, runs in found.items()
    }


def main() -> None:
    _import_once()
    columns: dict[str, dict[str, np.ndarray]] = {}
    for method in ("PGAS", "PMMH"):
        columns |= measured(method, partial(varves, method))
    ten = measured("ten states", ten_states)
    print(f"Seconds (of the processor), medians of {REPEATS} fresh processes.\n")
    _print(columns)
    print("\nLorenz-96, ten states, five of them seen, 50 rows, N = 1,000:\n")
    _print(ten)
    with TABLE.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("start", "stage", "seconds", "processor"))
        for name, column in (columns | ten).items():
            writer.writerows((name, k, f"{v[0]:.3f}", f"{v[1]:.3f}") for k, v in column.items())


def _print(columns: dict[str, dict[str, np.ndarray]]) -> None:
    rows = []
    for stage in dict.fromkeys(k for c in columns.values() for k in c):
        rows.append([stage, *(_text(c[stage]) if stage in c else "" for c in columns.values())])
    totals = [_text(sum(c.values(), np.zeros(2))) for c in columns.values()]
    show(["stage", *columns], [*rows, ["total", *totals]])


if __name__ == "__main__":
    main()
