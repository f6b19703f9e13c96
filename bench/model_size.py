"""Time to the first likelihood, and to the first draws, by the size of a model.

A dynamic factor model with D states and K series, D K loadings and K variances. For each size a
process of its own; the kernels that all models share are in the cache, what belongs to the model is
not. The last line is the slope of log seconds on the log of the loadings.

    python -m bench.model_size
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from .table import machine, show, versions

HERE = Path(__file__).parent
SIZES = ((2, 10), (6, 20), (10, 20), (10, 40), (10, 100), (20, 100), (40, 100), (40, 200))
DRAWN = ((2, 10), (4, 30), (4, 100))  # sizes of which draws are taken, too
ROWS, DRAWS = 100, 10


def measured(states: int, series: int, draws: bool, cache: str) -> dict[str, float]:
    """Seconds of one process."""
    command = [sys.executable, "-m", "bench.model_size", str(states), str(series), str(int(draws))]
    environment = os.environ | {"SSMPPL_CACHE": cache, "OPENBLAS_NUM_THREADS": "1"}
    out = subprocess.run(
        command, check=True, capture_output=True, text=True, env=environment, cwd=HERE.parent
    )
    found: dict[str, float] = json.loads(out.stdout.splitlines()[-1])
    return found


def one(states: int, series: int, draws: bool) -> None:
    """In a process of its own."""
    import ssmppl as ssm

    # another model in every call, as a model's name is in its text
    model = ssm.Model(f"factors_{time.time_ns()}")
    shape = series, states

    @model.prior
    def prior():
        return {
            "C": ssm.Normal(np.zeros(shape), sd=1),
            "r": ssm.InverseGamma(np.full(series, 2.0), scale=1),
            "a": ssm.Uniform(-1, 1),
        }

    @model.initial
    def initial():
        return {"x": ssm.MvNormal(np.zeros(states), covariance=np.eye(states))}

    @model.transition
    def transition(x, a):
        return {"x": ssm.MvNormal(a * x, covariance=0.1 * np.eye(states))}

    @model.observation
    def observation(x, C, r):
        return {"y": ssm.Normal(C @ x, variance=r)}

    rng = np.random.default_rng(0)
    data = {"y": rng.standard_normal((ROWS, series))}
    theta = {"C": rng.standard_normal(shape), "r": np.ones(series), "a": 0.5}
    began = time.perf_counter()
    ssm.log_likelihood(model, data, theta)
    found = {"first": time.perf_counter() - began}
    began = time.perf_counter()
    ssm.log_likelihood(model, data, theta)
    found["next"] = time.perf_counter() - began
    if draws:
        began = time.perf_counter()
        kept = {"draws": DRAWS, "warmup": DRAWS, "chains": 1, "progress": False}
        ssm.sample(model, data, ssm.Gibbs(), seed=1, **kept)
        found["draws"] = time.perf_counter() - began
    print(json.dumps(found))


def main() -> None:
    """Print the table."""
    found: dict[tuple[int, int], dict[str, float]] = {}
    with tempfile.TemporaryDirectory() as cache:
        measured(2, 10, True, cache)  # what all models share
        for size in SIZES:
            found[size] = measured(*size, False, cache)
        for size in DRAWN:
            found[size] = {**found.get(size, {}), **measured(*size, True, cache)}
    print(f"{machine()}. {versions('numba', 'numpy')}\n")
    rows = [
        (d, k, f"{f['first']:.2f} s", f"{1e3 * f['next']:.1f} ms",
         f"{f['draws']:.1f} s" if "draws" in f else "")
        for (d, k), f in found.items()
    ]  # fmt: skip
    show(("states", "series", "first likelihood", "next", f"first {2 * DRAWS} sweeps"), rows)
    loadings = [d * k for d, k in SIZES]
    slope = np.polyfit(np.log(loadings), np.log([found[s]["first"] for s in SIZES]), 1)[0]
    print(f"\nslope {slope:.2f}")


if __name__ == "__main__":
    if len(sys.argv) > 1:
        one(int(sys.argv[1]), int(sys.argv[2]), sys.argv[3] == "1")
    else:
        main()
