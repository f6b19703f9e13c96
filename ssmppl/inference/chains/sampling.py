"""What `sample` hands to a method, and what a method made ready hands back.

The module of each method has a function `prepare(setup, method) -> Sampler`, and `sample` runs the
chains of whatever it gets.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

import numpy as np

from ssmppl.data import unpack_parameters
from ssmppl.inference.preparation.space import Space
from ssmppl.inference.run.draws import Block, Keep
from ssmppl.inference.run.problem import Problem
from ssmppl.inference.run.seeds import random_state

Result = TypeVar("Result")


class Memory(Keep, Protocol):
    """Outlives the process: `ChainFile`."""

    def once(self, name: str, make: Callable[[], Any]) -> Any:
        """What `make` gives, or gave in an earlier process."""


@dataclass(frozen=True)
class Setup:
    """A call of `sample`, checked.

    space : the free parameters, at the values near which to begin. held : the fixed ones.
    chains, warmup, thin, states : as in `sample`. root : of all random numbers of the call.
    memory : what was found before the chains began, by name, and goes on being known.
    """

    problem: Problem
    space: Space
    held: dict[str, np.ndarray]
    chains: int
    warmup: int
    thin: int
    root: np.random.SeedSequence
    states: bool = True
    memory: Memory | None = None

    def once(self, name: str, make: Callable[[], Result]) -> Result:
        """What `make` gives, or gave in the call that this one continues: for what takes long, and
        for what the kernel of the chains depends on."""
        return make() if self.memory is None else self.memory.once(name, make)

    def streams(self, chain: int) -> tuple[np.random.Generator, np.ndarray]:
        """The random numbers of a chain: for the parameters, and for the kernels."""
        from_root = [*self.root.spawn_key, 1, chain]
        seed = np.random.SeedSequence(self.root.entropy, spawn_key=from_root)
        own, kernels = seed.spawn(2)
        return np.random.default_rng(own), random_state(kernels)

    def by_name(self, theta: np.ndarray) -> dict[str, Any]:
        """Parameters by name, as what can be written into attributes."""
        named = unpack_parameters(self.problem.trace, theta)
        return {name: value.tolist() for name, value in named.items()}


@dataclass(frozen=True)
class Sampler:
    """A method made ready: how a block of draws is made, where chains start, what to report.

    step_block, states : as in `run_chains`. A block's draws hold theta (n, P), path_<i> (n, T, D)
    for each experiment (unless the call wants no states), and possibly increment_<i> (n, T).
    """

    step_block: Callable[[Any, int], tuple[Any, Block]]
    states: list[Any]
    report: dict[str, Any]
