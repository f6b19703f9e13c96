"""How long `diagnose` takes: by rows and mode, the first time and again, and on two processes.

A driven pendulum with two states of which the angle is measured; the machine has Coulomb friction
in its joint, the model has none. The first call of each generates its code, into an empty cache;
the second one finds it there, as the next record of the same machine does. Then the same over
Dask's LocalCluster of one process and of two, in turns: seconds and their ratio, of processes that
have done a diagnosis before, so that what they import is no part of it.

    python bench/diagnosis.py [--rows 200 1000] [--turns 3] [--skip-dask]
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager

import numpy as np
from table import machine, show, versions

import ssmppl as ssm

STEP, FINE = 0.05, 10  # seconds a row, steps of the machine in one
FRICTION, WIDTH = 1.5, 0.05  # rad/s^2, and rad/s over which it turns
GOALS = {("full", 1000): 60, ("full", 200): 30, ("fast", 1000): 10, ("fast", 200): 10}  # seconds

pendulum = ssm.Model("pendulum", inputs=("u",))


@pendulum.prior
def prior():
    return {
        "k": ssm.LogNormal(2, sd=0.7), "d": ssm.LogNormal(-1, sd=1),
        "s": ssm.HalfNormal(sd=0.5), "r": ssm.HalfNormal(sd=0.1),
    }  # fmt: skip


@pendulum.initial
def initial():
    return {"q": ssm.Normal(0, sd=0.2), "v": ssm.Normal(0, sd=0.2)}


@pendulum.transition
def transition(q, v, u, k, d, s):
    return {
        "q": ssm.Dirac(q + STEP * v),
        "v": ssm.Normal(v + STEP * (u - k * np.sin(q) - d * v), sd=s),
    }


@pendulum.observation
def observation(q, r):
    return {"y": ssm.Normal(q, sd=r)}


def record(rows: int, seed: int = 1) -> dict[str, np.ndarray]:
    """Angles y (rows,) in radians, torques u (rows,) over the moment of inertia, of the machine."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-6, 6, rows), 15)[:rows]
    y, q, v, h = np.empty(rows), 0.0, 0.0, STEP / FINE
    for t in range(rows):
        y[t] = q + 0.01 * rng.normal()
        for _ in range(FINE):
            v += h * (u[t] - 9.0 * np.sin(q) - 0.4 * v - FRICTION * np.tanh(v / WIDTH))
            q += h * v
        v += 0.02 * rng.normal()
    return {"y": y, "u": u}


def diagnosed(rows: int, mode: str, executor: Executor | None = None) -> tuple[float, float, str]:
    """Seconds on the clock, of this process's processor time, and what came first."""
    began = time.perf_counter(), time.process_time()
    report = ssm.diagnose(
        pendulum, record(rows), mode=mode, seed=1, progress=False, executor=executor
    )
    wall, own = time.perf_counter() - began[0], time.process_time() - began[1]
    first = report.causes.iloc[0]
    said = f"{first['effect']} in {first['equation']}" if report.verdict == "effect" else ""
    return wall, own, said or str(report.verdict)


def twice(rows: int, mode: str) -> list[str]:
    """The row of a mode, from a process of its own with an empty cache."""
    code = (
        "import sys; sys.path.insert(0, sys.argv[1])\n"
        "from diagnosis import diagnosed\n"
        f"for _ in range(2): print('|'.join(map(str, diagnosed({rows}, {mode!r}))), flush=True)"
    )
    with tempfile.TemporaryDirectory() as folder:
        run = subprocess.run(
            [sys.executable, "-c", code, os.path.dirname(os.path.abspath(__file__))],
            env=os.environ | {"SSMPPL_CACHE": folder}, capture_output=True, text=True, check=True,
        )  # fmt: skip
    first, again = (line.split("|") for line in run.stdout.splitlines()[-2:])
    times = [f"{float(x):.0f}" for x in (*first[:2], *again[:2])]
    return [mode, str(rows), *times, str(GOALS.get((mode, rows), "")), again[2]]


@contextmanager
def cluster(processes: int) -> Iterator[Executor]:
    """Dask's, with so many processes of one thread."""
    from distributed import Client, LocalCluster

    with (
        LocalCluster(n_workers=processes, threads_per_worker=1, dashboard_address=None) as made,
        Client(made) as client,
    ):
        yield client.get_executor(pure=False)


def by_dask(rows: int, turns: int) -> None:
    taken = []
    for turn in range(turns + 1):
        each = []
        for processes in (1, 2):
            with cluster(processes) as pool:
                diagnosed(200, "fast", pool)  # there, and all is imported
                each.append(diagnosed(rows, "full", pool)[0])
        taken += [each] * (turn > 0)  # the first turn fills the cache
    gain = [one / two for one, two in taken]
    one, two = np.median(taken, axis=0)
    show(
        ["full mode over Dask", "one process, s", "two, s", "ratio", "in the turns"],
        [[f"{rows} rows", f"{one:.0f}", f"{two:.0f}", f"{np.median(gain):.2f}",
          f"{min(gain):.2f} to {max(gain):.2f}"]],
    )  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--rows", nargs="+", type=int, default=[200, 1000])
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--skip-dask", action="store_true")
    options = parser.parse_args()
    print(f"{machine()}; {versions('ssmppl', 'numba', 'numpy')}\n")
    show(
        ["mode", "rows", "first, s", "CPU s", "again, s", "CPU s", "goal", "first cause"],
        [twice(n, mode) for mode in ("fast", "full") for n in options.rows],
    )
    if not options.skip_dask:
        by_dask(max(options.rows), options.turns)


if __name__ == "__main__":
    main()
