"""Errors of ssmppl: one class per whose-fault-it-is, each saying where, what was found and the fix.

==================  =========================================================================
class               whose fault, and what its message names
==================  =========================================================================
ModelError          the model file: function, file, line, what was found, what to write
SimulatorError      a ModelError of what a simulator does: row, arguments, the user's traceback
DataError           the data: data set, variable, row (and column), the value, what to change
ArgumentError       the call: the argument, its value, the valid options
SamplingError       the numbers at run time: time step, site, the user's line, parameter values
ExecutorError       the executor or its workers: what happened to them, what to start anew
==================  =========================================================================

Everything derives from `SSMError`, so that `except ssm.SSMError` catches all of it.
"""

from __future__ import annotations

import difflib
import linecache
import os
import sys
import sysconfig
import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Location:
    """A place in the user's source: file, line and the function that holds it."""

    file: str
    line: int
    function: str = ""

    @property
    def text(self) -> str:
        """The source line itself, stripped; empty where the file is not at hand."""
        linecache.checkcache(self.file)  # it may have been edited and run again
        return linecache.getline(self.file, self.line).strip()

    @property
    def cell(self) -> str:
        """`In[3]` where the file is a cell of a notebook, as its own tracebacks say; else empty."""
        shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
        named = getattr(getattr(shell, "compile", None), "format_code_name", lambda file: None)
        found = named(self.file)
        return str(found[1]) if found else ""

    @property
    def place(self) -> str:
        """`varves.py:12`, in a notebook `In[3]:12`."""
        return f"{self.cell or os.path.basename(self.file)}:{self.line}"

    @property
    def short(self) -> str:
        """`varves.py:12: <the line>`, for reading rather than for finding."""
        return f"{self.place}: {self.text}" if self.text else self.place

    def __str__(self) -> str:
        inside = f" in {self.function}()" if self.function else ""
        place = f"Cell {self.cell}" if self.cell else f'File "{self.file}"'
        return f"{place}, line {self.line}{inside}"


class SSMError(Exception):
    """Base of every error that ssmppl raises on purpose.

    Parameters
    ----------
    found : what is wrong, with the value or name that was found.
    fix : what to write or change instead.
    where : place in the user's source or data, if there is one.
    """

    def __init__(self, found: str, *, fix: str = "", where: Location | str | None = None):
        self.found, self.fix, self.where = found, fix, where
        lines = []
        if where is not None:
            lines.append(str(where))
            if isinstance(where, Location) and where.text:
                lines.append(f"    {where.text}")
        lines.append(found)
        if fix:
            lines.append(f"Fix: {fix}")
        super().__init__("\n".join(lines))

    def __reduce__(
        self,
    ) -> tuple[Any, ...]:  # exceptions cross process borders when an Executor runs chains
        return _rebuild, (type(self), self.found, self.fix, self.where)


def _rebuild(cls: type[SSMError], found: str, fix: str, where: Location | str | None) -> SSMError:
    return cls(found, fix=fix, where=where)


class ModelError(SSMError):
    """The model as written breaks a rule of the language."""


class UnsupportedOperation(ModelError, TypeError):
    """An operation on symbols that has no symbolic meaning (a Python `if`, `float(x)`, ...)."""


class SimulatorError(ModelError):
    """A function under `@ssm.simulator` raised an error, or is none that can be computed with."""


class UnknownName(ModelError, AttributeError):
    """A decorator or attribute that a model does not have."""


class DataError(SSMError):
    """The data do not fit the model."""


class ArgumentError(SSMError, ValueError):
    """An argument of a verb is out of range, unknown or contradicts another."""


class SamplingError(SSMError):
    """Something went wrong numerically while an algorithm ran."""


class ExecutorError(SSMError):
    """The executor failed, not the task: a worker died, or cannot restore what it was sent."""


# Not the user's own lines, where a warning is to be looked for.
_LIBRARIES = tuple(
    str(path) for path in (
        os.path.dirname(os.path.abspath(__file__)) + os.sep, sysconfig.get_path("stdlib"),
        sysconfig.get_path("platlib"), sysconfig.get_path("purelib"),
    )
)  # fmt: skip


def warn(text: str) -> None:
    """Give a warning at the line of the user's that it is about: the innermost that is neither of
    this package nor of a library. It is shown once a line, in a notebook once a run of its cell, as
    `warnings.warn` would there."""
    frame = sys._getframe(1)
    while frame.f_back is not None and frame.f_code.co_filename.startswith(_LIBRARIES):
        frame = frame.f_back
    shown = frame.f_globals.setdefault("__warningregistry__", {})
    file, line = frame.f_code.co_filename, frame.f_lineno
    warnings.warn_explicit(text, UserWarning, file, line, registry=shown)


@dataclass(frozen=True)
class NotApplicable:
    """The outcome of an analysis that does not apply: the reason and the line it stems from."""

    reason: str
    where: Location | None = None

    def __bool__(self) -> bool:
        return False

    def __str__(self) -> str:
        return f"{self.reason} ({self.where})" if self.where else self.reason


def nearest_first(name: Any, known: Iterable[str]) -> list[str]:
    """`known` with the spellings closest to `name` first; a user's name may be anything."""
    known, given = list(known), str(name).lower()
    score = {k: difflib.SequenceMatcher(None, given, k.lower()).ratio() for k in known}
    return sorted(known, key=lambda k: (-score[k], k))


def written_as(given: Any, kinds: Iterable[type], argument: str = "method") -> str:
    """What to write for a class, or for its name, where an object of one of `kinds` is taken;
    empty where `given` is neither."""
    for kind in kinds:
        if given is kind or (isinstance(given, str) and given.lower() == kind.__name__.lower()):
            return f"write {argument}=ssm.{kind.__name__}()"
    return ""


def listing(name: Any, known: Iterable[str]) -> str:
    """`known` as text, nearest spelling to `name` first; "none" when empty."""
    return ", ".join(nearest_first(name, known)) or "none"
