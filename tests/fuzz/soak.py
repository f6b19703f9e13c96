"""`python -m tests.fuzz.soak HOURS [--table CSV]`: all verbs over and over in one process.

Every round simulates data of another length and calls each verb on them, with files of results and
checkpoints, and with errors on the way, as a server or a notebook left open would. Memory has to
stay what it was after the first rounds: what a call keeps, it keeps for good. Written down are the
memory (resident, MiB), open files and threads after rounds, and the growth per 1,000 calls by least
squares over all rounds after the first quarter.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import os
import resource
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import arviz as az
import numpy as np

import ssmppl as ssm
from tests.models.checkpoints import CALLS, pair

COUNTS = ssm.Model("counts")
SHORT: dict[str, Any] = {"draws": 6, "warmup": 4, "chains": 2, "progress": False}
AT = {"b": [0.5, -0.5], "q": 0.3, "r": 0.2}


@COUNTS.prior
def counts_prior():
    return {"a": ssm.Uniform(0, 1), "q": ssm.InverseGamma(3, scale=1)}


@COUNTS.initial
def counts_initial():
    return {"x": ssm.Normal(0, sd=1)}


@COUNTS.transition
def counts_transition(x, a, q):
    return {"x": ssm.Normal(a * x, variance=q)}


@COUNTS.observation
def counts_observation(x):
    return {"y": ssm.Poisson(np.exp(x))}


def calls(seed: int, folder: Path) -> Iterator[tuple[str, Callable[[], Any]]]:
    """Name and call, of one round; the data's length varies, so that buffers cannot be shared."""
    steps = 10 + seed % 17
    given = {"seed": seed, "progress": False}
    u = np.sin(np.arange(steps) / 3.0)
    drawn = ssm.simulate(pair, AT, inputs={"u": u}, steps=steps, seed=seed)["y"].values[0].copy()
    drawn[2] = np.nan
    data = {"y": drawn, "u": u}
    at = {"a": 0.8, "q": 0.2}
    counts = {"y": ssm.simulate(COUNTS, at, steps=steps, seed=seed)["y"].values[0]}
    for name, (method, more) in CALLS.items():
        short = {**SHORT, **more, "seed": seed, "warmup": 4, "checkpoint": folder / f"{name}.npz"}
        yield f"sample {name}", lambda m=method, s=short: ssm.sample(pair, data, m, **s)
    yield "log_likelihood", lambda: ssm.log_likelihood(COUNTS, counts, at, particles=200, seed=seed)
    yield "particle_filter", lambda: ssm.particle_filter(COUNTS, counts, at, particles=200, seed=1)
    yield "kalman_filter", lambda: ssm.kalman_filter(pair, data, AT)
    for method in (None, "ffbsi", "fixed_lag", "pgas"):
        yield (
            f"smooth {method}",
            lambda m=method: ssm.smooth(
                COUNTS, counts, at, m, particles=20, trajectories=5, seed=seed
            ),
        )
    yield "score", lambda: ssm.score(COUNTS, counts, at, particles=20, trajectories=5, seed=seed)
    yield "maximize", lambda: ssm.maximize(pair, data, ssm.EM(iterations=5), start=AT, **given)
    yield "explain", lambda: str(ssm.explain(COUNTS, counts))
    yield "error", lambda: ssm.log_likelihood(COUNTS, {"y": [1.5, -2]}, at)

    def files() -> None:
        found = ssm.sample(COUNTS, counts, ssm.PGAS(particles=5), seed=seed, **SHORT)
        found.to_netcdf(folder / "found.nc")
        again = az.from_netcdf(folder / "found.nc")
        ssm.predict(COUNTS, again, counts, seed=seed)
        ssm.forecast(COUNTS, again, steps=3, seed=seed)
        again.close()

    yield "files", files


def state() -> tuple[float, int, int]:
    """Resident memory in MiB, open files, threads."""
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    mib = pages * resource.getpagesize() / 2**20
    return mib, len(os.listdir("/proc/self/fd")), threading.active_count()


def growth(rows: list[tuple[float, ...]]) -> float:
    """MiB per 1,000 calls over the rounds after the first quarter; NaN of fewer than three."""
    late = np.array(rows[len(rows) // 4 :])
    if len(late) < 3:
        return np.nan
    return 1000 * float(np.polyfit(late[:, 1], late[:, 2], 1)[0])


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("hours", type=float)
    parser.add_argument("--table", type=Path, help="a CSV file for the rounds")
    given = parser.parse_args()
    begun, done, rows = time.monotonic(), 0, []
    with tempfile.TemporaryDirectory() as folder:
        while (seconds := time.monotonic() - begun) < 3600 * given.hours:
            for _, call in calls(len(rows), Path(folder)):
                with contextlib.suppress(ssm.SSMError), warnings.catch_warnings():
                    warnings.simplefilter("ignore", UserWarning)
                    call()
                done += 1
            for file in Path(folder).iterdir():
                file.unlink()
            rows.append((seconds / 60, done, *state()))
            line = ",".join(f"{v:.4g}" if isinstance(v, float) else str(v) for v in rows[-1])
            print(line, flush=True)
            if given.table:
                with given.table.open("a" if len(rows) > 1 else "w") as out:
                    out.write("minutes,calls,MiB,files,threads\n" if len(rows) == 1 else "")
                    out.write(line + "\n")
    print(f"{done} calls in {len(rows)} rounds, {growth(rows):+.2f} MiB per 1,000 calls")
    return 0


if __name__ == "__main__":
    sys.exit(main())
