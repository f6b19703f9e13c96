"""Labels of rows, dates above all, as people write them; and whether they are evenly spaced."""

from __future__ import annotations

from typing import Any

import numpy as np

__all__ = ["label_text", "spacing"]

EVEN = 1.2  # months and years are not all as long as each other, and are even all the same


def label_text(label: Any) -> str:
    """A row's label: of a date no more than it says, `2024-03-01` or `2024-03-01T06:30:00`."""
    text = str(label)
    if not isinstance(label, np.datetime64):
        return text
    clock = text.partition("T")[2]
    if "." in clock:
        text = text.rstrip("0").rstrip(".")
    return text.removesuffix("T00:00:00").removesuffix("T00:00")


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
