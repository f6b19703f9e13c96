"""Simulation-based calibration: do the samplers sample the posterior, over the whole prior?

Talts, Betancourt, Simpson, Vehtari and Gelman (2018), algorithm 2. Parameters are drawn from the
prior, data simulated from them, and the rank of each parameter among L nearly independent draws
from its posterior is uniform on 0, ..., L if simulation and sampling agree. The draws are thinned
by the effective sample size that a pilot finds, on data sets of its own.

    python -m tests.statistics.sbc [replications] [processes]

writes docs/figures/calibration.csv (one row per model, method, parameter and bin of ranks), which
the page on calibration plots.
"""

from __future__ import annotations

import csv
import sys
from collections.abc import Callable
from concurrent.futures import Executor, ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import arviz as az
import numpy as np
from scipy import stats

import ssmppl as ssm

from . import models
from .checks import seed_of

KEPT = 63  # L: ranks from 0 to 63
BINS = 16
STEPS = 50
TABLE = Path(__file__).parents[2] / "docs" / "figures" / "calibration.csv"


@dataclass(frozen=True)
class Study:
    """A model, how it is sampled, and what is ranked: its parameters, and a state half-way."""

    model: str
    method: ssm.PMMH | ssm.PGAS
    parameters: tuple[str, ...]
    state: str

    @property
    def name(self) -> str:
        return f"{self.model} {type(self.method).__name__}"

    @property
    def ranked(self) -> tuple[str, ...]:
        return (*self.parameters, f"{self.state}[{STEPS // 2}]")


MODELS = {
    "proper_varves": (("phi", "tau"), "x"),
    "regression": (("a", "b", "q"), "x"),
    "two_states": (("a", "k", "precision", "r"), "drive"),
    "counts": (("mu", "phi", "tau"), "x"),
}
METHODS = (ssm.PGAS(particles=20), ssm.PMMH(particles=100))
STUDIES = {
    study.name: study
    for name, (parameters, state) in MODELS.items()
    for method in METHODS
    for study in [Study(name, method, parameters, state)]
}


def inputs_of(model: ssm.Model) -> dict[str, np.ndarray]:
    """The same input for all data sets: a square wave."""
    return {name: np.sign(np.sin(np.arange(STEPS) / 3.0)) for name in model.inputs}


def draws_of(study: Study, replication: int, draws: int, thin: int, label: str):
    """Truth and one chain's draws (draw,) of every ranked quantity, for one simulated data set."""
    model = getattr(models, study.model)
    seeds = np.random.SeedSequence(seed_of("sbc", label, study.name, replication)).spawn(2)
    first, second = (int(s.generate_state(1)[0]) for s in seeds)
    u = inputs_of(model)
    truth = ssm.simulate(model, steps=STEPS, inputs=u or None, seed=first)
    data = {"y": truth["y"].values[0]} | u
    idata = ssm.sample(
        model, data, study.method, draws=draws, warmup=600, chains=1, thin=thin, progress=False,
        seed=second,
    )  # fmt: skip
    posterior = idata["posterior"]
    middle = STEPS // 2
    known = [float(truth[p].values[0]) for p in study.parameters]
    drawn = [posterior[p].values[0] for p in study.parameters]
    known.append(float(truth[study.state].values[0, middle]))
    drawn.append(posterior[study.state].values[0, :, middle])
    return np.array(known), np.array(drawn)


def iterations_per_draw(study: Study, replication: int) -> np.ndarray:
    """Iterations per effective draw of each ranked quantity, on one pilot data set."""
    length = 3000
    _, drawn = draws_of(study, replication, length, 1, "pilot")
    return np.array([length / az.ess(d[None], method="mean") for d in drawn])


def rank(job: tuple[Study, int, int]) -> np.ndarray:
    """Rank of the truth among `KEPT` draws, for every ranked quantity."""
    study, replication, thin = job
    known, drawn = draws_of(study, replication, KEPT, thin, "data")
    return (drawn < known[:, None]).sum(axis=1)


def _pilot(job: tuple[Study, int]) -> np.ndarray:
    return iterations_per_draw(*job)


def calibrate(
    study: Study, replications: int, executor: Executor | None = None, pilots: int = 8
) -> tuple[np.ndarray, int]:
    """Ranks (replications, quantities), and the thinning.

    Thinning is by the worst quantity of the second worst pilot data set: the few data sets whose
    chains mix worse leave their ranks a little too far out.
    """
    each: Callable = executor.map if executor is not None else map
    worst = np.sort([costs.max() for costs in each(_pilot, [(study, i) for i in range(pilots)])])
    thin = max(1, int(np.ceil(worst[-2])))
    ranks = list(each(rank, [(study, i, thin) for i in range(replications)]))
    return np.array(ranks), thin


def histogram(ranks: np.ndarray) -> np.ndarray:
    """Counts in `BINS` bins of equal width."""
    return np.bincount(ranks * BINS // (KEPT + 1), minlength=BINS)


def uniform_p(ranks: np.ndarray) -> float:
    """p value of the chi-square test of uniform ranks."""
    return float(stats.chisquare(histogram(ranks)).pvalue)


def main(replications: int = 256, processes: int = 2) -> None:
    rows = []
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as executor:
        for study in STUDIES.values():
            ranks, thin = calibrate(study, replications, executor)
            for quantity, column in zip(study.ranked, ranks.T, strict=True):
                p = uniform_p(column)
                print(f"{study.name:24} {quantity:12} thin {thin:4} p {p:.3f}", flush=True)
                rows += [
                    (study.model, type(study.method).__name__, quantity, thin, i, count)
                    for i, count in enumerate(histogram(column))
                ]
    TABLE.parent.mkdir(parents=True, exist_ok=True)
    with TABLE.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("model", "method", "quantity", "thin", "bin", "count"))
        writer.writerows(rows)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
