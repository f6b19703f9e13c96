"""Derivatives of a model by its noise: first and second ones, which Newton's method needs, and
third ones, of which the gradient of its determinant is made.

x_t = F(x_{t-1}, e_t) as of `twisted.NoiseForm`; second derivatives are those of l' F, with l the
slope in x_t of all that follows (the costate), so that they are one symmetric matrix a row.
"""

from __future__ import annotations

from dataclasses import dataclass

from ssmppl.analysis.density import Missing
from ssmppl.analysis.proposals.twisted import LookaheadModel, NoiseForm, lookahead_model
from ssmppl.analysis.structure import exact_observation
from ssmppl.errors import NotApplicable
from ssmppl.expressions.calculus import (
    NotDifferentiable,
    differentiate,
    hessian,
    reverse_gradient,
)
from ssmppl.expressions.expr import Expr, constant, symbol
from ssmppl.language.model.trace import Trace


@dataclass(frozen=True)
class Bend:
    """Derivatives of a distribution by noise: dF / d(before, e) by rows of F, first all of
    `before`, then all of e; then the lower half of the second derivatives of l' F in (before, e).

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
    """Bends of the initial distribution and of the transition."""
    first, later = bend_of(found.initial, []), bend_of(found.transition, trace.state_prev_symbols)
    for one in (first, later):
        if isinstance(one, NotApplicable):
            return one
    assert isinstance(first, Bend)
    assert isinstance(later, Bend)
    return first, later


def laplace_obstacle(trace: Trace, missing: Missing) -> NotApplicable | None:
    """Why a model has no Laplace approximation of its states; None where it has."""
    exact = exact_observation(trace)
    if exact is not None:
        return exact
    found = lookahead_model(trace, missing)
    if isinstance(found, NotApplicable):
        return found
    bent = bends(found, trace)
    return bent if isinstance(bent, NotApplicable) else None


@dataclass(frozen=True)
class Adjoint:
    """Gradients of what a distribution by noise adds to Laplace's log-likelihood; see
    `codegen/kernels/gaussian/mode_gradient.py`.

    With z = (x_{t-1}, e), D = dF / dz and S the second derivatives of l' F in z,
    Phi = W : D + Xi : S / 2, and

        Psi = Phi + a' F + l' D v.

    given : symbols of e (R,), l (D,), W (D, Z) by rows, Xi (Z, Z) its lower half by rows, a (D,), v
    (Z,). moving : gradient of Phi in x_{t-1} (none of the initial distribution), e and l. fixed :
    of Psi in theta.
    """

    given: tuple[Expr, ...]
    moving: tuple[Expr, ...]
    fixed: tuple[Expr, ...]


def adjoint_of(
    form: NoiseForm, bend: Bend, before: list[Expr], parameters: list[Expr]
) -> Adjoint | NotApplicable:
    """What stands in `Adjoint`; NotApplicable where F is not three times differentiable."""
    d, r, n = len(form.value), len(form.noise), len(before) + len(form.noise)
    own = [symbol("noise", "noise", (r + d + k,)) for k in range(d * n + n * (n + 1) // 2 + d + n)]
    weights, covariance = own[: d * n], own[d * n : -(d + n)]
    pull, along = own[-(d + n) : -n], own[-n:]
    costate = bend.given[r:]
    # `Bend` lists dF / dx_{t-1} first, then dF / de
    first = _by_rows(bend.values, d, [len(before), r])
    second = bend.values[d * n :]
    phi, move = constant(0.0), constant(0.0)
    for i in range(d):
        for j in range(n):
            phi = phi + weights[i * n + j] * first[i][j]
            move = move + costate[i] * first[i][j] * along[j]
    m = 0
    for i in range(n):
        for j in range(i + 1):
            phi = phi + (0.5 if i == j else 1.0) * covariance[m] * second[m]
            m += 1
    for a, value in zip(pull, form.value, strict=True):
        move = move + a * value
    try:
        moving = reverse_gradient(phi, [*before, *form.noise, *costate])
        fixed = reverse_gradient(phi + move, parameters)
    except NotDifferentiable as error:
        return NotApplicable(f"the transition has no third derivatives: {error.found}")
    return Adjoint((*bend.given, *own), tuple(moving), tuple(fixed))


def _by_rows(values: tuple[Expr, ...], d: int, widths: list[int]) -> list[list[Expr]]:
    rows: list[list[Expr]] = [[] for _ in range(d)]
    at = 0
    for width in widths:
        for row in rows:
            row += values[at : at + width]
            at += width
    return rows


@dataclass(frozen=True)
class SeenAdjoint:
    """The same of an observation: of log g + b' dlog g / dx - P : H / 2, with H minus the second
    derivatives of log g.

    given : symbols of P (D, D) its lower half by rows, b (D,). moving : gradient of -P : H / 2 in
    x_t. fixed : of the whole in theta.
    """

    given: tuple[Expr, ...]
    moving: tuple[Expr, ...]
    fixed: tuple[Expr, ...]


def seen_adjoint(
    found: LookaheadModel, states: list[Expr], parameters: list[Expr]
) -> SeenAdjoint | NotApplicable:
    """What stands in `SeenAdjoint`; NotApplicable where log g is not differentiable three times."""
    d = len(states)
    own = [symbol("noise", "noise", (k,)) for k in range(d * (d + 1) // 2 + d)]
    covariance, along = own[:-d], own[-d:]
    spread, total = constant(0.0), found.observed
    m = 0
    for i in range(d):
        for j in range(i + 1):
            weight = -0.5 if i == j else -1.0
            spread = spread + weight * covariance[m] * found.curvature[i, j]
            m += 1
        total = total + along[i] * found.slope[i]
    try:
        moving = reverse_gradient(spread, states)
        fixed = reverse_gradient(total + spread, parameters)
    except NotDifferentiable as error:
        return NotApplicable(f"the observation has no third derivatives: {error.found}")
    return SeenAdjoint(tuple(own), tuple(moving), tuple(fixed))
