"""What guided and auxiliary filters are worth, and whether "auto" chooses the right one.

For every model and N: variance of log Z, time per particle step, and their product, the variance
times seconds, relative to the bootstrap filter (less is better; variance falls as 1 / N and time
grows as N, so that the product is what a filter costs whatever the variance wanted). Then the
choice of `proposal="auto"` without the Kalman filter, the time that its pilot takes, and the costs
that it reckons with beside the measured ones.

    python bench/proposals.py [words of the cases ...]
"""

from __future__ import annotations

import sys
import time

import numpy as np
from models import Case, cases
from table import show

from ssmppl.analysis.proposals.proposals import Proposal
from ssmppl.codegen.kernels.math.random import new_state
from ssmppl.data import check_parameters
from ssmppl.errors import NotApplicable
from ssmppl.inference.particles.filtering import FilterSettings, log_likelihood_estimate
from ssmppl.inference.preparation.proposal_choice import TEMPERING, choose_by_pilot, cost
from ssmppl.inference.run.problem import Problem, pose

PARTICLES = (100, 1000)
REPEATS = 200


def derived(problem: Problem) -> dict[str, Proposal]:
    """All proposals that there are, those of Rao-Blackwellised filters too."""
    marginal = problem.program.marginal
    found = dict(problem.program.proposals)
    found |= {} if isinstance(marginal, NotApplicable) else marginal.proposals
    if isinstance(found["guided"], NotApplicable):  # else it is no match for the others
        tempered = problem.program.tempered
        found["tempered"] = (
            tempered if isinstance(tempered, NotApplicable) else tempered.proposals["tempered"]
        )
    return {k: p for k, p in found.items() if not isinstance(p, NotApplicable)}


def reckoned(problem: Problem, name: str) -> float:
    """What "auto" takes a particle's step to cost, in nanoseconds."""
    return cost(derived(problem)[name]) * (TEMPERING if name == "tempered" else 1.0)


def measure(problem: Problem, theta: np.ndarray, n: int) -> dict[str, tuple[float, float]]:
    """Proposal -> (variance of log Z, seconds per run), the runs of all in turn."""
    names = list(derived(problem))
    streams = {k: new_state(np.random.SeedSequence(i)) for i, k in enumerate(names)}
    log_z: dict[str, list[float]] = {k: [] for k in names}
    seconds: dict[str, list[float]] = {k: [] for k in names}
    for _ in range(REPEATS):
        for k in names:
            start = time.perf_counter()
            z = log_likelihood_estimate(problem, theta, FilterSettings(n, k), streams[k])
            seconds[k].append(time.perf_counter() - start)
            log_z[k].append(z)
    return {k: (float(np.var(log_z[k], ddof=1)), float(np.median(seconds[k]))) for k in names}


def report(case: Case) -> tuple[list[list[str]], list[list[str]]]:
    """Rows of the table of proposals, and those of the table of choices."""
    problem = pose(case.model, case.data)
    theta = check_parameters(problem.trace, case.parameters)
    for k in derived(problem):  # compile
        rng = new_state(np.random.SeedSequence(0))
        log_likelihood_estimate(problem, theta, FilterSettings(10, k), rng)
    start = time.perf_counter()
    choice = choose_by_pilot(problem, theta, exact=False, whole=True, integrate=True, temper=True)
    pilot = time.perf_counter() - start
    rows, chosen = [], []
    for n in PARTICLES:
        found = measure(problem, theta, n)
        base_variance, _ = found["bootstrap"]
        per_step = 1e9 / (n * problem.experiments[0].steps)
        work = {k: v * s for k, (v, s) in found.items()}
        for k, (variance, seconds) in found.items():
            rows.append([
                case.label, f"{n:,}", k, f"{variance:.4g}", f"{variance / base_variance:.3g}",
                f"{seconds * per_step:.1f}", f"{reckoned(problem, k):.1f}",
                f"{work[k] / work['bootstrap']:.3g}",
            ])  # fmt: skip
        best = min(work, key=lambda k: work[k])
        chosen.append([
            case.label, f"{n:,}", choice.name, best, f"{work[choice.name] / work[best]:.2f}",
            f"{pilot:.2f}",
        ])  # fmt: skip
    return rows, chosen


def main() -> None:
    tables: tuple[list, list] = ([], [])
    for case in cases():
        if sys.argv[1:] and not any(word in case.label for word in sys.argv[1:]):
            continue
        for table, rows in zip(tables, report(case), strict=True):
            table += rows
    print(f"Variance of log Z over {REPEATS} runs.\n")
    show(["model", "N", "proposal", "variance", "to bootstrap", "ns a step", "reckoned",
          "variance x time"], tables[0])  # fmt: skip
    print('\nChoice of "auto" against the least variance times time; at most 1.2 is wanted.\n')
    show(["model", "N", "auto", "best", "auto / best", "pilot, s"], tables[1])


if __name__ == "__main__":
    main()
