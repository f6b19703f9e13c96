"""Checkpoints: the numbers of what is done, so that a second call goes on from there.

One NumPy archive, written anew beside the old one and put in its place, so that an interrupt leaves
one or the other. It holds arrays of numbers and short texts by name, and digests of what they were
computed from: no code, nothing pickled.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import Any

import numpy as np

from ssmppl.data import Experiment
from ssmppl.diagnosis.effects.effect import Effect
from ssmppl.diagnosis.run.failures import FAULT, Failures, Tolerant
from ssmppl.inference.checkpoints.archive import no_checkpoint, read, unwritable, write
from ssmppl.inference.checkpoints.origin import (
    Origin,
    data_digest,
    digest,
    model_digest,
    origin_of,
    sources_digest,
    text_of,
)
from ssmppl.inference.run.tasks import run_tasks
from ssmppl.language.model.closure_digest import fingerprint
from ssmppl.language.model.trace import Trace

SECONDS = 5.0  # between two writings, at least
SHARE = 0.05  # of the time that may go into writing
HEADER = "made from"
WHAT = "a diagnosis"
FOLDERS = ("expressions", "language", "data", "analysis", "codegen", "inference", "diagnosis")

Numbers = dict[str, np.ndarray]


class Checkpoint:
    """Results of the parts that are done, by name; in memory alone where there is no path.

    path : a file, or a folder that has one file for each mode; neither needs to exist.
    made_from : digests by what they are of: "model", "data", ...
    executor, progress : where tasks run, and whether they are shown, on stderr. failures : takes
    what fails in between.

    Raises
    ------
    ArgumentError : the file is none of these, or it was made from something else.
    """

    def __init__(
        self, path: str | os.PathLike[str] | None, made_from: Mapping[str, str],
        executor: Executor | None = None, progress: bool = False,
        failures: Failures | None = None,
    ):  # fmt: skip
        self.made_from = Origin(dict(made_from))
        self.failures = Failures() if failures is None else failures
        self.executor, self.progress = executor, progress
        self.prefix = ""
        self.file = None if path is None else _file(Path(path), made_from.get("mode", "stages"))
        self._done: dict[str, Numbers] = {}
        self._lock = threading.RLock()
        self._written, self._cost, self._new = time.monotonic(), 0.0, False
        if self.file is not None and self.file.exists():
            self._done = self._read(self.file)

    def within(self, stage: str) -> Checkpoint:
        """The same checkpoint, its names and titles under that of a stage."""
        return ScopedCheckpoint(self, stage)

    def __contains__(self, name: str) -> bool:
        return name in self._done

    def get(self, name: str) -> Numbers:
        """The numbers under this name."""
        return self._done[name]

    def put(self, name: str, numbers: Mapping[str, Any]) -> None:
        """Keep numbers; they are written now and then, and at `flush`."""
        with self._lock:
            self._done[name] = {k: np.asarray(v) for k, v in numbers.items()}
            self._new = True
            if time.monotonic() - self._written > max(SECONDS, self._cost / SHARE):
                self._write()

    def flush(self) -> None:
        """Write what is new."""
        with self._lock:
            if self._new:
                self._write()

    def _keep_up(self) -> None:
        """Write what is new at the end of a stage, unless so much is kept that writing it again
        and again would take long."""
        if time.monotonic() - self._written >= self._cost / SHARE:
            self.flush()

    def say(self, text: str) -> None:
        """A line about what goes on, where progress is shown."""
        if self.progress:
            print(text, file=sys.stderr, flush=True)

    def computed(self, name: str, make: Callable[[], Mapping[str, Any]]) -> Numbers:
        """The numbers under this name, made where they are not there yet."""
        if name not in self:
            self.put(name, make())
            self._keep_up()
        return self.get(name)

    def map(
        self, stage: str, count: int, task: Callable[[int], Mapping[str, Any]]
    ) -> list[Numbers]:
        """The numbers of task(0), ..., task(count - 1), those left out that are there.

        A task may run in another process: a function of a module, or a `partial` of one. One that
        a fault of this package ends has that for its numbers (`Tolerant`), and is not kept: the
        next call tries again. At Ctrl-C the tasks that are done are kept, and KeyboardInterrupt
        goes on.
        """
        todo = [k for k in range(count) if f"{stage}/{k}" not in self]
        lost: dict[int, Numbers] = {}

        def take(i: int, numbers: Mapping[str, Any]) -> None:
            if FAULT in numbers:
                lost[todo[i]] = dict(numbers)
            else:
                self.put(f"{stage}/{todo[i]}", numbers)

        try:
            if todo:
                run_tasks(
                    task if self.failures.raised else Tolerant(task), todo,
                    executor=self.executor, progress=self.progress, title=self.prefix + stage,
                    take=take,
                )  # fmt: skip
        except BaseException:  # what is done is kept, whatever ends the run
            self.flush()
            raise
        self._keep_up()
        return [lost[k] if k in lost else self.get(f"{stage}/{k}") for k in range(count)]

    # -- the file
    def _write(self) -> None:
        if self.file is not None:
            begin = time.monotonic()
            members = {f"{name}|{field}": v for name, numbers in self._done.items()
                       for field, v in numbers.items()}  # fmt: skip
            members[HEADER] = np.array(self.made_from.as_text())
            try:
                self.file.parent.mkdir(parents=True, exist_ok=True)
                write(self.file, members.items())
            except OSError as error:
                raise unwritable(self.file, error) from error
            self._written = time.monotonic()
            self._cost = self._written - begin
        self._new = False

    def _read(self, file: Path) -> dict[str, Numbers]:
        found = read(file, WHAT)
        out: dict[str, Numbers] = {}
        try:
            was = origin_of(str(found.pop(HEADER)))
            for name, values in found.items():
                stage, field = name.rsplit("|", 1)
                out.setdefault(stage, {})[field] = values
        except (KeyError, ValueError, TypeError, AttributeError) as error:
            raise no_checkpoint(file, WHAT, "it holds something else") from error
        self.made_from.check(file, was)
        return out


class ScopedCheckpoint(Checkpoint):
    """A checkpoint seen from within a stage."""

    def __init__(self, whole: Checkpoint, stage: str):
        self._whole, self.prefix = whole, f"{whole.prefix}{stage}: "
        self._own = f"{stage}: "
        self.executor, self.progress = whole.executor, whole.progress
        self.failures = whole.failures

    def __contains__(self, name: str) -> bool:
        return self._own + name in self._whole

    def get(self, name: str) -> Numbers:
        return self._whole.get(self._own + name)

    def put(self, name: str, numbers: Mapping[str, Any]) -> None:
        self._whole.put(self._own + name, numbers)

    def flush(self) -> None:
        self._whole.flush()

    def _keep_up(self) -> None:
        self._whole._keep_up()


def _file(path: Path, mode: str) -> Path:
    folder = path.is_dir() or (not path.exists() and not path.suffix)
    return path / f"{mode}.npz" if folder else path


# -- what a diagnosis is computed from
def digests(
    trace: Trace, experiments: Sequence[Experiment], effects: Sequence[Effect], mode: str,
    settings: Mapping[str, Any],
) -> dict[str, str]:  # fmt: skip
    """Digests by what they are of; the mode as it is."""
    return {
        "mode": mode,
        "model": model_digest(trace),
        "data": data_digest(experiments),
        "set of effects": digest(*map(fingerprint, effects)),
        "settings": digest(*(f"{k}={text_of(v)}" for k, v in sorted(settings.items()))),
        "version of this package": sources_digest(*FOLDERS),
    }
