"""The particle filter as a likelihood for Metropolis-Hastings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssmppl.codegen.kernels.weights import ALL_ZERO, OK
from ssmppl.inference.filtering import FilterSettings, failure
from ssmppl.inference.pilot import Space
from ssmppl.inference.problem import Problem
from ssmppl.inference.walk import Point, Run


@dataclass(frozen=True)
class ParticleLikelihood:
    """An independent run of the particle filter for every point."""

    problem: Problem
    settings: FilterSettings

    def run(self, theta: np.ndarray, before: Run | None, stream: np.ndarray) -> Run | None:
        entry = self.problem.program.entry(f"filtered_path_{self.settings.proposal}")
        total, paths, increments = 0.0, [], []
        for e in self.problem.experiments:
            path = np.empty((e.steps, len(self.problem.trace.state_symbols)))
            increment = np.empty(e.steps)
            status, t, log_z = entry(
                theta, e.y, e.seen, e.u, self.settings.particles, stream, path, increment
            )
            if status == ALL_ZERO:
                return None
            if status != OK:
                raise failure(self.problem, theta, status, t, e)
            total += log_z
            paths.append(path)
            increments.append(increment)
        return Run(total, tuple(paths), tuple(increments))

    def kept(self, point: Point, stream: np.ndarray) -> dict[str, np.ndarray]:
        return paths_of(point)


def paths_of(point: Point) -> dict[str, np.ndarray]:
    """The path of the run and its increments, by the names of the draws."""
    named = {f"path_{i}": path for i, path in enumerate(point.run.paths)}
    return named | {f"increment_{i}": v for i, v in enumerate(point.run.increments)}


def run_filters(
    space: Space, theta: np.ndarray, settings: FilterSettings, stream: np.ndarray
) -> tuple[float, tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
    """(log Z, paths, increments) of all experiments; -inf where the estimate is zero."""
    run = ParticleLikelihood(space.problem, settings).run(theta, None, stream)
    return (-np.inf, (), ()) if run is None else (run.log_likelihood, run.paths, run.increments)
