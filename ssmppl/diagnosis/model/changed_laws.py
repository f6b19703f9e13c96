"""Distributions changed: their symbols replaced, their means moved, variances scaled, tails made
heavier.

Every change keeps the distribution's place in the user's file, and gives the distribution itself
back, expression by expression, where the change is 0 (tails: to rounding and `NORMAL`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from ssmppl.errors import NotApplicable
from ssmppl.expressions.arrays import ExprArray, array
from ssmppl.expressions.arrays import elementwise as ew
from ssmppl.expressions.expr import Expr, apply, substitute
from ssmppl.language.distributions import (
    Dirac,
    Distribution,
    Mixture,
    Normal,
    StudentT,
    Truncated,
    ZeroInflated,
)
from ssmppl.language.distributions.from_density import UserDefined

Index = tuple[int, ...]
Changes = Mapping[Index, Expr]

# 1 / df of the Student's t that stands for a normal law: small enough that the log density is off
# by 1e-5 (e^4 - 2 e^2 - 1) / 4, large enough that derivatives in 1 / df survive the rounding of
# log Gamma((df + 1) / 2) - log Gamma(df / 2).
NORMAL = 1e-5
LEAST = 1e-6  # mean of a count below which its logarithm is taken for that of this


def rebuilt(d: Distribution, parameters: Mapping[str, Any]) -> Distribution:
    """A distribution of the same family with these parameters for its own, of a truncated or
    zero-inflated one for those of the distribution inside."""
    inside = isinstance(d, (Truncated, ZeroInflated))
    return d.rebuilt({f"like_{k}" if inside else k: v for k, v in parameters.items()})


def _inner(d: Distribution) -> Distribution:
    """The distribution inside a truncated or zero-inflated one."""
    return d.base if isinstance(d, (Truncated, ZeroInflated)) else d


def substituted(d: Distribution, replacement: Mapping[Expr, Expr]) -> Distribution:
    """The distribution with symbols replaced; the distribution itself where it holds none of
    them."""
    own = d.parameters
    names, nodes = list(own), [e for a in own.values() for e in a.ravel()]
    new = substitute(nodes, dict(replacement))
    if all(a is b for a, b in zip(nodes, new, strict=True)):
        return d
    out, at = {}, 0
    for name in names:
        size = own[name].size
        out[name] = array(array(new[at : at + size]).reshape(own[name].shape))
        at += size
    return d.rebuilt(out)


# -- means
def scale_of_mean(d: Distribution) -> str | NotApplicable:
    """The scale on which increments of the mean act, or why there is none."""
    inner = _inner(d)
    if inner.mean_link is not None:
        return inner.mean_link.scale
    kind = type(inner).__name__
    return NotApplicable(f"its distribution is {kind}, whose mean cannot be moved by an increment",
                         d.location)  # fmt: skip


def noise_free(d: Distribution, index: Index) -> Expr:
    """The value without noise, on the scale of the quantity itself (truncation left out)."""
    values = array(_inner(d).noise_free())
    entry: Expr = values[index] if values.ndim == len(index) else values[()]
    return entry


def on_its_scale(d: Distribution, index: Index) -> Expr:
    """The value without noise on the scale of `scale_of_mean`, on which increments are added: of a
    count the log of its mean, at least `LEAST`, of a share the logit."""
    inner = _inner(d)
    link = inner.mean_link
    assert link is not None
    if link.scale == "log":
        return apply("log", apply("maximum", noise_free(d, index), LEAST))
    if link.scale == "identity":
        return noise_free(d, index)
    values = np.broadcast_to(inner.parameters[link.parameter].view(np.ndarray), d.shape)
    value: Expr = values[index]
    if link.scale == "mean of the log":
        return value
    return apply("log", value / (1.0 - value))


def values_on_its_scale(d: Distribution, values: np.ndarray) -> np.ndarray:
    """Measured values on that scale, NaN where missing; half a count above 0 and below the largest
    where a logarithm needs it."""
    scale = scale_of_mean(d)
    if isinstance(scale, NotApplicable) or scale == "identity":
        return values
    with np.errstate(invalid="ignore"):
        if scale == "logit":
            most = np.nanmax(values, initial=1.0)
            return np.asarray(np.log((values + 0.5) / (most - values + 0.5)))
        positive = values[values > 0.0]
        least = 0.5 * float(positive.min()) if positive.size else 1.0
        return np.asarray(np.log(np.maximum(values, least)))


def shifted(d: Distribution, changes: Changes) -> Distribution:
    """The distribution with means at these indices moved, on the scale of `scale_of_mean`."""
    inner = _inner(d)
    link = inner.mean_link
    assert link is not None
    sign = -1.0 if link.inverse else 1.0

    def change(value: Expr, by: Expr) -> Expr:
        if link.scale in ("identity", "mean of the log"):
            return value + by
        if link.scale == "log":
            return value * apply("exp", sign * by)
        growth = apply("expm1", by)  # of the odds
        return value * (1.0 + growth) / (1.0 + value * growth)

    values = _changed(d, inner.parameters[link.parameter], changes, change)
    return rebuilt(d, {link.parameter: values})


def _changed(d: Distribution, values: ExprArray, changes: Changes, change: Any) -> ExprArray:
    out = np.array(np.broadcast_to(values.view(np.ndarray), d.shape))
    for index, by in changes.items():
        out[index] = change(out[index], by)
    return array(out)


# -- variances
def has_scale(d: Distribution) -> NotApplicable | None:
    """Why the distribution has no variance of its own that could be scaled; None where it has."""
    inner = _inner(d)
    if inner.variance_link is not None:
        return None
    kind = type(inner).__name__
    reason = f"its distribution is {kind}, whose variance follows from its mean"
    if isinstance(inner, Dirac):
        reason = "it has no noise (Dirac)"
    elif isinstance(inner, (Mixture, UserDefined)):
        reason = f"its distribution is {kind}, of which no argument is known to be its spread"
    return NotApplicable(reason, d.location)


def scaled(d: Distribution, changes: Changes) -> Distribution:
    """The distribution with increments of the log variance of the components at these indices."""
    inner = _inner(d)
    assert inner.variance_link is not None
    name, power = inner.variance_link.parameter, inner.variance_link.power
    if inner.joint:
        half = math.copysign(0.5, power)
        matrix = np.array(inner.parameters[name].view(np.ndarray))
        for (i,), by in changes.items():
            factor = apply("exp", half * by)
            matrix[i, :] = [factor * e for e in matrix[i, :]]
            if name != "cholesky":
                matrix[:, i] = [factor * e for e in matrix[:, i]]
        return rebuilt(d, {name: array(matrix)})
    return rebuilt(d, {name: _changed(d, inner.parameters[name], changes,
                                      lambda s, by: s * apply("exp", power * by))})  # fmt: skip


# -- tails
def has_tail(d: Distribution) -> NotApplicable | None:
    """Why Student's t cannot stand for the distribution; None where it can."""
    inner = _inner(d)
    if isinstance(inner, Normal):
        return None
    kind = type(inner).__name__
    return NotApplicable(
        f"its distribution is {kind}: heavier tails are for Normal ones", d.location
    )


def heavier(d: Distribution, changes: Changes) -> Distribution:
    """Student's t with 1 / df = `NORMAL` + the changes at these indices, for a normal
    distribution."""
    inner = _inner(d)
    if isinstance(inner, StudentT):  # a second effect of the kind
        inverse = _changed(d, inner.df, changes, lambda df, by: 1.0 / df + by)
        return rebuilt(d, {"df": ew("div", 1.0, inverse)})
    assert isinstance(inner, Normal)
    wide = {n: array(np.broadcast_to(array(a).view(np.ndarray), d.shape))
            for n, a in (("loc", inner.mean()), ("scale", inner.sd()))}  # fmt: skip
    inverse = _changed(d, array(np.full(d.shape, NORMAL)), changes, lambda a, by: a + by)
    student: Distribution = StudentT(array(ew("div", 1.0, inverse)), wide["loc"],
                                     scale=wide["scale"])  # fmt: skip
    student.location = d.location
    return d.with_base(student) if isinstance(d, Truncated) else student
