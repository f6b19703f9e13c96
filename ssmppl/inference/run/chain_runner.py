"""Chains in blocks, over any `concurrent.futures.Executor`.

A chain is a state and a function: `step_block(state, n) -> (state, block)` makes n draws from
where `state` stands, and returns them with the state to go on from. The state carries everything,
its random state too, so the draws depend neither on the executor nor on how they fall into blocks,
and a block can run in a thread, in another process or on another machine. The runner submits one
block of every chain at a time, sized to take a fraction of a second: progress is shown, and an
interrupt obeyed, at the borders of blocks.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Generic, TypeVar

import numpy as np

from ssmppl.errors import ExecutorError, warn
from ssmppl.inference.run.draws import Arrays, Block, ChainDraws, Checkpoint, Standing, joined
from ssmppl.inference.run.executors import (
    Absent,
    Sent,
    error_of,
    give_up,
    lost_worker,
    threads_unless,
)
from ssmppl.inference.run.progress import Progress
from ssmppl.inference.run.tasks import POLL_SECONDS, interrupt_flag

State = TypeVar("State")

# Seconds that a block should take, at least so many times what it costs to send it (up to a limit),
# and how fast its size may grow.
BLOCK_SECONDS = 0.3
LONGEST_SECONDS = 5.0
TIMES_SENDING = 20
GROWTH = 4


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
    checkpoint: Checkpoint | None = None,
) -> list[ChainDraws[State]]:
    """Run a chain from each of `states`: `warmup` draws that are dropped, then `draws` more.

    No block holds draws of both phases. A state that adapts during warmup has to count its draws
    itself.

    Ctrl-C stops all chains at the next border of blocks, and what was drawn is returned: the
    chains, cut to the length of the shortest, with `interrupted` set. Before every chain has a
    draw there is nothing to return, and KeyboardInterrupt is raised, as on a second Ctrl-C.
    Likewise where the executor fails, as a pool of processes does when one of them is killed: with
    the error as a warning, or raised where there is nothing to return.

    An error in a chain stops the others and is raised as it is, with a note saying which chain.

    Parameters
    ----------
    step_block
        Makes a block of just n draws; may not change the state that it is given. With executors
        over processes it is a function at the top of a module, or a `functools.partial` of one,
        and sent to each worker once.
    states
        Where the chains start, each with a random state of its own.
    executor
        Where blocks run; not shut down. None: as many threads as chains and cores allow.
    block
        Draws in a block; None adapts to a fraction of a second.
    describe
        From the statistics of the last block of each chain, a few words for the progress line.
    checkpoint
        Keeps the chains now and then, at Ctrl-C, at an error and at the end. Where it has them
        from an earlier call, they go on from there, and `states` are not used.
    """
    run = _RunningChains(step_block, list(states), draws, warmup, block, keep_warmup_stats)
    if checkpoint is not None:
        run.go_on(checkpoint.standings())
    total = len(run.chains) * (warmup + draws)
    before = sum(min(chain.done, warmup + draws) for chain in run.chains)

    def report(n: int) -> None:
        bar.advance(n, run.note(describe))
        if checkpoint is not None and checkpoint.due(run.standings()):
            run.go_on(checkpoint.keep(run.standings(), last=False))

    with (
        threads_unless(executor, len(run.chains)) as pool,
        Progress(total, title, shown=progress, before=before) as bar,
        interrupt_flag() as stop,
    ):
        try:
            run.to_the_end(pool, stop, report)
            run.drain()
        except Exception:
            run.drain()
            raise
        finally:
            if checkpoint is not None:
                run.go_on(checkpoint.keep(run.standings(), last=True))
    return run.result()


@dataclass(frozen=True)
class _Chain(Generic[State]):
    """How far a chain has come, and its block under way; replaced, never changed."""

    state: State
    done: int = 0
    size: int = 1
    blocks: tuple[Block, ...] = ()
    warmup_stats: tuple[Arrays, ...] = ()
    recent: Arrays = field(default_factory=dict)
    running: Future[tuple[State, Block, float] | Absent] | None = None
    asked: int = 0
    submitted: float = 0.0
    known: bool = False  # to the worker that had it last


class _RunningChains(Generic[State]):
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
        self.sent = Sent(partial(_timed, step_block))
        self.lost: ExecutorError | None = None
        self.sending = np.inf  # seconds that it takes to hand a block over and back, at least
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
                    if isinstance(error_of(future), KeyboardInterrupt):
                        stop.set()  # a worker process got the signal too, and first
                        break
                    number = running[future]
                    report(self._collect(number))
                    self._submit(pool, number)
        except Exception as error:
            give_up(self._running())
            if stop.is_set():  # it is the interrupt that broke a pool of processes
                return
            self.lost = lost_worker(error)
            if self.lost is None:
                raise

    def go_on(self, standings: Sequence[Standing[State]] | None) -> None:
        """Put the chains where they stood."""
        for i, s in enumerate(standings or ()):
            self.chains[i] = replace(self.chains[i], state=s.state, done=s.done, blocks=s.blocks)

    def standings(self) -> list[Standing[State]]:
        """How far each has come."""
        return [Standing(c.state, c.done, c.blocks) for c in self.chains]

    def drain(self) -> None:
        """After an interrupt: wait for the blocks that run, and keep those that came to an end."""
        running = self._running()
        give_up(running)
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
        kept = min(kept, self.draws)  # an earlier call may have drawn more
        interrupted = any(chain.done < self.warmup + self.draws for chain in self.chains)
        if interrupted and kept == 0:
            raise self.lost or KeyboardInterrupt("interrupted before every chain had a draw")
        if self.lost is not None:
            warn(f"{kept} of {self.draws} draws of each chain are returned: {self.lost}")
        return [
            ChainDraws(
                draws=joined([block.draws for block in chain.blocks], kept),
                stats=joined([block.stats for block in chain.blocks], kept),
                warmup_stats=joined(chain.warmup_stats),
                state=chain.state,
                interrupted=interrupted,
                lost=self.lost,
            )
            for chain in self.chains
        ]

    def _running(self) -> dict[Future[tuple[State, Block, float] | Absent], int]:
        """Blocks under way, and whose they are."""
        return {chain.running: i for i, chain in enumerate(self.chains) if chain.running}

    def _submit(self, pool: Executor, number: int) -> None:
        chain = self.chains[number]
        border = self.warmup if chain.done < self.warmup else self.warmup + self.draws
        n = min(chain.size, border - chain.done)
        if n > 0:
            future = pool.submit(self.sent.task(whole=not chain.known), chain.state, n)
            now = time.perf_counter()
            self.chains[number] = replace(chain, running=future, asked=n, submitted=now)

    def _collect(self, number: int) -> int:
        """Take the finished block of a chain into it; returns its number of draws."""
        chain = self.chains[number]
        assert chain.running is not None
        try:
            answer = chain.running.result()
        except Exception as error:
            error.add_note(
                f"in chain {number + 1} of {len(self.chains)}, after {chain.done} of "
                f"{self.warmup} + {self.draws} draws (warmup + kept)"
            )
            raise
        if isinstance(answer, Absent):  # a worker that is new to this chain
            self.chains[number] = replace(chain, running=None, known=False)
            return 0
        state, block, seconds = answer
        self.sending = min(self.sending, time.perf_counter() - chain.submitted - seconds)
        n, kept = chain.asked, chain.done >= self.warmup
        warmup_stats = chain.warmup_stats
        if self.keep_warmup_stats and not kept:
            warmup_stats = (*warmup_stats, block.stats)
        self.chains[number] = _Chain(
            state=state,
            done=chain.done + n,
            size=self.block or _fitting_size(n, seconds, self.sending),
            blocks=(*chain.blocks, block) if kept else (),
            warmup_stats=warmup_stats,
            recent=block.stats,
            known=True,
        )
        return n


def _timed(
    step_block: Callable[[State, int], tuple[State, Block]], state: State, n: int
) -> tuple[State, Block, float]:
    started = time.perf_counter()
    state, block = step_block(state, n)
    return state, block, time.perf_counter() - started


def _fitting_size(n: int, seconds: float, sending: float) -> int:
    """Draws that fill a block, when n took so many seconds (compilation, possibly, included)."""
    fill = max(BLOCK_SECONDS, min(TIMES_SENDING * sending, LONGEST_SECONDS))
    return max(1, min(round(fill * n / max(seconds, 1e-9)), GROWTH * n))
