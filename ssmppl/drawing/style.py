"""Colours, sizes and the axis of time, shared by the panels.

Colours are those of Okabe and Ito (2008), which the colour-blind can tell apart; line styles and
hatching say the same again, for print in black and white.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

__all__ = [
    "AFTER", "BEFORE", "DATA", "FAINT", "INK", "MAIN", "OTHER", "RC", "SIGNED", "bare", "look",
    "times",
]  # fmt: skip

INK = "#222222"
FAINT = "#8a8a8a"
DATA = "#333333"
BEFORE = "#D55E00"  # vermilion, dashed
AFTER = "#0072B2"  # blue, solid
MAIN, OTHER = AFTER, BEFORE  # of plots of a result: what it says; what it is compared with
SIGNED = "RdBu_r"

RC: dict[Any, Any] = {
    "font.size": 9.0,
    "axes.titlesize": 9.0,
    "axes.titlelocation": "left",
    "axes.labelsize": 9.0,
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "legend.fontsize": 8.5,
    "axes.edgecolor": FAINT,
    "axes.labelcolor": INK,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "axes.linewidth": 0.7,
    "figure.facecolor": "white",
    "axes.facecolor": "white",
    "savefig.facecolor": "white",
    "hatch.linewidth": 0.6,
}


@contextlib.contextmanager
def look() -> Iterator[None]:
    """Draw in the look of the project, and leave the user's settings as they were.

    Only the settings of `RC` are put back: the first figure of a notebook loads the backend, which
    turns the interactive mode on, and `rc_context` would turn it off again, for good.
    """
    import matplotlib as mpl

    before = {name: mpl.rcParams[name] for name in RC}
    mpl.rcParams.update(RC)
    try:
        yield
    finally:
        mpl.rcParams.update(before)


def bare(ax: Any, keep: Iterable[str] = ("left", "bottom")) -> None:
    """Only the named sides of the frame."""
    for side, spine in ax.spines.items():
        spine.set_visible(side in keep)


def times(ax: Any, values: Any) -> np.ndarray:
    """Row labels as positions on the x axis: numbers, dates, or else their order of appearance."""
    import pandas as pd

    series = pd.Series(values).reset_index(drop=True)
    if pd.api.types.is_datetime64_any_dtype(series):
        from matplotlib.dates import AutoDateLocator, ConciseDateFormatter, date2num

        # its steps of months reach six, and from three years on it takes years: seven ticks cover
        # every span, where fewer leave gaps that it warns of
        locator = AutoDateLocator(minticks=3, maxticks=7)
        ax.xaxis.set_major_locator(locator)
        ax.xaxis.set_major_formatter(ConciseDateFormatter(locator))
        dates: np.ndarray = date2num(series.dt.to_pydatetime())
        return dates
    numbers = pd.to_numeric(series, errors="coerce")
    if numbers.notna().all():
        return numbers.to_numpy(float)
    codes, labels = pd.factorize(series)
    some = np.unique(np.linspace(0, len(labels) - 1, 5).astype(int))
    ax.set_xticks(some, [str(labels[i]) for i in some])
    return codes.astype(float)
