"""The exact E-step of linear Gaussian models, as expressions of the smoothed moments.

Given y, (x_t, x_{t-1}) is jointly Gaussian, so that a function c of theirs that is at most
quadratic has the expectation

    E[c] = c(means) + trace(H Sigma) / 2,

with its Hessian H and the joint covariance Sigma (Shumway and Stoffer 1982, "An approach to time
series smoothing and forecasting using the EM algorithm", spell this out for their model). In the
expressions below the states' symbols stand for the means, and symbols of kind "moment" for

    covariance (i, j)       Cov(x_t[i], x_t[j]), i >= j
    covariance_prev (i, j)  Cov(x_{t-1}[i], x_{t-1}[j]), i >= j
    cross (i, j)            Cov(x_t[i], x_{t-1}[j])
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ssmppl.analysis.density import Missing
from ssmppl.analysis.mstep import MStep, counted
from ssmppl.analysis.sufficient import (
    NOTHING_MISSING,
    CompleteData,
    complete_data,
    degenerate,
    restricted,
)
from ssmppl.errors import NotApplicable
from ssmppl.expressions.calculus import NotDifferentiable, differentiate
from ssmppl.expressions.expr import Expr, constant, depends_on, symbol, symbols_of, to_text
from ssmppl.language.traced import Trace

IN_TIME = ("initial", "transition", "observation")


def moment(which: str, i: int, j: int) -> Expr:
    """The symbol of one second moment; see the module."""
    if which != "cross":
        i, j = max(i, j), min(i, j)
    return symbol("moment", which, (i, j))


def expectation(expressions: Sequence[Expr], trace: Trace) -> list[Expr] | NotApplicable:
    """E of each expression given y; NotApplicable where one is not quadratic in the states."""
    states, before = trace.state_symbols, trace.state_prev_symbols
    variables = [*states, *before]
    out = []
    for e in expressions:
        mine = [(k, s) for k, s in enumerate(variables) if s in symbols_of(e)]
        total = e
        for k, s in mine:
            try:
                (slope,) = differentiate([e], s)
                seconds = [(m, differentiate([slope], r)[0]) for m, r in mine if m <= k]
            except NotDifferentiable as error:
                return NotApplicable(str(error))
            for m, second in seconds:
                if second.op == "const" and second.data == 0.0:
                    continue
                if depends_on(second, variables):
                    return NotApplicable(f"{to_text(e)[:100]} is not quadratic in the states")
                share = 0.5 if m == k else 1.0
                total = total + share * second * _covariance(k, m, len(states))
        out.append(total)
    return out


def _covariance(k: int, m: int, n: int) -> Expr:
    """Of the variables k >= m among (x_t, x_{t-1})."""
    if k < n:
        return moment("covariance", k, m)
    if m >= n:
        return moment("covariance_prev", k - n, m - n)
    return moment("cross", m, k - n)


def expected_statistics(step: MStep) -> dict[str, list[Expr]] | NotApplicable:
    """role -> what a row adds to each E[C_i | y], as expressions of moments."""
    out = {}
    for role in IN_TIME:
        found = expectation(step.update.coefficients[role], step.trace)
        if isinstance(found, NotApplicable):
            return found
        out[role] = found
    return out


@dataclass(frozen=True)
class ExpectedDensity:
    """Q itself, for models whose densities do not separate.

    summands : role -> what a row adds to Q, in theta and in moments, "prior" counting once.
    """

    trace: Trace
    free: tuple[Expr, ...]
    summands: dict[str, Expr]

    @cached_property
    def slopes(self) -> dict[str, list[Expr]] | NotApplicable:
        """role -> derivatives of the summand in the free parameters."""
        try:
            return {
                role: [differentiate([e], s)[0] for s in self.free]
                for role, e in self.summands.items()
            }
        except NotDifferentiable as error:
            return NotApplicable(str(error))


def expected_density(
    trace: Trace, fixed: Sequence[str] = (), missing: Missing = NOTHING_MISSING,
    posterior: bool = False,
) -> ExpectedDensity | NotApplicable:  # fmt: skip
    """Q as an expression of theta and of the smoothed moments."""
    free = [c for n, site in trace.parameters.items() if n not in fixed for c in site.components]
    data = counted(complete_data(trace, missing), posterior)
    reason = unsuited(data, free)
    if reason is not None:
        return reason
    members, summands = frozenset(free), {}
    for role in ("prior", *IN_TIME):
        total = constant(0.0)
        for factor in data.factors:
            if factor.role == role and factor.symbols & members:
                total = total + factor.density
        found = [total] if role == "prior" else expectation([total], trace)
        if isinstance(found, NotApplicable):
            return found
        summands[role] = found[0]
    return ExpectedDensity(trace, tuple(free), summands)


def unsuited(data: CompleteData, free: Sequence[Expr]) -> NotApplicable | None:
    """Why the states cannot serve as missing data for these parameters, if they cannot.

    Given the states, a deterministic law or a support that depends on a parameter determines it,
    or cuts it off, so that Q has no interior maximum.
    """
    found = degenerate(data, free)
    return found if found is not None else restricted(data, free)


def moments_of(
    mean: np.ndarray, covariance: np.ndarray, cross: np.ndarray, trace: Trace
) -> dict[Expr, np.ndarray]:
    """Symbol -> values over the rows (T,), from smoothed moments (T, D), (T, D, D), (T, D, D).

    Row 0 of what concerns x_{t-1} has no meaning.
    """
    n, before = mean.shape[1], np.maximum(np.arange(len(mean)) - 1, 0)
    values: dict[Expr, np.ndarray] = {}
    for k, (s, p) in enumerate(zip(trace.state_symbols, trace.state_prev_symbols, strict=True)):
        values[s], values[p] = mean[:, k], mean[before, k]
    for i in range(n):
        for j in range(n):
            values[moment("cross", i, j)] = cross[:, i, j]
            if j <= i:
                values[moment("covariance", i, j)] = covariance[:, i, j]
                values[moment("covariance_prev", i, j)] = covariance[before, i, j]
    return values
