"""Simulation-based calibration: do the samplers sample the posterior, over the whole prior?

Talts, Betancourt, Simpson, Vehtari and Gelman (2018), algorithm 2. Parameters are drawn from the
prior, data simulated from them, and the rank of each parameter among L nearly independent draws
from its posterior is uniform on 0, ..., L if simulation and sampling agree. The draws are thinned
by the effective sample size that a pilot finds, on data sets of its own.

    python -m tests.statistics.sbc [replications] [study ...]

writes docs/figures/calibration.csv (one row per model, method, quantity and bin of ranks), which
the page on calibration plots; with names, these studies only, the others in the table staying.
"""

from __future__ import annotations

import csv
import sys
from dataclasses import dataclass
from pathlib import Path

import arviz as az
import numpy as np
from scipy import stats

import ssmppl as ssm
from tests.models import constrained
from tests.models import standard as models
from tests.models import wider as wider_models

from .checks import seed_of

APART = 8  # draws of ISMCMC between those that are ranked
KEPT = 63  # L: ranks from 0 to 63
BINS = 16
STEPS = 50
TABLE = Path(__file__).parents[2] / "docs" / "figures" / "calibration.csv"


@dataclass(frozen=True)
class Study:
    """A model, how it is sampled, and what is ranked: its parameters, and a state half-way (not by
    SMC2, which keeps none).

    An entry of a vector or matrix is ranked by its name: "Q[0, 1]".
    """

    model: str
    method: ssm.PMMH | ssm.ISMCMC | ssm.PGAS | ssm.Gibbs | ssm.MetropolisHastings | ssm.SMC2
    parameters: tuple[str, ...]
    state: str

    @property
    def name(self) -> str:
        return f"{self.model} {self.label}"

    @property
    def label(self) -> str:
        """The method; those interweaved in every sweep, with parameters eliminated, or over the
        twisted filter, are studied beside the plain ones."""
        woven = getattr(self.method, "interweave", False) is True
        without = getattr(self.method, "eliminate", False) is not False
        twisted = getattr(self.method, "proposal", "") == "twisted"
        name = type(self.method).__name__ + " twisted" * twisted
        return name + " interweaved" * woven + " eliminated" * without

    @property
    def ranked(self) -> tuple[str, ...]:
        if isinstance(self.method, ssm.SMC2):
            return self.parameters
        return (*self.parameters, f"{self.state}[{STEPS // 2}]")


MODELS = {
    "proper_varves": (("phi", "tau"), "x"),
    "regression": (("a", "b", "q"), "x"),
    "two_states": (("a", "k", "precision", "r"), "drive"),
    "counts": (("mu", "phi", "tau"), "x"),
}
LINEAR = {  # for the methods with exact likelihood and trajectories
    "stationary": (("phi", "tau"), "x"),
}
BLOCKS = {  # joint conjugate blocks, states drawn exactly
    "vector_ar": (("a[0]", "a[1]", "a[3]", "Q[0, 0]", "Q[0, 1]", "Q[1, 1]"), "x"),
    "vector_ar_apart": (("a[0]", "a[1]", "a[3]", "Q[0, 0]", "Q[0, 1]", "Q[1, 1]"), "x"),
    "three_regimes": (("row0[0]", "row1[0]", "row2[1]", "level[0]", "level[1]", "v"), "k"),
}
WIDER = {  # for the two samplers that need no structure
    "leverage": (("mu", "phi", "tau", "k"), "x"),
    "ricker": (("log_r", "q", "scale", "dispersion"), "x"),
    "growth": (("a", "b", "q", "r"), "x"),
    "bounded": (("phi", "s"), "x"),
}
DELAYED = {  # linear Gaussian too, but with a deterministic state
    "delay": (("a", "c", "b", "q"), "x"),
}
NOISELESS = {  # states that follow from what was observed
    "garch": (("w", "a", "b", "h_1"), "h"),
}
METHODS = (
    ssm.PGAS(particles=20, interweave=False),
    ssm.PGAS(particles=20, interweave=True),
    ssm.PGAS(particles=20, eliminate=True),
    ssm.PMMH(particles=100),
    ssm.SMC2(parameters=4 * KEPT, particles=50),
)
APPROXIMATED = (ssm.ISMCMC(particles=8), ssm.PMMH(particles=8, proposal="twisted"))
# Those that have a Gaussian approximation; that of growth knows one of two modes, so that weights
# and estimates scatter beyond use.
GAUSSIAN = {n: m for n, m in (MODELS | LINEAR | WIDER | DELAYED).items() if n != "growth"}
EXACT = (ssm.Gibbs(interweave=False), ssm.Gibbs(interweave=True), ssm.MetropolisHastings())
PLAIN = (METHODS[0], METHODS[3])
MISSING = {"vector_ar", "vector_ar_apart", "bounded"}  # of their data, some steps and entries
STUDIES = {
    study.name: study
    for models_, methods in (
        (MODELS, METHODS),
        (GAUSSIAN, APPROXIMATED),
        (LINEAR, EXACT),
        (BLOCKS, EXACT[:1]),
        (WIDER, PLAIN),
        (DELAYED, (METHODS[0], EXACT[0], EXACT[2])),
        (NOISELESS, EXACT[2:]),
    )
    for name, (parameters, state) in models_.items()
    for method in methods
    for study in [Study(name, method, parameters, state)]
}


def model_of(study: Study) -> ssm.Model:
    homes = (models, wider_models, constrained)
    return next(getattr(m, study.model) for m in homes if hasattr(m, study.model))


def inputs_of(model: ssm.Model) -> dict[str, np.ndarray]:
    """The same input for all data sets: a square wave."""
    return {name: np.sign(np.sin(np.arange(STEPS) / 3.0)) for name in model.inputs}


def draws_of(study: Study, replication: int, draws: int, thin: int, label: str):
    """Truth and one chain's draws (draw,) of every ranked quantity, for one simulated data set."""
    model = model_of(study)
    seeds = np.random.SeedSequence(seed_of("sbc", label, study.name, replication)).spawn(2)
    first, second = (int(s.generate_state(1)[0]) for s in seeds)
    u = inputs_of(model)
    walks = isinstance(study.method, (ssm.PMMH, ssm.ISMCMC, ssm.MetropolisHastings))
    # of draws that are resampled out of as many, some are copies: those far apart are none
    apart = APART if isinstance(study.method, ssm.ISMCMC) else 1
    warmup = 600 if walks else 200  # random walks adapt during it
    truth = ssm.simulate(model, steps=STEPS, inputs=u or None, seed=first)
    y = truth["y"].values[0].copy()
    if study.model in MISSING:
        y[10:13] = np.nan
        if y.ndim > 1:
            y[20:25, 0] = y[40, 1] = np.nan
    data = {"y": y} | u
    idata = ssm.sample(
        model, data, study.method, draws=apart * draws, warmup=warmup, chains=1, thin=thin,
        progress=False, seed=second,
    )  # fmt: skip
    posterior = idata["posterior"].isel(draw=slice(None, None, apart))
    middle = STEPS // 2
    known = [entry(truth, p)[0] for p in study.parameters]
    drawn = [entry(posterior, p) for p in study.parameters]
    if len(study.ranked) > len(known):
        known.append(truth[study.state].values[0, middle].ravel()[0])
        drawn.append(posterior[study.state].values[0, :, middle].reshape(draws, -1)[:, 0])
    return np.array(known, dtype=float), np.array(drawn, dtype=float)


def entry(dataset, name: str) -> np.ndarray:
    """Draws (draw,) of a parameter, or of the entry of one that "name[i, j]" stands for."""
    name, _, index = name.partition("[")
    values = dataset[name].isel(chain=0) if "chain" in dataset[name].dims else dataset[name]
    where = tuple(int(i) for i in index.rstrip("]").split(",")) if index else ()
    return values.values[(slice(None), *where)]


def iterations_per_draw(study: Study, replication: int) -> np.ndarray:
    """Iterations per effective draw of each ranked quantity, on one pilot data set."""
    length = 3000
    _, drawn = draws_of(study, replication, length, 1, "pilot")
    return np.array([length / az.ess(d[None], method="mean") for d in drawn])


def rank(study: Study, replication: int, thin: int) -> np.ndarray:
    """Rank of the truth among `KEPT` draws, for every ranked quantity; ties broken at random."""
    known, drawn = draws_of(study, replication, KEPT, thin, "data")
    ties = (drawn == known[:, None]).sum(axis=1)
    rng = np.random.default_rng(seed_of("ties", study.name, replication))
    return (drawn < known[:, None]).sum(axis=1) + rng.integers(0, ties + 1)


def calibrate(study: Study, replications: int, pilots: int = 8) -> tuple[np.ndarray, int]:
    """Ranks (replications, quantities), and the thinning.

    Thinning is by the worst quantity of the second worst pilot data set: the few data sets whose
    chains mix worse leave their ranks a little too far out. SMC2, whose draws are no chain, keeps
    a quarter of its particles instead, so that few of those ranked have an ancestor in common.
    """
    if isinstance(study.method, ssm.SMC2):
        return np.array([rank(study, i, 1) for i in range(replications)]), 1
    worst = np.sort([iterations_per_draw(study, i).max() for i in range(pilots)])
    thin = max(1, int(np.ceil(worst[-2])))
    return np.array([rank(study, i, thin) for i in range(replications)]), thin


def histogram(ranks: np.ndarray) -> np.ndarray:
    """Counts in `BINS` bins of equal width."""
    return np.bincount(ranks * BINS // (KEPT + 1), minlength=BINS)


def uniform_p(ranks: np.ndarray) -> float:
    """p value of the chi-square test of uniform ranks."""
    return float(stats.chisquare(histogram(ranks)).pvalue)


def read_table() -> dict[str, list[tuple]]:
    """Rows of the table, by study."""
    rows: dict[str, list[tuple]] = {}
    if TABLE.exists():
        with TABLE.open(encoding="utf-8") as file:
            for row in list(csv.reader(file))[1:]:
                rows.setdefault(f"{row[0]} {row[1]}", []).append(tuple(row))
    return rows


def write_table(rows: dict[str, list[tuple]]) -> None:
    TABLE.parent.mkdir(parents=True, exist_ok=True)
    with TABLE.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("model", "method", "quantity", "thin", "bin", "count"))
        writer.writerows(row for name in STUDIES for row in rows.get(name, []))


def main(replications: int, chosen: list[str]) -> None:
    """Run the studies whose names begin with one of `chosen`, and put them into the table."""
    for name, study in STUDIES.items():
        if chosen and not name.startswith(tuple(chosen)):
            continue
        ranks, thin = calibrate(study, replications)
        own = []
        for quantity, column in zip(study.ranked, ranks.T, strict=True):
            p = uniform_p(column)
            print(f"{name:24} {quantity:12} thin {thin:4} p {p:.3f}", flush=True)
            own += [
                (study.model, study.label, quantity, thin, i, count)
                for i, count in enumerate(histogram(column))
            ]
        write_table(read_table() | {name: own})


if __name__ == "__main__":
    main(int(sys.argv[1]) if sys.argv[1:] else 256, sys.argv[2:])
