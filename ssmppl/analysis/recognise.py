"""Which family holds the functions of a block: (components, monomials) -> families.

By the functions alone, never by a distribution's name. What a family does not hold is left to the
caller, as a correction or a refusal.
"""

from __future__ import annotations

from collections.abc import Sequence

from ssmppl.analysis.families import (
    Beta,
    Dirichlet,
    Family,
    Gamma,
    Normal,
    NormalGamma,
    Wishart,
    lower_half,
)
from ssmppl.expressions.algebra import Monomial, Separation, separate
from ssmppl.expressions.expr import Expr, apply, item, matrix_op


def match_scalar(component: Expr, monomials: Sequence[Monomial], positive: bool) -> list[Family]:
    """Families of one number; those of a positive one only where its support is positive."""
    places = _places(monomials)
    log = places.get(frozenset({(apply("log", component), 1.0)}), -1)
    powers = {
        exponent: place
        for m, place in places.items()
        if len(m) == 1
        for atom, exponent in m
        if atom is component
    }
    found: list[Family] = []
    if positive:
        found += [Gamma(k, log, place) for k, place in sorted(powers.items(), reverse=True)]
    rest = places.get(_log_complement(component), -1)
    if rest >= 0 or (log >= 0 and not powers):
        found.append(Beta(log, rest))
    if 2.0 in powers:
        found.append(Normal((powers.get(1.0, -1),), ((powers[2.0],),)))
    return found


def _log_complement(component: Expr) -> Monomial:
    """log(1 - p), as `separate` writes it."""
    form = separate(apply("log", 1.0 - component), [component])
    return next(iter(form.terms)) if isinstance(form, Separation) else frozenset()


def match_normal(components: Sequence[Expr], monomials: Sequence[Monomial]) -> Normal | None:
    """A joint Normal in all components, where each has a square among the functions."""
    return _normal(components, _places(monomials))


def match_normal_gamma(
    thetas: Sequence[Expr], v: Expr, monomials: Sequence[Monomial]
) -> NormalGamma | None:
    """A Normal vector whose linear and quadratic functions all carry the factor v**k."""
    members = set(thetas)
    powers = {
        exponent
        for m in monomials
        for atom, exponent in m
        if atom is v and any(other in members for other, _ in m)
    }
    places = _places(monomials)
    log = places.get(frozenset({(apply("log", v), 1.0)}), -1)
    for k in sorted(powers):
        factor = (v, k)
        scaled = {m - {factor}: place for m, place in places.items() if factor in m}
        normal = _normal(thetas, scaled)
        if normal is not None:
            return NormalGamma(k, log, scaled.get(frozenset(), -1), normal)
    return None


def match_dirichlet(components: Sequence[Expr], monomials: Sequence[Monomial]) -> Dirichlet:
    """All components of one simplex."""
    places = _places(monomials)
    return Dirichlet(tuple(places.get(frozenset({(apply("log", p), 1.0)}), -1) for p in components))


def match_wishart(components: Sequence[Expr], size: int, monomials: Sequence[Monomial]) -> Family:
    """The lower half of one symmetric matrix: a Wishart or an inverse Wishart, by its functions."""
    places = _places(monomials)
    half = dict(zip(lower_half(size), components, strict=True))
    cells = [(i, j) for i in range(size) for j in range(size)]
    entries = [half[max(i, j), min(i, j)] for i, j in cells]
    if size == 1:
        families = match_scalar(components[0], monomials, positive=True)
        return families[0] if families else Gamma(1.0, -1, -1)
    log = places.get(frozenset({(matrix_op("logdet", entries, size), 1.0)}), -1)
    inverse = matrix_op("inverse", entries, size)
    inverted = tuple(places.get(frozenset({(item(inverse, i, j), 1.0)}), -1) for i, j in cells)
    if any(i >= 0 for i in inverted):
        return Wishart(size, log, inverted, True)
    linear = tuple(
        places.get(frozenset({(half[i, j], 1.0)}), -1) if i >= j else -1 for i, j in cells
    )
    return Wishart(size, log, linear, False)


def _places(monomials: Sequence[Monomial]) -> dict[Monomial, int]:
    return {m: i for i, m in enumerate(monomials)}


def _normal(thetas: Sequence[Expr], places: dict[Monomial, int]) -> Normal | None:
    linear = tuple(places.get(frozenset({(a, 1.0)}), -1) for a in thetas)
    quadratic = tuple(
        tuple(
            places.get(frozenset({(a, 2.0)} if a is b else {(a, 1.0), (b, 1.0)}), -1)
            for b in thetas
        )
        for a in thetas
    )
    if any(quadratic[i][i] < 0 for i in range(len(thetas))):
        return None
    return Normal(linear, quadratic)
