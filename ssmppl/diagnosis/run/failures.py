"""The parts of a diagnosis that an error ended, each with the reason in one line.

A diagnosis has many parts (candidates, refits, blocks left out, tables, panels), and the rest of
them are worth having where one fails. So an error ends its part and no other, and is reported.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np

from ssmppl.errors import ExecutorError, SSMError

FAULT = "fault"  # the entry of a task's numbers that says what ended it, and stands alone
LONGEST = 160  # characters of a reason


def reason_of(error: BaseException) -> str:
    """An error in one line: what was found; of a fault of this package its class, too."""
    if isinstance(error, SSMError):
        return one_line(error.found)
    text = one_line(str(error))
    return f"{type(error).__name__}{f': {text}' if text else ''} (internal error in ssmppl)"


def one_line(text: str) -> str:
    """The first line of a text, cut where it is long."""
    first = next(iter(text.strip().splitlines()), "")
    return first if len(first) <= LONGEST else first[: LONGEST - 3].rstrip() + "..."


class Failures:
    """The parts that failed so far, in the order in which they did.

    raised : errors are raised instead, as for somebody who looks for a fault.
    """

    def __init__(self, raised: bool = False):
        self.raised = raised
        self._reasons: dict[str, str] = {}

    def __iter__(self) -> Iterator[tuple[str, str]]:
        return iter(list(self._reasons.items()))

    def __len__(self) -> int:
        return len(self._reasons)

    def add(self, part: str, reason: str) -> None:
        """Record that a part failed, and why in one line."""
        self._reasons.setdefault(part, reason)

    def record_task(self, part: str, numbers: Mapping[str, Any]) -> bool:
        """Whether a task failed by a fault, which is then recorded of the part."""
        if FAULT not in numbers:
            return False
        self.add(part, str(numbers[FAULT]))
        return True

    @contextmanager
    def guard(self, name: str) -> Iterator[None]:
        """An error inside ends this part only. One of an executor is raised, as all that follows
        would meet it too."""
        try:
            yield
        except Exception as error:
            self.record(name, error)

    def record(self, part: str, error: Exception) -> None:
        """Record which error ended a part; in an `except` clause, which may raise it again."""
        if self.raised or isinstance(error, ExecutorError):
            raise error
        self.add(part, reason_of(error))


class Tolerant:
    """A task whose faults are its result: `{"fault": why}`; errors on purpose are raised.

    Of a class, so that it can be sent to another process with its task.
    """

    def __init__(self, task: Callable[[int], Mapping[str, Any]]):
        self.task = task

    def __call__(self, k: int) -> Mapping[str, Any]:
        try:
            return self.task(k)
        except SSMError:
            raise
        except Exception as error:
            return {FAULT: np.array(reason_of(error))}
