"""What a run shows while it goes on: a bar on a terminal, a few lines elsewhere. To stderr."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import Any

from tqdm import tqdm

from ssmppl.codegen.native.loading import notice

__all__ = ["Progress", "announced"]

BAR = "{desc}: {percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} [{elapsed}<{remaining}{postfix}]"

# Where there is no terminal: one line for so much of the work done, and seconds since the last.
SPARSE_SHARE = 0.2
SPARSE_SECONDS = 5.0

# Work without a bar that takes longer is announced; that on a model compiled before seldom does.
SILENT_SECONDS = 2.0


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
        self._lines = shown and not sys.stderr.isatty()
        self._bar = None
        if shown and not self._lines:
            self._bar = tqdm(
                total=total,
                initial=before,
                desc=title,
                bar_format=BAR,
                colour=_colour(),
                file=sys.stderr,
                **_shape(),
            )

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
        elif self._lines:
            self._first = self._first or (time.monotonic(), self.done)
            self._print_sparsely(note)

    def _print_sparsely(self, note: str) -> None:
        now = time.monotonic()
        finished = self.done >= self.total
        early = self.done < self._next_share * self.total
        if not finished and (early or now - self._last_line < SPARSE_SECONDS):
            return
        elapsed = now - self._started
        since, had = self._first or (self._started, self.before)
        if self.done == had:
            since, had = self._started, self.before
        left = (now - since) * (self.total - self.done) / (self.done - had)
        clock = f"{_clock(elapsed)}<{_clock(left)}" if not finished else _clock(elapsed)
        parts = [f"{100 * self.done // self.total}%", f"{self.done}/{self.total}", f"[{clock}]"]
        print(f"{self.title}:", *parts, note, file=sys.stderr, flush=True)
        self._last_line = now
        self._next_share = self.done / self.total + SPARSE_SHARE


@contextmanager
def announced(title: str, what: str, shown: bool = True) -> Iterator[None]:
    """Say what is going on where it takes long and there is nothing to count."""

    def tell() -> None:
        print(
            f"{title}: {what}; a new model is compiled first, once, which may take a minute",
            file=sys.stderr, flush=True,
        )  # fmt: skip

    timer = threading.Timer(SILENT_SECONDS, tell)
    timer.daemon = True
    if shown:
        notice.given = True  # by this
        timer.start()
    try:
        yield
    finally:
        timer.cancel()


def _shape() -> dict[str, Any]:
    """Settings of a bar as wide as the terminal, also once that is changed; where it does not tell
    its size, as within some containers and editors, and no bar would fit, 80 columns."""
    try:
        known = os.get_terminal_size(sys.stderr.fileno()).columns > 0
    except (OSError, ValueError, AttributeError):
        known = False
    return {"dynamic_ncols": True} if known else {"ncols": 80, "nrows": 24}


def _colour() -> str | None:
    """The colour of the bar; none where NO_COLOR is set, or the terminal has none."""
    plain = os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb"
    return None if plain else "cyan"


def _clock(seconds: float) -> str:
    return tqdm.format_interval(int(seconds))
