"""Backward simulation against exact smoothing: the bias in N, the moments, and what it costs.

Bias: smoothed covariances from M = N trajectories, centred on the exact means and averaged over
time, less the exact ones, over many independent runs. It falls as 1 / N, and so does half of it
with every doubling. Moments: every mean, covariance and covariance with the step before, in
standard errors over independent runs. Cost: nanoseconds for each index, one thread.

    python bench/smoothing.py
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from table import show

import ssmppl as ssm
from ssmppl.codegen.kernels.math.random import new_state
from ssmppl.data import check_parameters
from ssmppl.inference.exact.kalman import kalman_model
from ssmppl.inference.exact.kalman_matrices import SmoothedMoments
from ssmppl.inference.particles.backward import backward_draws, draw_paths, particle_system
from ssmppl.inference.particles.filtering import FilterSettings
from ssmppl.inference.run.problem import Problem, pose

STEPS = 50
RUNS = {20: 8000, 40: 4000, 80: 2000, 160: 1000, 320: 500}
MOMENT_RUNS, MOMENT_PARTICLES, MOMENT_DRAWS = 60, 2000, 200

one = ssm.Model("one state")


@one.initial
def one_initial():
    return {"x": ssm.Normal(0, variance=1 / 0.51)}


@one.transition
def one_transition(x):
    return {"x": ssm.Normal(0.7 * x, sd=1)}


@one.observation
def one_observation(x):
    return {"y": ssm.Normal(0.5 * x, variance=0.1)}


four = ssm.Model("four states")
A = np.array([
    [0.9, 0.25, 0.05, 0.0], [-0.25, 0.9, 0.0, 0.05], [0.1, 0.0, 0.6, 0.4], [0.0, 0.1, -0.4, 0.6]
])  # fmt: skip
ROOT = np.array([
    [0.5, 0.0, 0.0, 0.0], [0.2, 0.5, 0.0, 0.0], [0.0, 0.1, 0.6, 0.0], [0.1, 0.0, -0.2, 0.6]
])  # fmt: skip
C = np.array([[1.0, 0.0, 0.5, 0.0], [0.0, 1.0, 0.0, -0.5]])


@four.initial
def four_initial():
    return {"x": ssm.MvNormal(np.zeros(4), covariance=np.eye(4))}


@four.transition
def four_transition(x):
    return {"x": ssm.MvNormal(A @ x, covariance=ROOT @ ROOT.T)}


@four.observation
def four_observation(x):
    return {"y": ssm.Normal(C @ x, sd=0.8)}


class Case(NamedTuple):
    label: str
    problem: Problem
    theta: np.ndarray
    exact: SmoothedMoments


def cases() -> Iterator[Case]:
    """The two models; a quarter of the first one's data are missing."""
    for model in (one, four):
        y = np.array(ssm.simulate(model, {}, steps=STEPS, seed=20153)["y"].values[0])
        if model is one:
            y[np.random.default_rng(20154).uniform(size=STEPS) < 0.25] = np.nan
        problem = pose(model, {"y": y})
        theta = check_parameters(problem.trace, {})
        yield Case(
            model.name, problem, theta,
            kalman_model(problem.trace).smooth(problem.experiments[0], theta),
        )  # fmt: skip


def moments(paths: np.ndarray, exact: SmoothedMoments) -> list[np.ndarray]:
    """Errors of mean, covariance and covariance with the step before, of draws (M, T, D)."""
    z = paths - exact.mean
    pair = np.einsum("mti,mtj->tij", z[:, 1:], z[:, :-1]) / len(z)
    return [
        z.mean(0), np.einsum("mti,mtj->tij", z, z) / len(z) - exact.covariance,
        pair - exact.cross[1:],
    ]  # fmt: skip


def bias(case: Case, proposal: str) -> tuple[list[list[str]], float]:
    """Rows: N, runs, error of the mean smoothed variance with its standard error, N times it.

    And c of the variance's bias c / N, from N >= 40.
    """
    stream, rows = new_state(np.random.SeedSequence(1)), []
    scaled, weights = [], []
    for n, runs in RUNS.items():
        settings, found = FilterSettings(n, proposal), np.empty((runs, 2))
        for r in range(runs):
            (paths,), _ = backward_draws(case.problem, case.theta, settings, n, stream, "exact")
            _, spread, pair = moments(paths, case.exact)
            found[r] = [np.trace(e, axis1=1, axis2=2).mean() for e in (spread, pair)]
        mean, error = found.mean(0), found.std(0, ddof=1) / np.sqrt(runs)
        if n >= 40:
            scaled.append(n * mean[0])
            weights.append((n * error[0]) ** -2)
        rows.append([
            case.label, proposal, f"{n:,}", f"{runs:,}",
            *(f"{m:+.4f} ± {e:.4f}" for m, e in zip(mean, error, strict=True)),
            *(f"{n * m:+.2f} ± {n * e:.2f}" for m, e in zip(mean, error, strict=True)),
        ])  # fmt: skip
    return rows, float(np.average(scaled, weights=weights))


def against_exact(case: Case, proposal: str, kernel: str, c: float) -> list[str]:
    """A row: how many moments, their deviations in standard errors, and by how many of them
    twice as many particles would move the mean smoothed variance, whose bias is c / N."""
    stream = new_state(np.random.SeedSequence(2))
    settings = FilterSettings(MOMENT_PARTICLES, proposal)
    runs = []
    for _ in range(MOMENT_RUNS):
        (paths,), _ = backward_draws(
            case.problem, case.theta, settings, MOMENT_DRAWS, stream, kernel
        )
        runs.append(moments(paths, case.exact))
    row = [case.label, proposal, kernel]
    for k in range(3):
        off = np.array([r[k] for r in runs])
        z = off.mean(0) / (off.std(0, ddof=1) / np.sqrt(MOMENT_RUNS))
        row.append(f"{z.size}: {np.sqrt(np.mean(z**2)):.2f}, {np.max(np.abs(z)):.2f}")
    variances = [np.trace(r[1], axis1=1, axis2=2).mean() for r in runs]
    error = np.std(variances, ddof=1) / np.sqrt(MOMENT_RUNS)
    return [*row, f"{c / (2 * MOMENT_PARTICLES * error):.2f}"]


def cost(case: Case, proposal: str) -> list[list[str]]:
    """Rows: nanoseconds for one index of one trajectory, by kernel, and proposals it took."""
    rows = []
    (experiment,) = case.problem.experiments
    for n, m in ((100, 1000), (1000, 100), (1000, 1000), (1000, 10_000), (10_000, 1000)):
        stream = new_state(np.random.SeedSequence(3))
        system = particle_system(
            case.problem, case.theta, FilterSettings(n, proposal), experiment, stream
        )
        row = [case.label, f"{n:,}", f"{m:,}"]
        seconds = {}
        for kernel in ("exact", "rejection", "mcmc"):
            taken = []
            for _ in range(4):  # the first one compiles
                start = time.process_time()
                draw_paths(
                    case.problem, case.theta, experiment, system, m, stream, kernel, moves=20
                )
                taken.append(time.process_time() - start)
            seconds[kernel] = min(taken[1:])
            row.append(f"{1e9 * seconds[kernel] / (m * STEPS):,.0f}")
        tally = np.zeros(2)
        case.problem.program.entry("backward_rejection")(
            case.theta, experiment.y, experiment.seen, experiment.u, stream, system.particles,
            system.weights, np.empty((STEPS, case.exact.mean.shape[1], m)), tally,
        )  # fmt: skip
        row += [f"{tally[0] / (m * (STEPS - 1)):.1f}", f"{tally[1] / (m * (STEPS - 1)):.1%}"]
        rows.append([*row, f"{seconds['exact'] / seconds['rejection']:.1f}"])
    return rows


def main() -> None:
    one_state, four_states = cases()
    print(f"T = {STEPS}. Bias of the smoothed variance (summed over states, averaged over time) "
          "and of the covariance with the step before, M = N.\n")  # fmt: skip
    one_rows, c_one = bias(one_state, "bootstrap")
    four_rows, c_four = bias(four_states, "auxiliary")
    show(["model", "proposal", "N", "runs", "variance", "covariance", "N x variance",
          "N x covariance"], [*one_rows, *four_rows])  # fmt: skip
    print(f"\nDeviations from the exact moments over {MOMENT_RUNS} runs, "
          f"N = {MOMENT_PARTICLES:,}, M = {MOMENT_DRAWS}: number of moments, root mean square, "
          "worst, in standard errors; and by how many of them twice the N would move the "
          "smoothed variance.\n")  # fmt: skip
    kernels = ("exact", "rejection", "mcmc")
    rows = [against_exact(one_state, "bootstrap", k, c_one) for k in kernels]
    rows += [against_exact(four_states, "auxiliary", k, c_four) for k in kernels]
    show(["model", "proposal", "kernel", "means", "covariances", "with the step before",
          "doubling N"], rows)  # fmt: skip
    print("\nNanoseconds for an index, MCMC with 20 moves; proposals an index took in rejection "
          "sampling, and the share of indices left to the exact kernel.\n")  # fmt: skip
    show(["model", "N", "M", "exact", "rejection", "mcmc", "proposals", "left over",
          "exact / rejection"],
         [*cost(one_state, "bootstrap"), *cost(four_states, "auxiliary")])  # fmt: skip


if __name__ == "__main__":
    main()
