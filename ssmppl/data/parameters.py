"""Parameter values of a call: checked, packed into theta over the trace's symbols, and unpacked."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from ssmppl.data.values import (
    Fault,
    as_numbers,
    asymmetry,
    number,
    outside,
    short,
    without_unit_diagonal,
)
from ssmppl.errors import ArgumentError, listing
from ssmppl.expressions.arrays import ExprArray
from ssmppl.expressions.expr import Expr
from ssmppl.language.model.trace import Site, Trace


def check_parameters(
    trace: Trace,
    parameters: Mapping[str, Any] | None,
    fixed: Mapping[str, Any] | None = None,
    support: bool = True,
) -> np.ndarray:
    """theta, float64 (P,), over `trace.parameter_symbols`.

    support=False leaves out the check against the priors' supports: a likelihood is a function of
    the parameters wherever it can be evaluated.

    Raises
    ------
    ArgumentError : a name is unknown, missing or given twice; a value has the wrong shape, is not
        finite, or lies outside the support of the parameter's prior.
    """
    given = check_values(trace, parameters, argument="parameters", support=support)
    for name, value in check_values(trace, fixed, argument="fixed", support=support).items():
        if name in given and not np.array_equal(given[name], value):
            raise ArgumentError(
                f"parameter {name!r} is {short(given[name].tolist())} in parameters and "
                f"{short(value.tolist())} in fixed",
                fix=f"leave {name!r} out of one of them",
            )
        given[name] = value
    missing = [name for name in trace.parameters if name not in given]
    if missing:
        raise ArgumentError(
            f"no value is given for {_plural('parameter', missing)}; given: "
            f"{', '.join(given) or 'none'}",
            fix="give every parameter of the model a value: "
            f"{{{', '.join(f'{n!r}: ...' for n in trace.parameters)}}}",
        )
    if support:
        _check_supports(trace, given, "parameters")
    return pack(trace.parameters.values(), given)


def check_values(
    trace: Trace,
    values: Mapping[str, Any] | None,
    argument: str = "fixed",
    support: bool = True,
) -> dict[str, np.ndarray]:
    """Values of some of the parameters (`fixed`, `start`), each float64 of the site's shape.

    Raises
    ------
    ArgumentError : as `check_parameters`, save that names may be missing.
    """
    if values is None:
        return {}
    own = getattr(values, "parameters", None)  # of an Estimate
    values = own if isinstance(own, Mapping) else values
    if not isinstance(values, Mapping):
        example = ", ".join(f"{n!r}: ..." for n in trace.parameters)
        raise ArgumentError(
            f"{argument} is {short(values)} of type {type(values).__name__}",
            fix=f"give a dictionary of the parameters' values, {argument}={{{example}}}",
        )
    out = {}
    for name, value in values.items():
        site = trace.parameters.get(name)
        if site is None:
            raise ArgumentError(
                f"{argument} names {name!r}, which is {_role(trace, name)}",
                fix=f"the parameters of the model are: {listing(str(name), trace.parameters)}",
            )
        if isinstance(value, Mapping):
            value = _by_label(trace, site, value, argument)
        out[name] = _value(site, value, argument, name in trace.per_experiment)
    if support:
        _check_supports(trace, out, argument)
    return out


def _by_label(trace: Trace, site: Site, given: Mapping[Any, Any], argument: str) -> list[Any]:
    """Values along the first axis, in order, of a mapping by its labels."""
    names = trace.component_names
    dim = next(iter(names.dims.get(site.name, ())), "")
    labels = names.coords.get(dim, tuple(range(site.shape[0])) if site.shape else ())
    wrong = [k for k in given if k not in labels] or [k for k in labels if k not in given]
    if wrong or not labels:
        known = listing(str(wrong[0]) if wrong else "", [str(k) for k in labels])
        raise ArgumentError(
            f"{argument}: parameter {site.name!r} has the keys "
            f"{', '.join(repr(k) for k in given) or 'none'}",
            fix=f"give a value for each of {known}"
            if labels
            else "give one number, as its prior is scalar",
        )
    return [given[k] for k in labels]


def _value(site: Site, value: Any, argument: str, per_experiment: bool) -> np.ndarray:
    array = as_numbers(value)
    shape = f"of shape {site.shape}" if site.shape else "number"
    if isinstance(array, Fault):
        raise ArgumentError(
            f"{argument}: parameter {site.name!r}{_index(array.index)}: {array.found}"
            if array.index
            else f"{argument}: parameter {site.name!r} is {short(value)}",
            fix=f"give an array {shape}" if site.shape else "give a number",
        )
    if array.shape != site.shape:
        fix = f"give an array {shape}, the shape of its prior"
        if not site.shape:
            fix = "give one number, as its prior is scalar"
        if per_experiment:
            fix = f"{fix}; each experiment has its own: give those of the experiments in the data"
        raise ArgumentError(
            f"{argument}: parameter {site.name!r} has shape {array.shape}: {short(value)}", fix=fix
        )
    if not np.isfinite(array).all():
        index = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise ArgumentError(
            f"{argument}: parameter {site.name!r}{_index(index)} is {number(array[index])}",
            fix="give a finite number",
        )
    # a likelihood reads one half of a symmetric matrix only, and no diagonal of ones
    law = site.distribution
    fault = asymmetry(array) if law.symmetric else None
    fault = fault or (without_unit_diagonal(array) if law.unit_diagonal else None)
    if fault is not None:
        raise ArgumentError(
            f"{argument}: parameter {site.name!r}{_index((fault.index or ())[1:])}: {fault.found}",
            fix=f"give {fault.fix}",
        )
    return array


def _check_supports(trace: Trace, values: Mapping[str, np.ndarray], argument: str) -> None:
    env = {s: values[s.data[1]][s.data[2]] for s in trace.parameter_symbols if s.data[1] in values}
    for name, value in values.items():
        site = trace.parameters[name]
        fault = outside(site.distribution, value[None], env)
        if fault is not None:
            place = f" ({site.distribution.location})"
            raise ArgumentError(
                f"{argument}: parameter {name!r}{_index((fault.index or ())[1:])}: {fault.found}",
                fix=f"give {fault.fix}, or change its prior{place}",
            )


def pack(sites: Iterable[Site], values: Mapping[str, np.ndarray]) -> np.ndarray:
    """Values (..., *shape) by name as one array (..., number of distinct symbols)."""
    return _pack({s.name: s.value for s in sites}, values)


def _pack(of: Mapping[str, ExprArray], values: Mapping[str, np.ndarray]) -> np.ndarray:
    columns = [
        values[n][(..., *c.data[2])] for n, v in of.items() for c in dict.fromkeys(v.ravel())
    ]
    return np.stack(columns, axis=-1).astype(np.float64) if columns else np.zeros(0)


def unpack(sites: Iterable[Site], packed: np.ndarray) -> dict[str, np.ndarray]:
    """The reverse of `pack`: name -> (..., *shape), symmetric matrices filled on both sides."""
    return _unpack({s.name: s.value for s in sites}, packed)


def _unpack(of: Mapping[str, ExprArray], packed: np.ndarray) -> dict[str, np.ndarray]:
    position: dict[Expr, int] = {}
    for value in of.values():
        for symbol in dict.fromkeys(value.ravel()):
            position[symbol] = len(position)
    on_disk = isinstance(packed, np.memmap)
    packed = np.asarray(packed)
    if packed.ndim == 0 or packed.shape[-1] != len(position):
        raise ArgumentError(
            f"an array of shape {packed.shape} for {len(position)} components",
            fix=f"its last axis must have length {len(position)}: {', '.join(of) or 'none'}",
        )
    out = {}
    for name, value in of.items():
        columns = np.array([position[s] for s in value.ravel()], dtype=np.intp)
        taken: slice | np.ndarray = columns
        if on_disk and np.array_equal(columns, np.arange(len(columns)) + columns[0]):
            taken = slice(int(columns[0]), int(columns[0]) + len(columns))  # stays there
        out[name] = packed[..., taken].reshape(packed.shape[:-1] + value.shape)
    return out


def unpack_parameters(trace: Trace, theta: np.ndarray) -> dict[str, np.ndarray]:
    """theta (..., P) as name -> (..., *shape)."""
    return unpack(trace.parameters.values(), theta)


def spelled(trace: Trace, theta: np.ndarray) -> str:
    """theta (P,) by name, for messages."""
    values = unpack_parameters(trace, theta).items()
    each = [f"{n} = {np.array2string(np.asarray(v), precision=6)}" for n, v in values]
    return ", ".join(each) or "none"


def unpack_states(trace: Trace, x: np.ndarray, started: bool = True) -> dict[str, np.ndarray]:
    """States (..., T, D) as name -> (..., T, *shape).

    started : the first of the T rows is that of the data, to which no step has led: draws of a step
        are NaN there.
    """
    out = _unpack(trace.states, x)
    if started:
        first: tuple[Any, ...] = (*(slice(None),) * (np.ndim(x) - 2), 0)
        for name in trace.auxiliary:
            out[name] = np.array(out[name])
            out[name][first] = np.nan
    return out


def pack_states(trace: Trace, values: Mapping[str, np.ndarray]) -> np.ndarray:
    """The reverse of `unpack_states`."""
    known = {n: values[n] for n in trace.states}
    for name in trace.auxiliary:
        axis = np.ndim(known[name]) - trace.states[name].ndim - 1
        first: tuple[Any, ...] = (*(slice(None),) * axis, 0)
        known[name] = np.array(known[name])
        known[name][first] = 0.0
    return _pack(trace.states, known)


def unpack_observations(trace: Trace, y: np.ndarray) -> dict[str, np.ndarray]:
    """Observations (..., K) as name -> (..., *shape)."""
    return unpack(trace.observations.values(), y)


def _index(index: tuple[int, ...] | None) -> str:
    return f"[{', '.join(map(str, index))}]" if index else ""


def _plural(word: str, names: list[str]) -> str:
    return f"{word}{'s' * (len(names) > 1)} {', '.join(map(repr, names))}"


def _role(trace: Trace, name: object) -> str:
    for role, sites in (("a state", trace.states), ("an observation", trace.observations),
                        ("an input", trace.inputs)):  # fmt: skip
        if name in sites:
            return f"{role}, no parameter"
    return "no parameter of the model"
