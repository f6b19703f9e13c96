"""Models whose likelihood and smoothing distributions need no particles, of each kind: exact ones,
and, by an approximation, those that call a simulator."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from ssmppl.data import Experiment
from ssmppl.errors import NotApplicable
from ssmppl.inference.batched.extended import Extended, extended_model
from ssmppl.inference.exact.hidden_markov import HiddenMarkov, hidden_markov
from ssmppl.inference.exact.kalman import KalmanModel, kalman_model
from ssmppl.inference.particles.deterministic import Deterministic, deterministic_model
from ssmppl.inference.run.problem import EXACT
from ssmppl.language.model.trace import Trace

ExactModel = KalmanModel | HiddenMarkov | Deterministic | Extended

# What the filter behind each is called where a proposal is asked for, and in words; the kind of
# model; and what finds it.
FILTER = dict(zip((KalmanModel, HiddenMarkov, Deterministic, Extended), EXACT, strict=True))
FILTER_NAME = {
    KalmanModel: "the Kalman filter",
    HiddenMarkov: "the forward algorithm",
    Deterministic: "one deterministic simulation",
    Extended: "the extended Kalman filter",
}
KIND = {
    KalmanModel: "linear Gaussian",
    HiddenMarkov: "finite-state (hidden Markov)",
    Deterministic: "noise-free in its states",
    Extended: "one that calls a simulator",
}
NEEDED = {
    "kalman": "linear Gaussian model",
    "forward": "finite-state (hidden Markov) model",
    "deterministic": "model with noise-free states",
    "extended": "model that calls a simulator",
}
_FORMS: dict[str, Callable[[Trace], ExactModel | NotApplicable]] = {
    "kalman": kalman_model,
    "forward": hidden_markov,
    "deterministic": deterministic_model,
    "extended": extended_model,
}


def exact_model(trace: Trace) -> ExactModel | NotApplicable:
    """The exact form of a traced model, or, where it calls a simulator, its extended Kalman filter;
    or why it has none."""
    first = kalman_model(trace)
    if not isinstance(first, NotApplicable):
        return first
    others = (hidden_markov(trace), deterministic_model(trace), extended_model(trace))
    return next((m for m in others if not isinstance(m, NotApplicable)), first)


def form_of(proposal: str, trace: Trace) -> ExactModel | NotApplicable:
    """The exact form that a filter of `EXACT` needs, or why the model does not have it."""
    return _FORMS[proposal](trace)


def filter_of(model: ExactModel) -> str:
    """ "kalman", "forward", "deterministic" or "extended"."""
    return FILTER[type(model)]


def filter_name(model: ExactModel) -> str:
    """The name of the filter behind a model, in words."""
    return FILTER_NAME[type(model)]


def likelihood_by(model: ExactModel) -> str:
    """What its likelihood is: "exact, by the Kalman filter"."""
    kind = "approximate" if isinstance(model, Extended) else "exact"
    return f"{kind}, by {filter_name(model)}"


def exact_kind(model: ExactModel | NotApplicable) -> str | NotApplicable:
    """ "linear Gaussian", "finite-state (hidden Markov)" or "noise-free in its states"; of a model
    that is not exact, why not."""
    return model if isinstance(model, NotApplicable) else KIND[type(model)]


def log_increments(
    model: ExactModel, experiments: Iterable[Experiment], theta: np.ndarray
) -> list[np.ndarray]:
    """log p(y_t | y_{1:t-1}, theta) of each experiment, (T,).

    Raises
    ------
    SamplingError : the distributions have no density at theta; names the step and the parameters.
    """
    return [model.filter(e, theta).log_increments for e in experiments]


def exact_log_likelihood(
    trace: Trace, experiments: Iterable[Experiment], theta: np.ndarray
) -> float:
    """log p(y | theta), summed over experiments; -inf where there is none, or no exact filter."""
    model = exact_model(trace)
    return -np.inf if isinstance(model, NotApplicable) else model.log_likelihood(experiments, theta)
