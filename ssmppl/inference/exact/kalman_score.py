"""The exact score of a linear Gaussian model: derivatives of its matrices times their adjoints.

The matrices are differentiated as expressions, once for each model; their derivatives are evaluated
as the matrices themselves are, and meet what one backward pass of the filter says about every entry
(`codegen/kernels/kalman_adjoint.py`). No parameter costs another pass.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ssmppl.analysis.structure import LinearGaussian
from ssmppl.codegen.exact import exact_entry
from ssmppl.codegen.kernels.kalman import OK
from ssmppl.codegen.kernels.kalman_adjoint import zeros_like
from ssmppl.codegen.kernels.kalman_steps import Matrices
from ssmppl.data import Experiment
from ssmppl.errors import ArgumentError, Location
from ssmppl.expressions.calculus import NotDifferentiable, differentiate
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import Expr
from ssmppl.inference.exact.kalman_matrices import values_of
from ssmppl.inference.exact.kalman_moments import Stopped
from ssmppl.inference.totals import total_of
from ssmppl.language.traced import Trace

LAWS = {"m": "initial", "P": "initial", "A": "transition", "b": "transition", "Q": "transition",
        "C": "observation", "d": "observation", "R": "observation"}  # fmt: skip


class Slope(NamedTuple):
    """The derivative of one entry of one matrix in one parameter, where it is not zero."""

    parameter: int
    field: str
    entry: int
    expression: Expr


@dataclass(frozen=True)
class Slopes:
    """Derivatives of a model's matrices in its parameters.

    refused : for each parameter in which some matrix has no derivative, the reason and the place.
    """

    known: tuple[Slope, ...]
    refused: dict[int, tuple[str, Location]]


def slopes(trace: Trace, form: LinearGaussian) -> Slopes:
    """All derivatives of the matrices that are not zero."""
    known: list[Slope] = []
    refused: dict[int, tuple[str, Location]] = {}
    for p, parameter in enumerate(trace.parameter_symbols):
        for field in Matrices._fields:
            entries = list(getattr(form, field).ravel())
            try:
                found = differentiate(entries, parameter)
            except NotDifferentiable as error:
                place = _culprit(trace, LAWS[field], parameter)
                refused.setdefault(p, (f"the {LAWS[field]} law: {error.found}", place))
                continue
            known += [
                Slope(p, field, i, e)
                for i, e in enumerate(found)
                if not (e.op == "const" and e.data == 0.0)
            ]
    return Slopes(tuple(known), refused)


def _culprit(trace: Trace, law: str, parameter: Expr) -> Location:
    """Where the law is written that has no derivative in the parameter."""
    sites = {
        "initial": trace.initial, "transition": trace.transition,
        "observation": trace.observations,
    }[law]  # fmt: skip
    places = [site.distribution.location for site in sites.values()]
    for site, place in zip(sites.values(), places, strict=True):
        for values in site.distribution.parameters.values():
            try:
                differentiate(list(values.ravel()), parameter)
            except NotDifferentiable:
                return place
    return places[0]


def check_free(trace: Trace, found: Slopes, free: np.ndarray) -> None:
    """Refuse free parameters in which the likelihood has no derivative in closed form.

    Raises
    ------
    ArgumentError : naming the parameter, the law and the reason.
    """
    for p, (reason, where) in found.refused.items():
        if free[p]:
            raise ArgumentError(
                f"the score in {trace.parameter_symbols[p]!r} has no closed form: {reason}",
                fix="fix the parameter by fixed={...}, or use a method without gradients",
                where=where,
            )


def score(
    trace: Trace, found: Slopes, model: Matrices, start: np.ndarray, experiment: Experiment,
    theta: np.ndarray,
) -> tuple[float, np.ndarray]:  # fmt: skip
    """Log density of column 0 of the start, and the gradient (P,) of log p(y), of one experiment.

    Raises
    ------
    Stopped : the laws have no density at theta.
    """
    adjoint, increments = zeros_like(model), np.empty(experiment.steps)
    status, t = exact_entry("adjoints")(
        model, start, experiment.y, experiment.seen, increments, adjoint
    )
    if status != OK:
        raise Stopped(status, t)
    gradient = np.zeros(len(theta))
    values = evaluate([s.expression for s in found.known], values_of(trace, experiment, theta))
    for slope, value in zip(found.known, values, strict=True):
        gradient[slope.parameter] += _product(slope, np.asarray(value), adjoint, experiment.steps)
    return total_of(increments), gradient


def _product(slope: Slope, value: np.ndarray, adjoint: Matrices, steps: int) -> float:
    """Derivative of an entry times its adjoint, summed over the steps at which it acts."""
    weights: np.ndarray = getattr(adjoint, slope.field)
    if LAWS[slope.field] == "initial":
        return float(weights.ravel()[slope.entry] * value.ravel()[0])
    weight = weights.reshape(len(weights), -1)[:, slope.entry]
    if LAWS[slope.field] == "transition":  # row 0 has no transition
        if steps == 1:
            return 0.0
        if len(weight) > 1:
            weight = weight[1:]
            value = value[1:] if value.ndim else value
    return float(np.sum(weight * value))
