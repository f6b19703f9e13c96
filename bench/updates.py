"""Microseconds of a draw from a derived Gibbs update, the sums over the states already taken.

The ice varves' update of phi and tau (Normal-Gamma, with the factor of the stationary initial law
accepted or not), for a simulated trajectory of 600 states.

    python bench/updates.py
"""

from __future__ import annotations

import time

import numpy as np
from table import show

import ssmppl as ssm
from ssmppl.analysis.conjugacy.derive import derive_updates
from ssmppl.demo import varves
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import symbol
from ssmppl.inference.updates.draw_update import draw
from ssmppl.language.tracing import trace

STEPS, DRAWS, ROUNDS = 600, 1_000, 20
TRUE = {"phi": 0.9, "tau": 40.0}


def sums(update, x):
    """What the update needs of the trajectory x (T,): one number for each of its functions."""
    now, before = symbol("state", "x"), symbol("state_prev", "x")
    out = []
    for i in range(len(update.functions)):
        prior, initial, transition = (
            update.coefficients[role][i] for role in ("prior", "initial", "transition")
        )
        moves = evaluate(transition, {now: x[1:], before: x[:-1]})
        moves = np.sum(np.broadcast_to(moves, len(x) - 1))
        out.append(evaluate(prior, {}) + evaluate(initial, {now: x[0]}) + moves)
    return np.array(out)


def main() -> None:
    (update,) = derive_updates(trace(varves))
    path = ssm.simulate(varves, TRUE, steps=STEPS, seed=1)["x"].values[0]
    totals, rng, value = sums(update, path), np.random.default_rng(1), np.array([0.9, 40.0])
    times = []
    for _ in range(ROUNDS):
        start = time.perf_counter()
        for _ in range(DRAWS):
            value, _ = draw(update, totals, value, {}, rng)
        times.append((time.perf_counter() - start) / DRAWS)
    row = [update.family_name, f"{1e6 * min(times):.1f}", f"{1e6 * np.median(times):.1f}"]
    show(["family", "µs a draw, least", f"median of {ROUNDS} rounds"], [row])


if __name__ == "__main__":
    main()
