"""Every algorithm of Schön et al. (2015) on the paper's models, against exact answers.

    python bench/paper.py [model ...]

prints a table algorithm x model, and writes docs/figures/paper.csv: value, Monte Carlo error, exact
value, and how many errors lie between. Models: lgss_main_text, lgss_appendix, ice_varves, nile;
with names, only these, the other rows of the file staying.
"""

from __future__ import annotations

import csv
import json
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

import arviz as az
import numpy as np
from paper_models import lgss, nile_diffuse, nile_vague, varves
from table import machine, show, versions

import ssmppl as ssm
from ssmppl.datasets import load

ROOT = Path(__file__).parents[1]
TABLE = ROOT / "docs" / "figures" / "paper.csv"
EXACT = json.loads((ROOT / "tests" / "reference" / "exact_values.json").read_text())
SEED = 20150301
FIELDS = ("model", "quantity", "algorithm", "value", "error", "exact", "seconds")


@dataclass(frozen=True)
class Row:
    """One cell: error is the Monte Carlo standard error, 0 where the method is exact."""

    model: str
    quantity: str
    algorithm: str
    value: float
    error: float
    exact: float
    seconds: float


def timed(call: Callable[[], Any]) -> tuple[Any, float]:
    started = time.perf_counter()
    out = call()
    return out, time.perf_counter() - started


def maximum(
    name: str, model: ssm.Model, data: Any, method: Any, exact: Mapping[str, float], **options: Any
) -> Iterator[Row]:
    """The maximum likelihood estimate by one method."""
    found, seconds = timed(
        lambda: ssm.maximize(model, data, method, seed=SEED, progress=False, **options)
    )
    errors = found.attrs.get("monte_carlo_errors") or {}
    for parameter, value in exact.items():
        yield Row(
            name, f"MLE of {parameter}", type(method).__name__,
            float(found.parameters[parameter]), errors.get(parameter, 0.0), value, seconds,
        )  # fmt: skip


def posterior(
    name: str, model: ssm.Model, data: Any, label: str, method: Any,
    exact: Mapping[str, tuple[float, float]], **options: Any,
) -> Iterator[Row]:  # fmt: skip
    """Posterior means and standard deviations by one method."""
    idata, seconds = timed(
        lambda: ssm.sample(model, data, method, states=False, seed=SEED, progress=False, **options)
    )
    for parameter, (mean, sd) in exact.items():
        draws = idata["posterior"][parameter].values
        error = float(draws.std(ddof=1) / np.sqrt(az.ess(draws, method="mean")))
        yield Row(name, f"posterior mean of {parameter}", label, float(draws.mean()), error, mean,
                  seconds)  # fmt: skip
        influence = (draws - draws.mean()) ** 2 / (2 * draws.std())
        error = float(influence.std(ddof=1) / np.sqrt(az.ess(influence, method="mean")))
        yield Row(name, f"posterior sd of {parameter}", label, float(draws.std(ddof=1)), error, sd,
                  seconds)  # fmt: skip


def evidence(name: str, model: ssm.Model, data: Any, **options: Any) -> Iterator[Row]:
    found, seconds = timed(lambda: ssm.evidence(model, data, seed=SEED, progress=False, **options))
    yield Row(name, "log evidence", "bridge sampling", found.log_evidence, found.standard_error,
              EXACT[name]["log_evidence"], seconds)  # fmt: skip


def score(
    name: str, model: ssm.Model, data: Any, at: Mapping[str, float], exact: Mapping[str, float],
    **options: Any,
) -> Iterator[Row]:  # fmt: skip
    found, seconds = timed(lambda: ssm.score(model, data, at, seed=SEED, **options))
    point = ", ".join(f"{v:g}" for v in at.values())
    errors = found.gradient_errors
    label = "Fisher's identity" if "particles" in found.attrs else "Kalman sensitivities"
    for parameter, value in exact.items():
        yield Row(name, f"score of {parameter} at ({point})", label,
                  float(found.gradient[parameter]), float(errors.get(parameter, 0.0)), value,
                  seconds)  # fmt: skip


def linear(name: str, c: float) -> Iterator[Row]:
    """The linear Gaussian model of section 2, with the gain of one of the two series."""
    model, data, exact = lgss(c), {"y": load(name)["y"]}, EXACT[name]
    best = {"theta": exact["mle"]}
    for method in (ssm.DirectOptimization(), ssm.EM(), ssm.ScoreAscent(), ssm.ParticleEM(),
                   ssm.PSAEM()):  # fmt: skip
        yield from maximum(name, model, data, method, best)
    yield from score(name, model, data, {"theta": 1.0}, {"theta": exact["score_at_1"]})
    moments = {"theta": (exact["posterior_mean"], exact["posterior_sd"])}
    for label, method, draws in (
        ("MetropolisHastings", ssm.MetropolisHastings(), 10_000),
        ("Gibbs", ssm.Gibbs(interweave=False), 10_000),
        ("PMMH", ssm.PMMH(), 5_000),
        ("PGAS, N = 5", ssm.PGAS(particles=5), 10_000),
    ):
        yield from posterior(name, model, data, label, method, moments, draws=draws)
    yield from evidence(name, model, data)


def ice_varves() -> Iterator[Row]:
    """The nonlinear model of section 2."""
    name, data, exact = "ice_varves", {"y": load("ice_varves")["y"]}, EXACT["ice_varves"]
    best = exact["mle"]
    for method in (
        ssm.DirectOptimization(),
        ssm.ScoreAscent(particles=1000, trajectories=400, tolerance=0.025),
        ssm.ParticleEM(),
        ssm.PSAEM(iterations=4000),
    ):
        yield from maximum(name, varves, data, method, best)
    for key, slope in exact["score_at"].items():
        phi, tau = map(float, key.split(","))
        yield from score(name, varves, data, {"phi": phi, "tau": tau},
                         dict(zip(("phi", "tau"), slope, strict=True)))  # fmt: skip
    yield from information(data, best, np.array(exact["inverse_observed_information_at_mle"]))
    moments = {p: (exact["posterior_mean"][p], exact["posterior_sd"][p]) for p in best}
    for label, method, draws in (
        ("PMMH", ssm.PMMH(), 4_000),
        ("PMH1", ssm.PMMH(order=1), 2_000),
        ("PMH2", ssm.PMMH(order=2), 2_000),
        ("PMMH, correlated", ssm.PMMH(correlation=0.99), 4_000),
        ("PGAS", ssm.PGAS(), 10_000),
    ):
        yield from posterior(name, varves, data, label, method, moments, draws=draws)
    yield from evidence(name, varves, data)


def information(data: Any, at: Mapping[str, float], exact: np.ndarray) -> Iterator[Row]:
    """The inverse observed information at the maximum, by Louis' identity."""
    found, seconds = timed(lambda: ssm.score(varves, data, at, seed=SEED))
    inverse = np.linalg.inv(found.information.values)
    errors = np.sqrt(inverse**2 @ found.information_errors.values**2 @ inverse**2)  # delta method
    for i, j in ((0, 0), (0, 1), (1, 1)):
        a, b = list(at)[i], list(at)[j]
        yield Row(
            "ice_varves", f"inverse information, {a} {b}", "Louis' identity",
            float(inverse[i, j]), float(errors[i, j]), float(exact[i, j]), seconds,
        )  # fmt: skip


def nile() -> Iterator[Row]:
    """The local level model of the Nile's annual flow."""
    name, data, exact = "nile", {"y": load("nile")["y"]}, EXACT["nile_local_level"]
    at = {"r": 15099.0, "q": 1469.1}
    vague, diffuse = exact["log_likelihood"].values()
    for label, model, value in (("vague", nile_vague, vague), ("diffuse", nile_diffuse, diffuse)):
        found, seconds = timed(lambda model=model: ssm.log_likelihood(model, data, at)[0])
        yield Row(name, f"log-likelihood, {label} start", "Kalman", float(found), 0.0, value,
                  seconds)  # fmt: skip
    for method in (ssm.DirectOptimization(), ssm.EM()):
        yield from maximum(name, nile_diffuse, data, method, exact["mle"])


PARTS: dict[str, Callable[[], Iterator[Row]]] = {
    "lgss_main_text": lambda: linear("lgss_main_text", 0.5),
    "lgss_appendix": lambda: linear("lgss_appendix", 1.0),
    "ice_varves": ice_varves,
    "nile": nile,
}


def read() -> list[tuple[str, ...]]:
    if not TABLE.exists():
        return []
    with TABLE.open(encoding="utf-8") as file:
        return [tuple(row) for row in list(csv.reader(file))[1:]]


def write(rows: list[tuple[str, ...]]) -> None:
    TABLE.parent.mkdir(parents=True, exist_ok=True)
    with TABLE.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(FIELDS)
        order = list(PARTS)
        writer.writerows(sorted(rows, key=lambda row: order.index(row[0])))


def text(row: Row) -> tuple[str, ...]:
    return tuple(f"{v:.9g}" if isinstance(v, float) else v for v in astuple(row))


def shown(row: tuple[str, ...]) -> tuple[str, ...]:
    model, quantity, algorithm, value, error, exact, seconds = row
    off, spread = float(value) - float(exact), float(error)
    in_errors = f"{off / spread:+.1f}" if spread > 0 else f"{off:.1e}"
    return (model, quantity, algorithm, f"{float(value):.7g}", f"{spread:.2g}",
            f"{float(exact):.7g}", in_errors, f"{float(seconds):.1f}")  # fmt: skip


def main(chosen: list[str]) -> None:
    for name, part in PARTS.items():
        if chosen and name not in chosen:
            continue
        own = []
        for row in part():
            own.append(text(row))
            print(*shown(own[-1]), sep="  ", file=sys.stderr, flush=True)
        write([row for row in read() if row[0] != name] + own)
    print(f"{machine()}. {versions('numba', 'numpy')}.\n")
    show(("model", "quantity", "algorithm", "value", "error", "exact", "off", "seconds"),
         [shown(row) for row in read()])  # fmt: skip


if __name__ == "__main__":
    main(sys.argv[1:])
