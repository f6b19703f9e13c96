"""How time and memory grow: with particles N, steps T, states D and parameters P.

    python bench/scaling.py

writes docs/figures/scaling.csv (one row per point: what, against what, its size, seconds, MiB),
which the page on performance plots, and prints the slopes on a log-log scale. Every point is a
process of its own; its memory is the growth of the peak resident set over that of one small run, so
that Python, Numba and the compiled code do not count.
"""

from __future__ import annotations

import csv
import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from table import machine, show

import ssmppl as ssm
from ssmppl.codegen.kernels.math.random import new_state
from ssmppl.inference.chains.pgas import SweepSetup, pgas_block, plan_updates, start_chain
from ssmppl.inference.particles.filtering import FilterSettings, log_likelihood_estimate
from ssmppl.inference.run.problem import Problem, pose

TABLE = Path(__file__).parents[1] / "docs" / "figures" / "scaling.csv"
LONG = 1.0  # seconds of a point from which it is run once only

# what: (against what, sizes, the sizes from which the slope is taken)
POINTS: dict[str, tuple[str, tuple[int, ...], int]] = {
    "filter by particles": ("N", (100, 1_000, 10_000, 100_000, 1_000_000), 10_000),
    "filter by steps": ("T", (100, 1_000, 10_000, 100_000, 1_000_000), 10_000),
    "filter by states": ("D", (1, 2, 5, 10, 20, 40), 5),
    "PGAS by particles": ("N", (10, 100, 1_000, 10_000, 100_000), 1_000),
    "PGAS by steps": ("T", (100, 1_000, 10_000, 100_000, 1_000_000), 10_000),
    "PGAS by parameters": ("P", (1, 2, 5, 10, 20, 40), 5),
}


def walk(states: int) -> ssm.Model:
    """Autoregressions that each pull at the next one; their sum is observed."""
    model = ssm.Model(f"{states} states")
    model.initial(lambda: {"x": ssm.Normal(np.zeros(states), sd=1.0)})
    model.transition(lambda x: {"x": ssm.Normal(0.8 * x + 0.1 * np.roll(x, -1), sd=0.3)})
    model.observation(lambda x: {"y": ssm.Normal(np.sum(x), sd=1.0)})
    return model


def regression(parameters: int) -> ssm.Model:
    """An autoregression driven by a vector of inputs, with a coefficient for each."""
    model = ssm.Model(f"{parameters} parameters", inputs={"u": parameters})
    model.prior(lambda: {"b": ssm.Normal(np.zeros(parameters), sd=1.0)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1.0)})
    model.transition(lambda x, b, u: {"x": ssm.Normal(0.8 * x + b @ u, sd=1.0)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=1.0)})
    return model


def filter_run(problem: Problem, particles: int) -> Callable[[], object]:
    rng, settings = new_state(np.random.SeedSequence(1)), FilterSettings(particles, "bootstrap")
    theta = np.zeros(len(problem.trace.parameter_symbols))
    return lambda: log_likelihood_estimate(problem, theta, settings, rng)


def sweep_run(problem: Problem, particles: int) -> Callable[[], object]:
    theta = np.zeros(len(problem.trace.parameter_symbols))
    setup = SweepSetup(problem, plan_updates(problem, {}), FilterSettings(particles, "bootstrap"))
    stream, generator = new_state(np.random.SeedSequence(1)), np.random.default_rng(1)
    states = [start_chain(setup, theta, generator, stream)]

    def sweep() -> None:
        states[0] = pgas_block(setup, 1, False, states[0], 1)[0]

    return sweep


def prepared(what: str, size: int) -> tuple[Callable[[], object], Callable[[], object]]:
    """(a small run that compiles all of it, the run)."""
    rng = np.random.default_rng(2)

    def data(steps: int, inputs: int = 0) -> dict[str, np.ndarray]:
        y = {"y": rng.normal(size=steps)}
        return y | {"u": rng.normal(size=(steps, inputs))} if inputs else y

    kind, _, by = what.partition(" by ")
    make = filter_run if kind == "filter" else sweep_run
    inputs = size if by == "parameters" else 1 if kind == "PGAS" else 0
    model = walk(size if by == "states" else 1) if kind == "filter" else regression(inputs)
    steps = size if by == "steps" else 634
    particles = {"particles": size, "states": 1_000, "steps": 100 if kind == "filter" else 20}
    small = make(pose(model, data(20, inputs)), 10)
    return small, make(pose(model, data(steps, inputs)), particles.get(by, 20))


def point(what: str, size: int) -> tuple[float, float]:
    """(seconds of a run, MiB that it takes)."""
    small, run = prepared(what, size)
    small()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    times = []
    while not times or (len(times) < 5 and times[0] < LONG):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    return min(times), grown / 1024


def main() -> None:
    rows, lines = [], []
    for what, (against, sizes, least) in POINTS.items():
        found = []
        for size in sizes:
            out = subprocess.run(
                [sys.executable, __file__, what, str(size)],
                stdout=subprocess.PIPE, text=True, check=True,
            ).stdout  # fmt: skip
            seconds, memory = json.loads(out)
            found.append((size, seconds, memory))
            rows.append((what, against, size, f"{seconds:.4g}", f"{memory:.4g}"))
            print(*rows[-1], file=sys.stderr, flush=True)
        above = np.log(np.array([(n, s) for n, s, _ in found if n >= least]))
        slope = np.polyfit(above[:, 0], above[:, 1], 1)[0]
        last = found[-1]
        lines.append(
            [what, f"{slope:.2f}", f"{against} = {last[0]:,}", f"{last[1]:.3g}", f"{last[2]:.3g}"]
        )
    with TABLE.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("what", "against", "size", "seconds", "mebibytes"))
        writer.writerows(rows)
    print(
        f"{machine()}; one thread below 524,288 particles. "
        "Least seconds of five runs; the slope of its larger sizes.\n"
    )
    show(["what", "slope", "largest", "seconds", "MiB"], lines)


if __name__ == "__main__":
    if sys.argv[1:]:
        print(json.dumps(point(sys.argv[1], int(sys.argv[2]))))
    else:
        main()
