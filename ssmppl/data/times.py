"""Labels of rows, dates above all, as people write them; and whether they are evenly spaced."""

from __future__ import annotations

import datetime
import re
import warnings
from typing import Any

import numpy as np

from ssmppl.errors import DataError

__all__ = ["as_dates", "label_text", "spacing"]

# 04.01.2021, 1/4/21, 4 Jan 2021, Jan 4, 2021: which is day and which is month is not guessed
_MONTH = r"(?:jan|feb|mar|apr|may|jun|jul|aug|sep|oct|nov|dec)[a-z]*\.?"
_OTHER_DATES = re.compile(
    r"(?i)\s*(?:\d{1,2}([./-])\d{1,2}\1(?:\d{4}|\d{2})"
    rf"|\d{{1,2}}[. -]+{_MONTH}[ -]+\d{{2,4}}|{_MONTH} \d{{1,2}},? \d{{4}})(?:\s.*)?$"
)
_NUMERAL = re.compile(r"\s*(?!\d{8}\s*$)\d+\s*$")  # 1200 is a name or a number, 20210104 a date
_OFFSET = re.compile(r"(?i)\d(?:Z|[+-]\d\d(?::?\d\d)?)\s*$")  # behind a clock
EVEN = 1.2  # months and years are not all as long as each other, and are even all the same
LEAST_DAYS = 10  # rows from which a week has shown


def label_text(label: Any) -> str:
    """A row's label: of a date no more than it says, `2024-03-01` or `2024-03-01T06:30:00`."""
    text = str(label)
    if not isinstance(label, np.datetime64):
        return text
    clock = text.partition("T")[2]
    if "." in clock:
        text = text.rstrip("0").rstrip(".")
    return text.removesuffix("T00:00:00").removesuffix("T00:00")


def as_dates(labels: Any, what: str, code: str) -> Any:
    """Texts and dates of Python as a pandas Series of dates, in UTC where their offsets differ;
    None where they are something else.

    what, code : the labels in words, and in Python.

    Raises
    ------
    DataError : they are dates that could be read in two ways.
    """
    import pandas as pd

    entries = np.asarray(labels, dtype=object)
    if entries.ndim != 1:
        return None
    present = [v for v in entries if not (v is None or v is pd.NA or v != v)]
    written = [v for v in present if isinstance(v, str)]
    if not present or not all(isinstance(v, str | datetime.date | np.datetime64) for v in present):
        return None
    if any(map(_NUMERAL.match, written)):
        return None
    series = pd.Series(entries, dtype=object)
    for utc in (False, True):
        try:
            with warnings.catch_warnings():  # older pandas warn of differing offsets
                warnings.simplefilter("error", FutureWarning)
                dates = pd.to_datetime(series, format="ISO8601", utc=utc)
        except (ValueError, TypeError, FutureWarning):
            continue
        if utc and (bare := [v for v in present if not _has_zone(v)]):
            raise DataError(
                f"{what} has dates with and without a time zone: {str(bare[0])!r} has none",
                fix="give all of them an offset, 2021-01-04T12:00+01:00, or none",
            )
        return dates if dates.dtype.kind == "M" else None
    if len(written) == len(present) and all(map(_OTHER_DATES.match, written)):
        raise DataError(
            f"{what} holds dates in another form than ISO's: its first entry is {written[0]!r}",
            fix=f"write them year first, 2021-01-04: in Python pd.to_datetime({code}, "
            "dayfirst=True), or dayfirst=False where the month stands first",
        )
    return None


def _has_zone(date: Any) -> bool:
    if isinstance(date, str):
        return ":" in date and _OFFSET.search(date) is not None
    return getattr(date, "tzinfo", None) is not None


def trading_days(time: np.ndarray) -> bool:
    """Whether rows are days without their weekends, as of markets: nothing is absent then that is
    expected, on holidays neither."""
    if time.dtype.kind != "M" or len(time) < LEAST_DAYS:
        return False
    days = time.astype("datetime64[D]")
    one = np.median(np.diff(days)) == np.timedelta64(1, "D")
    return bool(one and np.all(np.is_busday(days)))


def spacing(time: np.ndarray) -> str:
    """What there is to know of steps that differ in length; empty where they are even, or where
    labels are text."""
    if time.dtype.kind not in "iufM" or len(time) < 3:
        return ""
    steps = np.diff(time)
    least, most = steps.min(), steps.max()
    if most / least <= EVEN:
        return ""
    return (
        f"from {_length(least)} to {_length(most)} long by their labels; one row is one step to "
        "the model, whatever they say"
    )


def _length(step: Any) -> str:
    if not isinstance(step, np.timedelta64):
        return f"{step:.6g}"
    seconds = step / np.timedelta64(1, "s")
    for unit, size in (("day", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= size:
            count = f"{seconds / size:.4g}"
            return f"{count} {unit}{'s' if unit == 'day' and count != '1' else ''}"
    return f"{seconds:.4g} s"
