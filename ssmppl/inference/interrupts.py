"""Ctrl-C, obeyed where it suits a loop."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


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
