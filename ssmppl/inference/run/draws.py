"""Draws as chains hand them over: block by block, how far each stands, all of them stacked."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from ssmppl.errors import ExecutorError

State = TypeVar("State")

Arrays = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class Block:
    """Consecutive draws of one chain.

    Parameters
    ----------
    draws : by variable, shape (n, ...).
    stats : by statistic, shape (n, ...); what goes to `sample_stats`.
    """

    draws: Arrays
    stats: Arrays

    @classmethod
    def of(cls, draws: Mapping[str, Sequence[Any]], stats: Mapping[str, Sequence[Any]]) -> Block:
        """A block of what was drawn one after the other."""
        return cls(*({name: np.array(v) for name, v in own.items()} for own in (draws, stats)))


@dataclass(frozen=True)
class ChainDraws(Generic[State]):
    """What one chain gave.

    Parameters
    ----------
    draws, stats : after warmup, first axis the draw.
    warmup_stats : the statistics during warmup; empty unless asked for.
    state : where the chain stands; running on from it continues the chain. After an interrupt
        that is possibly later than the last of `draws`.
    interrupted : whether the run was stopped before its end.
    lost : the error of the executor that stopped it, if one did.
    """

    draws: dict[str, np.ndarray]
    stats: dict[str, np.ndarray]
    warmup_stats: dict[str, np.ndarray]
    state: State
    interrupted: bool = False
    lost: ExecutorError | None = None

    def then(self, later: ChainDraws[State]) -> ChainDraws[State]:
        """These draws with the later ones of the same chain."""
        draws, stats = joined([self.draws, later.draws]), joined([self.stats, later.stats])
        return replace(later, draws=draws, stats=stats, warmup_stats=self.warmup_stats)

    def without_first(self, draws: int) -> ChainDraws[State]:
        """Its first draws count as warmup, the rest is thinned to as many. A chain of fewer than
        twice so many has no more than its last ones."""
        n = len(next(iter(self.draws.values())))
        left = max(n - draws, min(draws, n))
        own = slice(n - left, None, max(left // draws, 1))
        kept, stats = ({k: v[own][:draws] for k, v in d.items()} for d in (self.draws, self.stats))
        return replace(self, draws=kept, stats=stats)


@dataclass(frozen=True)
class Standing(Generic[State]):
    """How far a chain has come.

    Parameters
    ----------
    state : where it goes on from.
    done : draws made, those of the warmup included.
    blocks : what was drawn after warmup, in order.
    """

    state: State
    done: int = 0
    blocks: tuple[Block, ...] = ()


class Checkpoint(Protocol):
    """What a run goes on from after a kill: it outlives the process.

    report : of the chains, once they were made ready.
    """

    report: dict[str, Any] | None

    def once(self, name: str, make: Callable[[], Any]) -> Any:
        """What `make` gives, or gave in an earlier process."""

    def finished(self, draws: int) -> bool:
        """Whether every chain has so many draws, those of the warmup included."""

    def standings(self) -> Sequence[Standing[Any]] | None:
        """How far the chains have come in an earlier process; None: they have not begun."""

    def due(self, chains: Sequence[Standing[Any]]) -> bool:
        """Whether it is time to keep them again."""

    def keep(self, chains: Sequence[Standing[Any]], last: bool) -> Sequence[Standing[Any]]:
        """Keep them as they stand. Returns them with the draws that need to be in memory, after
        the last time with all."""


def stack(chains: Sequence[ChainDraws[Any]]) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Draws and statistics of all chains, shape (chain, draw, ...)."""
    first = chains[0]
    return (
        {name: np.stack([chain.draws[name] for chain in chains]) for name in first.draws},
        {name: np.stack([chain.stats[name] for chain in chains]) for name in first.stats},
    )


def joined(parts: Sequence[Arrays], length: int | None = None) -> dict[str, np.ndarray]:
    """Parts in one, one after the other; of `length` draws, where they are more."""
    if not parts:
        return {}
    if length is not None and len(next(iter(parts[0].values()))) >= length:
        return {name: values[:length] for name, values in parts[0].items()}  # not read from disk
    return {name: np.concatenate([part[name] for part in parts])[:length] for name in parts[0]}
