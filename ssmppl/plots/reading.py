"""What results hold, read for drawing: bands over time, the data, and the names of it all.

A result comes in several forms: InferenceData (or a DataTree) of `sample`, a Dataset of draws or of
moments, or a list of those for several experiments. Here each experiment becomes one `Record`.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ssmppl.data.experiments import experiments_of
from ssmppl.errors import ArgumentError, listing
from ssmppl.inference.verbs.predict import group
from ssmppl.tables import quantiles_of

__all__ = [
    "LEVELS",
    "Record",
    "bands",
    "components",
    "data_of",
    "drawn_of",
    "experiment_name",
    "group_of",
    "is_dataset",
    "is_inference_data",
    "is_prediction",
    "observed_states",
    "pick",
    "quantiles_at_levels",
    "records",
    "wrong_kind",
]

LEVELS = (0.05, 0.25, 0.5, 0.75, 0.95)  # the ends of the bands, and the median
_UNNAMED = re.compile(r".*_dim_\d+")  # a dim whose components have numbers for names
STATES_FROM = "give what ssm.sample(..., states=True), ssm.smooth or a filter returns"


@dataclass(frozen=True)
class Record:
    """One experiment as it is drawn (T rows); all names are those of scalars, as `x[0]`.

    name : of the experiment, "experiment 2" by its number; "" where there is one only.
    time : (T,) labels. states : quantiles (5, T) at `LEVELS`. data, inputs : (T,), NaN if missing.
    observes : of a component of the data, the state that is its mean.
    """

    name: str
    time: np.ndarray
    states: dict[str, np.ndarray]
    data: dict[str, np.ndarray] = field(default_factory=dict)
    inputs: dict[str, np.ndarray] = field(default_factory=dict)
    observes: dict[str, str] = field(default_factory=dict)


def is_inference_data(result: Any) -> bool:
    """Whether it has groups: ArviZ's InferenceData, or a DataTree."""
    return callable(getattr(result, "groups", None)) or hasattr(result, "children")


def is_dataset(result: Any) -> bool:
    """Whether it is one xarray Dataset."""
    return hasattr(result, "data_vars") and not is_inference_data(result)


def wrong_kind(verb: str, result: Any, fix: str) -> ArgumentError:
    """The error of a plot that was given something else than what it draws."""
    found = f"{type(result).__name__}"
    if is_dataset(result):
        found = f"a Dataset of {listing('', map(str, result.data_vars))}"
    elif is_inference_data(result):
        found = f"{found} with the groups {listing('', map(str, _group_names(result)))}"
    return ArgumentError(f"{verb} cannot draw {found}", fix=fix)


def _group_names(result: Any) -> list[str]:
    names = result.groups() if callable(getattr(result, "groups", None)) else result.children
    return [str(n).strip("/") for n in names]


def group_of(verb: str, result: Any, name: str, fix: str) -> Any:
    """A group of an InferenceData as a Dataset.

    Raises
    ------
    ArgumentError : it is not there; tells which groups are.
    """
    found = group(result, name) if is_inference_data(result) else None
    if found is None:
        raise wrong_kind(verb, result, fix)
    return found


def components(
    name: str, values: np.ndarray, leading: int, like: Any = None
) -> Iterator[tuple[str, np.ndarray]]:
    """(label, values) of each scalar of a variable, whose first `leading` axes are kept.

    like : the variable of a result, whose dims name the components; None: by their numbers.
    """
    further = values.ndim - leading
    dims = [] if like is None else list(like.dims)[like.ndim - further :]
    names: list[Any] = [None if _UNNAMED.fullmatch(str(d)) else like[d].values for d in dims]
    names = names or [None] * further
    for index in np.ndindex(values.shape[leading:]):
        own = [i if k is None else k[i] for i, k in zip(index, names, strict=True)]
        label = name + (f"[{', '.join(map(str, own))}]" if index else "")
        yield label, values[(slice(None),) * leading + index]


def pick(labels: Iterable[str], var_names: Any, what: str) -> list[str]:
    """Those of `labels` that `var_names` asks for, by a variable's name or a component's label.

    Raises
    ------
    ArgumentError : a name that is not among them; lists those that are.
    """
    labels = list(labels)
    if var_names is None:
        return labels
    asked = [var_names] if isinstance(var_names, str) else list(var_names)
    found: list[str] = []
    for name in asked:
        own = [k for k in labels if k == name or k.split("[")[0] == name]
        if not own:
            known = dict.fromkeys(k.split("[")[0] for k in labels)
            raise ArgumentError(
                f"there is no {name!r} among {what}",
                fix=f"var_names= takes: {listing(str(name), known)}"
                + (", or a component such as " + repr(labels[0]) if "[" in labels[0] else "")
                if labels
                else "leave var_names= out",
            )
        found += [k for k in own if k not in found]
    return found


def bands(draws: np.ndarray) -> np.ndarray:
    """(5, ...) quantiles at `LEVELS` of draws along the first axis."""
    return quantiles_of(draws, LEVELS)


def observed_states(attrs: Any) -> dict[str, str]:
    """The attribute `observes` of a result; empty where it has none."""
    text = attrs.get("observes", "{}")
    found = json.loads(text) if isinstance(text, str) else dict(text)
    return {str(k): str(v) for k, v in found.items()}


def data_of(dataset: Any) -> dict[str, np.ndarray]:
    """Scalars (T,) of one experiment in a group of data; none where there is no group."""
    found: dict[str, np.ndarray] = {}
    for name, variable in {} if dataset is None else dataset.data_vars.items():
        if "time" in variable.dims:
            values = np.asarray(variable.transpose("time", ...).values, dtype=float)
            found |= components(str(name), values, 1, variable)
    return found


def experiment_name(label: str) -> str:
    """What an experiment is called over a panel: its label, "experiment 2" for a number."""
    return f"experiment {label}" if label.isdigit() else label


def records(result: Any, verb: str) -> list[Record]:
    """Each experiment of a result that tells of states.

    Raises
    ------
    ArgumentError : the result tells of none; says what to give.
    """
    if is_inference_data(result):
        return _of_posterior(result, verb)
    if isinstance(result, Mapping) and not is_dataset(result):
        each = [(experiment_name(str(k)), one) for k, one in result.items()]
    elif isinstance(result, (list, tuple)):
        several = len(result) > 1
        each = [(f"experiment {k}" if several else "", r) for k, r in enumerate(result, start=1)]
    else:
        each = [("", result)]
    found = []
    for name, one in each:
        if not is_dataset(one):
            raise wrong_kind(verb, one, STATES_FROM)
        found.append(_of_dataset(one, name, verb))
    if not found:
        raise ArgumentError(f"{verb} was given an empty list", fix=STATES_FROM)
    return found


def drawn_of(idata: Any, drawn: Any) -> list[Record]:
    """Bands of the draws of a group, with the data, of each experiment."""
    groups = [group(idata, name) for name in ("observed_data", "constant_data")]
    data = [[one for _, one in experiments_of(g)] if g is not None else [] for g in groups]
    found = []
    for i, (label, own) in enumerate(experiments_of(drawn)):
        states: dict[str, np.ndarray] = {}
        for name, variable in own.data_vars.items():
            if "time" in variable.dims:
                values = variable.transpose("chain", "draw", "time", ...).values
                flat = values.reshape(-1, *values.shape[2:])
                states |= {k: bands(v) for k, v in components(str(name), flat, 2, variable)}
        found.append(
            Record(
                experiment_name(label),
                own["time"].values if states else np.arange(0),
                states,
                data_of(data[0][i] if data[0] else None),
                data_of(data[1][i] if data[1] else None),
                observed_states(drawn.attrs),
            )
        )
    return found


def _of_posterior(idata: Any, verb: str) -> list[Record]:
    posterior = group_of(verb, idata, "posterior", STATES_FROM)
    found = drawn_of(idata, posterior)
    if not found[0].states:
        raise ArgumentError(
            f"the posterior holds no states, only {listing('', map(str, posterior.data_vars))}",
            fix="sample with states=True and a method that draws them, or give what ssm.smooth "
            "returns",
        )
    return found


def _of_dataset(dataset: Any, name: str, verb: str) -> Record:
    states: dict[str, np.ndarray] = {}
    data: dict[str, np.ndarray] = {}
    inputs: dict[str, np.ndarray] = {}
    for key, variable in dataset.data_vars.items():
        label = str(key)
        if variable.dims[:2] == ("trajectory", "time"):
            states |= {k: bands(v) for k, v in components(label, variable.values, 2, variable)}
        elif f"{label}_quantile" in dataset and not is_prediction(dataset, label):
            states |= quantiles_at_levels(dataset, label, label, verb)
        elif variable.dims[:1] == ("time",):
            for suffix, into in (("_observed", data), ("_input", inputs)):
                if label.endswith(suffix):
                    into |= components(label.removesuffix(suffix), variable.values, 1, variable)
    if not states:
        raise wrong_kind(verb, dataset, STATES_FROM)
    return Record(name, dataset["time"].values, states, data, inputs,
                  observed_states(dataset.attrs))  # fmt: skip


def is_prediction(dataset: Any, name: str) -> bool:
    """Whether a variable of a filter's result is the predicted mean of a channel."""
    channel = name.removesuffix("_predicted")
    return channel != name and f"{channel}_pit" in dataset


def quantiles_at_levels(dataset: Any, variable: str, name: str, verb: str) -> dict[str, np.ndarray]:
    """Quantiles of the first draw of a variable, (5, T) at `LEVELS`, of each of its scalars, called
    by name.

    Raises
    ------
    ArgumentError : the result has others.
    """
    quantiles = dataset[f"{variable}_quantile"].isel(draw=0).transpose("time", ..., "quantile")
    known = dataset["quantile"].values
    places = [np.flatnonzero(np.isclose(known, level)) for level in LEVELS]
    if not all(len(p) for p in places):
        raise ArgumentError(
            f"{verb} draws the quantiles {_texts(LEVELS)}, and the result has {_texts(known)}",
            fix="leave quantiles= out of the call that made it",
        )
    values = np.moveaxis(quantiles.values[..., [p[0] for p in places]], -1, 0)  # (5, T, ...)
    return dict(components(name, values, 2, quantiles.isel(quantile=0)))


def _texts(levels: Sequence[float] | np.ndarray) -> str:
    return ", ".join(f"{level:g}" for level in levels)
