"""Laws changed: their symbols replaced, their means moved, variances scaled, tails made heavier.

Every change keeps the law's place in the user's file, and gives the law itself back, expression by
expression, where the change is 0 (tails: to rounding and `NORMAL`).
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
    Bernoulli,
    Binomial,
    Cauchy,
    Dirac,
    Distribution,
    Exponential,
    Gamma,
    Laplace,
    LogNormal,
    Mixture,
    MvNormal,
    NegativeBinomial,
    Normal,
    Poisson,
    StudentT,
    Truncated,
    VonMises,
    Weibull,
    ZeroInflated,
)
from ssmppl.language.distributions.from_density import Written

Index = tuple[int, ...]
Changes = Mapping[Index, Expr]

# The parameter that a change of the mean acts on, and the scale that it acts on.
_MEAN: dict[type[Distribution], tuple[str, str]] = {
    Normal: ("mean_", "identity"), MvNormal: ("mean_", "identity"), StudentT: ("loc", "identity"),
    Laplace: ("loc", "identity"), Cauchy: ("loc", "identity"), Dirac: ("value", "identity"),
    LogNormal: ("mean_", "mean of the log"), Poisson: ("rate", "log"),
    NegativeBinomial: ("mean_", "log"), Gamma: ("spread", "log"), Exponential: ("spread", "log"),
    Bernoulli: ("p", "logit"), Binomial: ("p", "logit"), Weibull: ("scale", "log"),
    VonMises: ("mean_", "identity"),
}  # fmt: skip
# 1 / df of the Student's t that stands for a normal law: small enough that the log density is off
# by 1e-5 (e^4 - 2 e^2 - 1) / 4, large enough that derivatives in 1 / df survive the rounding of
# log Gamma((df + 1) / 2) - log Gamma(df / 2).
NORMAL = 1e-5


def rebuilt(d: Distribution, parameters: Mapping[str, Any]) -> Distribution:
    """A law of the same family with these parameters for its own, of a truncated or zero-inflated
    one for those of the law inside."""
    inside = isinstance(d, (Truncated, ZeroInflated))
    return d.rebuilt({f"like_{k}" if inside else k: v for k, v in parameters.items()})


def _inner(d: Distribution) -> Distribution:
    """The law inside a truncated or zero-inflated one."""
    return d.base if isinstance(d, (Truncated, ZeroInflated)) else d


def truncated(base: Distribution, bounds: Mapping[str, ExprArray]) -> Truncated:
    """A law truncated at the bounds of `bounds_of`; infinite ones are left out."""
    kept = {k: v for k, v in bounds.items() if not infinite(v)}
    return Truncated(base, **kept)


def infinite(bound: Any) -> bool:
    """Whether a bound bounds nothing."""
    return all(e.op == "const" and math.isinf(e.data) for e in array(bound).ravel())


def bounds_of(d: Truncated) -> dict[str, ExprArray]:
    """As the user gave them: whole numbers are taken of them again where the law is discrete."""
    out = {}
    for name, op in (("lower", "ceil"), ("upper", "floor")):
        flat = [e.args[0] if d.discrete and e.op == op else e for e in d.parameters[name].ravel()]
        out[name] = array(array(flat).reshape(d.shape))
    return out


def substituted(d: Distribution, replacement: Mapping[Expr, Expr]) -> Distribution:
    """The law with symbols replaced; the law itself where it holds none of them."""
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
    if type(inner) in _MEAN:
        return _MEAN[type(inner)][1]
    kind = type(inner).__name__
    return NotApplicable(f"its law is {kind}, whose mean cannot be moved by an increment",
                         d.location)  # fmt: skip


def noise_free(d: Distribution, index: Index) -> Expr:
    """The value without noise, on the scale of the quantity itself (truncation left out)."""
    inner = _inner(d)
    if isinstance(inner, (Gamma, Exponential, Binomial, Weibull)):
        return _entry(inner.mean(), index)
    value = _entry(inner.parameters[_MEAN[type(inner)][0]], index)
    return apply("exp", value) if isinstance(inner, LogNormal) else value


def _entry(values: Any, index: Index) -> Expr:
    values = array(values)
    entry: Expr = values[index] if values.ndim == len(index) else values[()]
    return entry


def shifted(d: Distribution, changes: Changes) -> Distribution:
    """The law with means at these indices moved, on the scale of `scale_of_mean`."""
    inner = _inner(d)
    name, scale = _MEAN[type(inner)]
    sign = 1.0
    if name == "spread":
        name = inner.spread  # type: ignore[assignment]
        sign = -1.0 if name == "rate" else 1.0

    def change(value: Expr, by: Expr) -> Expr:
        if scale in ("identity", "mean of the log"):
            return value + by
        if scale == "log":
            return value * apply("exp", sign * by)
        growth = apply("expm1", by)  # of the odds
        return value * (1.0 + growth) / (1.0 + value * growth)

    return rebuilt(d, {name: _changed(d, inner.parameters[name], changes, change)})


def _changed(d: Distribution, values: ExprArray, changes: Changes, change: Any) -> ExprArray:
    out = np.array(np.broadcast_to(values.view(np.ndarray), d.shape))
    for index, by in changes.items():
        out[index] = change(out[index], by)
    return array(out)


# -- variances
_SCALE = {LogNormal: "sd", StudentT: "scale", Laplace: "scale", Cauchy: "scale",
          VonMises: "concentration"}  # fmt: skip


def has_scale(d: Distribution) -> NotApplicable | None:
    """Why the law has no variance of its own that could be scaled; None where it has."""
    inner = _inner(d)
    if isinstance(inner, (Normal, MvNormal)) or type(inner) in _SCALE:
        return None
    kind = type(inner).__name__
    reason = f"its law is {kind}, whose variance follows from its mean"
    if isinstance(inner, Dirac):
        reason = "it has no noise (Dirac)"
    elif isinstance(inner, (Mixture, Written)):
        reason = f"its law is {kind}, of which no argument is known to be its spread"
    return NotApplicable(reason, d.location)


def scaled(d: Distribution, changes: Changes) -> Distribution:
    """The law with increments of the log variance of the components at these indices."""
    inner = _inner(d)
    if isinstance(inner, MvNormal):
        name = inner.spread
        half = -0.5 if name == "precision" else 0.5
        matrix = np.array(inner.parameters[name].view(np.ndarray))
        for (i,), by in changes.items():
            factor = apply("exp", half * by)
            matrix[i, :] = [factor * e for e in matrix[i, :]]
            if name != "cholesky":
                matrix[:, i] = [factor * e for e in matrix[:, i]]
        return rebuilt(d, {name: array(matrix)})
    name = inner.spread if isinstance(inner, Normal) else _SCALE[type(inner)]
    power = {"variance": 1.0, "precision": -1.0, "concentration": -1.0}.get(name, 0.5)
    return rebuilt(d, {name: _changed(d, inner.parameters[name], changes,
                                      lambda s, by: s * apply("exp", power * by))})  # fmt: skip


# -- tails
def has_tail(d: Distribution) -> NotApplicable | None:
    """Why Student's t cannot stand for the law; None where it can."""
    inner = _inner(d)
    if isinstance(inner, Normal):
        return None
    kind = type(inner).__name__
    return NotApplicable(f"its law is {kind}: heavier tails are for Normal ones", d.location)


def heavier(d: Distribution, changes: Changes) -> Distribution:
    """Student's t with 1 / df = `NORMAL` + the changes at these indices, for a normal law."""
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
    if isinstance(d, Truncated):
        student = truncated(student, bounds_of(d))
        student.location = d.location
    return student
