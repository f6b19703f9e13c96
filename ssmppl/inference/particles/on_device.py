"""Runs of the particle filter on a CUDA device; see `codegen/kernels/particle/cuda_filter.py`."""

from __future__ import annotations

import numpy as np
from numba.core.errors import NumbaError

from ssmppl.codegen.kernels.math.random import new_state, uniform
from ssmppl.codegen.kernels.particle.weights import OK
from ssmppl.codegen.modules.device import THREADS, cuda_module
from ssmppl.data import Experiment
from ssmppl.errors import ArgumentError
from ssmppl.inference.run.problem import Problem
from ssmppl.inference.run.seeds import fill_uniform


def check_device(problem: Problem, proposal: str, **others: tuple[object, object]) -> None:
    """Refuse what only the processor does.

    others : argument -> (its value, the only one that the device knows).

    Raises
    ------
    ArgumentError : naming the argument, or what has to be installed for a device to be found.
    """
    cuda_module()
    for name, (value, only) in others.items():
        if value != only:
            raise ArgumentError(
                f"{name}={value!r} together with device='cuda', which does {name}={only!r} only",
                fix=f"leave {name}= out, or device=",
            )
    if not problem.program.apart(proposal):
        able = [name for name in problem.program.proposals if problem.program.apart(name)]
        raise ArgumentError(
            f"proposal={proposal!r} is not run by device='cuda'",
            fix=f"use one of: {', '.join(able)}; or leave device= out",
        )


def run_on_device(
    problem: Problem, theta: np.ndarray, proposal: str, particles: int, experiment: Experiment,
    rng: np.ndarray, log_increments: np.ndarray, ess: np.ndarray, threads: int = THREADS,
) -> tuple[int, int]:  # fmt: skip
    """Run the filter over one experiment, with systematic resampling at every row; (status, t).

    log_increments, ess : (T,), written.
    """
    cuda = cuda_module()
    made = problem.program.on_device(proposal, threads)
    steps, blocks = experiment.steps, -(-particles // threads)
    c, s = np.empty(made.sizes[0]), np.empty((steps, made.sizes[1]))
    made.prepare(theta, c)
    for t in range(steps):
        made.step(theta, c, experiment.y, experiment.seen, experiment.u, t, s[t])
    keys, points = random_numbers(rng, steps)
    given = [cuda.to_device(a) for a in (theta, _some(c), _some(s))]
    draws = [cuda.to_device(a) for a in (keys, points)]
    x, old = (cuda.device_array((made.sizes[2], particles)) for _ in range(2))
    sums, old_sums = (cuda.device_array(particles, np.int64) for _ in range(2))
    ends = cuda.device_array(blocks, np.int64)
    tops, squares = (cuda.device_array(blocks) for _ in range(2))
    flags, status = cuda.device_array(blocks, np.int64), cuda.device_array(steps, np.int64)
    out = [cuda.device_array(steps) for _ in range(2)]
    for t in range(steps):
        x, old, sums, old_sums = old, x, old_sums, sums
        move = *given, t, particles, *draws, old, old_sums, ends, x, sums, tops, squares, flags
        join = particles, t, sums, tops, squares, flags, ends, *out, status
        try:
            made.move[blocks, threads](*move)
            made.join[1, threads](*join)
        except NumbaError as error:  # at the first row, where the kernels are compiled
            first_line = next(line for line in str(error).splitlines() if line.strip())
            raise ArgumentError(
                f"the model {problem.trace.name!r} is not compiled for device='cuda': {first_line}",
                fix="leave device= out",
            ) from error
    found = status.copy_to_host()
    log_increments[:], ess[:] = out[0].copy_to_host(), out[1].copy_to_host()
    failed = np.flatnonzero(found != OK)
    if len(failed):
        return int(found[failed[0]]), int(failed[0])
    return OK, steps


def random_numbers(rng: np.ndarray, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """The state that the particles' streams count from, and where each row's systematic points
    begin, (T,). The filter's own state moves on by one word."""
    keys = new_state(np.random.SeedSequence([int(word) for word in rng[:3]]))
    uniform(rng)
    points = np.empty(steps)
    fill_uniform(keys, points)
    return keys, points


def _some(a: np.ndarray) -> np.ndarray:
    """The array, with a column where it has none: devices take no empty ones."""
    return a if a.size else np.zeros((*a.shape[:-1], 1))
