"""Models whose likelihood and smoothing distributions are exact, of each kind."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from ssmppl.data import Experiment
from ssmppl.errors import NotApplicable
from ssmppl.inference.exact.hidden_markov import HiddenMarkov, hidden_markov
from ssmppl.inference.exact.kalman import KalmanModel, kalman_model
from ssmppl.inference.particles.deterministic import Deterministic, deterministic_model
from ssmppl.inference.run.problem import EXACT
from ssmppl.language.model.trace import Trace

ExactModel = KalmanModel | HiddenMarkov | Deterministic

# What the filter behind each is called where a proposal is asked for, and in words; the kind of
# model; and what finds it.
FILTER = dict(zip((KalmanModel, HiddenMarkov, Deterministic), EXACT, strict=True))
FILTER_NAME = {
    KalmanModel: "the Kalman filter",
    HiddenMarkov: "the forward algorithm",
    Deterministic: "running the states once",
}
KIND = {
    KalmanModel: "linear Gaussian",
    HiddenMarkov: "of finitely many states",
    Deterministic: "without noise in its states",
}
NEEDED = {
    "kalman": "linear Gaussian model",
    "forward": "model of finite states",
    "deterministic": "model without noise in its states",
}
_FORMS: dict[str, Callable[[Trace], ExactModel | NotApplicable]] = {
    "kalman": kalman_model,
    "forward": hidden_markov,
    "deterministic": deterministic_model,
}


def exact_model(trace: Trace) -> ExactModel | NotApplicable:
    """The exact form of a traced model, or why it has none."""
    first = kalman_model(trace)
    if not isinstance(first, NotApplicable):
        return first
    others = (hidden_markov(trace), deterministic_model(trace))
    return next((m for m in others if not isinstance(m, NotApplicable)), first)


def form_of(proposal: str, trace: Trace) -> ExactModel | NotApplicable:
    """The exact form that a filter of `EXACT` needs, or why the model does not have it."""
    return _FORMS[proposal](trace)


def filter_of(model: ExactModel) -> str:
    """ "kalman", "forward" or "deterministic"."""
    return FILTER[type(model)]


def filter_name(model: ExactModel) -> str:
    """In words."""
    return FILTER_NAME[type(model)]


def exact_kind(model: ExactModel | NotApplicable) -> str | NotApplicable:
    """ "linear Gaussian", "of finitely many states" or "without noise in its states"; of a model
    that is not exact, why not."""
    return model if isinstance(model, NotApplicable) else KIND[type(model)]


def exact_log_likelihood(
    trace: Trace, experiments: Iterable[Experiment], theta: np.ndarray
) -> float:
    """log p(y | theta), summed over experiments; -inf where there is none, or no exact filter."""
    model = exact_model(trace)
    return -np.inf if isinstance(model, NotApplicable) else model.log_likelihood(experiments, theta)
