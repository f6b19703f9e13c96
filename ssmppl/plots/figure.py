"""The panels of a report put together: one figure of all, or one figure for each."""

from __future__ import annotations

import io
from typing import Any

from ssmppl.gap.numerals import is_number
from ssmppl.gap.report import GapReport
from ssmppl.plots.panels import (
    bars,
    curves,
    free_run,
    gap_closed,
    mapped,
    missing_term,
    ranked_effects,
    residual_map,
    runs,
)  # fmt: skip
from ssmppl.plots.style import look

__all__ = ["TITLES", "panel_figures", "pictures", "plot"]

TITLES = {
    "residual_map": "Where the model and the data disagree",
    "ranked_effects": "Effects that were tried, best first",
    "gap_closed": "How much of the gap each closes",
    "missing_term": "What is missing, as estimated",
    "free_run": "Simulated without seeing the data",
}

WIDE = 6.0  # inches, from which curves stand side by side
DESK = 7.4  # inches: what a column of text is wide
DPI = 170
MOST_CURVES = 4
MOST_RUNS = 6


def plot(report: GapReport) -> Any:
    """All panels that the report has something for, below each other, as a pyplot figure."""
    from matplotlib import pyplot

    with look():
        width = 8.0
        sizes = {name: height for name in TITLES if (height := _height(report, name, width))}
        figure = pyplot.figure(figsize=(width, sum(sizes.values()) or 1.0), layout="constrained")
        if not sizes:
            figure.text(0.5, 0.5, "Nothing to draw.", ha="center", va="center")
            return figure
        parts = figure.subfigures(len(sizes), 1, height_ratios=list(sizes.values()), squeeze=False)
        for (name, _), part in zip(sizes.items(), parts[:, 0], strict=True):
            part.suptitle(TITLES[name], x=0.01, ha="left", weight="bold", fontsize=10.5)
            _draw(report, name, part, width)
    return figure


def panel_figures(report: GapReport, width: float) -> dict[str, Any]:
    """Each panel that the report has something for, as a figure of its own, `width` inches wide.

    The figures belong to no window, and need not be closed.
    """
    from matplotlib.figure import Figure

    found: dict[str, Any] = {}
    with look():
        for name in TITLES:
            with report.failures.part(f"the panel {name!r}"):
                height = _height(report, name, width)
                if height:
                    figure = Figure(figsize=(width, height), layout="constrained")
                    _draw(report, name, figure, width)
                    found[name] = figure
    return found


def pictures(report: GapReport, width: float = DESK) -> dict[str, bytes]:
    """`panel_figures` as PNG files."""
    found = {}
    for name, figure in panel_figures(report, width).items():
        with report.failures.part(f"the panel {name!r}"):
            buffer = io.BytesIO()
            figure.savefig(buffer, format="png", dpi=DPI)
            found[name] = buffer.getvalue()
    return found


def _height(report: GapReport, name: str, width: float) -> float:
    """In inches; 0 where there is nothing to draw."""
    if name == "residual_map":
        return 0.7 + 0.3 * max(len(mapped(report)), 3) if len(report.residual_map) else 0.0
    if name == "ranked_effects":
        return 0.75 + 0.42 * len(bars(report)) if len(report.causes) else 0.0
    if name == "gap_closed":
        shown = sum(is_number(f) for f in report.closed["F"])
        return 0.75 + 0.42 * min(shown, 8) if shown else 0.0
    if name == "missing_term":
        lines, _ = _grid(len(curves(report)[:MOST_CURVES]), width)
        return 2.4 * lines
    count = len(runs(report)[:MOST_RUNS])
    return 0.5 + 2.0 * count if count else 0.0


def _grid(count: int, width: float) -> tuple[int, int]:
    across = 1 if width < WIDE or count < 2 else 2
    return -(-count // across), across


def _draw(report: GapReport, name: str, figure: Any, width: float) -> None:
    if name == "missing_term":
        known = curves(report)[:MOST_CURVES]
        axes = figure.subplots(*_grid(len(known), width), squeeze=False).ravel()
        for ax, (equation, variable) in zip(axes, known, strict=False):
            missing_term(report, ax, equation, variable)
        for ax in axes[len(known) :]:
            ax.set_axis_off()
    elif name == "free_run":
        known = runs(report)[:MOST_RUNS]
        axes = figure.subplots(len(known), 1, squeeze=False).ravel()
        for ax, (experiment, channel) in zip(axes, known, strict=True):
            free_run(report, ax, experiment, channel)
            if ax is not axes[-1]:
                ax.set_xlabel("")
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower left", ncols=3, frameon=False,
                      handlelength=1.6, columnspacing=1.2, borderaxespad=0.2)  # fmt: skip
    else:
        panel = {
            "residual_map": residual_map,
            "ranked_effects": ranked_effects,
            "gap_closed": gap_closed,
        }[name]
        panel(report, figure.subplots())
