"""What the plots of results share: axes in a grid, fans, dots of data, legends."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import numpy as np

from ssmppl.drawing.style import DATA, MAIN, bare, look, times
from ssmppl.errors import ArgumentError, warn

__all__ = [
    "MOST_PANELS", "dots", "fan", "few", "handed", "key", "line", "multiples", "only_below",
    "panels", "shown_time", "styled",
]  # fmt: skip

Plot = TypeVar("Plot", bound=Callable[..., Any])
MOST_PANELS = 24  # of small multiples
WIDTH = 8.0  # inches, of a figure
ROW = 1.65  # inches, of a panel over time


def styled(plot: Plot) -> Plot:
    """Draw in the look of the project, and leave the user's settings as they were."""

    @functools.wraps(plot)
    def inside(*args: Any, **kwargs: Any) -> Any:
        with look():
            return plot(*args, **kwargs)

    return inside  # type: ignore[return-value]


def panels(
    verb: str, rows: int, columns: int, ax: Any, *, height: float = ROW, width: float = WIDTH,
    share: bool = True, ratios: Sequence[float] | None = None,
) -> np.ndarray:  # fmt: skip
    """Axes (rows, columns): those that are given, or those of a new figure.

    share : whether the axes of a column of a new figure have one x axis.

    Raises
    ------
    ArgumentError : what is given are no axes, or not as many as there are panels.
    """
    if ax is None:
        from matplotlib import pyplot

        height = rows * height + (1.0 if rows == 1 else 0.6)
        figure = pyplot.figure(figsize=(width, height), layout="constrained")
        found = figure.subplots(
            rows, columns, squeeze=False, sharex="col" if share else False, width_ratios=ratios
        )
        if share:
            for one in found[:-1].ravel():
                one.tick_params(labelbottom=False)
        return np.asarray(found)
    given = np.asarray(ax, dtype=object)
    for one in given.ravel():
        if not hasattr(one, "fill_between"):
            raise ArgumentError(
                f"ax= of {verb} holds {type(one).__name__}", fix="give Matplotlib axes, or None"
            )
    if given.size != rows * columns:
        raise ArgumentError(
            f"{verb} has {rows * columns} panels to draw ({rows} by {columns}), and ax= holds "
            f"{given.size} axes",
            fix=f"give as many, plt.subplots({rows}, {columns})[1]; choose fewer panels by "
            "var_names=; or leave ax out for a figure of its own",
        )
    return given.reshape(rows, columns)


def multiples(
    verb: str, count: int, ax: Any, *, share: bool = True, height: float = ROW
) -> np.ndarray:
    """Axes (count,) of small multiples: those that are given, or in a grid of a new figure."""
    if ax is not None:
        return panels(verb, count, 1, ax)[:, 0]
    if share:
        columns = 1 if count <= 4 else 2 if count <= 8 else 3
    else:
        columns = 2 if count in (2, 4) else min(count, 3)
    rows = -(-count // columns)
    found = panels(verb, rows, columns, None, share=share, height=height).ravel()
    for spare in found[count:]:
        spare.set_axis_off()
    if share:
        for one in found[max(count - columns, 0) : count]:
            one.tick_params(labelbottom=True)
    return found[:count]


def handed(axes: np.ndarray) -> Any:
    """One Axes as it is, more of them as an array without empty dimensions, as `plt.subplots`."""
    return axes.item() if axes.size == 1 else np.squeeze(axes)


def only_below(axes: np.ndarray) -> None:
    """Leave the name of the x axis to the panels at the lower end of their column."""
    for one in axes.ravel():
        if not one.xaxis.get_tick_params().get("labelbottom", True):
            one.set_xlabel("")


def few(labels: list[str], verb: str) -> list[str]:
    """The first of too many panels, with a warning that says so."""
    if len(labels) > MOST_PANELS:
        warn(
            f"{verb} draws the first {MOST_PANELS} of {len(labels)} variables; choose others by "
            "var_names="
        )
    return labels[:MOST_PANELS]


def shown_time(ax: Any, labels: np.ndarray) -> np.ndarray:
    """Row labels as positions on the x axis, which is named."""
    found = times(ax, labels)
    whole = np.arange(1, len(labels) + 1)
    plain = np.issubdtype(labels.dtype, np.integer) and np.array_equal(labels, whole)
    ax.set_xlabel("t" if plain else "time")
    ax.margins(x=0.01)
    return found


def fan(ax: Any, x: np.ndarray, quantiles: np.ndarray, colour: str = MAIN, style: str = "-",
        label: str = "median, 50% and 90%") -> None:  # fmt: skip
    """Bands between the outer and the inner of five quantiles (5, T), and a line in the middle."""
    ax.fill_between(x, quantiles[0], quantiles[4], color=colour, alpha=0.18, linewidth=0)
    ax.fill_between(x, quantiles[1], quantiles[3], color=colour, alpha=0.30, linewidth=0)
    marker = "." if len(x) < 2 else None
    if marker:  # a single row has no area between curves
        ax.vlines(x, quantiles[0], quantiles[4], color=colour, alpha=0.25, linewidth=5)
    ax.plot(x, quantiles[2], style, color=colour, linewidth=1.3, marker=marker, label=label)
    bare(ax)


def line(ax: Any, x: np.ndarray, y: np.ndarray, steps: bool = False) -> None:
    """A measured input, held from row to row."""
    ax.plot(x, y, color=DATA, linewidth=1.0, drawstyle="steps-post" if steps else "default")
    bare(ax)


def dots(ax: Any, x: np.ndarray, y: np.ndarray, label: str = "data") -> None:
    """Measurements; the missing ones are left out."""
    seen = np.isfinite(y)
    bare(ax)
    if not seen.any():
        return
    ax.plot(x[seen], y[seen], ".", color=DATA, markersize=3.5 if len(x) < 400 else 2.0,
            label=label, zorder=2.5)  # fmt: skip


def key(axes: np.ndarray, given: Any) -> None:
    """One legend for all panels: below a figure of our own, inside of the first of axes given."""
    entries: dict[str, Any] = {}
    for one in axes.ravel():
        handles, labels = one.get_legend_handles_labels()
        for handle, label in zip(handles, labels, strict=True):
            entries.setdefault(label, handle)
    if given is not None:
        if entries:
            axes.ravel()[0].legend(entries.values(), entries.keys(), loc="best", framealpha=0.8,
                                   edgecolor="none")  # fmt: skip
        return
    figure = axes.ravel()[0].figure
    if entries:
        figure.legend(entries.values(), entries.keys(), loc="outside lower left", frameon=False,
                      ncols=len(entries), handlelength=1.6, columnspacing=1.2, borderaxespad=0.2,
                      )  # fmt: skip
    figure.align_ylabels(list(axes.ravel()))
