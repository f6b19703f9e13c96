"""What a call counts and measures: whole numbers and others within their range, and whether the
machine's memory holds that many."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from numbers import Real
from typing import Any

import numpy as np

from ssmppl.errors import ArgumentError


def check_count(name: str, value: Any, least: int) -> None:
    """Refuse what is no whole number of at least `least`, or more than memory holds."""
    whole = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    if not whole or value < least:
        fix = f"give a whole number of at least {least}"
        if isinstance(value, (float, np.floating)) and value >= least and value == value // 1:
            fix = f"write {name}={int(value)}, a whole number"
        raise ArgumentError(f"{name}={value!r}", fix=fix)
    check_room(f"{name}={value}", value, f"give a smaller {name}=")


def check_number(
    name: str, value: Any, fits: Callable[[float], bool], fix: str, *, infinite: bool = False
) -> None:
    """Refuse what is no number, or one that does not fit; NaN never does.

    infinite : whether one beyond all bounds may fit.
    """
    if not isinstance(value, Real) or isinstance(value, bool):
        raise ArgumentError(f"{name}={value!r}", fix=fix)
    try:
        number = float(value)
    except OverflowError:  # a whole number or fraction beyond the range of float
        number = math.nan
    if math.isnan(number) or (math.isinf(number) and not infinite) or not fits(number):
        raise ArgumentError(f"{name}={value!r}", fix=fix)


def check_room(what: str, numbers: int, fix: str) -> None:
    """Refuse what takes more memory than the machine has: it would be ended by the system.

    what : which arguments ask for it, as the user wrote them.
    numbers : how many floating-point numbers of 8 bytes are held at a time, at least.
    """
    wanted, there = 8 * int(numbers), memory()
    if there is not None and wanted > there:
        raise ArgumentError(
            f"{what}: {_gigabytes(wanted)} of numbers, and this machine's memory is "
            f"{_gigabytes(there)}",
            fix=fix,
        )


def memory() -> int | None:
    """Bytes of this machine's memory; None where the system does not tell."""
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):  # Windows, and whatever knows no such name
        return None


def _gigabytes(size: int) -> str:
    return f"{size / 1e9:,.0f} GB" if size >= 1e10 else f"{size / 1e9:.1f} GB"
