"""Functions of a model that are written as text, such as those of a component of `ssm.structural`.

The text is kept where Python looks for sources, so that errors, `inspect.getsource` and a debugger
show its lines. A function goes to another process as its text.
"""

from __future__ import annotations

import hashlib
import linecache
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ssmppl.compiling import one_at_a_time, parse

ROLES = ("prior", "initial", "transition", "observation")
_MARK = "__written__"


@dataclass(frozen=True)
class Written:
    """A text of decorated functions, and the place of one of them in it."""

    text: str
    title: str
    place: int

    def function(self) -> Callable[..., Any]:
        """The function, compiled."""
        return functions_of(self.text, self.title)[self.place][1]


class _Recorder:
    """What `model` is in a text: keeps what its decorators are given."""

    def __init__(self) -> None:
        self.found: list[tuple[str, Callable[..., Any]]] = []

    def __getattr__(self, role: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
        def keep(function: Callable[..., Any]) -> Callable[..., Any]:
            self.found.append((role, function))
            return function

        return keep


@one_at_a_time
def functions_of(text: str, title: str) -> list[tuple[str, Callable[..., Any]]]:
    """(role, function) of each `@model.role` function of a text, in order. title : names the text
    in messages."""
    digest = hashlib.sha256(text.encode()).hexdigest()[:8]
    file = f"<{title} {digest}>"
    linecache.cache[file] = (len(text), None, text.splitlines(keepends=True), file)
    recorder = _Recorder()
    names = {"__name__": "ssmppl_written", "np": np, "ssm": sys.modules["ssmppl"],
             "model": recorder}  # fmt: skip
    exec(compile(parse(text), file, "exec"), names)
    for place, (_, function) in enumerate(recorder.found):
        setattr(function, _MARK, Written(text, title, place))
    return recorder.found


def written(function: Any) -> Written | None:
    """Where a function was written as text; None of a user's own."""
    found: Written | None = getattr(function, _MARK, None)
    return found
