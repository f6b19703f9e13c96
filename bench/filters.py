"""Nanoseconds per particle and time step on the ice varves: ssmppl, plain C, `particles`.

One filter run of each in turn, many times over, so that whatever else the machine does hits all
alike; medians, and their ratios to C. See README.md for the filter in C.

    python bench/filters.py
"""

from __future__ import annotations

import subprocess
import time
from pathlib import Path

import numpy as np
import particles
from particles import distributions as law
from particles import state_space_models
from table import show

from ssmppl.codegen.kernels.math.random import new_state
from ssmppl.datasets import ice_varves
from ssmppl.demo import varves
from ssmppl.inference.particles.filtering import FilterSettings, log_likelihood_estimate
from ssmppl.inference.run.problem import pose

HERE = Path(__file__).parent
SERIES = HERE.parent / "ssmppl" / "datasets" / "ice_varves.csv"
PHI, TAU = 0.95, 50.0
ROUNDS = {100: 15, 1000: 15, 10_000: 7}
C_REPEATS = 5


class Varves(state_space_models.StateSpaceModel):
    """The model as `particles` wants it."""

    def PX0(self):
        return law.Normal(scale=1 / np.sqrt((1 - PHI**2) * TAU))

    def PX(self, t, xp):
        return law.Normal(loc=PHI * xp, scale=1 / np.sqrt(TAU))

    def PY(self, t, xp, x):
        return law.Gamma(a=6.25, b=0.256 * np.exp(-x))


def compile_c() -> Path:
    """The program in C, compiled for this machine."""
    program = HERE / "build" / "bootstrap_varves"
    program.parent.mkdir(exist_ok=True)
    subprocess.run(
        ["gcc", "-O3", "-march=native", HERE / "c" / "bootstrap_varves.c", "-o", program, "-lm"],
        check=True,
    )
    return program


def run_c(program: Path) -> dict[int, float]:
    """ns per particle step by N, each the median of a few runs."""
    out = subprocess.run(
        [program, SERIES, str(C_REPEATS), str(PHI), str(TAU)],
        capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip
    words = [line.replace("=", " ").split() for line in out.splitlines()]
    return {int(w[1]): float(w[2]) for w in words}


def run_particles(y: np.ndarray, n: int) -> float:
    """Seconds of one bootstrap filter, systematic resampling at every step."""
    model = state_space_models.Bootstrap(ssm=Varves(), data=y)
    filter_ = particles.SMC(fk=model, N=n, resampling="systematic", ESSrmin=1.0)
    start = time.perf_counter()
    filter_.run()
    return time.perf_counter() - start


def main() -> None:
    y = ice_varves()
    problem = pose(varves, {"y": y})
    theta, rng = np.array([PHI, TAU]), new_state(np.random.SeedSequence(1))
    program = compile_c()
    names = ["bootstrap", "guided", "auxiliary"]

    def run_own(name: str, n: int) -> float:
        start = time.perf_counter()
        log_likelihood_estimate(problem, theta, FilterSettings(n, name), rng)
        return time.perf_counter() - start

    for name in names:
        run_own(name, 100)  # compiles
    run_particles(y, 100)
    table: dict[tuple[str, int], list[float]] = {}
    for turn in range(max(ROUNDS.values())):
        for n, took in run_c(program).items():
            table.setdefault(("plain C, bootstrap", n), []).append(took)
        for n, rounds in ROUNDS.items():
            if turn >= rounds:
                continue
            per_step = 1e9 / (n * len(y))
            for name in names:
                taken = [run_own(name, n) for _ in range(C_REPEATS)]
                table.setdefault((f"ssmppl, {name}", n), []).append(np.median(taken) * per_step)
            if turn < 3:
                took = run_particles(y, n) * per_step
                table.setdefault(("particles, bootstrap", n), []).append(took)
    median = {key: float(np.median(values)) for key, values in table.items()}
    rows = []
    for name in dict.fromkeys(key[0] for key in median):
        row = [name]
        for n in ROUNDS:
            ns = median[name, n]
            row.append(f"{ns:.2f} ({ns / median['plain C, bootstrap', n]:.2f})")
        rows.append(row)
    print(f"Varves, T = {len(y)}: ns per particle step (ratio to plain C), medians of turns.\n")
    show(["filter", *(f"N = {n:,}" for n in ROUNDS)], rows)


if __name__ == "__main__":
    main()
