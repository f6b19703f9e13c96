"""What a user may not know of the data: noticed where something is estimated from them."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import numpy as np

from ssmppl.data.binding import Experiment, unread
from ssmppl.data.times import as_dates, spacing, trading_days
from ssmppl.errors import DataError, warn
from ssmppl.language.checks.ranges import beyond_range
from ssmppl.language.model.trace import Trace

OF_TIME = re.compile(
    r"(?i)(.*_)?(date|time|datetime|timestamp|day|week|month|quarter|year)s?(_.*)?"
)
FIRST = 20  # entries of a column that tell whether it holds dates

_noticed: ContextVar[bool] = ContextVar("noticed", default=False)


@contextmanager
def noticed() -> Iterator[None]:
    """Within the block nothing is noticed: a verb has done so that calls others, with parts of the
    data."""
    token = _noticed.set(True)
    try:
        yield
    finally:
        _noticed.reset(token)


def warn_of(trace: Trace, data: Any, experiments: Sequence[Experiment]) -> None:
    """Warn of rows that seem to be absent, of columns that hold nothing, and of times that nobody
    reads; and of priors that go beyond what their parameters may be."""
    if _noticed.get():
        return
    found = (*_steps(trace, experiments), *_empty(trace, experiments), *beyond_range(trace))
    for text in found:
        warn(text)
    if all(e.time is None for e in experiments):
        for column, values in unread(trace, data).items():
            if not (OF_TIME.fullmatch(column) or _are_dates(values)):
                continue
            warn(
                f"the column {column!r} is not used, and rows have numbers: call it `time` to "
                "label them, by which absent rows are noticed"
            )


def _are_dates(values: Any) -> bool:
    """By the first entries of a column; dates too that are written in more than one order."""
    try:
        if np.asarray(values).dtype.kind == "M":
            return True
        entries = np.asarray(values, dtype=object)[:FIRST]
        return as_dates(entries, "", "") is not None
    except DataError:
        return True
    except (TypeError, ValueError, IndexError):
        return False


def _steps(trace: Trace, experiments: Sequence[Experiment]) -> list[str]:
    """Of the first data set whose steps differ, unless the model reads their lengths."""
    if trace.time_step is not None:
        return []
    for e in experiments:
        found = "" if e.time is None or trading_days(e.time) else spacing(e.time)
        if found:
            return [
                f"the steps of the data are {found}. Give absent rows with NaN for what was not "
                'measured, or declare ssm.Model(..., time_step="dt")'
            ]
    return []


def _empty(trace: Trace, experiments: Sequence[Experiment]) -> list[str]:
    """Of what is missing in every row."""
    seen = np.any([np.any(e.seen == 1.0, axis=0) for e in experiments], axis=0)
    lost = [repr(s) for s, any_ in zip(trace.observation_symbols, seen, strict=True) if not any_]
    if not lost:
        return []
    return [f"{', '.join(lost)}: missing in every row, so that the data say nothing of it"]
