"""Models whose likelihood and smoothing distributions are exact, of either kind."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from ssmppl.data import Experiment
from ssmppl.errors import NotApplicable
from ssmppl.inference.exact.hidden_markov import HiddenMarkov, hidden_markov
from ssmppl.inference.exact.kalman import KalmanModel, kalman_model
from ssmppl.language.trace import Trace

ExactModel = KalmanModel | HiddenMarkov
EXACT = ("kalman", "forward")  # what their filters are called where a proposal is asked for

# The filter behind each, the kind of model, and what its smoother is.
FILTER = {KalmanModel: "kalman", HiddenMarkov: "forward"}
FILTER_NAME = {KalmanModel: "the Kalman filter", HiddenMarkov: "the forward algorithm"}
KIND = {KalmanModel: "linear Gaussian", HiddenMarkov: "of finitely many states"}


def exact_model(trace: Trace) -> ExactModel | NotApplicable:
    """The exact form of a traced model, or why it has none."""
    found = kalman_model(trace)
    if not isinstance(found, NotApplicable):
        return found
    finite = hidden_markov(trace)
    return found if isinstance(finite, NotApplicable) else finite


def filter_of(model: ExactModel) -> str:
    """ "kalman" or "forward"."""
    return FILTER[type(model)]


def filter_name(model: ExactModel) -> str:
    """In words."""
    return FILTER_NAME[type(model)]


def kind_of(model: ExactModel) -> str:
    """ "linear Gaussian" or "of finitely many states"."""
    return KIND[type(model)]


def exact_log_likelihood(
    trace: Trace, experiments: Iterable[Experiment], theta: np.ndarray
) -> float:
    """log p(y | theta), summed over experiments; -inf where there is none, or no exact filter."""
    model = exact_model(trace)
    return -np.inf if isinstance(model, NotApplicable) else model.log_likelihood(experiments, theta)
