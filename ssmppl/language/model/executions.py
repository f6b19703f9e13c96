"""Which run of a notebook cell, a module or a script a function was declared in.

A cell that is run again declares its functions again. What an earlier run of the same place has
declared is out of date then, be it the same, changed, renamed or gone. A place is a cell, where the
front end says which one it is, or a file. Two functions of one run are two functions, also of one
name (as a loop makes them).
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from types import CodeType, FrameType
from typing import Any


@dataclass(frozen=True)
class Execution:
    """One run of a place.

    place : of the cell or the file; None where the front end does not name the cell. run : the
    number of the cell's run, or the code object of the module's, of which each run has its own.
    interactive : whether it is a cell, or a line at a prompt.
    """

    place: str | None
    run: int | CodeType
    interactive: bool

    def outdates(self, other: Execution) -> bool:
        """Whether this is a later run of the place of the other."""
        return self.place is not None and self.place == other.place and self._later(other)

    def redefines(self, new: Callable[..., Any], old: Callable[..., Any], other: Execution) -> bool:
        """Whether a function of this run takes the place of one of the other: also where cells are
        not told apart, by its name, as a second `def` at a prompt does."""
        if self.outdates(other):
            return True
        typed = self.interactive and other.interactive and self._later(other)
        return typed and new.__qualname__ == old.__qualname__

    def _later(self, other: Execution) -> bool:
        same = self.run == other.run if isinstance(self.run, int) else self.run is other.run
        return not same


def this_execution() -> Execution:
    """The run of the cell, module or script that is under way."""
    frame = _module_frame(sys._getframe(1))
    shell = _shell()
    if shell is not None and frame.f_globals is getattr(shell, "user_ns", None):
        return Execution(_cell(shell), int(shell.execution_count), True)
    name = frame.f_code.co_filename
    typed = name.startswith("<")  # at Python's own prompt, or in a doctest
    return Execution(None if typed else name, frame.f_code, typed)


def _module_frame(frame: FrameType) -> FrameType:
    """The nearest frame that runs a module's own lines; the outermost one where there is none, as
    in a thread."""
    while frame.f_code.co_name != "<module>" and frame.f_back is not None:
        frame = frame.f_back
    return frame


def _shell() -> Any:
    """IPython's shell, where one runs."""
    ask = getattr(sys.modules.get("IPython"), "get_ipython", None)
    return ask() if callable(ask) else None


def _cell(shell: Any) -> str | None:
    """The id that the front end sent with the cell; None where it sends none."""
    ask = getattr(shell, "get_parent", None)
    try:
        found = ask()["metadata"]["cellId"] if callable(ask) else None
    except (LookupError, TypeError):
        return None
    return None if found is None else f"cell {found}"
