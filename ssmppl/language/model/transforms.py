"""Parameters on an unconstrained scale, with their Jacobians.

Numbers: identity, log, or logit between bounds (which may depend on earlier parameters).
Probability vectors: stick breaking. Positive definite matrices: the Cholesky factor with the log of
its diagonal. Correlation matrices: the inverse hyperbolic tangents of partial correlations.
Increasing vectors: the logarithms of the gaps, or between two bounds, where a stick is broken. Stan
Development Team (2024), "Stan reference manual", section "Constraint transforms", gives the
Jacobians.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from ssmppl.expressions.arrays import ExprArray, array
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import Expr, apply, constant, substitute, symbol
from ssmppl.language.distributions.positive import LEAST_SHARE
from ssmppl.language.distributions.vectors.correlations import with_unit_diagonal
from ssmppl.language.model.trace import Site, Trace, once_per_trace

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
        if support.kind == "correlation":
            return free_correlations(value)
        if support.kind == "simplex":
            return np.concatenate([_unstick(row) for row in value.reshape(-1, value.shape[-1])])
        if support.kind == "positive definite":
            root = np.linalg.cholesky(value)
            out = [math.log(root[i, i]) if i == j else root[i, j] for i, j in _lower(len(value))]
            return np.array(out)
        lower = np.broadcast_to(evaluate(array(support.lower), known), value.shape).ravel()
        upper = np.broadcast_to(evaluate(array(support.upper), known), value.shape).ravel()
        if support.kind == "ordered":
            k, out = value.shape[-1], []
            for first in range(0, value.size, k):  # of each row
                out.append(_free_gaps(value.ravel()[first : first + k], lower[first], upper[first]))
            return np.concatenate(out)
        pairs = zip(value.ravel(), lower, upper, strict=True)
        return np.array([free_number(v, a, b) for v, a, b in pairs])


@once_per_trace
def transforms(trace: Trace) -> tuple[Transform, ...]:
    """The transform of each parameter, in the trace's order."""
    return tuple(_transform(site) for site in trace.parameters.values())


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
    elif support.kind == "correlation":
        p = site.shape[0]
        z = _free_symbols(site, p * (p - 1) // 2)
        values, log_jacobian = _correlations(z, p, site)
    elif support.kind == "ordered":
        k = site.shape[-1]
        z, values, log_jacobian = _free_symbols(site, len(components)), [], ZERO
        ends = array(support.lower).ravel(), array(support.upper).ravel()
        for first in range(0, len(z), k):  # of each row
            row, part = _gaps(z[first : first + k], ends[0][first], ends[1][first])
            values += row
            log_jacobian = log_jacobian + part
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
    return _distinct(array(root) @ array(root).T, site), log_jacobian


def _distinct(matrix: ExprArray, site: Site) -> list[Expr]:
    """The entries of a symmetric matrix in the order of the site's components."""
    place = {s: i for i, s in reversed(list(enumerate(site.value.ravel())))}
    return [matrix.ravel()[place[s]] for s in site.components]


def _correlations(z: list[Expr], p: int, site: Site) -> tuple[list[Expr], Expr]:
    """tanh z are partial correlations: of a row and column, given the columns before it."""
    root = np.full((p, p), ZERO, dtype=object)
    root[0, 0], log_jacobian, given = constant(1.0), ZERO, iter(z)
    for i in range(1, p):
        left = constant(1.0)  # the root of what is left of the row's unit length
        for j in range(i):
            s = next(given)
            root[i, j] = left * apply("tanh", s)
            log_cosh = apply("logaddexp", s, -s) - math.log(2.0)
            left = left * apply("exp", -log_cosh)
            log_jacobian = log_jacobian - (p - j) * log_cosh
        root[i, i] = left
    return _distinct(with_unit_diagonal(array(root) @ array(root).T), site), log_jacobian


def free_correlations(matrix: np.ndarray) -> np.ndarray:
    """The unconstrained numbers of a correlation matrix; of one that is singular by rounding, those
    of one next to it."""
    root = np.linalg.cholesky(_regular(matrix))
    left = np.sqrt(np.cumsum((root**2)[:, ::-1], axis=1)[:, ::-1])  # of a row from a column on
    return np.array([
        math.asinh(root[i, j] / left[i, j + 1]) for i in range(1, len(root)) for j in range(i)
    ])  # fmt: skip


def _regular(matrix: np.ndarray) -> np.ndarray:
    """A correlation matrix shrunk towards the identity until it is positive definite."""
    for shrunk in (0.0, *10.0 ** np.arange(-15.0, 0.0)):
        found = (1.0 - shrunk) * matrix + shrunk * np.eye(len(matrix))
        try:
            if np.all(np.diagonal(np.linalg.cholesky(found)) > 0.0):
                return found
        except np.linalg.LinAlgError:
            continue
    return np.eye(len(matrix))


def _gaps(z: list[Expr], lower: Expr, upper: Expr) -> tuple[list[Expr], Expr]:
    """Numbers in increasing order: the one next to a bound, or the first of all, and the gaps."""
    bounded = not _is(lower, -math.inf), not _is(upper, math.inf)
    if all(bounded):
        shares, log_jacobian = _stick(z)
        width, values, below = upper - lower, list[Expr](), constant(0.0)
        for share in shares[:-1]:
            below = below + share
            values.append(lower + width * below)
        return values, log_jacobian + len(z) * apply("log", width)
    sign, order = (-1.0, z[::-1]) if bounded[1] else (1.0, z)  # downwards from an upper bound
    value, log_jacobian = _bounded(order[0], lower, upper)
    values = [value]
    for s in order[1:]:
        values.append(values[-1] + sign * apply("exp", s))
        log_jacobian = log_jacobian + s
    return values[::-1] if bounded[1] else values, log_jacobian


def _free_gaps(value: np.ndarray, lower: float, upper: float) -> np.ndarray:
    gaps = np.diff(value)
    if lower > -math.inf and upper < math.inf:
        return _unstick(np.array([value[0] - lower, *gaps, upper - value[-1]]) / (upper - lower))
    # two that are one by rounding are next to each other
    least = np.maximum(np.spacing(np.abs(value[1:])), LEAST_SHARE)
    logs = np.log(np.maximum(gaps, least))
    if upper < math.inf:
        return np.array([*logs, free_number(value[-1], lower, upper)])
    return np.array([free_number(value[0], lower, upper), *logs])


def parameter_bounds(trace: Trace) -> list[tuple[float, float]] | None:
    """Bounds of every component; None where some depend on other parameters, or a parameter is
    not made of free numbers (`Support.tied`)."""
    out = []
    for site in trace.parameters.values():
        support = site.distribution.support()
        if support.tied:
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
