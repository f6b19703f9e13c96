"""A second process compiles what a question needs next, while this one compiles or runs the first.

A chain's kernels are wanted when its pilot has ended, a gradient's when the first value is known.
Who asks the question names what comes later, as calls that use it (`beforehand`). They are made in
another process when the first thing turns out not to be compiled, and only then: it keeps what it
compiles in the cache folder, where this one finds it, or waits for what is half done
(`folder.one_process`). What those calls return, or raise, is of no interest; an answer does not
depend on them. It ends when it is done, with the next question, or with the process that asked.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import pickle
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any

from numba import config

from ssmppl.codegen.store import folder
from ssmppl.language.model.pickling import packed, unpacked

ALONE = "SSMPPL_ONE_COMPILER"  # set, to anything, there is no other process
_running: list[subprocess.Popen[bytes]] = []
START = (
    "import pickle, sys; sys.path[:] = pickle.load(sys.stdin.buffer); "
    "from ssmppl.codegen.store.beforehand import serve; serve()"
)


@contextlib.contextmanager
def beforehand(*calls: Callable[[], Any]) -> Iterator[None]:
    """Context in which these calls are begun by another process at the first thing that is not
    compiled. It goes on after the context, until it is done."""

    def start() -> None:
        folder.on_missing.remove(start)
        _start(calls)

    if not (calls and _wanted()):
        yield
        return
    folder.on_missing.append(start)
    try:
        yield
    finally:
        with contextlib.suppress(ValueError):
            folder.on_missing.remove(start)


def _start(calls: tuple[Callable[[], Any], ...]) -> None:
    """Called under the lock; there is one such process at a time, for the last question."""
    try:
        content = pickle.dumps(sys.path) + pickle.dumps(packed(calls))
    except Exception:  # of a model with something of the user's that cannot travel
        return
    end()
    env = {**os.environ, ALONE: "1", "SSMPPL_CACHE": str(folder.cache_folder().parent)}
    with contextlib.suppress(OSError):
        process = subprocess.Popen(
            [sys.executable, "-c", START], stdin=subprocess.PIPE, stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL, env=env, start_new_session=True,
        )  # fmt: skip
        _running.append(process)
        # It reads when it has imported what it needs; a pipe holds little.
        threading.Thread(target=_send, args=(process, content), daemon=True).start()


def end() -> None:
    """End the other process, if there is one."""
    while _running:
        process = _running.pop()
        process.kill()
        process.wait()
        if process.stdin is not None:
            with contextlib.suppress(OSError):
                process.stdin.close()


atexit.register(end)


def _send(process: subprocess.Popen[bytes], content: bytes) -> None:
    assert process.stdin is not None
    with contextlib.suppress(OSError, ValueError):  # it has ended, or was ended
        process.stdin.write(content)
        process.stdin.flush()


def _wanted() -> bool:
    """Whether another process would be of use: there is a processor for it, a folder to share and a
    Python to run; and this is none of many that work side by side."""
    main = sys.modules.get("multiprocessing.process")
    return (
        ALONE not in os.environ
        and not config.DISABLE_JIT  # type: ignore[attr-defined]
        and _processors() > 1
        and bool(sys.executable) and not getattr(sys, "frozen", False)
        and "python" in os.path.basename(sys.executable).lower()
        and (main is None or main.parent_process() is None)
        and os.access(folder.cache_folder(), os.W_OK)
    )  # fmt: skip


def _processors() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def serve() -> None:
    """Of the other process: make the calls that come by its standard input."""
    calls = unpacked(pickle.load(sys.stdin.buffer))
    # The pipe is never written to again: it ends when who asked has ended, however it did.
    threading.Thread(target=_end_with, args=(sys.stdin.buffer,), daemon=True).start()
    for call in calls:
        with contextlib.suppress(Exception):
            call()


def _end_with(pipe: Any) -> None:
    pipe.read()
    os._exit(0)
