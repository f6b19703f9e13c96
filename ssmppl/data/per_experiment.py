"""Parameters of which each experiment has its own, `@model.prior(per="experiment")`: the trace of a
model over the experiments of some data, and in each data set the number of its experiment."""

from __future__ import annotations

from typing import Any

from ssmppl.data.experiments import EXPERIMENT, split
from ssmppl.data.sources import Source
from ssmppl.errors import DataError, listing
from ssmppl.language.model.model import Model
from ssmppl.language.model.trace import Trace
from ssmppl.language.tracing import trace


def trace_over(model: Model, data: Any) -> Trace:
    """The trace of a model whose parameters per experiment are those of the experiments in `data`,
    where these are several, or are one in a list.

    Raises
    ------
    ModelError, DataError : a rule of the language is broken; the data name no experiments.
    """
    traced = trace(model)
    if data is None or not traced.per_experiment:
        return traced
    parts = split(data, [*traced.observations, *traced.inputs], traced.experiment, "data")
    if not parts:
        return traced
    return trace(model, tuple(_label(label, k) for k, (label, _) in enumerate(parts)))


def trace_of_results(model: Model, group: Any, data: Any = None) -> Trace:
    """The trace over the experiments that results (a group of them) are of; of results without
    that dim over those in `data`."""
    if EXPERIMENT not in getattr(group, "dims", ()) or not trace(model).per_experiment:
        return trace_over(model, data)
    return trace(model, tuple(group[EXPERIMENT].values.tolist()))


def experiment_number(trace: Trace, source: Source, k: int) -> float:
    """That of the k-th data set; 0 where no parameters are of each experiment.

    Raises
    ------
    DataError : its label is none of those that the parameters are of.
    """
    return float(number_of(trace, _label(source.experiment, k))) if trace.experiments else 0.0


def number_of(trace: Trace, label: Any) -> int:
    """Of an experiment by its label.

    Raises
    ------
    DataError : the parameters are not of it.
    """
    if label not in trace.experiments:
        names = listing(str(label), list(map(str, trace.experiments)))
        raise DataError(
            f"{trace.per_experiment[0]!r} has no value for the experiment {label!r}",
            fix=f"give data of these: {names}",
        )
    return trace.experiments.index(label)


def _label(label: Any, k: int) -> Any:
    return k + 1 if label is None else label
