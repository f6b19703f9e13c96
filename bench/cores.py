"""What two cores are worth: chains and filters over threads, processes and Dask.

Seconds of the same work - chains of PMMH and of PGAS on the ice varves, and repeated filters - on
one thread and on two workers of a kind, in turn, several times over; the speed-up is the median
of the ratios within a turn. Every executor is warm: its workers have imported the package, and
generated and loaded the code. Then one filter of up to a million particles: whole, as fewer
particles run; in blocks of particles, by one thread and by two; and two filters of half as many
beside each other, whose mean is as good an estimate. The figures are kept in
docs/figures/cores.csv, for the page on performance.

    python bench/cores.py [turns [most particles]]
"""

from __future__ import annotations

import csv
import os
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from models import varves
from table import machine, show

import ssmppl as ssm
from ssmppl.codegen.kernels.math.random import new_state
from ssmppl.datasets import ice_varves
from ssmppl.inference.chains import pgas, pmmh
from ssmppl.inference.chains.sampling import SamplingSetup
from ssmppl.inference.particles.blocks import run_in_blocks
from ssmppl.inference.preparation.space import space_of
from ssmppl.inference.run.chain_runner import run_chains
from ssmppl.inference.run.problem import pose

WORKERS = 2
DATA = {"y": ice_varves()}
THETA = {"phi": 0.95, "tau": 50.0}
SIZES = (131_072, 1_000_000)
HOW = {"whole": "whole", "in blocks, 1 thread": "1", "in blocks, 2 threads": "2"}
TABLE = Path(__file__).parents[1] / "docs" / "figures" / "cores.csv"


@contextmanager
def _dask() -> Iterator[Executor]:
    from distributed import Client, LocalCluster

    with (
        LocalCluster(n_workers=WORKERS, threads_per_worker=1, dashboard_address=None) as cluster,
        Client(cluster) as client,
    ):
        yield client.get_executor(pure=False)


# Each open only while it is measured: a machine may take memory from processes that sleep.
EXECUTORS: dict[str, Callable[[], AbstractContextManager[Executor]]] = {
    "2 threads": partial(ThreadPoolExecutor, WORKERS),
    "2 processes": lambda: ProcessPoolExecutor(WORKERS, get_context("forkserver")),
    "2 Dask workers": _dask,
}


def chains(prepare: Callable, method: object, draws: int) -> Callable[[Executor], object]:
    """Two chains from fixed states, without what `sample` does before them on one core."""
    problem = pose(varves, DATA)
    root = np.random.SeedSequence(1)
    setup = SamplingSetup(problem, space_of(problem, {}, THETA), {}, WORKERS, 0, 1, root, False)
    sampler = prepare(setup, method)
    return lambda executor: run_chains(
        sampler.step_block, sampler.states, draws, executor=executor, progress=False
    )


def filters(particles: int, repeats: int, executor: Executor) -> np.ndarray:
    return ssm.log_likelihood(
        varves, DATA, THETA, particles=particles, repeats=repeats, proposal="bootstrap", seed=1,
        executor=executor,
    )  # fmt: skip


def works() -> dict[str, Callable[[Executor], object]]:
    """By name, with some seconds of work for one core in each."""
    bootstrap = {"particles": 1000, "proposal": "bootstrap"}
    return {
        "2 chains of PMMH, N = 1000": chains(pmmh.prepare, ssm.PMMH(**bootstrap), 160),
        "2 chains of PGAS, N = 100": chains(pgas.prepare, ssm.PGAS(particles=100), 600),
        "32 filters, N = 10,000": partial(filters, 10_000, 32),
    }


def one_filter(particles: int, how: str) -> Callable[[], object]:
    """One bootstrap filter: "whole", in one thread; in blocks, by this number of threads."""
    problem = pose(varves, DATA)
    e, theta = problem.experiments[0], np.array([THETA["phi"], THETA["tau"]])
    out, rng = np.empty((2, e.steps)), new_state(np.random.SeedSequence(1))
    if how == "whole":
        run = problem.program.entry("filter_bootstrap")
        return lambda: run(theta, e.y, e.seen, e.u, particles, None, 1.0, rng, *out, None, None)
    return lambda: run_in_blocks(
        problem, theta, "bootstrap", particles, 1.0, e, rng, *out, threads=int(how)
    )


def compared(works: dict[str, Callable[[], object]], turns: int) -> np.ndarray:
    """Seconds (turns, works), in turn."""
    for work in works.values():
        work()
    return np.array([[seconds(work) for work in works.values()] for _ in range(turns)])


def seconds(work: Callable[[], object]) -> float:
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


def main(turns: int = 7, most: int = SIZES[-1]) -> None:
    busy = os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")
    print(f"{machine()}; load {busy:.1f} before the start, of whatever else runs\n")
    kept = []

    def report(name: str, kinds: list[str], taken: np.ndarray) -> None:
        rows = []
        for i, kind in enumerate(kinds):
            gain = taken[:, 0] / taken[:, i]
            figures = np.median(taken[:, i]), np.median(gain), gain.min(), gain.max()
            if (name, "1 thread") not in {k[:2] for k in kept} or kind != "1 thread":
                kept.append((name, kind, *(f"{x:.4g}" for x in figures)))
            rows.append([kind, f"{figures[0]:.3g}", f"{figures[1]:.2f}",
                         f"{figures[2]:.2f} to {figures[3]:.2f}"])  # fmt: skip
        show([name, "s", "speed-up", "in the turns"], rows)
        print(flush=True)

    with ThreadPoolExecutor(1) as one, ThreadPoolExecutor(WORKERS) as two:
        for name, work in works().items():
            for kind, opened in EXECUTORS.items():
                try:
                    with opened() as pool:
                        own = {"1 thread": partial(work, one), kind: partial(work, pool)}
                        report(name, list(own), compared(own, turns))
                except ImportError as error:
                    print(f"no row for {kind}: {error}\n")
        for n in filter(lambda n: n <= most, SIZES):
            own = {kind: one_filter(n, how) for kind, how in HOW.items()}
            own["two filters of half, 2 threads"] = partial(filters, n // 2, 2, two)
            report(f"1 filter, N = {n:,}", list(own), compared(own, turns if n < 10**6 else 3))
    with TABLE.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("work", "workers", "seconds", "speed-up", "least", "most"))
        writer.writerows(kept)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
