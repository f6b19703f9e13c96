"""Independent tasks over any `concurrent.futures.Executor`, and Ctrl-C obeyed where it suits a
loop.
"""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    Executor,
    Future,
    ThreadPoolExecutor,
    wait,
)
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
AHEAD = 3  # submissions under way for each worker of another process
TOGETHER_SECONDS = 0.3  # of tasks that are sent to another process together


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


class Several:
    """A task for several arguments in a row: its results, and the seconds that they took."""

    def __init__(self, task: Callable[[Any], Any]):
        self.task = task

    def __call__(self, arguments: Sequence[Any]) -> tuple[list[Any], float]:
        began = time.perf_counter()
        return [self.task(argument) for argument in arguments], time.perf_counter() - began


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

    The first error is raised as it is, with a note saying which task; the others are given up. To
    other processes tasks that take milliseconds are sent several at a time, as the way there takes
    as long as they do.

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
        sent, workers = Sent(Several(task)), workers_of(pool)
        left, results = dict[Future[Any], Sequence[int]](), dict[int, Any]()
        first = workers or len(arguments)  # so many are sent whole
        apart = bool(workers) and executor is pool and not isinstance(pool, ThreadPoolExecutor)
        together, most = 1, AHEAD * first if apart else len(arguments)

        def send(numbers: Sequence[int], whole: bool) -> None:
            own = [arguments[i] for i in numbers]
            left[pool.submit(sent.task(whole=whole), own)] = numbers

        todo = 0
        try:
            while todo < len(arguments) or left:
                while todo < len(arguments) and len(left) < most:
                    size = max(1, min(together, (len(arguments) - todo) // most))
                    send(range(todo, todo + size), todo < first)
                    todo += size
                done, _ = wait(left, POLL_SECONDS, FIRST_COMPLETED)
                if stop.is_set():
                    raise KeyboardInterrupt
                for future in done:
                    numbers = left.pop(future)
                    if (error := error_of(future)) is not None:
                        lost = lost_worker(error)
                        if lost is None and len(numbers) > 1:  # alone, to know which it was
                            for number in numbers:
                                send([number], False)
                            continue
                        error = lost or error
                        error.add_note(f"in task {numbers[0] + 1} of {len(arguments)}")
                        raise error
                    if isinstance(result := future.result(), Absent):
                        send(numbers, True)
                        continue
                    values, seconds = result
                    if apart:
                        together = int(TOGETHER_SECONDS * len(numbers) / max(seconds, 1e-9))
                    for number, value in zip(numbers, values, strict=True):
                        results[number] = value
                        take(number, value)
                    bar.advance(len(numbers))
        except BrokenExecutor as error:  # of a call that found its pool broken
            raise lost_worker(error) or error from error
        finally:
            give_up(left)
            for future, numbers in left.items():  # what came to an end meanwhile
                if future.cancelled() or future.exception() is not None:
                    continue
                if not isinstance(result := future.result(), Absent):
                    for number, value in zip(numbers, result[0], strict=True):
                        take(number, value)
        return [results[number] for number in range(len(arguments))]
