"""`plot_components`: what each component of a structural model adds, over time."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ssmppl.compiling import parse
from ssmppl.data.experiments import experiments_of
from ssmppl.data.parameters import check_parameters, unpack_parameters
from ssmppl.errors import ArgumentError, listing
from ssmppl.inference.verbs.predict import group
from ssmppl.language.model.model import Model
from ssmppl.language.tracing import trace
from ssmppl.plots.drawing import dots, fan, handed, key, only_below, panels, shown_time, styled
from ssmppl.plots.reading import (
    bands,
    data_of,
    experiment_name,
    is_dataset,
    is_inference_data,
    wrong_kind,
)
from ssmppl.structural.component import Component, components_of, observations_of

__all__ = ["plot_components"]

WANTED = "give what ssm.sample(..., states=True) or ssm.smooth returns"
NORMAL = (-1.6448536269514722, -0.6744897501960817, 0.0, 0.6744897501960817, 1.6448536269514722)
OVER_DATA = ("level", "trend")  # kinds that are where the data are


@dataclass(frozen=True)
class _Rows:
    """One experiment of a result (T rows), for N draws of its states, or their moments.

    states : by name (N, T), of vectors (d, N, T); of moments N is 1. parameters : (N, 1), of
    vectors (d, N, 1). inputs : (1, T), of vectors (d, 1, T). covariance : (T, D, D) of the
    components of all states, None of draws; labels : (D,) their names and indices.
    """

    name: str
    time: np.ndarray
    states: dict[str, np.ndarray]
    parameters: dict[str, np.ndarray]
    inputs: dict[str, np.ndarray]
    data: dict[str, np.ndarray]
    covariance: np.ndarray | None = None
    labels: tuple[tuple[str, tuple[int, ...]], ...] = ()


@styled
def plot_components(
    model: Any, result: Any, *, components: Any = None, parameters: Any = None, ax: Any = None
) -> Any:
    """What each component of `ssm.structural` adds to the mean, with its 50% and 90% bands.

    The first panel has the data and the sum of the components, where `ssm.structural.observe` wrote
    their observation; the others have one component each. Data are drawn over levels and trends
    too. Of counts the components, and the data, are on the scale of the logarithm; of 0 and 1 the
    components are on that of the log odds, without the data. Several experiments stand side by
    side.

    Parameters
    ----------
    model : the model, with its components.
    result : what `sample` returns, with states; or `smooth`.
    components : names of the components that are drawn; None: all.
    parameters : of `smooth`, the values at which it was called; only where a component reads
        some, as a regression does.
    ax : Matplotlib axes, as many as there are panels; None: a new figure.

    Returns
    -------
    Axes
        Of several panels an array of them, as of `plt.subplots`.

    Raises
    ------
    ArgumentError : the model has no components, or none of such a name; the result is of another
        model, or lacks what they need.
    """
    if not isinstance(model, Model):
        raise ArgumentError(
            f"plot_components was given {type(model).__name__} for the model",
            fix="write ssm.plot_components(model, result)",
        )
    rows = _chosen(model, components)
    found = _records(model, result, rows, parameters)
    axes = panels(
        "plot_components", len(rows), len(found), ax,
        width=8.0 if len(found) == 1 else max(8.0, 3.0 * len(found)),
    )  # fmt: skip
    for record, column in zip(found, axes.T, strict=True):
        for part, one in zip(rows, column, strict=True):
            _draw(model, part, record, one)
        column[0].set_title(record.name)
    only_below(axes)
    key(axes, ax)
    return handed(axes)


def _chosen(model: Model, asked: Any) -> list[Component]:
    """The observations, and the components, that are drawn."""
    known = components_of(model)
    if not known:
        raise ArgumentError(
            f"the model {model.name!r} has no components of ssm.structural",
            fix="write them by ssm.structural.level(model) and its like; ssm.plot_states draws the "
            "states of any model",
        )
    if asked is None:
        return [*observations_of(model).values(), *known.values()]
    given = [asked] if isinstance(asked, (str, Component)) else list(asked)
    names: list[Any] = [n.name if isinstance(n, Component) else n for n in given]
    both = observations_of(model) | known
    for name in names:
        if name not in both:
            raise ArgumentError(
                f"the model {model.name!r} has no component {name!r}",
                fix=f"components= takes: {listing(str(name), both)}",
            )
    return [both[n] for n in dict.fromkeys(names)]


def _draw(model: Model, part: Component, record: _Rows, ax: Any) -> None:
    x = shown_time(ax, record.time)
    fan(ax, x, _bands(part, record))
    channel = part.name if part.kind == "observation" else _channel(model, record)
    link = observations_of(model)[channel].link if channel in observations_of(model) else ""
    if channel in record.data and (part.kind == "observation" or part.kind in OVER_DATA):
        y = record.data[channel]
        if link == "identity":
            dots(ax, x, y)
        elif link == "log":
            with np.errstate(divide="ignore", invalid="ignore"):
                dots(ax, x, np.where(y > 0, np.log(y), np.nan), "data (logarithm)")
    name = part.name
    if part.kind == "observation" and link != "identity":
        name = {"log": f"log mean of {name}", "logit": f"log odds of {name}"}[link]
    ax.set_ylabel(name)


def _channel(model: Model, record: _Rows) -> str:
    """The one channel over which a level is drawn; "" where there are several."""
    names = list(observations_of(model))
    return names[0] if len(names) == 1 and names[0] in record.data else ""


# -- what a component adds
def _bands(part: Component, record: _Rows) -> np.ndarray:
    """(5, T) quantiles at `LEVELS` of `reading.py`."""
    if record.covariance is None:
        return bands(np.broadcast_to(_value(part, record, record.states), _shape(record)))
    mean = _value(part, record, record.states)
    base = _value(part, record, {n: np.zeros_like(v) for n, v in record.states.items()})
    slopes = np.zeros((len(record.labels), len(record.time)))
    for k, (name, index) in enumerate(record.labels):
        if name in part.states:  # a component is linear in the states
            unit = {n: np.zeros_like(v) for n, v in record.states.items()}
            unit[name][index] = 1.0
            slopes[k] = np.broadcast_to(_value(part, record, unit) - base, (1, slopes.shape[1]))[0]
    variance = np.einsum("kt,tkj,jt->t", slopes, record.covariance, slopes)
    sd = np.sqrt(np.maximum(variance, 0.0))
    return np.array([np.broadcast_to(mean, (1, len(sd)))[0] + z * sd for z in NORMAL])


def _shape(record: _Rows) -> tuple[int, int]:
    arrays = (*record.states.values(), *record.parameters.values())
    return max(a.shape[-2] for a in arrays), len(record.time)


def _value(part: Component, record: _Rows, states: Mapping[str, np.ndarray]) -> np.ndarray:
    """(N, T), or what can be broadcast to it."""
    known: dict[str, Any] = {"np": np, "t": np.arange(1.0, len(record.time) + 1.0)[None]}
    known |= {**record.inputs, **record.parameters, **states}
    return np.asarray(eval(compile(parse(part.value, "eval"), "", "eval"), known), dtype=float)


# -- results
def _records(model: Model, result: Any, parts: Sequence[Component], parameters: Any) -> list[_Rows]:
    if is_inference_data(result):
        return _of_posterior(model, result, parts)
    if isinstance(result, Mapping) and not is_dataset(result):
        each = [(experiment_name(str(k)), one) for k, one in result.items()]
    elif isinstance(result, (list, tuple)):
        each = [(f"experiment {k}", r) for k, r in enumerate(result, start=1)]
    else:
        each = [("", result)]
    given = _given(model, parts, parameters)
    return [_of_smoothed(model, name, one, given) for name, one in each]


def _given(model: Model, parts: Sequence[Component], parameters: Any) -> dict[str, np.ndarray]:
    """Values of all parameters, as of a single draw; none where no component reads one."""
    traced = trace(model)
    read = {n for p in parts for n in p.arguments if n in traced.parameters}
    if parameters is None:
        if read:
            raise ArgumentError(
                f"what the components add depends on the parameters {listing('', read)}, which a "
                "smoother's result does not hold",
                fix="give them: ssm.plot_components(model, smoothed, parameters=...)",
            )
        return {}
    values = unpack_parameters(traced, check_parameters(traced, parameters))
    return {n: _column(np.asarray(v)[None]) for n, v in values.items()}


def _of_smoothed(model: Model, name: str, dataset: Any, parameters: dict[str, np.ndarray]) -> _Rows:
    if not is_dataset(dataset):
        raise wrong_kind("plot_components", dataset, WANTED)
    wanted = {n: v.ndim for n, v in trace(model).states.items()}
    missing = [n for n in wanted if n not in dataset]
    if missing or "time" not in dataset.dims:
        raise wrong_kind("plot_components", dataset, WANTED)
    lead = next((d for d in ("trajectory", "draw") if d in dataset[next(iter(wanted))].dims), "")
    states = {n: _over_time(dataset[n], (lead,)) for n in wanted}
    data, inputs = dict[str, np.ndarray](), dict[str, np.ndarray]()
    for n, v in dataset.data_vars.items():
        if str(n).endswith("_observed") and v.dims == ("time",):
            data[str(n).removesuffix("_observed")] = np.asarray(v.values, dtype=float)
        elif str(n).endswith("_input") and v.dims[:1] == ("time",):
            inputs[str(n).removesuffix("_input")] = _input(v.values)
    covariance, labels = None, tuple[tuple[str, tuple[int, ...]], ...]()
    if lead == "draw":
        if "covariance" not in dataset:
            raise ArgumentError(
                "the result has the moments of single states, and a component may be a sum",
                fix="give draws: ssm.smooth(..., trajectories=500)",
            )
        covariance = dataset["covariance"].isel(draw=0).transpose("time", "state", "state_").values
        labels = tuple((s.data[1], s.data[2]) for s in trace(model).state_symbols)
    return _Rows(name, dataset["time"].values, states, parameters, inputs, data, covariance, labels)


def _of_posterior(model: Model, idata: Any, parts: Sequence[Component]) -> list[_Rows]:
    posterior = group(idata, "posterior")
    if posterior is None:
        raise wrong_kind("plot_components", idata, WANTED)
    traced, found = trace(model), []
    others = [group(idata, name) for name in ("observed_data", "constant_data")]
    data = [[one for _, one in experiments_of(g)] if g is not None else [] for g in others]
    fixed = json.loads(posterior.attrs.get("fixed", "{}"))
    for i, (label, own) in enumerate(experiments_of(posterior)):
        lead = ("chain", "draw")
        parameters = {}
        for name in traced.parameters:
            if name in own:
                values = own[name].transpose(*lead, ...).values
                parameters[name] = _column(values.reshape(-1, *values.shape[2:]))
            elif name in fixed:
                parameters[name] = _column(np.asarray(fixed[name], dtype=float)[None])
        states = {
            n: _over_time(own[n], lead) for n in traced.states if n in own and "time" in own[n].dims
        }
        needed = {n for p in parts for n in p.states}
        if needed - set(states):
            raise ArgumentError(
                f"the posterior holds no draws of {listing('', needed - set(states))}",
                fix="sample with states=True; for the states at given parameters take ssm.smooth",
            )
        inputs = {}
        if data[1]:
            inputs = {
                str(n): _input(v.transpose("time", ...).values)
                for n, v in data[1][i].data_vars.items()
                if "time" in v.dims
            }
        measured = data_of(data[0][i] if data[0] else None)
        length = next(iter(states.values())).shape[-1] if states else len(own["time"])
        time = own["time"].values[:length]
        found.append(_Rows(experiment_name(label), time, states, parameters, inputs, measured))
    return found


def _over_time(variable: Any, lead: tuple[str, ...]) -> np.ndarray:
    """(N, T), or (d, N, T) of a vector."""
    values = variable.transpose(*lead, "time", ...).values
    values = values.reshape(-1, *values.shape[len(lead) :])
    return np.moveaxis(values, -1, 0) if values.ndim == 3 else values


def _column(values: np.ndarray) -> np.ndarray:
    """(N,) or (N, d) as (N, 1) or (d, N, 1)."""
    return values[:, None] if values.ndim == 1 else np.moveaxis(values, -1, 0)[..., None]


def _input(values: Any) -> np.ndarray:
    """(T,) or (T, d) as (1, T) or (d, 1, T)."""
    array = np.asarray(values, dtype=float)
    return array[None] if array.ndim == 1 else np.moveaxis(array, -1, 0)[:, None]
