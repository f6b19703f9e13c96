"""Cold and warm start on the ice varves, in seconds per stage, each in a fresh process.

Beside the time on the clock stands, in brackets, the processor time of the process: on a machine
that does other work too, the clock tells how busy that was.

Cold: an empty cache of compiled models. Warm: the cache that the cold start left. Both end with
the first draw of `sample`; Numba's own start is part of the import.

    python bench/start.py
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile

import numpy as np
from table import show

REPEATS = 3
STAGES = """
import json, time
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
from ssmppl.datasets import ice_varves
from ssmppl.demo import varves
from ssmppl.inference.problem import pose
y = {"y": ice_varves()}
stage("data, model")
pose(varves, y)
stage("trace, derive, generate")
at = {"phi": 0.95, "tau": 50.0}
ssm.log_likelihood(varves, y, at, proposal="bootstrap", seed=1)
stage("first log-likelihood, N = 1,000")
ssm.log_likelihood(varves, y, at, proposal="bootstrap", seed=1)
stage("second log-likelihood")
ssm.sample(varves, y, METHOD, draws=1, warmup=0, chains=1, seed=1, progress=False)
stage("first draw of sample, METHOD")
print(json.dumps(times))
"""


def run(folder: str, method: str) -> dict[str, np.ndarray]:
    """Stage -> seconds on the clock and of the processor, in a process of its own."""
    script = STAGES.replace("METHOD)", f"{method})").replace("METHOD,", f"ssm.{method}(),", 1)
    script = script.replace("METHOD", method)
    env = {**os.environ, "SSMPPL_CACHE": folder}
    out = subprocess.run([sys.executable, "-c", script], env=env, capture_output=True, text=True)
    if out.returncode:
        raise SystemExit(out.stderr)
    found = json.loads(out.stdout.splitlines()[-1])
    return {stage: np.array(seconds) for stage, seconds in found.items()}


def _text(seconds: np.ndarray) -> str:
    return f"{seconds[0]:.2f} ({seconds[1]:.2f})"


def main() -> None:
    found: dict[str, list[dict[str, np.ndarray]]] = {}
    for method in ("PGAS", "PMMH"):
        for _ in range(REPEATS):
            with tempfile.TemporaryDirectory() as folder:
                found.setdefault(f"{method} cold", []).append(run(folder, method))
                found.setdefault(f"{method} warm", []).append(run(folder, method))
    columns = {
        name: {k: np.median([r[k] for r in runs], axis=0) for k in runs[0]}
        for name, runs in found.items()
    }
    rows = []
    for stage in dict.fromkeys(k for c in columns.values() for k in c):
        rows.append([stage, *(_text(c[stage]) if stage in c else "" for c in columns.values())])
    totals = [_text(sum(c.values(), np.zeros(2))) for c in columns.values()]
    print(f"Seconds (of the processor), medians of {REPEATS} fresh processes.\n")
    show(["stage", *columns], [*rows, ["total", *totals]])


if __name__ == "__main__":
    main()
