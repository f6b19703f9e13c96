"""Which proposals survive in more than one dimension, at which N, and what "auto" chooses.

The pendulum and the vehicle of the examples, at the truth, and Lorenz-96 with 8 and 40 states of
which every other one is seen. For every proposal and N: the mean and spread of log Z, and the
seconds of a run. A filter survives where log Z spreads by no more than 3 and lies no further than 3
from the reference: Kalman's value for the vehicle, else the log mean of the twisted filter's runs
at the largest N.

    python bench/moderate.py [words of the cases ...]

Without words, all of it goes to docs/figures/moderate.csv too, from which the page on proposals is
made.
"""

from __future__ import annotations

import csv
import sys
import time
from pathlib import Path

import numpy as np
from models import Case, lorenz, simulated
from table import machine, show, versions

import ssmppl as ssm
from examples.check.rows import files
from ssmppl.data import check_parameters
from ssmppl.errors import NotApplicable, SSMError
from ssmppl.inference.particles.filtering import (
    FilterSettings,
    log_likelihood_estimate,
    log_of_mean,
)
from ssmppl.inference.preparation.exact_models import exact_model
from ssmppl.inference.preparation.proposal_choice import choose_by_pilot
from ssmppl.inference.run.problem import Problem, pose
from ssmppl.inference.run.seeds import random_state

PARTICLES = (100, 1000, 10000)
REPEATS = 20
BOUND = 3.0  # nats of spread, and of distance from the reference
NONE = NotApplicable("there is none")
VEHICLE = {"c_front": 7.0, "c_rear": 8.5, "q_v": 1e-3, "q_w": 2e-5, "r_gyro": 1e-4,
           "r_position": 0.04}  # fmt: skip
PENDULUM = {"k": 15.0, "c": 0.4, "b": 8.0, "q": 0.2}
HEADER = ["model", "proposal", "N", "log Z less the reference", "sd", "ms a run", "survives"]
TABLE = Path(__file__).parents[1] / "docs" / "figures" / "moderate.csv"
PROPOSALS = ("bootstrap", "guided", "auxiliary", "twisted")


def cases() -> list[Case]:
    small, large = lorenz(8, 0.05), lorenz(40, 0.025)
    return [
        Case("pendulum", *files("pendulum"), PENDULUM),
        Case("vehicle", *files("vehicle"), VEHICLE),
        Case("Lorenz-96, 8 states", small, simulated(small, 100), {}),
        Case("Lorenz-96, 40 states", large, simulated(large, 100), {}),
    ]


def report(case: Case) -> tuple[list[list[str]], list[str]]:
    """Rows of the table of one case, and its row of the table of choices."""
    problem = pose(case.model, case.data)
    theta = check_parameters(problem.trace, case.parameters)
    start = time.perf_counter()
    choice = choose_by_pilot(problem, theta, exact=False, whole=True, integrate=True)
    pilot = time.perf_counter() - start
    found = [
        (name, n, *runs(problem, theta, name, n)) for name in names(problem) for n in PARTICLES
    ]
    reference, by = float("nan"), "Kalman"
    if isinstance(exact_model(problem.trace), NotApplicable):
        reference, by = log_of_mean(found[-1][2])[0], f"twisted, N = {PARTICLES[-1]:,}"
    else:
        reference = float(ssm.log_likelihood(case.model, case.data, case.parameters)[0])
    rows = []
    for name, n, log_z, seconds in found:
        mean, spread = float(np.mean(log_z)), float(np.std(log_z, ddof=1))
        survives = spread <= BOUND and abs(log_of_mean(log_z)[0] - reference) <= BOUND
        rows.append([
            case.label, name, f"{n:,}", f"{mean - reference:.2f}", f"{spread:.3g}",
            f"{1e3 * seconds:.3g}", "yes" if survives else "no",
        ])  # fmt: skip
    alone = choose_by_pilot(problem, theta, whole=True, integrate=True).name
    return rows, [case.label, f"{reference:.2f} ({by})", alone, choice.name, f"{pilot:.1f}"]


def names(problem: Problem) -> list[str]:
    """The proposals that were derived."""
    return [n for n in PROPOSALS
            if not isinstance(problem.program.proposals.get(n, NONE), NotApplicable)]  # fmt: skip


def runs(problem: Problem, theta: np.ndarray, name: str, n: int) -> tuple[np.ndarray, float]:
    """Estimates of log Z, and the median of their seconds."""
    log_z, seconds, root = [], [], np.random.SeedSequence(96)
    for repeat in range(REPEATS + 1):  # the first one compiles
        start = time.perf_counter()
        rng = random_state(root, repeat)
        try:
            log_z.append(log_likelihood_estimate(problem, theta, FilterSettings(n, name), rng))
        except SSMError:
            log_z.append(-np.inf)
        seconds.append(time.perf_counter() - start)
    return np.array(log_z[1:]), float(np.median(seconds[1:]))


def main() -> None:
    rows: list[list[str]] = []
    choices: list[list[str]] = []
    for case in cases():
        if sys.argv[1:] and not any(word in case.label for word in sys.argv[1:]):
            continue
        more, choice = report(case)
        rows += more
        choices.append(choice)
    print(f"{machine()}; {versions('numpy', 'numba')}. {REPEATS} runs each, one thread.\n")
    show(HEADER, rows)
    print("\nChoices: by default, and among particle filters, with the seconds of that pilot.\n")
    show(["model", "reference", "auto", "of the particle filters", "pilot, s"], choices)
    if not sys.argv[1:]:
        with TABLE.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(HEADER)
            writer.writerows([[c.replace(",", "") if k == 2 else c for k, c in enumerate(r)]
                              for r in rows])  # fmt: skip


if __name__ == "__main__":
    main()
