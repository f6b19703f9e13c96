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
)
from ssmppl.analysis.families_matrix import MatrixNormalWishart, Wishart, lower_half
from ssmppl.analysis.sufficient import BlockForm
from ssmppl.expressions.algebra import Monomial, Separation, separate
from ssmppl.expressions.expr import Expr, apply, item, matrix_op
from ssmppl.expressions.zero import cancels


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
    inverse = _cells(components, size, inverse=True)
    inverted = tuple(places.get(frozenset({(inverse[cell], 1.0)}), -1) for cell in cells)
    if any(i >= 0 for i in inverted):
        return Wishart(size, log, inverted, True)
    linear = tuple(
        places.get(frozenset({(half[i, j], 1.0)}), -1) if i >= j else -1 for i, j in cells
    )
    return Wishart(size, log, linear, False)


def match_matrix_normal(
    thetas: Sequence[Expr], components: Sequence[Expr], size: int, form: BlockForm
) -> MatrixNormalWishart | None:
    """A Normal matrix A whose rows the symmetric matrix of these components joins, W or W^-1.

    theta is in row i where W_ii theta**2 is a function; its column is its place among the thetas of
    the row. All that W multiplies must have the coefficients that one S_yz and one K give.
    """
    wishart = match_wishart(components, size, form.monomials)
    if not isinstance(wishart, Wishart):
        return None
    places = _places(form.monomials)
    cells = _cells(components, size, wishart.inverse)

    def at(i: int, j: int, *others: Expr) -> tuple[int, ...]:
        """Positions of W_ij times these, by either name of the cell."""
        power = frozenset((x, float(sum(y is x for y in others))) for x in others)
        names = dict.fromkeys((cells[i, j], cells[j, i]))
        return tuple(places[m] for w in names if (m := power | {(w, 1.0)}) in places)

    rows: list[list[int]] = [[] for _ in range(size)]
    for place, theta in enumerate(thetas):
        mine = [i for i in range(size) if at(i, i, theta, theta)]
        if len(mine) != 1:
            return None
        rows[mine[0]].append(place)
    if len({len(row) for row in rows}) != 1:
        return None
    a = [[thetas[place] for place in row] for row in rows]
    columns = range(len(a[0]))
    linear = [[at(i, i, a[i][k]) for k in columns] for i in range(size)]
    quadratic = [[at(0, 0, a[0][k], a[0][m]) for m in columns] for k in columns]
    members = set(wishart.used)
    for i, j in cells:
        for k in columns:
            found = at(i, j, a[j][k])
            members.update(found)
            if not _same(form, found, linear[i][k]):
                return None
            for m in columns:
                found, twice = at(i, j, a[i][k], a[j][m]), i != j and k == m
                members.update(found)
                if not _same(form, found, quadratic[k][m] * (2 if twice else 1)):
                    return None
    return MatrixNormalWishart(
        wishart, tuple(map(tuple, rows)), _first(linear), _first(quadratic), frozenset(members)
    )


def _cells(components: Sequence[Expr], size: int, inverse: bool) -> dict[tuple[int, int], Expr]:
    """W_ij, as functions of the block name it: those of a precision by its lower half."""
    half = dict(zip(lower_half(size), components, strict=True))
    entries = {(i, j): half[max(i, j), min(i, j)] for i in range(size) for j in range(size)}
    if not inverse:
        return entries
    node = matrix_op("inverse", entries.values(), size)
    return {(i, j): item(node, i, j) for i, j in entries}


def _same(form: BlockForm, first: tuple[int, ...], second: tuple[int, ...]) -> bool:
    """Whether the coefficients at these positions have the same sum, in each role."""
    if first == second:
        return True
    for coefficients in form.coefficients.values():
        parts = [coefficients[i] for i in first] + [-coefficients[i] for i in second]
        parts = [p for p in parts if not (p.op == "const" and p.data == 0.0)]
        if parts and not cancels(parts):
            return False
    return True


def _first(found: list[list[tuple[int, ...]]]) -> tuple[tuple[int, ...], ...]:
    return tuple(tuple(places[0] if places else -1 for places in row) for row in found)


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
