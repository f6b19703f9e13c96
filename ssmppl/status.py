"""What a call tells while it goes on, to stderr and to the log: which verb runs, and what it waits
for.

Who waits longer than two seconds, for a compiler or for what cannot be counted, is told so, with
the seconds that have passed: on a terminal by a line that is written over, in a notebook by an
output that is, and taken away; elsewhere, as in a log file, by a line now and then. A verb that is
called with `progress=False` tells nothing.

The log is Python's, by the name "ssmppl": at INFO how long a verb took, which method was chosen and
why, what was compiled. Nobody sees it who does not ask, as by `logging.basicConfig(level="INFO")`.
"""

from __future__ import annotations

import logging
import os
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from tqdm import tqdm

from ssmppl import markup

LOG = logging.getLogger("ssmppl")
LOG.addHandler(logging.NullHandler())

STYLE = "SSMPPL_PROGRESS"  # "lines": as in a log file, also on a terminal and in a notebook
SILENT_SECONDS = 2.0  # of waiting within a call, all together, before it is told
TICK_SECONDS = 0.5
NEXT_LINE = 2.0  # times as long until the next line, where there is no terminal
WORTH_SAYING = 0.5  # seconds of a compilation, for the log
LONGEST_PAUSE = 60.0  # seconds between such lines
WORDS = {  # of functions that take long to compile
    "backward_exact": "backward simulation",
    "backward_mcmc": "backward simulation",
    "backward_rejection": "backward simulation",
    "conditional_smc": "conditional SMC",
    "filter": "the particle filter",
    "filtered_path": "the particle filter that keeps a trajectory",
    "follow_filter": "the filter that looks ahead",
    "gaussian_mode": "the mode of the states",
    "guide": "the Gaussian approximation of the states",
    "kalman_filter": "the Kalman filter",
    "log_joint": "the joint density",
    "log_prior": "the prior density",
    "mode_gradient": "the gradient of Laplace's approximation",
    "mode_moments": "the moments of Laplace's approximation",
    "particle_filter": "the particle filter",
    "path_score": "the score of a trajectory",
    "row_scores": "the score by rows",
    "sums_of": "sums over trajectories",
    "tempered_filter": "the tempered particle filter",
    "unscented_filter": "the unscented Kalman filter",
}


@dataclass(eq=False)
class Call:
    """A verb under way. shown : False: it tells nothing. lines : whether it tells also where there
    is neither a terminal nor a notebook. waited : seconds of what it has waited for."""

    name: str
    shown: bool = True
    lines: bool = False
    began: float = field(default_factory=lambda: time.monotonic())
    waited: float = 0.0
    next_line: float = 0.0


@dataclass(eq=False)
class _Wait:
    title: str
    what: str
    call: Call
    since: float = field(default_factory=lambda: time.monotonic())


def kind_of_stderr() -> str:
    """ "terminal", "notebook", "lines", or "none" where there is no stderr."""
    if sys.stderr is None:
        return "none"
    if os.environ.get(STYLE) == "lines":
        return "lines"
    if sys.stderr.isatty():
        return "terminal"
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return "notebook" if hasattr(shell, "kernel") else "lines"


class Output:
    """An output of a notebook's cell that is written over."""

    def __init__(self) -> None:
        self._handle: Any = None

    def show(self, html: str, text: str) -> None:
        bundle = {"text/plain": text, "text/html": html}
        if self._handle is None:
            display = sys.modules["IPython"].display.display
            self._handle = display(bundle, raw=True, display_id=True)
        else:
            self._handle.update(bundle, raw=True)

    def clear(self) -> None:
        if self._handle is not None:
            self.show("", "")


def terminal_shape() -> dict[str, Any]:
    """Settings of a bar as wide as the terminal, also once that is changed; where it does not tell
    its size, as within some containers and editors, and no bar would fit, 80 columns."""
    try:
        known = os.get_terminal_size(sys.stderr.fileno()).columns > 0
    except (OSError, ValueError, AttributeError):
        known = False
    return {"dynamic_ncols": True} if known else {"ncols": 80, "nrows": 24}


class _Status:
    """What is waited for, by any thread, and the one line that tells of it."""

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self.calls: list[Call] = []
        self._outside = Call("ssmppl")
        self._waits: list[_Wait] = []
        self._ticker: threading.Thread | None = None
        self._bar: Any = None
        self._output: Output | None = None

    def enter(self, call: Call) -> None:
        with self._lock:
            self.calls.append(call)

    def leave(self, call: Call) -> None:
        with self._lock:
            self.calls.remove(call)
            if not self.calls:
                self._output = None  # the next call may be of another cell

    def begin(self, title: str, what: str) -> _Wait:
        with self._lock:
            wait = _Wait(title, what, self.calls[-1] if self.calls else self._outside)
            self._waits.append(wait)
            if self._ticker is None and kind_of_stderr() != "none":
                self._ticker = threading.Thread(target=self._tick, daemon=True)
                self._ticker.start()
        return wait

    def end(self, wait: _Wait) -> None:
        with self._lock:
            self._waits.remove(wait)
            if not any(w.call is wait.call for w in self._waits):
                wait.call.waited += time.monotonic() - wait.since
            if not self._waits:
                self._hide()

    def _tick(self) -> None:
        while True:
            time.sleep(min(TICK_SECONDS, max(SILENT_SECONDS, 0.01)))
            with self._lock:
                if not self._waits:
                    self._ticker = None
                    return
                self._tell()

    def _tell(self) -> None:
        wait = self._waits[-1]
        call, now = wait.call, time.monotonic()
        first = min(w.since for w in self._waits if w.call is call)
        if call.waited + now - first < SILENT_SECONDS or not all(c.shown for c in self.calls):
            return
        seconds = now - (call.began if call in self.calls else first)
        # The seconds stand where a narrow terminal does not cut them off.
        text = f"{wait.title or call.name} [{clock(seconds)}]: {wait.what}"
        kind = kind_of_stderr()
        if kind == "terminal":
            if self._bar is None:
                self._bar = tqdm(
                    total=0, bar_format="{desc}", leave=False, file=sys.stderr, **terminal_shape()
                )
            self._bar.set_description_str(text)
        elif kind == "notebook":
            self._output = self._output or Output()
            self._output.show(f"<code>{markup.text(text)}</code>", text)
        elif kind == "lines" and call.lines and seconds >= call.next_line:
            print(text, file=sys.stderr, flush=True)
            call.next_line = min(NEXT_LINE * seconds, seconds + LONGEST_PAUSE)

    def _hide(self) -> None:
        if self._bar is not None:
            self._bar.close()
        if self._output is not None:
            self._output.clear()
            self._output = self._output if self.calls else None
        self._bar = None


_status = _Status()


def _after_fork() -> None:
    """A fork has neither the thread that ticks nor what other threads wait for."""
    global _status
    _status = _Status()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


def clock(seconds: float) -> str:
    return str(tqdm.format_interval(int(seconds)))


@contextmanager
def call_of(verb: str, model: str, shown: bool, lines: bool) -> Iterator[None]:
    """Context of a verb: what it waits for is told under its name, and its time is logged.

    shown, lines : as of `Call`.
    """
    call, inner = Call(verb, shown, lines), bool(_status.calls)
    status = _status
    status.enter(call)
    try:
        yield
    finally:
        status.leave(call)
    seconds = time.monotonic() - call.began
    of = f" of model {model!r}" if model else ""
    LOG.log(logging.DEBUG if inner else logging.INFO, "%s%s took %.1f s", verb, of, seconds)


@contextmanager
def waiting(title: str, what: str) -> Iterator[None]:
    """Context of what takes long, where nothing can be counted.

    title : of what is under way; empty: the verb.
    """
    status = _status
    wait = status.begin(title, what)
    try:
        yield
    finally:
        status.end(wait)


class Compilations:
    """What is compiled, of which the compiler tells, nested: the outermost is waited for."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._depth, self._name = 0, ""
        self._wait: _Wait | None = None
        self._status = _status

    def began(self, name: str) -> None:
        """name : of the function; empty where another process compiles, which is waited for."""
        with self._lock:
            self._depth += 1
            if self._depth == 1:
                what = f"compiling {_in_words(name)}, once for models of this kind"
                if not name:
                    what = "waiting for another process that compiles the same"
                self._status, self._name = _status, name
                self._wait = _status.begin("", what)

    def ended(self) -> None:
        with self._lock:
            self._depth = max(self._depth - 1, 0)
            wait, self._wait = (self._wait, None) if self._depth == 0 else (None, self._wait)
        if wait is not None:
            self._status.end(wait)
            seconds = time.monotonic() - wait.since
            if self._name:
                level = logging.INFO if seconds >= WORTH_SAYING else logging.DEBUG
                LOG.log(level, "compiled %s in %.1f s", self._name, seconds)


def _in_words(name: str) -> str:
    """A compiled function of the package in words; its name where there are none for it."""
    plain = name.strip("_").removesuffix("_each")
    return WORDS.get(plain, plain.replace("_", " "))
