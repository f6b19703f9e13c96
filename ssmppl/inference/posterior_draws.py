"""Posterior draws read back: parameters and trajectories of an InferenceData as the kernels take
them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from ssmppl.data import check_values
from ssmppl.data.parameters import pack
from ssmppl.errors import ArgumentError, listing
from ssmppl.language.traced import Trace


def group(idata: Any, name: str) -> Any:
    """A group of an InferenceData or DataTree as a Dataset; None where it has none of this name."""
    names = idata.groups() if callable(getattr(idata, "groups", None)) else idata.children
    if name not in names and f"/{name}" not in names:
        return None
    found = idata[name]
    return found.to_dataset() if hasattr(found, "to_dataset") else found


def posterior_of(idata: Any, fix: str = "give what ssm.sample returns") -> Any:
    """Its posterior.

    Raises
    ------
    ArgumentError : it has none.
    """
    known = hasattr(idata, "groups") or hasattr(idata, "children")
    found = group(idata, "posterior") if known else None
    if found is None:
        raise ArgumentError(
            f"idata is {type(idata).__name__} without a group `posterior`",
            fix=fix,
        )
    return found


def parameters_of(trace: Trace, posterior: Any) -> np.ndarray:
    """(chain, draw, P) theta of each draw; parameters that were held are among the attributes.

    Raises
    ------
    ArgumentError : a parameter is neither drawn nor held.
    """
    fixed = posterior.attrs.get("fixed", "{}")
    held = check_values(trace, json.loads(fixed) if isinstance(fixed, str) else fixed)
    shape = (posterior.sizes["chain"], posterior.sizes["draw"])
    values: dict[str, np.ndarray] = {}
    for name, site in trace.parameters.items():
        if name in posterior:
            values[name] = _drawn(posterior, name, site.shape, ())
        elif name in held:
            values[name] = np.broadcast_to(held[name], (*shape, *site.shape))
        else:
            raise ArgumentError(
                f"the posterior has no parameter {name!r}",
                fix=f"use the model that was sampled; the posterior holds "
                f"{listing(name, map(str, posterior.data_vars))}",
            )
    if not values:
        return np.empty((*shape, 0))
    return pack(trace.parameters.values(), values)


def all_draws(values: np.ndarray) -> np.ndarray:
    """(chain, draw, ...) as (chain * draw, ...); said by numbers, as the rest may be empty."""
    return values.reshape(values.shape[0] * values.shape[1], *values.shape[2:])


def states_of(trace: Trace, posterior: Any, mark: str, axis: str) -> np.ndarray | None:
    """(chain, draw, T, D) trajectories of one experiment; None where they were not kept.

    mark : what follows the names of its variables. axis : its dim over time.
    """
    values: Mapping[str, Any] = {
        name: _drawn(posterior, f"{name}{mark}", site.shape, (axis,))
        for name, site in trace.initial.items()
        if f"{name}{mark}" in posterior and axis in posterior[f"{name}{mark}"].dims
    }
    if len(values) < len(trace.initial):
        return None
    return pack(trace.initial.values(), values)


def _drawn(posterior: Any, name: str, shape: tuple[int, ...], over: tuple[str, ...]) -> np.ndarray:
    own = posterior[name].transpose("chain", "draw", *over, ...)
    values = np.asarray(own.values, dtype=np.float64)
    rest = values.shape[2 + len(over) :]
    if rest != shape:
        raise ArgumentError(
            f"{name!r} of the posterior has shape {rest}, that of the model {shape}",
            fix="use the model that was sampled",
        )
    return values
