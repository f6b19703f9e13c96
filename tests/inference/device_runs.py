"""Filters in Numba's simulator of CUDA, beside the same arithmetic in NumPy: a program.

    NUMBA_ENABLE_CUDASIM=1 python -m tests.inference.device_runs MODEL:PROPOSAL ...

The simulator has to be asked for before Numba is imported, so test_device.py runs this in a process
of its own. Prints for each, as JSON, the increments of log Z and the effective sizes, of both.
"""

from __future__ import annotations

import json
import sys

import numpy as np

from ssmppl.codegen.kernels.math.random import fill_normal, fill_uniform
from ssmppl.codegen.kernels.particle.cuda_filter import STREAM_BITS
from ssmppl.codegen.text.kernel_functions import filter_functions
from ssmppl.codegen.text.module import Layout
from ssmppl.data import unpack_observations
from ssmppl.inference.particles.on_device import random_numbers, run_on_device
from ssmppl.inference.run.problem import pose
from ssmppl.inference.run.seeds import random_state
from ssmppl.language.tracing import trace
from tests.codegen.harness import Numbers
from tests.models.statements import build

THREADS = 4
ROLES = ("prepare", "step", "draw_initial", "weigh_initial", "fit", "draw", "weigh")


def example(name):
    """(problem, theta) of a model of the corpus, with four rows, of which the last is missing."""
    model = build(name)
    traced = trace(model)
    numbers = Numbers(traced, np.random.default_rng(1))
    numbers.y[3] = np.nan
    data, at = dict(unpack_observations(traced, numbers.y)), 0
    for own, shape in traced.inputs.items():
        size = int(np.prod(shape))
        data[own], at = numbers.u[:, at : at + size].reshape(-1, *shape), at + size
    return pose(model, data), numbers.theta


def by_numpy(problem, theta, proposal, particles, rng):
    """(log increments, effective sizes) of the filter with the device's random numbers."""
    e, module = problem.experiments[0], problem.program.module
    section = filter_functions(Layout(problem.trace), problem.program.proposals[proposal])
    role = {r: getattr(module, section.name(r), None) for r in ROLES}
    keys, points = random_numbers(rng, e.steps)
    states, fits = len(problem.trace.state_symbols), max(len(section.fits), 1)
    c, s = np.empty(500), np.empty(500)
    x, old = np.empty((states, particles)), np.empty((states, particles))
    increments, ess, w = [], [], np.ones(particles)
    role["prepare"](theta, c)
    for t in range(e.steps):
        role["step"](theta, c, e.y, e.seen, e.u, t, s)
        x, old = old, x
        log_w = np.empty(particles)
        if t > 0:
            sums = np.cumsum(w) / w.sum() * particles
            ancestors = np.searchsorted(sums, np.arange(particles) + points[t], side="right")
        for i in range(particles):
            stream = np.zeros(4, dtype=np.uint64)
            stream[:2] = keys[:2]
            stream[2] = keys[2] + (np.uint64(t * particles + i) << STREAM_BITS)
            normals, uniforms = (
                np.empty(max(section.normals, 1)),
                np.empty(max(section.uniforms, 1)),
            )
            fill_normal(stream, normals)
            fill_uniform(stream, uniforms)
            one, fitted, own = np.empty((states, 1)), np.empty((fits, 1)), np.empty(1)
            if t == 0:
                role["draw_initial"](theta, c, s, one, normals, uniforms, stream)
                role["weigh_initial"](theta, c, s, one, own)
            else:
                before = np.ascontiguousarray(old[:, [ancestors[i]]])
                if section.fits:
                    role["fit"](theta, c, s, before, fitted)
                role["draw"](theta, c, s, before, fitted, one, normals, uniforms, stream)
                role["weigh"](theta, c, s, before, fitted, one, own)
            x[:, i], log_w[i] = one[:, 0], own[0]
        top = log_w.max()
        w = np.exp(log_w - top)
        increments.append(top + np.log(w.mean()))
        ess.append(w.sum() ** 2 / np.sum(w**2))
    return increments, ess


def main(cases, particles=10):
    for case in cases:
        name, proposal = case.split(":")
        problem, theta = example(name)
        root = np.random.SeedSequence(3)
        e = problem.experiments[0]
        out = np.empty((2, e.steps))
        status, t = run_on_device(
            problem, theta, proposal, particles, e, random_state(root), *out, threads=THREADS
        )
        expected = by_numpy(problem, theta, proposal, particles, random_state(root))
        found = {"case": case, "status": [status, t], "found": out.tolist(), "expected": expected}
        print(json.dumps(found), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
