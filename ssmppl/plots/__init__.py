"""What results look like: plots of what the verbs return, and the report of `diagnose`.

    style.py        colours, sizes and the axis of time
    reading.py      results read for drawing: bands over time, data, names
    drawing.py      what the plots of results share: axes, fans, dots, legends
    density.py      densities of draws and of priors
    states.py       plot_states, plot_forecast
    filters.py      plot_filter, plot_ancestry
    predictions.py  plot_predictions
    parameters.py   plot_prior_posterior, plot_maximization
    likelihood.py   plot_likelihood

Of a report:

    panels.py       one function for each panel, on axes that are given
    figure.py       the panels put together
    page.py         the report as one HTML file
    folder.py       everything written to a folder

Importing this package is what gives `GapReport` its `plot` and `save`.
"""

from ssmppl.gap.report import PRESENTERS
from ssmppl.plots.figure import panel_figures, pictures, plot
from ssmppl.plots.filters import plot_ancestry, plot_filter
from ssmppl.plots.folder import save
from ssmppl.plots.likelihood import plot_likelihood
from ssmppl.plots.page import page
from ssmppl.plots.panels import free_run, gap_closed, missing_term, ranked_effects, residual_map
from ssmppl.plots.parameters import plot_maximization, plot_prior_posterior
from ssmppl.plots.predictions import plot_predictions
from ssmppl.plots.states import plot_forecast, plot_states

__all__ = [
    "free_run",
    "gap_closed",
    "missing_term",
    "page",
    "panel_figures",
    "pictures",
    "plot",
    "plot_ancestry",
    "plot_filter",
    "plot_forecast",
    "plot_likelihood",
    "plot_maximization",
    "plot_predictions",
    "plot_prior_posterior",
    "plot_states",
    "ranked_effects",
    "residual_map",
    "save",
]

PRESENTERS["plot"] = plot
PRESENTERS["save"] = save
