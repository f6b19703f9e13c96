"""Swarms of iterated filtering: how a pass over the data moves them; see iterated_filtering.py."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ssmppl.analysis.perturbed import Perturbed, perturbed
from ssmppl.codegen.iterated import compile_iterated_filter
from ssmppl.codegen.kernels.weights import OK
from ssmppl.compiling import once_property
from ssmppl.inference.draws import Block
from ssmppl.inference.particles.filtering import failure
from ssmppl.inference.particles.pilot import Space
from ssmppl.inference.problem import Problem
from ssmppl.inference.totals import total_of


@dataclass(frozen=True)
class Swarms:
    """What all swarms of a call share; other processes generate the filter again.

    perturbation : (F,) standard deviation of the first step. moving : (F,) see `Perturbed`.
    cooling : factor of the standard deviation over 50 passes.
    """

    space: Space
    with_prior: bool
    perturbation: np.ndarray
    moving: np.ndarray
    cooling: float

    @property
    def problem(self) -> Problem:
        return self.space.problem

    @once_property
    def run(self) -> Callable[..., Any]:
        return compile_iterated_filter(perturbed_model(self.space, self.with_prior))

    def __getstate__(self) -> dict:
        return {k: v for k, v in self.__dict__.items() if k != "run"}

    def steps(self, iteration: int) -> list[np.ndarray]:
        """Standard deviations of the steps in a pass (from 1), (T, F) for each experiment."""
        rows = [e.steps for e in self.problem.experiments]
        part = iteration - 1.0 + np.arange(sum(rows)) / sum(rows)
        scale = (self.cooling ** (part / 50.0))[:, None] * self.perturbation
        out = np.split(scale, np.cumsum(rows)[:-1])
        for own in out:
            own[1:, ~self.moving] = 0.0
        return out

    def one_pass(
        self, swarm: np.ndarray, iteration: int, stream: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Move the swarm (F, N) over all experiments; (iterate (F,), log_increment of all rows).

        Raises
        ------
        SamplingError : a weight is infinite.
        """
        every, sums = [], np.zeros(len(swarm))
        for k, (e, steps) in enumerate(
            zip(self.problem.experiments, self.steps(iteration), strict=True)
        ):
            parts = [e.u, steps]
            if self.with_prior:
                counts = np.zeros((e.steps, 1))
                counts[0] = k == 0
                parts.append(counts)
            increment, means = np.empty(e.steps), np.empty(steps.shape)
            status, t = self.run(
                self.space.theta, e.y, e.seen, np.hstack(parts), stream, swarm, increment, means
            )
            if status != OK:
                theta, _ = self.space.parameters(swarm.mean(axis=1))
                raise failure(self.problem, theta, status, t, e)
            every.append(increment)
            sums += means.sum(axis=0)
        log_increment = np.concatenate(every)
        mean = np.where(self.moving, sums / len(log_increment), swarm.mean(axis=1))
        return mean, log_increment


@dataclass(frozen=True)
class State:
    """Where a swarm stands: (F, N), the kernels' random state, passes made."""

    swarm: np.ndarray
    stream: np.ndarray
    done: int


def swarm_block(swarms: Swarms, state: State, n: int) -> tuple[State, Block]:
    """n passes of one swarm."""
    swarm, stream = state.swarm.copy(), state.stream.copy()
    z, totals, impossible = [], [], []
    for k in range(state.done + 1, state.done + n + 1):
        mean, log_increment = swarms.one_pass(swarm, k, stream)
        z.append(mean)
        totals.append(total_of(log_increment))
        impossible.append(np.sum(log_increment == -np.inf))
    stats = {"perturbed_log_likelihood": np.array(totals), "impossible": np.array(impossible)}
    return State(swarm, stream, state.done + n), Block({"z": np.array(z)}, stats)


def perturbed_model(space: Space, with_prior: bool) -> Perturbed:
    """The perturbed form of a problem's model."""
    problem = space.problem
    return perturbed(problem.trace, problem.program.missing, space.free.tolist(), with_prior)
