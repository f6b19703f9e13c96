"""Arrays in, labelled results out: xarray Datasets, and ArviZ's container of posterior draws.

ArviZ 0.2x keeps groups in its own `InferenceData`; ArviZ 1.x in an `xarray.DataTree`. The groups
are xarray Datasets under both, so they are built here once, and only the container differs.
"""

from __future__ import annotations

import datetime
import json
import os
import platform
import warnings
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "Rows",
    "arviz",
    "save",
    "to_dataset",
    "to_inference_data",
]

# Groups of draws all of whose variables have a time axis.
BY_ROW = ("log_likelihood", "prior_predictive", "posterior_predictive")

# What a netCDF attribute may hold in the 64 KB that HDF5 leaves for one; longer text is cut.
LONGEST_ATTRIBUTE = 60_000


@dataclass(frozen=True)
class Rows:
    """What the log-likelihoods of rows lie along: those that were measured.

    dims : names. time : their labels along `time`. further : as of `to_inference_data`.
    """

    dims: tuple[str, ...]
    time: Any = None
    further: Mapping[str, tuple[Sequence[str], np.ndarray, Mapping[str, Any]]] = field(
        default_factory=dict
    )


def to_inference_data(
    *,
    posterior: Mapping[str, np.ndarray] | None = None,
    sample_stats: Mapping[str, np.ndarray] | None = None,
    observed_data: Mapping[str, np.ndarray] | None = None,
    constant_data: Mapping[str, np.ndarray] | None = None,
    log_likelihood: Mapping[str, np.ndarray] | None = None,
    prior: Mapping[str, np.ndarray] | None = None,
    prior_predictive: Mapping[str, np.ndarray] | None = None,
    posterior_predictive: Mapping[str, np.ndarray] | None = None,
    over_time: Collection[str] = (),
    stats_over_time: Collection[str] = (),
    time: Any = None,
    dims: Mapping[str, Sequence[str]] | None = None,
    coords: Mapping[str, Any] | None = None,
    renamed: Mapping[str, str] | None = None,
    further: Mapping[str, tuple[Sequence[str], np.ndarray, Mapping[str, Any]]] | None = None,
    rows: Rows | None = None,
    attrs: Mapping[str, Any] | None = None,
) -> Any:
    """ArviZ InferenceData of a run; under ArviZ 1.x an `xarray.DataTree` with the same groups.

    Groups that are None or empty are left out.

    Parameters
    ----------
    posterior, sample_stats, prior
        Arrays of shape (chain, draw, ...); (chain, draw, T, ...) for the names in `over_time`.
    log_likelihood, prior_predictive, posterior_predictive
        Arrays of shape (chain, draw, T, ...).
    observed_data, constant_data
        Arrays of shape (T, ...).
    over_time
        Names of posterior and prior whose first axis after chain and draw is time: the states.
    stats_over_time
        Likewise of sample_stats, whose names are another matter: a state may be called `lp`.
    time
        The T values of the `time` coordinate; row numbers from 1 if None.
    dims
        For single variables, names of all dims after chain and draw, instead of the rule above. A
        variable of the same name in another group that has fewer takes the first of them.
    coords
        Values of further coordinates, by dim.
    renamed
        Other names of dims that follow from the names of variables: `x_dim_0`.
    further
        Coordinates that are no dims, with their dims and attributes: in each group that has these.
    rows
        Dims and labels of log_likelihood, where it does not have those of the other groups.
    attrs
        What the run was. Made fit for netCDF (see `netcdf_attributes`), and written on the whole
        and on every group of draws.
    """
    sampled = {
        "posterior": posterior,
        "sample_stats": sample_stats,
        "log_likelihood": log_likelihood,
        "posterior_predictive": posterior_predictive,
        "prior": prior,
        "prior_predictive": prior_predictive,
    }
    fixed = {"observed_data": observed_data, "constant_data": constant_data}
    written = _provenance() | netcdf_attributes(attrs or {})
    own = {"sample_stats": stats_over_time}
    groups: dict[str, xr.Dataset] = {}
    for group, variables in {**sampled, **fixed}.items():
        if not variables:
            continue
        by_row = group in fixed or group in BY_ROW
        special = rows if group == "log_likelihood" else None
        groups[group] = _dataset(
            variables,
            sample_dims=() if group in fixed else ("chain", "draw"),
            over_time=variables if by_row else own.get(group, over_time),
            time=time if special is None else special.time,
            dims=(dims or {}) if special is None else dict.fromkeys(variables, special.dims),
            coords=coords or {},
            renamed=renamed or {},
            further=(further or {}) if special is None else special.further,
            attrs={} if group in fixed else written,
        )
    return _container(groups, written)


def to_dataset(
    variables: Mapping[str, np.ndarray],
    *,
    sample_dim: str | tuple[str, ...] | None = "draw",
    over_time: Collection[str] | None = None,
    time: Any = None,
    dims: Mapping[str, Sequence[str]] | None = None,
    coords: Mapping[str, Any] | None = None,
    renamed: Mapping[str, str] | None = None,
    attrs: Mapping[str, Any] | None = None,
) -> xr.Dataset:
    """A Dataset with dims `sample_dim` ("draw" or "trajectory"), `time`, then `<name>_dim_0`, ...

    Parameters
    ----------
    variables
        Arrays of shape (draws, T, ...), or (draws, ...) for names that are not in `over_time`;
        without the first axis if `sample_dim` is None, with as many as it has names if it is a
        tuple.
    over_time
        Names with a time axis; None means all.
    time, dims, coords, renamed, attrs
        As in `to_inference_data`.
    """
    leading = (sample_dim,) if isinstance(sample_dim, str) else sample_dim or ()
    return _dataset(
        variables,
        sample_dims=leading,
        over_time=variables if over_time is None else over_time,
        time=time,
        dims=dims or {},
        coords=coords or {},
        renamed=renamed or {},
        further={},
        attrs=_provenance() | netcdf_attributes(attrs or {}),
    )


def save(idata: Any, path: str | os.PathLike[str]) -> Path:
    """Write what `sample` returned to a netCDF file, which `arviz.from_netcdf` reads.

    Parameters
    ----------
    idata : InferenceData or DataTree.
    path : of the file, which appears whole or not at all: it is written beside `path` first.

    Returns
    -------
    Path : the same.
    """
    target = Path(path)
    partial = target.with_name(f".{target.name}.{os.getpid()}.partial")
    try:
        # Both containers have the method; both take the engine by this name.
        idata.to_netcdf(str(partial), engine="h5netcdf")
        os.replace(partial, target)
    finally:
        partial.unlink(missing_ok=True)
    return target


def arviz() -> Any:
    """The arviz module: imported on first use, which takes seconds, and without its greeting."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)
        import arviz
    return arviz


def netcdf_attributes(attrs: Mapping[str, Any]) -> dict[str, Any]:
    """`attrs` in types that netCDF can hold.

    Numbers and text stay; booleans become 0 and 1, so that they keep their truth; mappings and
    sequences become JSON; None and everything else (settings, say) becomes its `repr`.
    """
    return {str(name): _attribute(value) for name, value in attrs.items()}


def _attribute(value: Any) -> Any:
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, bool):
        return int(value)
    if isinstance(value, int):
        return value if -(2**63) <= value < 2**63 else str(value)
    if isinstance(value, float):
        return value
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, Mapping | list | tuple):
        value = json.dumps(value, default=_json_value)
    text = value if isinstance(value, str) else repr(value)
    if len(text.encode()) > LONGEST_ATTRIBUTE:
        kept = text.encode()[:LONGEST_ATTRIBUTE].decode(errors="ignore")
        text = f"{kept}\n[cut: the whole had {len(text)} characters]"
    return text


def _json_value(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return str(value) if isinstance(value, Path | datetime.date) else repr(value)


def _provenance() -> dict[str, str]:
    """Who made a result, and when; the names of the first three are ArviZ's."""
    found = {
        "created_at": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "inference_library": "ssmppl",
        "inference_library_version": _version("ssmppl"),
        "python_version": platform.python_version(),
    }
    return found | {f"{name}_version": _version(name) for name in ("numpy", "numba", "arviz")}


@cache  # read from disk: a list of many data sets has as many results
def _version(distribution: str) -> str:
    try:
        return version(distribution)
    except PackageNotFoundError:
        return "unknown"


def _dataset(
    variables: Mapping[str, np.ndarray],
    *,
    sample_dims: tuple[str, ...],
    over_time: Collection[str],
    time: Any,
    dims: Mapping[str, Sequence[str]],
    coords: Mapping[str, Any],
    renamed: Mapping[str, str],
    further: Mapping[str, tuple[Sequence[str], np.ndarray, Mapping[str, Any]]],
    attrs: Mapping[str, Any],
) -> xr.Dataset:
    import xarray as xr

    arrays: dict[str, tuple[tuple[str, ...], np.ndarray]] = {}
    sizes: dict[str, tuple[int, str]] = {}
    for name, values in variables.items():
        array = np.asarray(values)
        if name in dims:
            labels = (*sample_dims, *dims[name][: array.ndim - len(sample_dims)])
        else:
            labels = (*sample_dims, "time") if name in over_time else sample_dims
            labels += tuple(f"{name}_dim_{i}" for i in range(array.ndim - len(labels)))
        labels = tuple(renamed.get(label, label) for label in labels)
        if len(labels) != array.ndim:
            expected = ", ".join(labels)
            raise ValueError(f"{name!r} has shape {array.shape}, but its dims are ({expected})")
        for label, size in zip(labels, array.shape, strict=True):
            first_size, first = sizes.setdefault(label, (size, name))
            if size != first_size:
                raise ValueError(
                    f"{name!r} has {size} along {label!r}, but {first!r} has {first_size}"
                )
        arrays[name] = (labels, array)

    coordinates: dict[str, Any] = {
        dim: np.arange(size) for dim, (size, _) in sizes.items() if dim in sample_dims
    }
    if "time" in sizes:
        n_rows = sizes["time"][0]
        coordinates["time"] = np.arange(1, n_rows + 1) if time is None else _labels(time)
    for dim, (size, _) in sizes.items():
        if dim in coords:
            coordinates[dim] = _labels(coords[dim])
        elif dim not in coordinates:
            coordinates[dim] = np.arange(size)
    for name, (own, values, about) in further.items():
        if set(own) <= set(sizes):
            coordinates[name] = (list(own), _labels(values), dict(about))
    return xr.Dataset(arrays, coords=coordinates, attrs=dict(attrs))


def _labels(values: Any) -> np.ndarray:
    """Coordinate values in a type that netCDF can hold: objects other than text become text."""
    array = np.asarray(values)
    return array.astype(str) if array.dtype == object else array


def _container(groups: Mapping[str, xr.Dataset], attrs: Mapping[str, Any]) -> Any:
    az = arviz()
    if az.__version__.startswith("0."):
        return az.InferenceData(**groups, attrs=dict(attrs))

    import xarray as xr

    return xr.DataTree.from_dict({"/": xr.Dataset(attrs=dict(attrs)), **groups})
