"""Names, dims and coordinates of what belongs to an experiment.

Of a single one `y` over `time`; of several `y_1` over `time_1`, `y_2` over `time_2`, as their
lengths differ.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ssmppl.data import Experiment
from ssmppl.errors import ModelError
from ssmppl.expressions.arrays import array
from ssmppl.language.model.trace import Trace

if TYPE_CHECKING:
    import xarray as xr

TIME_ZONES = "time_zones"  # the attribute


def with_data(result: xr.Dataset, trace: Trace, experiment: Experiment) -> xr.Dataset:
    """`result` and the data that it is about, (time, ...): `y_observed`, `u_input`."""
    own = trace.component_names.renamed
    data = {f"{n}_observed": v for n, v in experiment.observed.items()}
    data |= {f"{n}_input": v for n, v in experiment.inputs.items()}
    named = {n: ["time", *component_dims(n.rpartition("_")[0], v, 1)] for n, v in data.items()}
    named = {n: [own.get(d, d) for d in dims] for n, dims in named.items()}
    out = result.assign({n: (named[n], v) for n, v in data.items()})
    labels = trace.component_names.coords
    return out.assign_coords({d: list(v) for d, v in labels.items() if d in out.dims})


def component_dims(name: str, values: np.ndarray, leading: int) -> list[str]:
    """Dims of the components of a state, channel or input, whatever quantity it is:
    what has the same dims can be added, and is not spread out into a table."""
    return [f"{name}_dim_{k}" for k in range(values.ndim - leading)]


def model_attributes(trace: Trace) -> dict[str, Any]:
    """The attributes of every result that are about the model: its name, and which of its
    distributions are approximations of what was declared, as that of a non-linear `SDE`."""
    told = "; ".join(f"{name}: {text}" for name, text in trace.approximations.items())
    return {"model": trace.name} | ({"approximate_distributions": told} if told else {})


def observes(trace: Trace) -> dict[str, str]:
    """Components of the observation whose mean, or location, is a component of the state itself:
    `y[0]` to `x`, as results call them.

    These are in the same units, so that one can be drawn over the other.
    """
    states = set(trace.state_symbols)
    found: dict[str, str] = {}
    for site in trace.observations.values():
        d, symbols = site.distribution, site.value.view(np.ndarray).ravel()
        centres = [d.parameters[n] for n in ("loc",) if n in d.parameters]
        with contextlib.suppress(AttributeError):  # no moments
            centres.append(d.mean())
        for centre in centres:
            values = np.broadcast_to(array(centre).view(np.ndarray), site.shape).ravel()
            pairs = zip(symbols, values, strict=True)
            found |= {trace.label(y): trace.label(x) for y, x in pairs if x in states}
    return found


def zone_of(attrs: Mapping[str, Any], axis: str) -> str:
    """The zone that the labels of a dim were given in, by the attributes of a result."""
    found = attrs.get(TIME_ZONES, {})
    return str((json.loads(found) if isinstance(found, str) else found).get(axis, ""))


def check_names(trace: Trace, experiments: Sequence[Experiment], states: bool = True) -> None:
    """Refuse a parameter called as results call what belongs to one of several experiments.

    states : whether these are in the results.

    Raises
    ------
    ModelError : there is one, `x_1` beside the state `x`.
    """
    numbers = range(1, len(experiments) + 1) if len(experiments) > 1 else ()
    roles: dict[str, Iterable[str]] = {
        "state": trace.initial if states else (), "observation": trace.observations,
        "input": trace.inputs, "dimension": ("time",),
    }  # fmt: skip
    for name, site in trace.parameters.items():
        for role, known in roles.items():
            for own in known:
                k = next((k for k in numbers if name == f"{own}_{k}"), None)
                if k is not None:
                    raise ModelError(
                        f"{name!r} is a parameter, and in results of several data sets the "
                        f"{role} {own!r} of the {k}. of them",
                        fix=f"rename the parameter, as {own}_first: no number may follow `{own}_`",
                        where=site.distribution.location,
                    )


class Labels:
    """dims, coords : of the variables named so far, for `to_inference_data`. attrs : the zones that
    dates were given in, by the dim over time, where they have any; dates themselves are in UTC."""

    def __init__(self, trace: Trace, experiments: Sequence[Experiment]):
        self.renamed = trace.component_names.renamed
        self.several = len(experiments) > 1
        self.time = None if self.several else experiments[0].time
        self.dims: dict[str, list[str]] = {}
        self.coords: dict[str, Any] = dict(trace.component_names.coords)
        zones = {self.axis(i): e.zone for i, e in enumerate(experiments) if e.zone}
        self.attrs = {TIME_ZONES: zones} if zones else {}
        if self.several:
            self.coords |= {
                self.axis(i): np.arange(1, e.steps + 1) if e.time is None else e.time
                for i, e in enumerate(experiments)
            }

    def mark(self, i: int) -> str:
        """What follows the names of experiment i's variables."""
        return f"_{i + 1}" if self.several else ""

    def axis(self, i: int) -> str:
        """Its dim over time."""
        return f"time{self.mark(i)}"

    def named(self, i: int, values: Mapping[str, Any], leading: int = 1) -> dict[str, np.ndarray]:
        """Variables of experiment i under their names; time is the last of `leading` axes."""
        named = {f"{n}{self.mark(i)}": v for n, v in values.items()}
        if self.several:
            for n, v in named.items():
                rest = component_dims(n, v, leading)
                # the log likelihood has none but time
                self.dims.setdefault(n, [self.axis(i), *rest])
        return named
