"""Chains in blocks, over any `concurrent.futures.Executor`.

A chain is a state and a function: `step_block(state, n) -> (state, block)` makes n draws from
where `state` stands, and returns them with the state to go on from. The state carries everything,
its random state too, so the draws depend neither on the executor nor on how they fall into blocks,
and a block can run in a thread, in another process or on another machine. The runner submits one
block of every chain at a time, sized to take a fraction of a second: progress is shown, and an
interrupt obeyed, at the borders of blocks.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from types import FrameType
from typing import Any, Generic, TypeVar

import numpy as np

from ssmppl.inference.progress import Progress

__all__ = ["Block", "ChainDraws", "run_chains", "run_tasks", "stack"]

State = TypeVar("State")
Argument = TypeVar("Argument")
Result = TypeVar("Result")

Arrays = Mapping[str, np.ndarray]

# Seconds that a block should take, how fast its size may grow, and seconds between looks at Ctrl-C.
BLOCK_SECONDS = 0.3
GROWTH = 4
POLL_SECONDS = 0.1


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
    """

    draws: dict[str, np.ndarray]
    stats: dict[str, np.ndarray]
    warmup_stats: dict[str, np.ndarray]
    state: State
    interrupted: bool = False


Describe = Callable[[Sequence[Arrays]], str]


def describe_acceptance(recent: Sequence[Arrays]) -> str:
    """Mean of the statistic `acceptance_rate` over the last blocks of all chains."""
    rates = [stats["acceptance_rate"] for stats in recent if "acceptance_rate" in stats]
    return f"acceptance {np.mean(np.concatenate(rates)):.2f}" if rates else ""


def run_chains(
    step_block: Callable[[State, int], tuple[State, Block]],
    states: Sequence[State],
    draws: int,
    warmup: int = 0,
    *,
    executor: Executor | None = None,
    progress: bool = True,
    block: int | None = None,
    keep_warmup_stats: bool = False,
    describe: Describe = describe_acceptance,
    title: str = "sampling",
) -> list[ChainDraws[State]]:
    """Run a chain from each of `states`: `warmup` draws that are dropped, then `draws` more.

    No block holds draws of both phases. A state that adapts during warmup has to count its draws
    itself.

    Ctrl-C stops all chains at the next border of blocks, and what was drawn is returned: the
    chains, cut to the length of the shortest, with `interrupted` set. Before every chain has a
    draw there is nothing to return, and KeyboardInterrupt is raised, as on a second Ctrl-C.

    An error in a chain stops the others and is raised as it is, with a note saying which chain.

    Parameters
    ----------
    step_block
        Makes a block of just n draws; may not change the state that it is given. With executors
        over processes it is a function at the top of a module, or a `functools.partial` of one.
    states
        Where the chains start, each with a random state of its own.
    executor
        Where blocks run; not shut down. None: as many threads as chains and cores allow.
    block
        Draws in a block; None adapts to a fraction of a second.
    describe
        From the statistics of the last block of each chain, a few words for the progress line.
    """
    run = _Run(step_block, list(states), draws, warmup, block, keep_warmup_stats)
    total = len(run.chains) * (warmup + draws)
    with (
        _threads_unless(executor, len(run.chains)) as pool,
        Progress(total, title, shown=progress) as bar,
        _interrupt_flag() as stop,
    ):
        run.to_the_end(pool, stop, lambda n: bar.advance(n, run.note(describe)))
        run.drain()
    return run.result()


def run_tasks(
    task: Callable[[Argument], Result],
    arguments: Sequence[Argument],
    *,
    executor: Executor | None = None,
    progress: bool = False,
    title: str = "running",
) -> list[Result]:
    """`task(argument)` for each of `arguments`, in their order, over an executor.

    The first error is raised as it is, with a note saying which task; the others are given up.
    """
    with (
        _threads_unless(executor, len(arguments)) as pool,
        Progress(len(arguments), title, shown=progress) as bar,
        _interrupt_flag() as stop,
    ):
        futures = [pool.submit(task, argument) for argument in arguments]
        numbers = {future: i for i, future in enumerate(futures)}
        waiting = set(futures)
        try:
            while waiting:
                done, waiting = wait(waiting, POLL_SECONDS, FIRST_COMPLETED)
                if stop.is_set():
                    raise KeyboardInterrupt
                for future in done:
                    if (error := future.exception()) is not None:
                        error.add_note(f"in task {numbers[future] + 1} of {len(futures)}")
                        raise error
                bar.advance(len(done))
        finally:
            _give_up(waiting)
        return [future.result() for future in futures]


def stack(chains: Sequence[ChainDraws[Any]]) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Draws and statistics of all chains, shape (chain, draw, ...)."""
    first = chains[0]
    return (
        {name: np.stack([chain.draws[name] for chain in chains]) for name in first.draws},
        {name: np.stack([chain.stats[name] for chain in chains]) for name in first.stats},
    )


@dataclass(frozen=True)
class _Chain(Generic[State]):
    """How far a chain has come, and its block under way; replaced, never changed."""

    state: State
    done: int = 0
    size: int = 1
    blocks: tuple[Block, ...] = ()
    warmup_stats: tuple[Arrays, ...] = ()
    recent: Arrays = field(default_factory=dict)
    running: Future[tuple[State, Block, float]] | None = None
    asked: int = 0


class _Run(Generic[State]):
    """The loop of `run_chains`: what is running, and what came back."""

    def __init__(
        self,
        step_block: Callable[[State, int], tuple[State, Block]],
        states: list[State],
        draws: int,
        warmup: int,
        block: int | None,
        keep_warmup_stats: bool,
    ):
        self.step_block = step_block
        self.chains: list[_Chain[State]] = [_Chain(state, size=block or 1) for state in states]
        self.draws, self.warmup, self.block = draws, warmup, block
        self.keep_warmup_stats = keep_warmup_stats

    def to_the_end(
        self, pool: Executor, stop: threading.Event, report: Callable[[int], None]
    ) -> None:
        """Submit, collect, submit the next, until all is drawn or `stop` is set."""
        try:
            for number in range(len(self.chains)):
                self._submit(pool, number)
            while (running := self._running()) and not stop.is_set():
                done, _ = wait(running, POLL_SECONDS, FIRST_COMPLETED)
                for future in done:
                    if isinstance(future.exception(), KeyboardInterrupt):
                        stop.set()  # a worker process got the signal too, and first
                        break
                    number = running[future]
                    report(self._collect(number))
                    self._submit(pool, number)
        except Exception:
            _give_up(self._running())
            if not stop.is_set():  # else it is the interrupt that broke a pool of processes
                raise

    def drain(self) -> None:
        """After an interrupt: wait for the blocks that run, and keep those that came to an end."""
        running = self._running()
        _give_up(running)
        for future, number in running.items():
            # A signal reaches the workers of a process pool too: their blocks are lost, no more.
            if not future.cancelled() and future.exception() is None:
                self._collect(number)

    def note(self, describe: Describe) -> str:
        """Phase, and what `describe` says of the last blocks."""
        phase = "warmup" if any(chain.done < self.warmup for chain in self.chains) else ""
        words = describe([chain.recent for chain in self.chains if chain.recent])
        return ", ".join(part for part in (phase, words) if part)

    def result(self) -> list[ChainDraws[State]]:
        """The draws of all chains, of equal length."""
        kept = min((max(chain.done - self.warmup, 0) for chain in self.chains), default=0)
        interrupted = any(chain.done < self.warmup + self.draws for chain in self.chains)
        if interrupted and kept == 0:
            raise KeyboardInterrupt("interrupted before every chain had a draw")
        return [
            ChainDraws(
                draws=_join([block.draws for block in chain.blocks], kept),
                stats=_join([block.stats for block in chain.blocks], kept),
                warmup_stats=_join(chain.warmup_stats),
                state=chain.state,
                interrupted=interrupted,
            )
            for chain in self.chains
        ]

    def _running(self) -> dict[Future[tuple[State, Block, float]], int]:
        """Blocks under way, and whose they are."""
        return {chain.running: i for i, chain in enumerate(self.chains) if chain.running}

    def _submit(self, pool: Executor, number: int) -> None:
        chain = self.chains[number]
        border = self.warmup if chain.done < self.warmup else self.warmup + self.draws
        n = min(chain.size, border - chain.done)
        if n > 0:
            future = pool.submit(_timed, self.step_block, chain.state, n)
            self.chains[number] = replace(chain, running=future, asked=n)

    def _collect(self, number: int) -> int:
        """Take the finished block of a chain into it; returns its number of draws."""
        chain = self.chains[number]
        assert chain.running is not None
        try:
            state, block, seconds = chain.running.result()
        except Exception as error:
            error.add_note(
                f"in chain {number + 1} of {len(self.chains)}, after {chain.done} of "
                f"{self.warmup} + {self.draws} draws (warmup + kept)"
            )
            raise
        n, kept = chain.asked, chain.done >= self.warmup
        warmup_stats = chain.warmup_stats
        if self.keep_warmup_stats and not kept:
            warmup_stats = (*warmup_stats, block.stats)
        self.chains[number] = _Chain(
            state=state,
            done=chain.done + n,
            size=self.block or _fitting_size(n, seconds),
            blocks=(*chain.blocks, block) if kept else (),
            warmup_stats=warmup_stats,
            recent=block.stats,
        )
        return n


def _timed(
    step_block: Callable[[State, int], tuple[State, Block]], state: State, n: int
) -> tuple[State, Block, float]:
    started = time.perf_counter()
    state, block = step_block(state, n)
    return state, block, time.perf_counter() - started


def _fitting_size(n: int, seconds: float) -> int:
    """Draws that fill a block, when n took so many seconds (compilation, possibly, included)."""
    return max(1, min(round(BLOCK_SECONDS * n / max(seconds, 1e-9)), GROWTH * n))


def _join(parts: Sequence[Arrays], length: int | None = None) -> dict[str, np.ndarray]:
    if not parts:
        return {}
    return {name: np.concatenate([part[name] for part in parts])[:length] for name in parts[0]}


def _give_up(futures: Collection[Future[Any]]) -> None:
    """Cancel what has not begun, and wait for what has."""
    for future in futures:
        future.cancel()
    wait(futures)


@contextmanager
def _threads_unless(executor: Executor | None, tasks: int) -> Iterator[Executor]:
    if executor is not None:
        yield executor
        return
    with ThreadPoolExecutor(max_workers=max(1, min(tasks, _cpu_count()))) as threads:
        yield threads


def _cpu_count() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextmanager
def _interrupt_flag() -> Iterator[threading.Event]:
    """An event that Ctrl-C sets, in place of an exception at an arbitrary line.

    Inside of `concurrent.futures` such an exception can leave a lock taken for good. A second
    Ctrl-C does what the first would have done. Signals belong to the main thread: in others, and
    where somebody has turned them off, the event is never set.
    """
    stop = threading.Event()
    earlier = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(earlier):
        yield stop
        return

    def handle(number: int, frame: FrameType | None) -> None:
        if stop.is_set():
            earlier(number, frame)
        stop.set()

    signal.signal(signal.SIGINT, handle)
    try:
        yield stop
    finally:
        signal.signal(signal.SIGINT, earlier)
