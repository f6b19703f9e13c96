"""What a report of `diagnose` looks like: its panels, its figure, its page, its folder.

    style.py    colours, sizes and the axis of time
    panels.py   one function for each panel, on axes that are given
    figure.py   the panels put together
    page.py     the report as one HTML file
    folder.py   everything written to a folder

Importing this package is what gives `GapReport` its `plot` and `save`.
"""

from ssmppl.gap.report import PRESENTERS
from ssmppl.plots.figure import panel_figures, pictures, plot
from ssmppl.plots.folder import save
from ssmppl.plots.page import page
from ssmppl.plots.panels import free_run, gap_closed, missing_term, ranked_effects, residual_map

__all__ = [
    "free_run",
    "gap_closed",
    "missing_term",
    "page",
    "panel_figures",
    "pictures",
    "plot",
    "ranked_effects",
    "residual_map",
    "save",
]

PRESENTERS["plot"] = plot
PRESENTERS["save"] = save
