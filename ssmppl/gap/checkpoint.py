"""Checkpoints: the numbers of what is done, so that a second call goes on from there.

One NumPy archive, written anew beside the old one and put in its place, so that an interrupt leaves
one or the other. It holds arrays of numbers and short texts by name, and digests of what they were
computed from: no code, nothing pickled.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
import threading
import time
import zipfile
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from ssmppl.data import Experiment
from ssmppl.errors import ArgumentError
from ssmppl.expressions.arrays import array
from ssmppl.expressions.expr import Expr, topological
from ssmppl.gap.effect import Effect
from ssmppl.inference.runner import run_tasks
from ssmppl.language.primitive import Primitive
from ssmppl.language.trace import Site, Trace

SECONDS = 5.0  # between two writings, at least
SHARE = 0.05  # of the time that may go into writing
HEADER = "made from"

Numbers = dict[str, np.ndarray]


class Checkpoint:
    """What is done, by name; in memory alone where there is no path.

    path : a file, or a folder that has one file for each mode; neither needs to exist.
    made_from : digests by what they are of: "model", "data", ...
    executor, progress : where tasks run, and whether they are shown, on stderr.

    Raises
    ------
    ArgumentError : the file is none of these, or it was made from something else.
    """

    def __init__(
        self, path: str | os.PathLike[str] | None, made_from: Mapping[str, str],
        executor: Executor | None = None, progress: bool = False,
    ):  # fmt: skip
        self.made_from = dict(made_from)
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
        return _Part(self, stage)

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
            wait = max(SECONDS, self._cost / SHARE)
            if time.monotonic() - self._written > wait:
                self._write()

    def flush(self) -> None:
        """Write what is new."""
        with self._lock:
            if self._new:
                self._write()

    def say(self, text: str) -> None:
        """A line about what goes on, where progress is shown."""
        if self.progress:
            print(text, file=sys.stderr, flush=True)

    def of(self, name: str, make: Callable[[], Mapping[str, Any]]) -> Numbers:
        """The numbers under this name, made where they are not there yet."""
        if name not in self:
            self.put(name, make())
            self.flush()
        return self.get(name)

    def each(
        self, stage: str, count: int, task: Callable[[int], Mapping[str, Any]]
    ) -> list[Numbers]:
        """The numbers of task(0), ..., task(count - 1), those left out that are there.

        At Ctrl-C the tasks that are done are kept, and KeyboardInterrupt goes on.
        """
        todo = [k for k in range(count) if f"{stage}/{k}" not in self]

        def one(k: int) -> None:
            self.put(f"{stage}/{k}", task(k))

        try:
            if todo:
                run_tasks(
                    one, todo, executor=self.executor, progress=self.progress,
                    title=self.prefix + stage,
                )  # fmt: skip
        finally:
            self.flush()
        return [self.get(f"{stage}/{k}") for k in range(count)]

    # -- the file
    def _write(self) -> None:
        if self.file is not None:
            begin = time.monotonic()
            members = {f"{name}|{field}": v for name, numbers in self._done.items()
                       for field, v in numbers.items()}  # fmt: skip
            members[HEADER] = np.array(json.dumps(self.made_from))
            beside = self.file.with_name(f"{self.file.name}.{os.getpid()}.part")
            try:
                self.file.parent.mkdir(parents=True, exist_ok=True)
                with open(beside, "wb") as f:
                    np.savez(f, **members)  # type: ignore[arg-type]
                os.replace(beside, self.file)
            except OSError as error:
                raise ArgumentError(
                    f"the checkpoint {self.file} cannot be written: {error.strerror or error}",
                    fix="give another path, or checkpoint=None",
                ) from error
            self._written = time.monotonic()
            self._cost = self._written - begin
        self._new = False

    def _read(self, file: Path) -> dict[str, Numbers]:
        try:
            with np.load(file, allow_pickle=False) as archive:
                found = {name: archive[name] for name in archive.files}
            made_from = json.loads(str(found.pop(HEADER)))
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            raise ArgumentError(
                f"{file} is no checkpoint of a diagnosis",
                fix="give the path of one, or of a file or folder that does not exist yet",
            ) from error
        other = [k for k, v in self.made_from.items() if made_from.get(k) != v]
        if other:
            raise ArgumentError(
                f"the checkpoint {file} was made with {_listed(other)}",
                fix="give another path, or delete it to start anew",
            )
        out: dict[str, Numbers] = {}
        for name, values in found.items():
            stage, field = name.rsplit("|", 1)
            out.setdefault(stage, {})[field] = values
        return out


class _Part(Checkpoint):
    """A checkpoint seen from within a stage."""

    def __init__(self, whole: Checkpoint, stage: str):
        self._whole, self.prefix = whole, f"{whole.prefix}{stage}: "
        self._own = f"{stage}: "
        self.executor, self.progress = whole.executor, whole.progress

    def __contains__(self, name: str) -> bool:
        return self._own + name in self._whole

    def get(self, name: str) -> Numbers:
        return self._whole.get(self._own + name)

    def put(self, name: str, numbers: Mapping[str, Any]) -> None:
        self._whole.put(self._own + name, numbers)

    def flush(self) -> None:
        self._whole.flush()


def _file(path: Path, mode: str) -> Path:
    folder = path.is_dir() or (not path.exists() and not path.suffix)
    return path / f"{mode}.npz" if folder else path


def _listed(other: Sequence[str]) -> str:
    plural = ("settings", "data")
    words = [f"{'other' if k in plural else 'another'} {k}" for k in other]
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


# -- what a diagnosis is computed from
def digests(
    trace: Trace, experiments: Sequence[Experiment], effects: Sequence[Effect], mode: str,
    settings: Mapping[str, Any],
) -> dict[str, str]:  # fmt: skip
    """By what they are of: the mode itself, digests of the others."""
    return {
        "mode": mode,
        "model": _digest(_model(trace)),
        "data": _digest(*(_data(e) for e in experiments)),
        "set of effects": _digest(*(_effect(e) for e in effects)),
        "settings": _digest(*(f"{k}={_value(v)}" for k, v in sorted(settings.items()))),
        "version of this package": _code(),
    }


def _digest(*parts: str) -> str:
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:20]


def _value(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{k}: {_value(v)}" for k, v in sorted(value.items()))
    return repr(value.tolist()) if isinstance(value, np.ndarray) else repr(value)


def _data(e: Experiment) -> str:
    own = hashlib.sha256()
    for values in (e.y, e.seen, e.u):
        own.update(repr(values.shape).encode())
        own.update(np.ascontiguousarray(values).tobytes())
    own.update(repr(None if e.time is None else [str(t) for t in e.time]).encode())
    return own.hexdigest()


def _model(trace: Trace) -> str:
    """Laws and expressions, without where they were written."""
    lines = [trace.name]
    roots: list[Expr] = []
    for role in ("parameters", "initial", "transition", "observations", "proposal"):
        for name, site in getattr(trace, role).items():
            lines.append(f"{role} {name} {site.shape} {_law(site.distribution)}")
            roots += _roots(site)
    number: dict[Expr, int] = {}
    for e in topological(roots):
        number[e] = len(number)
        data = e.data.name if isinstance(e.data, Primitive) else repr(e.data)
        lines.append(f"{e.op} {data} {[number[a] for a in e.args]}")
    lines.append(repr([number[e] for e in roots]))
    return "\n".join(lines)


def _law(distribution: Any) -> str:
    base = getattr(distribution, "base", None)
    return f"{type(distribution).__name__}{f' of {_law(base)}' if base is not None else ''}"


def _roots(site: Site) -> list[Expr]:
    out: list[Expr] = list(site.value.ravel())
    law: Any = site.distribution
    while law is not None:
        for values in law.parameters.values():
            out += list(array(values).ravel())
        law = getattr(law, "base", None)
    return out


def _effect(e: Effect) -> str:
    """Its declaration, and the compiled text of its function."""
    code = e.function.__code__
    plain = [c for c in code.co_consts if c is None or isinstance(c, int | float | str | tuple)]
    declared = [e.name, e.form, e.kind, e.on, e.lower, e.upper, dict(e.shapes), dict(e.given),
                dict(e.states), e.profile, e.process]  # fmt: skip
    return f"{declared!r} {code.co_code.hex()} {code.co_names} {plain!r}"


@cache
def _code() -> str:
    """Of the sources that numbers come from."""
    package = Path(__file__).parents[1]
    folders = ("expressions", "language", "data", "analysis", "codegen", "inference", "gap")
    return _digest(*(f.read_text(encoding="utf-8") for folder in folders
                     for f in sorted((package / folder).rglob("*.py"))))  # fmt: skip
