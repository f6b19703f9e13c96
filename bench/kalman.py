"""Microseconds per time step of the exact algorithms, by the number of states.

python bench/kalman.py
"""

from __future__ import annotations

import time

import numpy as np
from table import show

from ssmppl.codegen.kernels.kalman.adjoint import zeros_like
from ssmppl.codegen.kernels.kalman.steps import Matrices
from ssmppl.codegen.kernels.math.random import new_state
from ssmppl.codegen.modules.exact import exact_entry

STEPS, ROUNDS = 20_000, 5
SIZES = [(1, 1), (4, 2), (10, 3)]


def model(d, k):
    """A stable model with full matrices, and data."""
    rng = np.random.default_rng(d)
    a = rng.normal(size=(d, d))
    a *= 0.95 / np.abs(np.linalg.eigvals(a)).max()
    half = rng.normal(size=(d, d))
    q = half @ half.T
    made = Matrices(
        np.zeros(d), q, a[None], np.zeros((1, d)), q[None], rng.normal(size=(1, k, d)),
        np.zeros((1, k)), np.eye(k)[None],
    )  # fmt: skip
    return made, rng.normal(size=(STEPS, k))


def runs(d, k):
    """Name -> a function that runs it once."""
    made, y = model(d, k)
    seen, start, out = np.ones_like(y), made.m[:, None].copy(), np.empty(STEPS)
    shapes = ((d,), (d, d), (d,), (d, d), (k,), (k, k))
    none = [np.empty((0, *s)) for s in shapes]
    moments = [np.empty((STEPS, *s)) for s in ((d,), (d, d), (d, d))]
    stream, one, ten = (
        new_state(np.random.SeedSequence(1)), np.empty((1, STEPS, d)), np.empty((10, STEPS, d))
    )  # fmt: skip
    draw = exact_entry("draw")
    return {
        "log-likelihood": lambda: exact_entry("kalman_filter")(*made, y, seen, out, *none),
        "score": lambda: exact_entry("adjoints")(
            made, start, y, seen, np.ones(8, np.int64), out, zeros_like(made)
        ),
        "smoother": lambda: exact_entry("smooth")(
            made, start, y, seen, out, *moments, None, None, None, None
        ),
        "1 draw": lambda: draw(made, start, y, seen, stream, out, one),
        "10 draws": lambda: draw(made, start, y, seen, stream, out, ten),
    }


def microseconds(run):
    """Best of a few rounds, per step."""
    run()
    best = np.inf
    for _ in range(ROUNDS):
        before = time.perf_counter()
        run()
        best = min(best, time.perf_counter() - before)
    return 1e6 * best / STEPS


def main() -> None:
    """Print the table."""
    rows = []
    for d, k in SIZES:
        found = {name: microseconds(run) for name, run in runs(d, k).items()}
        rows.append([f"{d}, {k}", *(f"{v:.2f}" for v in found.values())])
    show(["states, channels", *runs(1, 1)], rows)


if __name__ == "__main__":
    main()
