"""Parameters on an unconstrained scale, with their Jacobians.

Numbers: identity, log, or logit between bounds (which may depend on earlier parameters).
Probability vectors: stick breaking. Positive definite matrices: the Cholesky factor with the log of
its diagonal. Stan Development Team (2024), "Stan reference manual", section "Constraint
transforms", gives the Jacobians.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from ssmppl.expressions.arrays import array
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import Expr, apply, constant, substitute, symbol
from ssmppl.language.distributions.positive import LEAST_SHARE
from ssmppl.language.model.trace import Site, Trace

ZERO = constant(0.0)


@dataclass(frozen=True)
class Transform:
    """One parameter's way from the unconstrained scale and back.

    free : the symbols of the unconstrained numbers, kind "unconstrained".
    components : the parameter's own symbols. values : these as expressions of `free` and of
        earlier parameters. log_jacobian : log |d values / d free|.
    """

    site: Site
    free: tuple[Expr, ...]
    components: tuple[Expr, ...]
    values: tuple[Expr, ...]
    log_jacobian: Expr

    @property
    def on_the_line(self) -> tuple[bool, ...]:
        """For each free number whether it has the parameter's own unit and may be any number."""
        if self.site.distribution.support().kind == "positive definite":
            return tuple(i != j for i, j in _lower(self.site.shape[0]))
        if len(self.free) != len(self.values):
            return (False,) * len(self.free)
        return tuple(z is value for z, value in zip(self.free, self.values, strict=True))

    def inverse(self, value: np.ndarray, known: dict[Expr, float]) -> np.ndarray:
        """The unconstrained numbers of a value (the site's shape), numerically."""
        support = self.site.distribution.support()
        if support.kind == "simplex":
            return np.concatenate([_unstick(row) for row in value.reshape(-1, value.shape[-1])])
        if support.kind == "positive definite":
            root = np.linalg.cholesky(value)
            out = [math.log(root[i, i]) if i == j else root[i, j] for i, j in _lower(len(value))]
            return np.array(out)
        lower = np.broadcast_to(evaluate(array(support.lower), known), value.shape).ravel()
        upper = np.broadcast_to(evaluate(array(support.upper), known), value.shape).ravel()
        pairs = zip(value.ravel(), lower, upper, strict=True)
        return np.array([free_number(v, a, b) for v, a, b in pairs])


def transforms(trace: Trace) -> list[Transform]:
    """The transform of each parameter, in the trace's order."""
    return [_transform(site) for site in trace.parameters.values()]


@dataclass(frozen=True)
class Unconstrained:
    """The free parameters of a trace on their unconstrained scale.

    z : symbols of the unconstrained numbers. values : symbol of a free parameter -> expression in
    z and in the parameters that are not free. log_jacobian : log |d values / d z|.
    """

    z: tuple[Expr, ...]
    values: dict[Expr, Expr]
    log_jacobian: Expr


def unconstrained(trace: Trace, free: Iterable[bool]) -> Unconstrained:
    """The parameters that `free` says are free, one truth value for each site of the trace."""
    z: list[Expr] = []
    values: dict[Expr, Expr] = {}
    log_jacobian = constant(0.0)
    for t, is_free in zip(transforms(trace), free, strict=True):
        if is_free:
            z += t.free
            *own, part = substitute([*t.values, t.log_jacobian], values)
            values.update(zip(t.components, own, strict=True))
            log_jacobian = log_jacobian + part
    return Unconstrained(tuple(z), values, log_jacobian)


def _transform(site: Site) -> Transform:
    support = site.distribution.support()
    components = tuple(site.components)
    if support.kind == "simplex":
        k = site.shape[-1]
        z, values, log_jacobian = _free_symbols(site, len(components) // k * (k - 1)), [], ZERO
        for first in range(0, len(z), k - 1):  # of each row
            row, part = _stick(z[first : first + k - 1])
            values += row
            log_jacobian = log_jacobian + part
    elif support.kind == "positive definite":
        p = site.shape[0]
        z = _free_symbols(site, p * (p + 1) // 2)
        values, log_jacobian = _cholesky(z, p, site)
    else:
        z = _free_symbols(site, len(components))
        lower, upper = array(support.lower).ravel(), array(support.upper).ravel()
        values, log_jacobian = [], constant(0.0)
        for s, a, b in zip(z, lower, upper, strict=True):
            value, part = _bounded(s, a, b)
            values.append(value)
            log_jacobian = log_jacobian + part
    return Transform(site, tuple(z), components, tuple(values), log_jacobian)


def _free_symbols(site: Site, n: int) -> list[Expr]:
    return [symbol("unconstrained", site.name, (i,)) for i in range(n)]


def _is(e: Expr, value: float) -> bool:
    return e.op == "const" and e.data == value


def _bounded(z: Expr, lower: Expr, upper: Expr) -> tuple[Expr, Expr]:
    if _is(lower, -math.inf) and _is(upper, math.inf):
        return z, constant(0.0)
    if _is(upper, math.inf):
        return lower + apply("exp", z), z
    if _is(lower, -math.inf):
        return upper - apply("exp", z), z
    share = 1.0 / (1.0 + apply("exp", -z))
    # log share + log(1 - share), from whichever side does not cancel
    tails = -apply("logaddexp", 0.0, z) - apply("logaddexp", 0.0, -z)
    return lower + (upper - lower) * share, apply("log", upper - lower) + tails


def free_number(value: float, lower: float, upper: float) -> float:
    """A number between bounds, on the unconstrained scale."""
    # a search that ran towards a bound ends on it by rounding
    if value == lower:
        value = math.nextafter(lower, math.inf)
    if value == upper:
        value = math.nextafter(upper, -math.inf)
    if lower == -math.inf and upper == math.inf:
        return value
    if upper == math.inf:
        return math.log(value - lower)
    if lower == -math.inf:
        return math.log(upper - value)
    return math.log(value - lower) - math.log(upper - value)


def _stick(z: list[Expr]) -> tuple[list[Expr], Expr]:
    left, values, log_jacobian = constant(1.0), [], constant(0.0)
    k = len(z) + 1
    for i, s in enumerate(z):
        at = s - math.log(k - i - 1.0)
        share = 1.0 / (1.0 + apply("exp", -at))
        tails = -apply("logaddexp", 0.0, at) - apply("logaddexp", 0.0, -at)
        log_jacobian = log_jacobian + tails + apply("log", left)
        values.append(left * share)
        left = left * (1.0 / (1.0 + apply("exp", at)))  # 1 - share, however near 1 that is
    return [*values, left], log_jacobian


def _unstick(value: np.ndarray) -> np.ndarray:
    # a search that ran towards an edge ends on a share of zero by rounding
    shares = np.maximum(value, LEAST_SHARE)
    left = np.cumsum(shares[::-1])[::-1]  # of each share and those that follow
    many = np.arange(len(value) - 1.0, 0.0, -1.0)
    return np.log(shares[:-1]) - np.log(left[1:]) + np.log(many)


def _lower(p: int) -> list[tuple[int, int]]:
    return [(i, j) for i in range(p) for j in range(i + 1)]


def _cholesky(z: list[Expr], p: int, site: Site) -> tuple[list[Expr], Expr]:
    root = np.full((p, p), 0.0, dtype=object)
    log_jacobian = constant(p * math.log(2.0))
    for s, (i, j) in zip(z, _lower(p), strict=True):
        root[i, j] = apply("exp", s) if i == j else s
        if i == j:
            log_jacobian = log_jacobian + (p - i + 1.0) * s
    matrix = array(root) @ array(root).T
    place = {s: i for i, s in reversed(list(enumerate(site.value.ravel())))}
    return [matrix.ravel()[place[s]] for s in site.components], log_jacobian


def parameter_bounds(trace: Trace) -> list[tuple[float, float]] | None:
    """Bounds of every component; None where some depend on other parameters, or a parameter is
    not made of free numbers (a simplex, a positive definite matrix)."""
    out = []
    for site in trace.parameters.values():
        support = site.distribution.support()
        if support.kind in ("simplex", "positive definite"):
            return None
        for pair in zip(array(support.lower).ravel(), array(support.upper).ravel(), strict=True):
            if any(e.op != "const" for e in pair):
                return None
            out.append((pair[0].data, pair[1].data))
    return out


def unconstrain(
    trace: Trace, theta: np.ndarray, values: dict[str, np.ndarray],
    made: Sequence[Transform] | None = None,
) -> np.ndarray:  # fmt: skip
    """The unconstrained numbers of all parameters, given theta (P,) and its values by name.

    made : the transforms, for those who ask for many points.
    """
    known = dict(zip(trace.parameter_symbols, theta, strict=True))
    known_as = transforms(trace) if made is None else made
    parts = [t.inverse(np.asarray(values[t.site.name]), known) for t in known_as]
    return np.concatenate([*parts, np.empty(0)])
