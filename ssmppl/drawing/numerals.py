"""Numbers as a reader wants them: rounded to what is known, and NaN as a dash."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ssmppl.data.times import label_text

__all__ = [
    "DASH", "interval", "is_number", "label", "number", "p_text", "percent", "span", "with_error",
]  # fmt: skip

DASH = "–"
SMALLEST_P = 0.001  # below it, only the bound is said


def is_number(value: Any) -> bool:
    """Whether it is a number, and not NaN."""
    try:
        return not math.isnan(float(value))
    except (TypeError, ValueError):
        return False


def number(value: Any, digits: int = 3) -> str:
    """Three digits: 0.0123, 1.23, 12,300, 1.2e-05; with a true minus sign."""
    if not is_number(value):
        return DASH
    x = float(value)
    if math.isinf(x):
        return "∞" if x > 0 else "−∞"
    if x == 0:
        return "0"
    place = digits - 1 - math.floor(math.log10(abs(x)))
    x = round(x, place)
    if abs(x) >= 1e7 or abs(x) < 1e-4:
        text = f"{x:.{digits - 1}e}"
    else:
        text = f"{x:,.{max(place, 0)}f}"
        if "." in text:
            text = text.rstrip("0").rstrip(".")
    return text.replace("-", "−", 1) if x < 0 else text


def with_error(value: Any, error: Any) -> str:
    """Value ± standard error, both to two digits of the error; without error, three digits."""
    if not is_number(value) or not is_number(error) or not 0 < float(error) < math.inf:
        return number(value)
    place = 1 - math.floor(math.log10(float(error)))
    x = round(float(value), place)
    if max(abs(x), float(error)) >= 1e7 or float(error) < 1e-5:
        return f"{number(value)} ± {number(error, 2)}"
    digits = max(place, 0)
    return f"{x:,.{digits}f} ± {round(float(error), place):,.{digits}f}".replace("-", "−")


def percent(share: Any) -> str:
    """0.861 is 86%."""
    if not is_number(share):
        return DASH
    if math.isinf(float(share)):
        return number(share)
    return f"{100 * float(share):,.0f}%".replace("-0%", "0%").replace("-", "−")


def p_text(p: Any) -> str:
    """p = 0.012, or p < 0.001; p unknown for NaN."""
    if not is_number(p):
        return "p unknown"
    x = float(p)
    if x < SMALLEST_P:
        return f"p < {SMALLEST_P}"
    return f"p = {x:.3f}" if x < 0.1 else f"p = {x:.2f}"


def interval(low: Any, high: Any) -> str:
    """The ends of a 95% interval of a share, also where the data bound it on one side or none; NaN
    where the share is of the reference itself."""
    if not (is_number(low) and is_number(high)):
        return "no comparison: the reference is this model itself"
    below, above = math.isinf(float(low)), math.isinf(float(high))
    if below and above:
        return "95% interval: unbounded"
    if above:
        return f"95% interval: at least {percent(low)}"
    if below:
        return f"95% interval: at most {percent(high)}"
    return f"95% interval {percent(low)} to {percent(high)}"


def span(first: Any, last: Any, experiment: Any = "") -> str:
    """A stretch of time by its row labels: t = 411 to 700; dates without an empty clock.

    experiment : "2" or "1 to 3", where there are several.
    """
    ends = [label(end) for end in (first, last)]
    if not all(ends):
        return ""
    if not isinstance(experiment, str) or not experiment:
        return f"t = {ends[0]}" if ends[0] == ends[1] else f"t = {ends[0]} to {ends[1]}"
    a, _, b = experiment.partition(" to ")
    if b:
        return f"t = {ends[0]} of experiment {a} to t = {ends[1]} of experiment {b}"
    return f"{span(first, last)} of experiment {a}"


def label(value: Any) -> str:
    """The label of a row: its time, or its number; "" where there is none."""
    if value is None or (isinstance(value, float) and math.isnan(value)) or str(value) == "NaT":
        return ""
    date = isinstance(value, np.datetime64)  # of nanoseconds it would be a number
    if not date and is_number(value):  # without commas: it may be a year
        x = float(value)
        if x == int(x):
            return str(int(x))
        digits = max(6, len(str(int(abs(x)))) + 3)  # seconds of an epoch have ten in front
        return f"{x:.{digits}g}"
    return label_text(value).removesuffix(" 00:00:00")
