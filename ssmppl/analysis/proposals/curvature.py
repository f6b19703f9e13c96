"""First and second derivatives of a model by its noise: what Newton's method needs of it.

x_t = F(x_{t-1}, e_t) as of `twisted.NoiseForm`; second derivatives are those of l' F, with l the
slope in x_t of all that follows (the costate), so that they are one symmetric matrix a row.
"""

from __future__ import annotations

from dataclasses import dataclass

from ssmppl.analysis.density import Missing
from ssmppl.analysis.proposals.twisted import LookaheadModel, NoiseForm, lookahead_model
from ssmppl.errors import NotApplicable
from ssmppl.expressions.calculus import NotDifferentiable, differentiate, hessian
from ssmppl.expressions.expr import Expr, constant, symbol
from ssmppl.language.model.trace import Trace


@dataclass(frozen=True)
class Bend:
    """Derivatives of a law by noise: dF / d(before, e) by rows of F, first all of `before`, then
    all of e; then the lower half of the second derivatives of l' F in (before, e).

    given : the symbols of e (R,), then those of l (D,).
    """

    given: tuple[Expr, ...]
    values: tuple[Expr, ...]


def bend_of(form: NoiseForm, before: list[Expr]) -> Bend | NotApplicable:
    """What stands in `Bend`; NotApplicable where F is not twice differentiable."""
    r, d = len(form.noise), len(form.value)
    costate = [symbol("noise", "noise", (r + i,)) for i in range(d)]
    total = constant(0.0)
    for weight, value in zip(costate, form.value, strict=True):
        total = total + weight * value
    try:
        columns = [differentiate(list(form.value), z) for z in (*before, *form.noise)]
        second = hessian(total, [*before, *form.noise])
    except NotDifferentiable as error:
        return NotApplicable(f"the transition is not twice differentiable: {error.found}")
    n = len(before)
    out = [columns[j][i] for i in range(d) for j in range(n)]
    out += [columns[n + k][i] for i in range(d) for k in range(r)]
    out += [second[i, j] for i in range(n + r) for j in range(i + 1)]
    return Bend((*form.noise, *costate), tuple(out))


def bends(found: LookaheadModel, trace: Trace) -> tuple[Bend, Bend] | NotApplicable:
    """Of the initial law and of the transition."""
    first, later = bend_of(found.initial, []), bend_of(found.transition, trace.state_prev_symbols)
    for one in (first, later):
        if isinstance(one, NotApplicable):
            return one
    assert isinstance(first, Bend)
    assert isinstance(later, Bend)
    return first, later


def laplace_obstacle(trace: Trace, missing: Missing) -> NotApplicable | None:
    """Why a model has no Laplace approximation of its states; None where it has."""
    found = lookahead_model(trace, missing)
    if isinstance(found, NotApplicable):
        return found
    bent = bends(found, trace)
    return bent if isinstance(bent, NotApplicable) else None
