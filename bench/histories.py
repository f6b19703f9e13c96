"""Milliseconds of a capture-recapture model of many short data sets, by the number of animals.

The Cormack-Jolly-Seber model: of each animal whether it was seen at 7 occasions, the first of them
that of its release. `python bench/histories.py [animals ...]`
"""

from __future__ import annotations

import sys
import time

import numpy as np
from table import show

import ssmppl as ssm
from ssmppl.inference.exact.hidden_markov import hidden_markov
from ssmppl.inference.run.problem import pose

ANIMALS, OCCASIONS, ROUNDS, DRAWS = (150, 2_000), 7, 20, 200
SURVIVAL, CAPTURE = 0.6, 0.7


def model():
    made = ssm.Model("capture and recapture")
    made.prior(lambda: {"phi": ssm.Beta(1, 1), "p": ssm.Beta(1, 1)})
    made.initial(lambda: {"alive": ssm.Bernoulli(1.0)})
    made.transition(lambda alive, phi: {"alive": ssm.Bernoulli(phi * alive)})
    made.observation(lambda alive, p, t: {"seen": ssm.Bernoulli(alive * np.where(t == 1, 1.0, p))})
    return made


def animals(n):
    rng = np.random.default_rng(n)
    alive = np.cumprod(rng.random((n, OCCASIONS - 1)) < SURVIVAL, axis=1)
    seen = alive * (rng.random(alive.shape) < CAPTURE)
    return [{"seen": np.concatenate([[1.0], row])} for row in seen]


def milliseconds(function, rounds=1):
    times = []
    for _ in range(rounds):
        began = time.perf_counter()
        function()
        times.append(time.perf_counter() - began)
    return f"{1e3 * np.median(times):,.2f}"


def runs(made, data, theta):
    """Name -> (a function that runs it once, how often)."""
    problem = pose(made, data)
    exact = hidden_markov(problem.trace)
    own = {"draws": DRAWS, "warmup": DRAWS, "chains": 1, "seed": 1, "progress": False}
    return {
        "binding of the data": (lambda: pose(made, data), 3),
        "one likelihood": (lambda: exact.log_likelihood(problem.experiments, theta), ROUNDS),
        "one score": (lambda: exact.score(problem.experiments, theta), ROUNDS),
        "maximize": (lambda: ssm.maximize(made, data, seed=1), 1),
        "maximize, EM": (lambda: ssm.maximize(made, data, method=ssm.EM(), seed=1), 1),
        f"MetropolisHastings, {2 * DRAWS} steps": (
            lambda: ssm.sample(made, data, ssm.MetropolisHastings(), states=False, **own), 1
        ),
    }  # fmt: skip


def main(sizes):
    made, theta = model(), np.array([SURVIVAL, CAPTURE])
    for run, _ in runs(made, animals(5), theta).values():  # compiles
        run()
    found = [runs(made, animals(n), theta) for n in sizes]
    rows = [[name, *(milliseconds(*f[name]) for f in found)] for name in found[0]]
    show(["milliseconds", *(f"{n:,} animals" for n in sizes)], rows)


if __name__ == "__main__":
    main([int(a) for a in sys.argv[1:]] or ANIMALS)
