"""The complete-data density of a trace, as terms that can be weighed, summed and separated.

log p(x_{1:T}, y_{1:T}, theta) = sum of the terms of `prior`, of `initial` at t = 1, of
`transition` at t = 2..T and of `observation` at t = 1..T.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssmppl.errors import Location, NotApplicable
from ssmppl.expressions.arrays import ExprArray, array, elementwise, inverse, log_determinant
from ssmppl.expressions.expr import Expr, apply, as_expr, attributed, constant
from ssmppl.language.distributions.multivariate import Centred, surely_positive, where_definite
from ssmppl.language.model.trace import Site, Trace, seen


@dataclass(frozen=True)
class Missing:
    """What the data lack, as far as the generated code depends on it.

    none : every entry was measured, so no term is ever left out.
    partial : names of channels with a joint distribution of which single components are missing.
    noise, spread : why an observation, and why the states have no density in some row; None where
        they have one in all.
    """

    none: bool = False
    partial: frozenset[str] = frozenset()
    noise: NotApplicable | None = None
    spread: NotApplicable | None = None


@dataclass(frozen=True)
class Term:
    """One summand of a log density.

    guard : the term counts where this is true (1); None: always.
    """

    site: Site
    log_density: Expr
    guard: Expr | None

    @property
    def where(self) -> Location:
        return self.site.distribution.location

    def guarded(self) -> Expr:
        """The term as one expression, 0 where the guard is false."""
        if self.guard is None:
            return self.log_density
        return apply("where", self.guard, self.log_density, 0.0)


def terms(trace: Trace, role: str, missing: Missing = Missing(), guard: bool = True) -> list[Term]:
    """The terms of one role: "prior", "initial", "transition" or "observation".

    guard=False leaves the supports out of the densities, as algebra on them needs it.
    """
    if role == "observation":
        out = []
        for s in trace.observations.values():
            with attributed(trace.locations, s.distribution.location):
                out += _observed(s, missing, guard)
        return out
    sites = {
        "prior": trace.parameters, "initial": trace.initial, "transition": trace.transition
    }[role]  # fmt: skip
    out = []
    for s in sites.values():
        with attributed(trace.locations, s.distribution.location):
            out.append(Term(s, s.distribution.log_density(s.value, guard), None))
    return out


def _observed(site: Site, missing: Missing, guard: bool) -> list[Term]:
    d = site.distribution
    if missing.none:
        return [Term(site, d.log_density(site.value, guard), None)]
    masks = array([seen(s) for s in site.components])
    if d.joint:
        if site.name in missing.partial and isinstance(d, Centred) and d.margins:
            return [Term(site, marginal_density(d, site.value, masks, guard), any_of(masks))]
        return [Term(site, d.log_density(site.value, guard), masks[0])]
    densities = d.guarded_log_densities(site.value) if guard else d.log_densities(site.value)
    flat = array(np.broadcast_to(array(densities).view(np.ndarray), site.shape)).ravel()
    return [Term(site, e, m) for e, m in zip(flat, masks, strict=True)]


def any_of(masks: ExprArray) -> Expr:
    """1 where any component was measured."""
    total = constant(0.0)
    for m in masks:
        total = apply("maximum", total, m) if total.op != "const" else m
    return total


def marginal_density(d: Centred, value: ExprArray, masks: ExprArray, guard: bool = True) -> Expr:
    """Log density of the measured components of a Gaussian or Student vector.

    With m the 0/1 vector of measured components, the marginal distribution of these is that of m *
    y with the matrix (m m') * C + diag(1 - m), for so many components as were measured.

    guard : -inf where what was measured has no covariance that is positive definite. The formula
        may have any value there, +inf too: [[0, c], [c, 1]], whose 0 is a square that underflowed,
        has an inverse and a determinant.
    """
    whole = d.whole_matrix()
    residual = where_measured(masks, value - d.centre)
    covariance = mask_covariance(whole, masks)
    quadratic = residual @ inverse(covariance) @ residual
    density = as_expr(d.of_form(quadratic, -0.5 * log_determinant(covariance), np.sum(masks)))
    if not guard or surely_positive(whole):
        return density
    return where_definite(covariance, density)


def where_measured(masks: ExprArray, values: ExprArray) -> ExprArray:
    """The values where they were measured, else 0; no product, which of an infinite one is NaN."""
    return array(elementwise("where", masks, values, 0.0))


def mask_covariance(covariance: ExprArray, masks: ExprArray) -> ExprArray:
    """(m m') * C + diag(1 - m): unit variance, uncorrelated, where not measured."""
    kept = where_measured(array(np.outer(masks, masks)), covariance)
    return array(kept + np.diag(array(1.0 - masks)))
