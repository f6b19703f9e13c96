"""Independent tasks over any `concurrent.futures.Executor`, and Ctrl-C obeyed where it suits a
loop.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, wait
from contextlib import contextmanager
from types import FrameType
from typing import Any, TypeVar

from ssmppl.inference.run.executors import (
    Absent,
    Sent,
    error_of,
    give_up,
    lost_worker,
    threads_unless,
    workers_of,
)
from ssmppl.inference.run.progress import Progress

Argument = TypeVar("Argument")
Result = TypeVar("Result")
POLL_SECONDS = 0.1  # between looks at Ctrl-C


@contextmanager
def interrupt_flag() -> Iterator[threading.Event]:
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


def run_tasks(
    task: Callable[[Argument], Result],
    arguments: Sequence[Argument],
    *,
    executor: Executor | None = None,
    progress: bool = False,
    title: str = "running",
    take: Callable[[int, Result], None] = lambda number, result: None,
) -> list[Result]:
    """`task(argument)` for each of `arguments`, in their order, over an executor.

    The first error is raised as it is, with a note saying which task; the others are given up.
    take : gets the number and the result of each task as soon as it is done, in this process.

    Raises
    ------
    ExecutorError : the executor failed, not a task.
    """
    with (
        threads_unless(executor, len(arguments)) as pool,
        Progress(len(arguments), title, shown=progress) as bar,
        interrupt_flag() as stop,
    ):
        sent, workers = Sent(task), workers_of(pool) or len(arguments)
        left, waiting, results = dict[Future[Any], int](), set[Future[Any]](), dict[int, Any]()
        try:
            for i, argument in enumerate(arguments):
                left[pool.submit(sent.task(whole=i < workers), argument)] = i
            waiting = set(left)
            while waiting:
                done, waiting = wait(waiting, POLL_SECONDS, FIRST_COMPLETED)
                if stop.is_set():
                    raise KeyboardInterrupt
                for future in done:
                    number = left.pop(future)
                    if (error := error_of(future)) is not None:
                        error = lost_worker(error) or error
                        error.add_note(f"in task {number + 1} of {len(arguments)}")
                        raise error
                    if isinstance(result := future.result(), Absent):
                        again = pool.submit(sent.task(), arguments[number])
                        left[again] = number
                        waiting.add(again)
                        continue
                    results[number] = result
                    take(number, result)
                    bar.advance(1)
        except BrokenExecutor as error:  # of a call that found its pool broken
            raise lost_worker(error) or error from error
        finally:
            give_up(left)
            for future, number in left.items():  # what came to an end meanwhile
                if future.cancelled() or future.exception() is not None:
                    continue
                if not isinstance(result := future.result(), Absent):
                    take(number, result)
        return [results[number] for number in range(len(arguments))]
