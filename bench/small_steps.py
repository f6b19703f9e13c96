"""Small steps of a differential equation: time to the first likelihood, and per particle against C.

The pendulum of `c/small_steps.c`, by `ssm.integrate` with one, 25 and 100 Runge-Kutta steps in each
of 700 rows. For each number of steps a process with an empty cache for the model (the kernels that
all models share are there); then the bootstrap filter's time less that of one step, so that what
is left are the steps, against the loop in C. Run in turn, medians.

    python -m bench.small_steps
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from .table import machine, show, versions

HERE = Path(__file__).parent
PARTICLES, ROWS, ROUNDS = 1000, 700, 7
STEPS = (1, 25, 100)


def compile_c() -> Path:
    """The loop in C, compiled for this machine."""
    program = HERE / "build" / "small_steps"
    program.parent.mkdir(exist_ok=True)
    source = HERE / "c" / "small_steps.c"
    command = ["gcc", "-O3", "-march=native", source, "-o", program, "-lm"]
    subprocess.run(command, check=True)
    return program


def run_c(program: Path, steps: int) -> float:
    """Seconds of all rows."""
    command = [str(program), str(PARTICLES), str(ROWS), str(steps), "3"]
    out = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return float(out.split()[1])


def measured(steps: int, proposal: str, cache: str) -> dict[str, float]:
    """Of one process: seconds of the "first" likelihood and of the "next", length of the "text"."""
    command = [sys.executable, "-m", "bench.small_steps", str(steps), proposal]
    environment = os.environ | {"SSMPPL_CACHE": cache, "OPENBLAS_NUM_THREADS": "1"}
    out = subprocess.run(command, check=True, capture_output=True, text=True, env=environment)
    found: dict[str, float] = json.loads(out.stdout.splitlines()[-1])
    return found


def one(steps: int, proposal: str) -> None:
    """In a process of its own."""
    import numpy as np

    import ssmppl as ssm

    # another model in every call, as a model's name is in its text
    model = ssm.Model(f"pendulum_{time.time_ns()}", inputs=("u",))

    @model.initial
    def initial():
        return {"q": ssm.Normal(0, sd=0.2), "v": ssm.Normal(0, sd=0.2)}

    @model.transition
    def transition(q, v, u):
        def swing(q, v):
            return {"q": v, "v": u - 9.0 * np.sin(q) - 0.5 * v}

        new = ssm.integrate(swing, {"q": q, "v": v}, 0.05, steps=steps)
        return {"q": ssm.Normal(new["q"], sd=0.002), "v": ssm.Normal(new["v"], sd=0.04)}

    @model.observation
    def observation(q):
        return {"y": ssm.Normal(q, sd=0.01)}

    u = 0.5 * np.sin(0.1 * np.arange(ROWS))
    data = {"u": u, "y": 0.05 * np.sin(0.12 * np.arange(ROWS))}
    seconds = []
    for _ in range(4):
        began = time.perf_counter()
        ssm.log_likelihood(model, data, {}, proposal=proposal, particles=PARTICLES, seed=1)
        seconds.append(time.perf_counter() - began)
    size = len(ssm.compile(model).source())
    print(json.dumps({"first": seconds[0], "next": min(seconds[1:]), "text": size}))


def main() -> None:
    """Print both tables."""
    program = compile_c()
    found: dict[tuple[int, str], list[dict[str, float]]] = {}
    c: dict[int, list[float]] = {s: [] for s in STEPS}
    with tempfile.TemporaryDirectory() as cache:
        for proposal in ("bootstrap", "twisted"):
            measured(1, proposal, cache)  # what all models share
        for _ in range(ROUNDS):
            for steps in STEPS:
                c[steps].append(run_c(program, steps))
                for proposal in ("bootstrap", "twisted"):
                    found.setdefault((steps, proposal), []).append(measured(steps, proposal, cache))

    def median(steps: int, proposal: str, what: str) -> float:
        return statistics.median(f[what] for f in found[steps, proposal])

    print(f"{machine()}. {versions('numba', 'numpy')}\n")
    rows = [
        (s, p, f"{median(s, p, 'first'):.2f} s",
         f"{median(s, p, 'first') - median(1, p, 'first'):+.2f} s",
         f"{1e3 * median(s, p, 'next'):.1f} ms", f"{median(s, p, 'text'):.0f}")
        for p in ("bootstrap", "twisted") for s in STEPS
    ]  # fmt: skip
    show(("steps", "proposal", "first likelihood", "over one step's", "next", "characters"), rows)
    print()
    each = PARTICLES * ROWS * 1e-9
    base = median(1, "bootstrap", "next") - statistics.median(c[1])
    rows = []
    for s in STEPS[1:]:
        own, other = median(s, "bootstrap", "next") - base, statistics.median(c[s])
        rows.append((s, f"{own / each:.1f} ns", f"{other / each:.1f} ns", f"{own / other:.2f}"))
    show(("steps", "ssmppl, a particle and row", "C", "ratio"), rows)


if __name__ == "__main__":
    one(int(sys.argv[1]), sys.argv[2]) if len(sys.argv) > 1 else main()
