"""Names, dims and coordinates of what belongs to an experiment.

Of a single one `y` over `time`; of several `y` over `experiment` and `time`, NaN after the end of a
shorter one. The coordinate `rows` (experiment) says how many rows each has; where their rows are
labelled differently `time` counts them, and `times` (experiment, time) are the labels.
"""

from __future__ import annotations

import contextlib
import json
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ssmppl.data import Experiment
from ssmppl.data.experiments import EXPERIMENT, ROWS, TIMES, WHOLE
from ssmppl.errors import ModelError
from ssmppl.expressions.arrays import array
from ssmppl.language.model.trace import Trace
from ssmppl.results import Rows

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


def by_experiment(
    experiments: Sequence[Experiment], results: Sequence[xr.Dataset]
) -> xr.Dataset | list[xr.Dataset] | dict[Any, xr.Dataset]:
    """The results of each experiment as they are handed out: one alone, by label, or in a list."""
    if len(results) == 1:
        return results[0]
    labels = [e.label for e in experiments]
    return list(results) if None in labels else dict(zip(labels, results, strict=True))


def as_list(
    results: xr.Dataset | list[xr.Dataset] | dict[Any, xr.Dataset],
) -> list[xr.Dataset]:
    """What `by_experiment` handed out, one after the other."""
    if isinstance(results, dict):
        return list(results.values())
    return results if isinstance(results, list) else [results]


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


def zone_of(attrs: Mapping[str, Any], i: int) -> str:
    """The zone that the labels of experiment i were given in, by the attributes of a result."""
    found = attrs.get(TIME_ZONES, {})
    return str((json.loads(found) if isinstance(found, str) else found).get(str(i + 1), ""))


def check_names(trace: Trace, experiments: Sequence[Experiment]) -> None:
    """Refuse a parameter called as the dims that results of several experiments have.

    Raises
    ------
    ModelError : there is one.
    """
    for name, site in trace.parameters.items():
        if len(experiments) > 1 and name in (EXPERIMENT, ROWS, TIMES):
            raise ModelError(
                f"{name!r} is a parameter, and in results of several data sets a dimension or its "
                "labels",
                fix=f"rename the parameter, as {name}_",
                where=site.distribution.location,
            )


class Labels:
    """What results of these experiments are labelled by, for `to_inference_data`.

    dims : of the variables named so far, where there are several. coords, further : labels by dim,
    and those of two dims, with these. renamed : names of the components. attrs : the zones that
    dates were given in, by the number of the experiment; dates themselves are in UTC.
    """

    def __init__(self, trace: Trace, experiments: Sequence[Experiment]):
        self.renamed = trace.component_names.renamed
        self.coords: dict[str, Any] = dict(trace.component_names.coords)
        self.several, self.rows = len(experiments) > 1, [e.steps for e in experiments]
        self.dims: dict[str, list[str]] = {}
        self.further: dict[str, tuple[list[str], np.ndarray, dict[str, Any]]] = {}
        zones = {str(i): e.zone for i, e in enumerate(experiments, start=1) if e.zone}
        self.attrs = {TIME_ZONES: zones} if zones else {}
        times = [e.time for e in experiments]
        alike = all(t is None for t in times) or (
            all(t is not None for t in times)
            and all(np.array_equal(t, times[0]) for t in times[1:])  # type: ignore[arg-type]
        )
        self.time = times[0] if alike else None
        if self.several:
            names = [i if e.label is None else e.label for i, e in enumerate(experiments, start=1)]
            self.coords[EXPERIMENT] = names
            self.further[ROWS] = ([EXPERIMENT], np.array(self.rows), {})
            if not alike:
                own = [np.arange(0) if t is None else t for t in times]
                whole = all(t.dtype.kind in "iu" for t in own)  # NaN makes floats of them
                padded = _padded_labels(own, max(self.rows))
                self.further[TIMES] = ([EXPERIMENT, "time"], padded, {WHOLE: int(whole)})

    @property
    def arguments(self) -> dict[str, Any]:
        """The arguments of `to_inference_data`, once all variables are named."""
        return {
            "time": self.time, "dims": self.dims, "coords": self.coords, "renamed": self.renamed,
            "further": self.further,
        }  # fmt: skip

    def together(
        self, each: Sequence[Mapping[str, Any]], leading: int = 1
    ) -> dict[str, np.ndarray]:
        """Variables of all experiments, by name, of each of which the last of `leading` axes is
        time: with an axis before it for the experiment, where there are several, and NaN after the
        end of a shorter one."""
        if not self.several:
            return dict(each[0])
        out: dict[str, np.ndarray] = {}
        for n, first in each[0].items():
            rest, before = component_dims(n, first, leading), first.shape[: leading - 1]
            shape = (*before, len(each), max(self.rows), *first.shape[leading:])
            out[n] = _room(first, shape)
            for i, own in enumerate(each):
                rows = own[n].shape[leading - 1]
                # by chain, as draws may lie on disk, both those and these
                for c in range(shape[0]) if before else [slice(None)]:
                    whole = out[n][c] if before else out[n]
                    at = (slice(None),) * max(len(before) - 1, 0)
                    whole[(*at, i, slice(0, rows))] = own[n][c]  # type: ignore[index]
                    whole[(*at, i, slice(rows, None))] = np.nan  # type: ignore[index]
            self.dims[n] = [EXPERIMENT, "time", *rest]
        return out


def measured_rows(
    labels: Labels, experiments: Sequence[Experiment], increments: Sequence[np.ndarray]
) -> tuple[np.ndarray, Rows] | None:
    """Log-likelihoods (chain, draw, T) of each experiment's rows, those that were measured, and
    what they lie along; None where none was.

    Others count for ArviZ as observations, of a log-likelihood that does not vary. Of several
    experiments that differ in their rows all lie along `row`, with their experiment and time.
    """
    seen = [e.seen.any(axis=1) for e in experiments]
    if not any(s.any() for s in seen):
        return None
    if not labels.several:
        time = np.arange(1, labels.rows[0] + 1) if labels.time is None else labels.time
        whole = bool(seen[0].all())
        values = increments[0] if whole else increments[0][..., seen[0]]
        return values, Rows(("time",), np.asarray(time)[seen[0]])
    if all(s.all() for s in seen) and len(set(labels.rows)) == 1:
        together = np.stack(increments, axis=-2)
        return together, Rows((EXPERIMENT, "time"), labels.time, labels.further)
    values = np.concatenate([v[..., s] for v, s in zip(increments, seen, strict=True)], axis=-1)
    names = np.asarray(labels.coords[EXPERIMENT])
    own = [np.arange(1, e.steps + 1) if e.time is None else e.time for e in experiments]
    if len({t.dtype.kind for t in own}) > 1:
        own = [t.astype(str) for t in own]
    further: dict[str, tuple[list[str], np.ndarray, dict[str, Any]]] = {
        EXPERIMENT: (["row"], np.repeat(names, [int(s.sum()) for s in seen]), {}),
        "time": (["row"], np.concatenate([t[s] for t, s in zip(own, seen, strict=True)]), {}),
    }
    return values, Rows(("row",), None, further)


def _room(like: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Room for numbers of this shape: on disk where `like` is, in a file that goes with them."""
    owner: Any = like
    while isinstance(owner, np.ndarray) and not isinstance(owner, np.memmap):
        owner = owner.base
    if not isinstance(owner, np.memmap) or not owner.filename:
        return np.empty(shape)
    file = tempfile.TemporaryFile(dir=Path(owner.filename).parent)  # noqa: SIM115
    return np.memmap(file, dtype=float, mode="w+", shape=shape)


def _padded_labels(each: Sequence[np.ndarray], rows: int) -> np.ndarray:
    """Labels of the rows of all experiments, (E, T): dates, numbers or texts, with no date, NaN or
    an empty text where there are none."""
    kinds = {t.dtype.kind for t in each if len(t)}
    if kinds <= {"i", "u", "f"}:
        out = np.full((len(each), rows), np.nan)
    elif len(kinds) == 1 and kinds <= {"m", "M"}:
        dtype = np.result_type(*(t.dtype for t in each if len(t)))
        out = np.full((len(each), rows), np.array("NaT", dtype=dtype))
    else:
        each = [t.astype(str) for t in each]
        out = np.full((len(each), rows), "", dtype=np.result_type(*each))
    for i, t in enumerate(each):
        out[i, : len(t)] = t
    return out
