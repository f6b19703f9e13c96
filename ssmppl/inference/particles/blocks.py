"""One particle filter of very many particles, in blocks that the cores of a machine share out.

See `codegen/kernels/particle/particle_filter.py`. The numbers depend on the size of a block and on
the seed, not on how many threads there are.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np

from ssmppl.codegen.kernels.math.random import new_state, uniform
from ssmppl.codegen.kernels.particle.particle_filter import BLOCK
from ssmppl.codegen.kernels.particle.resampling import PADDING
from ssmppl.codegen.kernels.particle.weights import ALL_ZERO, INFINITE, NAN, OK
from ssmppl.data import Experiment
from ssmppl.inference.run.executors import cpu_count
from ssmppl.inference.run.problem import Problem

LEAST = 1 << 19
"""Particles from which a filter runs in blocks, whatever the number of cores."""


def run_in_blocks(
    problem: Problem, theta: np.ndarray, proposal: str, particles: int, ess_threshold: float,
    experiment: Experiment, rng: np.ndarray, log_increments: np.ndarray, ess: np.ndarray,
    threads: int | None = None,
) -> tuple[int, int]:  # fmt: skip
    """Run the filter over one experiment with systematic resampling; (status, t).

    log_increments, ess : (T,), written. threads : None, as many as there are cores.
    """
    name = f"move_blocks_{proposal}"
    move, sizes = problem.program.entry(name), problem.program.loaded.sizes(name)
    data = theta, experiment.y, experiment.seen, experiment.u
    blocks = -(-particles // BLOCK)
    parts = _parts(blocks, cpu_count() if threads is None else threads)
    x, old = np.empty((blocks, sizes[2], BLOCK)), np.empty((blocks, sizes[2], BLOCK))
    scratch = [np.empty((sum(sizes[2:]) + 2, BLOCK)) for _ in parts]
    ancestors = [np.zeros(BLOCK + PADDING, dtype=np.int32) for _ in parts]
    w, old_w = np.empty((blocks, BLOCK)), np.empty((blocks, BLOCK))
    sums, streams = np.empty((blocks, 4)), _streams(rng, blocks)
    shares, moved = np.full(blocks, -1.0), np.full(blocks, -1.0)
    ends, u = np.zeros(blocks + 1), 0.5
    log_increments[:] = -np.inf
    for t in range(experiment.steps):
        weighted = t > 0 and not (ess_threshold >= 1.0 or ess[t - 1] < ess_threshold * particles)
        if t > 0 and not weighted:
            ends, u = _ends(shares, particles), uniform(rng)
        x, old, w, old_w = old, x, old_w, w
        kept = shares if weighted else moved
        given = *data, t, particles, old, old_w, ends, u, kept, streams, x, w, sums
        own = zip(scratch, ancestors, parts, strict=True)
        _share_out(move, [(*given, room, slots, *part) for room, slots, part in own])
        status = _status(sums)
        if status != OK:
            return status, t
        total = np.logaddexp.reduce(sums[:, 0])
        shares = np.exp(sums[:, 0] - total)
        ess[t] = 1.0 / np.sum(shares[shares > 0] ** 2 / sums[shares > 0, 1])
        log_increments[t] = total if weighted else total - np.log(particles)
    return OK, experiment.steps


def _streams(rng: np.ndarray, blocks: int) -> np.ndarray:
    """A stream of random numbers for each block, (B, 4); the filter's own moves on by one word."""
    entropy = [int(word) for word in rng[:3]]
    uniform(rng)
    return np.array([new_state(np.random.SeedSequence([*entropy, b])) for b in range(blocks)])


def _ends(shares: np.ndarray, particles: int) -> np.ndarray:
    """N times the sum of the shares before each block, and at the end of all of them."""
    ends = np.concatenate([[0.0], np.cumsum(shares)]) * particles
    ends[np.flatnonzero(shares)[-1] + 1 :] = particles
    return np.minimum(ends, particles)


def _status(sums: np.ndarray) -> int:
    """Status of all blocks together, as `normalise` and the kernel `particle_filter` tell it."""
    found = sums[:, 2]
    if (found == NAN).any():
        return NAN if sums[:, 3].any() else ALL_ZERO
    if (found == INFINITE).any():
        return INFINITE
    return OK if (sums[:, 0] > -np.inf).any() else ALL_ZERO


def _parts(blocks: int, threads: int) -> list[tuple[int, int]]:
    """The first block of each thread's, and the one after its last."""
    cuts = np.linspace(0, blocks, min(threads, blocks) + 1).astype(int)
    return [(int(a), int(b)) for a, b in pairwise(cuts)]


def _share_out(run: Callable[..., Any], tasks: list[tuple[Any, ...]]) -> None:
    """Each task in a thread, the first of them in this one."""
    others = [_pool(os.getpid(), len(tasks) - 1).submit(run, *task) for task in tasks[1:]]
    try:
        run(*tasks[0])
    finally:
        wait(others)  # an interrupt must not leave threads behind that still write
    for future in others:
        future.result()


@cache
def _pool(process: int, threads: int) -> ThreadPoolExecutor:
    """Threads that are kept: a pass takes less time than starting one. Not over a fork."""
    return ThreadPoolExecutor(threads, thread_name_prefix="ssmppl_blocks")
