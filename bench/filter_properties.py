"""What theory says of the particle filter, measured on a linear Gaussian model with exact answers.

Writes docs/figures/filter_properties.csv, which docs/explanations/filter_properties.md plots, and
prints the fitted slopes. Columns: property, series, x, value, error (one standard error).

* unbiased: mean of Z / Z_exact, x = N;
* filter means: root mean square error over the steps, x = N;
* variance of log Z: x = T;
* genealogy: distinct values of x_{T - lag} among N paths, x = lag;
* update rate: share of sweeps that change x_t, conditional SMC with and without ancestor
  sampling, x = t;
* adapted: variance of log Z of a proposal over that of the bootstrap filter, x = sd of the noise.

    python bench/filter_properties.py
"""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
from table import show

import ssmppl as ssm
from ssmppl.codegen.kernels.math.random import new_state
from ssmppl.data import check_parameters
from ssmppl.inference.exact.kalman import kalman_filter, kalman_model
from ssmppl.inference.particles.backward import draw_paths, particle_system
from ssmppl.inference.particles.filtering import FilterSettings, full_run, log_likelihood_estimate
from ssmppl.inference.run.problem import Problem, pose

OUT = Path(__file__).parents[1] / "docs" / "figures" / "filter_properties.csv"
Row = tuple[str, str, float, float, float]

model = ssm.Model("autoregression in noise")


@model.prior
def prior():
    return {"r": ssm.HalfNormal(sd=1)}


@model.initial
def initial():
    return {"x": ssm.Normal(0, variance=1 / 0.19)}


@model.transition
def transition(x):
    return {"x": ssm.Normal(0.9 * x, sd=1)}


@model.observation
def observation(x, r):
    return {"y": ssm.Normal(x, sd=r)}


def problem_of(steps: int, r: float = 1.0) -> tuple[Problem, np.ndarray]:
    """Simulated data, and theta."""
    y = ssm.simulate(model, {"r": r}, steps=steps, seed=20155)["y"].values[0]
    problem = pose(model, {"y": y})
    return problem, check_parameters(problem.trace, {"r": r})


def log_ratios(
    problem: Problem, theta: np.ndarray, settings: FilterSettings, runs: int, seed: int
) -> np.ndarray:
    """log Z - log Z_exact of independent runs."""
    exact = kalman_model(problem.trace).log_likelihood(problem.experiments, theta)
    stream = new_state(np.random.SeedSequence(seed))
    found = [log_likelihood_estimate(problem, theta, settings, stream) for _ in range(runs)]
    return np.array(found) - exact


def unbiased() -> list[Row]:
    problem, theta = problem_of(10)
    rows = []
    for proposal in ("bootstrap", "auxiliary"):
        for n in (1, 2, 5, 20, 100, 500):
            ratio = np.exp(log_ratios(problem, theta, FilterSettings(n, proposal), 40_000, n))
            rows.append(("unbiased", proposal, n, ratio.mean(), ratio.std() / np.sqrt(len(ratio))))
    return rows


def filter_means() -> list[Row]:
    problem, theta = problem_of(100)
    (experiment,) = problem.experiments
    exact = kalman_filter(problem.trace, experiment, theta).mean
    rows = []
    for proposal in ("bootstrap", "auxiliary"):
        for n in (10, 30, 100, 300, 1000, 3000, 10_000, 30_000):
            stream, squares = new_state(np.random.SeedSequence(n)), []
            for _ in range(60):
                settings = FilterSettings(n, proposal)
                run = full_run(problem, experiment, theta, settings, stream, np.empty(0), stream)
                squares.append(np.mean((run.mean - exact) ** 2))
            rmse = float(np.sqrt(np.mean(squares)))
            error = float(np.std(squares, ddof=1) / np.sqrt(len(squares)) / (2 * rmse))
            rows.append(("filter means", proposal, n, rmse, error))
    return rows


def variance_in_time() -> list[Row]:
    rows = []
    for proposal in ("bootstrap", "auxiliary"):
        for steps in (25, 50, 100, 200, 400, 800, 1600):
            problem, theta = problem_of(steps)
            z = log_ratios(problem, theta, FilterSettings(1000, proposal), 400, steps)
            rows.append(("variance of log Z", proposal, steps, *variance(z)))
    return rows


def variance(z: np.ndarray) -> tuple[float, float]:
    """Sample variance, and its standard error from the fourth moment."""
    centred = (z - z.mean()) ** 2
    return float(z.var(ddof=1)), float(centred.std(ddof=1) / np.sqrt(len(z)))


def genealogy() -> list[Row]:
    """Distinct values among N paths, by lag from the end; mean over runs."""
    problem, theta = problem_of(200)
    (experiment,) = problem.experiments
    n, runs = 500, 40
    stream, rows = new_state(np.random.SeedSequence(4)), []
    counts: dict[str, list[list[int]]] = {"genealogy": [], "exact": []}
    for _ in range(runs):
        system = particle_system(problem, theta, FilterSettings(n, "bootstrap"), experiment, stream)
        for kernel, found in counts.items():
            paths = draw_paths(problem, theta, experiment, system, n, stream, kernel)
            found.append([len(np.unique(paths[:, t, 0])) for t in range(200)])
    names = {"genealogy": "ancestral paths", "exact": "backward simulation"}
    for kernel, found in counts.items():
        values = np.array(found)[:, ::-1]
        mean, error = values.mean(0), values.std(0, ddof=1) / np.sqrt(runs)
        lags = sorted({*range(20), *range(20, 200, 5)})
        rows += [("genealogy", names[kernel], k, mean[k], error[k]) for k in lags]
    return rows


def update_rate() -> list[Row]:
    """How often x_t changes in a sweep of conditional SMC with 20 particles."""
    problem, _ = problem_of(200)
    y = problem.experiments[0].y[:, 0]
    sweeps, n = 2000, 20
    found = ssm.smooth(model, {"y": y}, {"r": 1.0}, ssm.PGAS(n, "bootstrap"), trajectories=sweeps,
                       seed=5)  # fmt: skip
    with_ancestors = (np.diff(found["x"].values, axis=0) != 0).mean(0)
    rng = np.random.default_rng(6)
    path, paths = found["x"].values[0], []
    for _ in range(sweeps):
        path = conditional_filter(y, path, n, rng)
        paths.append(path)
    without = (np.diff(np.array(paths), axis=0) != 0).mean(0)
    rows = []
    for label, rate in (("ancestor sampling", with_ancestors), ("without", without)):
        error = np.sqrt(rate * (1 - rate) / sweeps)
        rows += [("update rate", label, t + 1, rate[t], error[t]) for t in range(0, 200, 3)]
    return rows


def conditional_filter(
    y: np.ndarray, reference: np.ndarray, n: int, rng: np.random.Generator
) -> np.ndarray:
    """Conditional SMC without ancestor sampling (Andrieu, Doucet and Holenstein 2010), for this
    model with r = 1; multinomial resampling."""
    steps = len(y)
    x, ancestors = np.empty((steps, n)), np.empty((steps, n), dtype=int)
    w = np.full(n, 1 / n)
    for t in range(steps):
        if t == 0:
            x[0] = rng.normal(size=n) / np.sqrt(0.19)
        else:
            ancestors[t] = rng.choice(n, size=n, p=w)
            ancestors[t, -1] = n - 1
            x[t] = 0.9 * x[t - 1, ancestors[t]] + rng.normal(size=n)
        x[t, -1] = reference[t]
        log_w = -0.5 * (y[t] - x[t]) ** 2
        w = np.exp(log_w - log_w.max())
        w /= w.sum()
    k, out = rng.choice(n, p=w), np.empty(steps)
    for t in range(steps - 1, -1, -1):
        out[t] = x[t, k]
        k = ancestors[t, k] if t else k
    return out


def adapted() -> list[Row]:
    rows = []
    for r in (0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0):
        problem, theta = problem_of(100, r)
        figures = {
            p: variance(log_ratios(problem, theta, FilterSettings(1000, p), 400, 7))
            for p in ("bootstrap", "guided", "auxiliary")
        }
        base, base_error = figures["bootstrap"]
        for p in ("guided", "auxiliary"):
            value, error = figures[p]
            relative = np.hypot(error / value, base_error / base)
            rows.append(("adapted", p, r, value / base, value / base * relative))
    return rows


def slope(rows: list[Row], series: str, least: float = 0.0) -> str:
    """Of log value on log x, x >= least, weighted by the errors; with its standard error."""
    x, value, error = np.array([r[2:] for r in rows if r[1] == series and r[2] >= least]).T
    weight = (value / error) ** 2
    u, v = np.log(x), np.log(value)
    centre = np.average(u, weights=weight)
    spread = np.sum(weight * (u - centre) ** 2)
    fitted = np.sum(weight * (u - centre) * v) / spread
    return f"{fitted:.3f} ± {spread**-0.5:.3f}"


def main() -> None:
    parts = [unbiased(), filter_means(), variance_in_time(), genealogy(), update_rate(), adapted()]
    OUT.parent.mkdir(exist_ok=True)
    with OUT.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["property", "series", "x", "value", "error"])
        for row in (r for part in parts for r in part):
            writer.writerow([*row[:2], f"{row[2]:g}", f"{row[3]:.6g}", f"{row[4]:.3g}"])
    show(["proposal", "N", "mean of Z / exact"],
         [[s, f"{x:g}", f"{v:.4f} ± {e:.4f}"] for _, s, x, v, e in parts[0]])  # fmt: skip
    print()
    table = [["error of the filter means in N, from 100 on", s, slope(parts[1], s, 100), "-1/2"]
             for s in ("bootstrap", "auxiliary")]  # fmt: skip
    table += [["variance of log Z in T", s, slope(parts[2], s), "1"]
              for s in ("bootstrap", "auxiliary")]  # fmt: skip
    show(["exponent of", "proposal", "fitted", "theory"], table)
    print(f"\nWrote {OUT.name}")


if __name__ == "__main__":
    main()
