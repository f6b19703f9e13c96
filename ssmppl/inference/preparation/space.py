"""The free parameters on their unconstrained scale: where climbs and chains move."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from ssmppl.data import unpack_parameters
from ssmppl.inference.preparation.initial_values import ordinary_values
from ssmppl.inference.run.problem import Problem
from ssmppl.language.model.trace import Trace
from ssmppl.language.model.transforms import transforms, unconstrain


class Region(Protocol):
    """A space with coordinates: a point in, (theta, log density of the prior there) out."""

    @property
    def problem(self) -> Problem: ...

    def parameters(self, point: np.ndarray, /) -> tuple[np.ndarray, float]: ...


@dataclass(frozen=True)
class Space:
    """The free parameters on their unconstrained scale.

    theta : (P,) values of all parameters; the fixed ones stay as they are here.
    free : (sites,) which parameters are free. positions : of their numbers in the full z.
    """

    problem: Problem
    theta: np.ndarray
    z: np.ndarray
    free: np.ndarray
    positions: np.ndarray

    @property
    def on_the_line(self) -> np.ndarray:
        """(free numbers,) which are values of the whole line, neither logarithms nor shares."""
        found = [x for t in transforms(self.problem.trace) for x in t.on_the_line]
        return np.array(found, dtype=bool)[self.positions]

    def parameters(self, z_free: np.ndarray) -> tuple[np.ndarray, float]:
        """(theta, log prior + log Jacobian) at unconstrained values of the free parameters."""
        theta, log_prior, log_jacobian = self.point(z_free)
        total = log_prior + log_jacobian
        return theta, total if total < np.inf else -np.inf

    def point(self, z_free: np.ndarray) -> tuple[np.ndarray, float, float]:
        """(theta, log prior density of theta, log Jacobian) at unconstrained values of the free
        parameters; -inf for the prior where theta is not finite, or the density is not."""
        if not self.problem.trace.parameters:
            return self.theta, 0.0, 0.0
        z, theta = self.z.copy(), self.theta.copy()
        z[self.positions] = z_free
        program = self.problem.program
        log_jacobian = float(program.entry("constrain")(theta, z, self.free))
        log_prior = float(program.entry("log_prior")(theta))
        if not np.isfinite(theta).all() or not log_prior < np.inf:
            log_prior = -np.inf
        return theta, log_prior, log_jacobian


def space_of(problem: Problem, fixed: dict[str, np.ndarray], start: dict[str, np.ndarray]) -> Space:
    """The unconstrained space, at moderate values of the parameters where `start` gives none."""
    trace = problem.trace
    values = ordinary_values(trace, fixed, start)
    theta = np.array([values[s.data[1]][s.data[2]] for s in trace.parameter_symbols])
    z = unconstrain(trace, theta, values)
    free = np.array([name not in fixed for name in trace.parameters], dtype=bool)
    sizes = [len(t.free) for t in transforms(trace)]
    positions = np.flatnonzero(np.repeat(free, sizes))
    return Space(problem, theta, z, free, positions)


def at(space: Space, theta: np.ndarray) -> Space:
    """The same space with other values of the parameters to stand on."""
    values = unpack_parameters(space.problem.trace, theta)
    return replace(space, theta=theta, z=unconstrain(space.problem.trace, theta, values))


def free_components(trace: Trace, fixed: dict[str, np.ndarray]) -> np.ndarray:
    """(P,) which components of theta belong to parameters that are not fixed."""
    return np.array([s.data[1] not in fixed for s in trace.parameter_symbols], dtype=bool)
