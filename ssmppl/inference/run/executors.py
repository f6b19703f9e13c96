"""What any `concurrent.futures.Executor` needs of us: threads, processes, loky, Dask.

A task is a function, which holds the model and the data and is the same for many tasks, and a few
arguments. Threads call the function as it is. On its way to another process it is packed once, and
each process unpacks it once, under a digest: there the model's code is generated, and found in that
machine's cache or compiled. A task may also be sent by the digest alone; a process that does not
know it says so (`Absent`), and gets the whole.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import uuid
from collections.abc import Callable, Collection, Iterator
from concurrent.futures import (
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    wait,
)
from contextlib import contextmanager, suppress
from typing import Any

from ssmppl.errors import ArgumentError, ExecutorError
from ssmppl.language.model.pickling import UnpackedCache, digest_of, packed, unpacked

MOST = 8  # functions that a worker keeps; each may hold the data
_functions: UnpackedCache[Callable[..., Any]] = UnpackedCache(MOST)
_here = threading.local()


def check_executor(executor: Any) -> None:
    """Refuse what is no executor, before anything is done.

    Raises
    ------
    ArgumentError : naming what was given.
    """
    if executor is None or isinstance(executor, Executor):
        return
    of_dask = callable(getattr(executor, "get_executor", None))
    raise ArgumentError(
        f"executor={executor!r} is no concurrent.futures.Executor",
        fix="give client.get_executor()" if of_dask
        else "give one, as concurrent.futures.ThreadPoolExecutor(4), or None for threads",
    )  # fmt: skip


class Absent:
    """What a worker answers that does not know a function's digest."""


class Sent:
    """A function that is sent to other processes once."""

    def __init__(self, function: Callable[..., Any]):
        self.function = function
        self._content: tuple[bytes, bytes] | None = None
        self._lock = threading.Lock()

    def task(self, *, whole: bool = True) -> Task:
        """The function as it is submitted; not `whole`: by its digest, should it be pickled."""
        return Task(self, whole)

    def content(self) -> tuple[bytes, bytes]:
        """Digest, and the function packed.

        Raises
        ------
        ArgumentError : it holds something that cannot be sent.
        """
        with self._lock:
            if self._content is None:
                try:
                    content = packed(self.function)
                except Exception as error:
                    raise ArgumentError(
                        f"the task cannot be sent to another process: {_error_text(error)}",
                        fix="install cloudpickle, or define what is named here at the top of a "
                        "module that the workers can import, or use threads (executor=None)",
                    ) from error
                self._content = digest_of(content), content
            return self._content


class Task:
    """One submission of a `Sent` function."""

    def __init__(self, sent: Sent, whole: bool):
        self.sent, self.whole = sent, whole

    def __call__(self, *args: Any) -> Any:
        return self.sent.function(*args)

    def __reduce__(self) -> tuple[Any, ...]:
        digest, content = self.sent.content()
        return _Received, (digest, content if self.whole else None)

    def __dask_tokenize__(self) -> str:
        """Dask gives one result to tasks of one name, and cancels them together: a call after an
        interrupted one is not to meet what is left of it."""
        return uuid.uuid4().hex


class _Received:
    """A `Task` in another process; unpacked when it is called, so that errors come back."""

    def __init__(self, digest: bytes, content: bytes | None):
        self.digest, self.content = digest, content

    def __call__(self, *args: Any) -> Any:
        content = self.content
        function = _functions.get(
            self.digest, None if content is None else lambda: _opened(content)
        )
        if function is None:
            return Absent()
        before, _here.one_core = getattr(_here, "one_core", False), True
        try:
            return function(*args)
        finally:
            _here.one_core = before


def _opened(content: bytes) -> Callable[..., Any]:
    try:
        function: Callable[..., Any] = unpacked(content)
    except Exception as error:
        raise ExecutorError(
            f"a worker cannot restore the task: {_error_text(error)}",
            fix="workers need the same versions of Python, NumPy, Numba and ssmppl, and must find "
            "the modules that hold the model's @ssm.primitive and @ssm.effect functions "
            "(PYTHONPATH of the workers; with Dask also client.upload_file)",
        ) from error
    return function


def _error_text(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}" if str(error) else type(error).__name__


def lost_worker(error: BaseException) -> ExecutorError | None:
    """The error of a user whose executor failed, not the task; None for errors of tasks.

    A pool of processes is of no use once a process of it has died. Dask runs the tasks of a dead
    worker elsewhere, and gives up on a task whose workers died four times (`KilledWorker`, Dask's
    setting distributed.scheduler.allowed-failures).
    """
    of_dask = type(error).__module__.partition(".")[0] == "distributed"
    if isinstance(error, BrokenExecutor):
        found, fix = "a worker process died, and its pool with it", (
            "make a new executor and call again; where memory ran out, use fewer workers, or "
            "threads (executor=None), which share the data"
        )  # fmt: skip
    elif isinstance(error, CancelledError):
        found, fix = "the executor cancelled a task", (
            "keep the executor, its client and its scheduler open until the call returns"
        )  # fmt: skip
    elif of_dask:
        found, fix = "Dask gave up on a task", (
            "look into the logs of the workers; where memory ran out, give each worker more, or "
            "run fewer on a machine"
        )  # fmt: skip
    else:
        return None
    return ExecutorError(f"{found}: {_error_text(error)}", fix=fix)


def error_of(future: Future[Any]) -> BaseException | None:
    """The error of a future that is done; one may be cancelled by its executor, too."""
    return CancelledError() if future.cancelled() else future.exception()


def give_up(futures: Collection[Future[Any]]) -> None:
    """Cancel what can be cancelled, and wait for the rest.

    Not for what was cancelled: Dask's futures can be in the middle of being computed, and nothing
    tells of their end.
    """
    wait([future for future in futures if not future.cancel()])


def workers_of(executor: Executor | None) -> int | None:
    """How many tasks an executor runs at a time, where it can be known."""
    if (known := getattr(executor, "_max_workers", None)) is not None:
        return int(known)
    client = getattr(executor, "_client", None)
    return sum(client.nthreads().values()) or None if client is not None else None


@contextmanager
def threads_unless(executor: Executor | None, tasks: int) -> Iterator[Executor]:
    """The executor, or as many threads as tasks and cores allow. In a task that came from another
    process there are none: the other cores are those of the tasks beside it."""
    if executor is not None:
        with _with_room(executor) as room:
            yield room
        return
    if getattr(_here, "one_core", False):
        yield InPlace()
        return
    with ThreadPoolExecutor(max_workers=max(1, min(tasks, cpu_count()))) as threads:
        yield threads


@contextmanager
def processes(
    workers: int, first: Callable[[], object] | None = None
) -> Iterator[ProcessPoolExecutor]:
    """So many processes, which leave Ctrl-C to the one that waits for them. The script that asks
    needs the line `if __name__ == "__main__":`, as each of them imports it.

    first : what each of them calls before its first task, as to have what is pickled by name.
    """
    context = multiprocessing.get_context("spawn")  # threads are running here: no fork
    pool = ProcessPoolExecutor(workers, context, _begin, (first,))
    try:
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)


def _begin(first: Callable[[], object] | None) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if first is not None:
        with suppress(Exception):  # a task that needs it says so, where here the pool would break
            first()


def cpu_count() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextmanager
def _with_room(executor: Executor) -> Iterator[Executor]:
    """The executor for a call that may come from one of its own workers.

    Such a call waits for tasks that wait for its worker. On a thread of the executor itself the
    tasks run in place; on one of Dask's the call leaves the worker's pool until it is done.
    """
    # By its name: a pool enters a thread into its list only after that has begun to work.
    own = getattr(executor, "_thread_name_prefix", None)
    if own is not None and threading.current_thread().name.startswith(f"{own}_"):
        yield InPlace()
        return
    dask = sys.modules.get("distributed") if hasattr(executor, "_client") else None
    state = getattr(sys.modules.get("distributed.worker"), "thread_state", None)
    if dask is None or not hasattr(state, "execution_state"):
        yield executor
        return
    dask.secede()
    try:
        yield executor
    finally:
        dask.rejoin()


class InPlace(Executor):
    """Runs a task when it is submitted."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future
