"""The time from each row to the next, from the labels of the rows: `Model(..., time_step="dt")`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ssmppl.data.sources import Source
from ssmppl.errors import DataError
from ssmppl.language.model.model import TIME_UNITS
from ssmppl.language.model.trace import Trace


def with_time_step(trace: Trace, source: Source) -> Source:
    """The data set with the column that the model's time step is, unless it has one of that name.

    The last row, which has no next one, has the step before (1 where there is none); only a
    forecast reads it, and puts in what it knows.

    Raises
    ------
    DataError : the rows have no labels, or such as are no times.
    """
    if trace.time_step is None or trace.time_step[0] in source.columns:
        return source
    name, unit = trace.time_step
    time = source.time
    fix = (
        f"give the times of the rows, as data['time'] or the index of a table, or the column "
        f"{name!r} with the time from each row to the next"
    )
    if time is None:
        raise DataError(
            f"the rows have no times, and the model takes its time step {name!r} from them",
            fix=fix,
            where=source.place(),
        )
    if time.dtype.kind not in "iufM":
        raise DataError(
            f"the labels of the rows are texts, such as {str(time[0])!r}, and the model takes its "
            f"time step {name!r} from them",
            fix=fix,
            where=source.place(),
        )
    steps = lengths(time, unit)
    whole = np.append(steps, steps[-1] if len(steps) else 1.0)
    return replace(source, columns={**source.columns, name: whole})


def lengths(time: np.ndarray, unit: str) -> np.ndarray:
    """(T - 1,) from each time to the next; of dates in this unit, of numbers as they are."""
    steps = np.diff(time)
    if time.dtype.kind == "M":
        return np.asarray(steps / np.timedelta64(1, "ns") / (TIME_UNITS[unit] * 1e9), dtype=float)
    return steps.astype(float)
