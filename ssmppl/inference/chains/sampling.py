"""What `sample` hands to a method, and what a method tells `sample` of itself.

The module of each method has a `METHOD`, of the class `SamplingMethod`, which `verbs/sample.py`
registers under the class of its settings. Everything in which methods differ, for `sample`, its
checkpoints and `explain`, is in there.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import Any, Protocol, TypeVar

import numpy as np

from ssmppl.analysis.elimination.eliminable import Eliminable
from ssmppl.analysis.proposals.noises import Noises
from ssmppl.data import unpack_parameters
from ssmppl.errors import NotApplicable
from ssmppl.inference.preparation.space import Space
from ssmppl.inference.run.chain_runner import run_chains
from ssmppl.inference.run.draws import Block, ChainDraws, Checkpoint
from ssmppl.inference.run.problem import Problem
from ssmppl.inference.run.progress import announced
from ssmppl.inference.run.seeds import random_state
from ssmppl.language.model.trace import Trace

Result = TypeVar("Result")
DrawnChains = Sequence[ChainDraws[Any]]
Drawn = tuple[list[ChainDraws[Any]], dict[str, Any]]  # the chains, and what to report of them
PlanRows = list[tuple[str, str]]

# Times the draws that were asked for, to which chains go on that have not converged: one more for
# a longer warmup, which the first ones then are, and the others for larger effective sample sizes.
GO_ON = (2, 3, 5, 9)

# Titles of what `explain` says of the methods.
TRAJECTORIES = "Trajectories"
INTERWEAVED = "Joint parameter-trajectory moves (ASIS interweaving)"
ELIMINATED = "Parameters that PGAS can marginalise (`eliminate=`)"


@dataclass(frozen=True)
class SamplingSetup:
    """A call of `sample`, checked.

    space : the free parameters, at the values near which to begin. fixed : values of the others.
    chains, warmup, thin, states : as in `sample`. root : of all random numbers of the call.
    checkpoint : keeps the chains, and by name what was found before they began.
    """

    problem: Problem
    space: Space
    fixed: dict[str, np.ndarray]
    chains: int
    warmup: int
    thin: int
    root: np.random.SeedSequence
    states: bool = True
    checkpoint: Checkpoint | None = None

    def once(self, name: str, make: Callable[[], Result]) -> Result:
        """What `make` gives, or gave in the call that this one continues: for what takes long, and
        for what the kernel of the chains depends on."""
        return make() if self.checkpoint is None else self.checkpoint.once(name, make)

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
class PreparedChains:
    """Markov chains made ready: how a block of draws is made, where chains start, what to report.

    step_block, states : as in `run_chains`. A block's draws hold theta (n, P), path_<i> (n, T, D)
    for each experiment (unless the call wants no states), and possibly increment_<i> (n, T).
    """

    step_block: Callable[[Any, int], tuple[Any, Block]]
    states: list[Any]
    report: dict[str, Any]


class Derived(Protocol):
    """What `explain` has derived of a model: its `Plan`."""

    @property
    def trace(self) -> Trace: ...
    @property
    def noises(self) -> Noises | NotApplicable: ...
    @property
    def deterministic_memory(self) -> int | None: ...
    @property
    def eliminable(self) -> Eliminable: ...


@dataclass(frozen=True)
class SamplingMethod:
    """What `sample` and `explain` know of a method, whose settings are of the class it is
    registered under.

    prepare : (setup, settings) -> its Markov chains, made ready; None where draws come otherwise.
    independent : (setup, settings, draws, executor, progress) -> such draws, as chains, and what to
    report. trajectories : whether they begin with a warmup, are thinned and hold the states, too.
    state_classes : the dataclasses that its checkpoints are made of.
    complete : (settings, draws) -> settings, with what depends on the number of draws.
    by_row : settings -> whether draws come with a log-likelihood of each row.
    attributes : (problem, chains) -> what else goes to the attributes of the result.
    explain : plan -> the rows that `explain` shows, by title.
    """

    prepare: Callable[[SamplingSetup, Any], PreparedChains] | None
    independent: Callable[..., Drawn] | None = None
    state_classes: tuple[type, ...] = ()
    complete: Callable[[Any, int], Any] = lambda settings, draws: settings
    by_row: Callable[[Any], bool] = lambda settings: False
    attributes: Callable[[Problem, DrawnChains], dict[str, Any]] = lambda problem, chains: {}
    explain: Callable[[Derived], Mapping[str, PlanRows]] = lambda plan: {}
    trajectories: bool = False

    @property
    def markov(self) -> bool:
        """Whether its draws stem from Markov chains, which need warmup, and hold the states too."""
        return self.prepare is not None or self.trajectories

    def draw(
        self, setup: SamplingSetup, settings: Any, draws: int, executor: Executor | None,
        progress: bool, converged: Callable[[DrawnChains], bool] | None = None,
        go_on: Sequence[int] = GO_ON,
    ) -> Drawn:  # fmt: skip
        """The chains, and what to report of them.

        converged : whether they have; where they have not they go on, to so many times the draws,
        of which the first ones then count as warmup. None: they are left as they are.
        """
        if self.prepare is None:
            assert self.independent is not None
            return self.independent(setup, settings, draws, executor, progress)
        title, checkpoint = type(settings).__name__, setup.checkpoint
        chains: PreparedChains | None = None
        result: list[ChainDraws[Any]] = []
        for times in (1, *go_on):
            kept = [_as_asked(c, draws) for c in result]
            if kept and (converged is None or kept[0].interrupted or converged(kept)):
                break
            done = len(result[0].draws["theta"]) if result else 0
            if chains is None and not _on_file(checkpoint, setup.warmup + times * draws):
                with announced(title, "preparing", shown=progress):
                    chains = self.prepare(setup, settings)
                if checkpoint is not None:
                    checkpoint.report = chains.report
            made = chains
            if made is None:  # nothing is left to draw, and nothing needs to be compiled for it
                assert checkpoint is not None
                assert checkpoint.report is not None
                made = PreparedChains(_finished, [None] * setup.chains, checkpoint.report)
            if checkpoint is None and result:
                try:
                    more = run_chains(
                        made.step_block, [c.state for c in result], times * draws - done, 0,
                        executor=executor, progress=progress, title=f"{title}, on",
                    )  # fmt: skip
                except KeyboardInterrupt:  # there are the draws of before
                    result = [replace(c, interrupted=True) for c in result]
                    break
                result = [a.then(b) for a, b in zip(result, more, strict=True)]
            else:
                result = run_chains(
                    made.step_block, made.states, times * draws, setup.warmup, executor=executor,
                    progress=progress, title=title, checkpoint=checkpoint,
                )  # fmt: skip
            report = made.report
        total = len(result[0].draws["theta"])
        if total > draws:
            report = {**report, "further_draws": total - draws}
        return [_as_asked(c, draws) for c in result], report


def _as_asked(chain: ChainDraws[Any], draws: int) -> ChainDraws[Any]:
    """A chain that may have gone on, with as many draws as were asked for."""
    more = len(chain.draws["theta"]) > draws
    return chain.without_first(draws) if more else chain


def _on_file(checkpoint: Checkpoint | None, draws: int) -> bool:
    """Whether a checkpoint has all that is asked for, so that no chain is needed."""
    if checkpoint is None or checkpoint.report is None:
        return False
    return checkpoint.finished(draws)


def _finished(state: Any, n: int) -> tuple[Any, Block]:
    raise AssertionError("a finished chain draws no more")


def reason_and_line(found: NotApplicable) -> str:
    """Why something does not apply, and the user's line, as `explain` shows it."""
    return found.reason + (f"\n{found.where.short}" if found.where else "")
