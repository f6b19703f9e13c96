"""What a run shows while it goes on, to stderr: a bar on a terminal and in a notebook, a few lines
elsewhere."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import Any

from tqdm import tqdm

from ssmppl import markup
from ssmppl.status import Output, clock, kind_of_stderr, terminal_shape, waiting

__all__ = ["Progress", "announced"]

BAR = "{desc}: {percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} [{elapsed}<{remaining}{postfix}]"

# Where there is no terminal: one line for so much of the work done, and seconds since the last.
SPARSE_SHARE = 0.2
SPARSE_SECONDS = 5.0
NOTEBOOK_SECONDS = 0.2  # between two states of a notebook's bar


class Progress:
    """Counts steps done out of `total`; used as a context manager, by one thread.

    Parameters
    ----------
    total : number of steps in all, over all chains.
    title : what is being done.
    shown : False shows nothing.
    before : steps done in an earlier call, which tell nothing of the speed of this one.
    """

    def __init__(self, total: int, title: str, shown: bool = True, before: int = 0):
        self.total = total
        self.title = title
        self.done = self.before = before
        self._started = self._last_line = time.monotonic()
        self._first: tuple[float, int] | None = None  # when, and how many: code was compiled before
        self._next_share = before / max(total, 1) + SPARSE_SHARE
        self._bar: Any = None
        self._kind = kind_of_stderr() if shown else "none"
        if self._kind == "terminal":
            self._bar = tqdm(
                total=total,
                initial=before,
                desc=title,
                bar_format=BAR,
                colour=_colour(),
                file=sys.stderr,
                **terminal_shape(),
            )
        self._output = Output() if self._kind == "notebook" else None

    def __enter__(self) -> Progress:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self._bar is not None:
            self._bar.close()

    def advance(self, steps: int, note: str = "") -> None:
        """Count `steps` more; `note` says how it goes (phase, acceptance)."""
        self.done += steps
        if self._bar is not None:
            self._bar.set_postfix_str(note, refresh=False)
            self._bar.update(steps)
        elif self._kind != "none":
            self._first = self._first or (time.monotonic(), self.done)
            now = time.monotonic()
            if self._output is not None:
                self._show_in_notebook(self._output, now, note)
            else:
                self._print_sparsely(now, note)

    def _print_sparsely(self, now: float, note: str) -> None:
        early = self.done < self._next_share * self.total
        if self.done < self.total and (early or now - self._last_line < SPARSE_SECONDS):
            return
        print(self._line(now, note), file=sys.stderr, flush=True)
        self._last_line = now
        self._next_share = self.done / self.total + SPARSE_SHARE

    def _show_in_notebook(self, output: Output, now: float, note: str) -> None:
        if self.done < self.total and now - self._last_line < NOTEBOOK_SECONDS:
            return
        self._last_line = now
        line = self._line(now, note)
        bar = f"<progress value='{self.done}' max='{self.total}'></progress>"
        output.show(f"{bar} <code>{markup.text(line)}</code>", line)

    def _line(self, now: float, note: str) -> str:
        """How far it is, how long it has taken, and will."""
        elapsed = now - self._started
        since, had = self._first or (self._started, self.before)
        if self.done == had:
            since, had = self._started, self.before
        left = (now - since) * (self.total - self.done) / (self.done - had)
        finished = self.done >= self.total
        time_ = clock(elapsed) if finished else f"{clock(elapsed)}<{clock(left)}"
        parts = [f"{100 * self.done // self.total}%", f"{self.done}/{self.total}", f"[{time_}]"]
        return " ".join([f"{self.title}:", *parts, note])


@contextmanager
def announced(title: str, what: str, shown: bool = True) -> Iterator[None]:
    """Say what is going on where it takes long and there is nothing to count."""
    if not shown:
        yield
        return
    with waiting(title, what):
        yield


def _colour() -> str | None:
    """The colour of the bar; none where NO_COLOR is set, or the terminal has none."""
    plain = os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb"
    return None if plain else "cyan"
