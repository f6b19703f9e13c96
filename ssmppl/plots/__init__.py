"""What results look like: plots of what the verbs return.

    reading.py      results read for drawing: bands over time, data, names
    drawing.py      what the plots of results share: axes, fans, dots, legends
    density.py      densities of draws and of priors
    states.py       plot_states, plot_forecast
    filters.py      plot_filter, plot_ancestry
    predictions.py  plot_predictions
    parameters.py   plot_prior_posterior, plot_maximization
    model.py        plot_model
    structure.py    plot_components
    likelihood.py   plot_likelihood

The panels of a report of `diagnose` are under these names too; they stand in
`ssmppl.diagnosis.report`.
"""

from ssmppl.diagnosis.report.folder import save
from ssmppl.diagnosis.report.page import page
from ssmppl.diagnosis.report.panels import (
    free_run,
    gap_closed,
    missing_term,
    panel_figures,
    pictures,
    plot,
    ranked_effects,
    residual_map,
    separating_signal,
)
from ssmppl.plots.filters import plot_ancestry, plot_filter
from ssmppl.plots.likelihood import plot_likelihood
from ssmppl.plots.model import plot_model
from ssmppl.plots.parameters import plot_maximization, plot_prior_posterior
from ssmppl.plots.predictions import plot_predictions
from ssmppl.plots.states import plot_forecast, plot_states
from ssmppl.plots.structure import plot_components

__all__ = [
    "free_run", "gap_closed", "missing_term", "page", "panel_figures", "pictures", "plot",
    "plot_ancestry", "plot_components", "plot_filter", "plot_forecast", "plot_likelihood",
    "plot_maximization", "plot_model", "plot_predictions", "plot_prior_posterior", "plot_states",
    "ranked_effects", "residual_map", "save", "separating_signal",
]  # fmt: skip
