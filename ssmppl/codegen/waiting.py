"""Who waits at a terminal for the compiler is told so, once in a process.

Verbs that show no progress would otherwise be silent for half a minute, on the first model of its
kind on a machine. Numba tells when it compiles (`numba.core.event`).
"""

from __future__ import annotations

import sys
import threading
import time

from numba.core import event
from tqdm import tqdm

__all__ = ["notice"]

SILENT_SECONDS = 2.0  # of compiling, all together, before it is told
TEXT = "ssmppl: compiling what this kind of model needs, once; it may take a minute"


class Notice(event.Listener):
    """Hears of every compilation, of any thread.

    told : nothing is said any more.
    """

    def __init__(self) -> None:
        self.told = False
        self._lock = threading.Lock()
        self._running, self._spent, self._since = 0, 0.0, 0.0
        self._timer: threading.Timer | None = None

    def on_start(self, event: event.Event) -> None:
        with self._lock:
            self._running += 1
            if self._running > 1 or self.told or not (sys.stderr and sys.stderr.isatty()):
                return
            self._since = time.monotonic()
            self._timer = threading.Timer(max(SILENT_SECONDS - self._spent, 0.0), self._tell)
            self._timer.daemon = True
            self._timer.start()

    def on_end(self, event: event.Event) -> None:
        with self._lock:
            self._running -= 1
            if self._running == 0 and self._timer is not None:
                self._timer.cancel()
                self._timer = None
                self._spent += time.monotonic() - self._since

    def _tell(self) -> None:
        with self._lock:
            if self.told:
                return
            self.told = True
        tqdm.write(TEXT, file=sys.stderr)


notice = Notice()
