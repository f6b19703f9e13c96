"""The search for blocks of parameters with a closed-form conditional.

Largest first: a Normal vector together with its precision, joint Normal vectors, then one unit at a
time (a number, a simplex, a matrix). A block is told by its functions alone.

Which family holds the functions of a block: (components, monomials) -> families.

By the functions alone, never by a distribution's name. What a family does not hold is left to the
caller, as a correction or a refusal.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from ssmppl.analysis.conjugacy.describe import joined, shorten
from ssmppl.analysis.conjugacy.families import (
    Beta,
    Dirichlet,
    Family,
    Gamma,
    MatrixNormalWishart,
    Normal,
    NormalGamma,
    Wishart,
    lower_half,
)
from ssmppl.analysis.conjugacy.sufficient import (
    BOUNDED_ROLES,
    BlockForm,
    CompleteData,
    Factor,
    separate_block,
)
from ssmppl.errors import NotApplicable
from ssmppl.expressions.algebra import Monomial, Separation, separate
from ssmppl.expressions.expr import Expr, apply, constant, item, matrix_op, symbols_of, to_text
from ssmppl.expressions.zero import cancels
from ssmppl.language.model.traced import Site


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


@dataclass(frozen=True)
class Found:
    """A family for a block, and what it leaves over."""

    components: tuple[Expr, ...]
    form: BlockForm
    family: Family
    correction: tuple[int, ...]


class Search:
    def __init__(self, data: CompleteData, fixed: frozenset[str]):
        self.data = data
        self.sites = {n: s for n, s in data.trace.parameters.items() if n not in fixed}
        self.bound: dict[Expr, tuple[Expr, Expr]] = {}
        for site in self.sites.values():
            self.bound.update(bounds_of(site))
        self.single: dict[tuple[Expr, ...], Found | NotApplicable] = {}
        for unit in self._units():
            self.single[unit] = self._alone(unit)

    def _units(self) -> list[tuple[Expr, ...]]:
        """What is drawn at least together: a matrix, shares of one whole, else one component."""
        out: list[tuple[Expr, ...]] = []
        for site in self.sites.values():
            kind = kind_of(site)
            if kind == "simplex":  # a vector, or each row of a matrix
                out += [tuple(row) for row in site.value.reshape(-1, site.shape[-1])]
            elif kind == "matrix":
                out.append(tuple(site.components))
            else:
                out += [(c,) for c in site.components]
        return out

    def unread(self, components: Iterable[Expr]) -> list[str] | None:
        """None where some law reads one of these components; else the parameters that their own
        prior depends on."""
        block, trace = frozenset(components), self.data.trace
        for group in (trace.parameters, trace.initial, trace.transition, trace.observations):
            if any(block & _read_by(site) for site in group.values()):
                return None
        own = frozenset[Expr]().union(*(_read_by(self.site(c)) for c in block))
        return [n for n, s in trace.parameters.items() if not own.isdisjoint(s.components)]

    def site(self, component: Expr) -> Site:
        return self.sites[component.data[1]]

    # -- one unit by itself
    def _alone(self, unit: tuple[Expr, ...]) -> Found | NotApplicable:
        form = separate_block(self.data, unit, leave=True)
        if not isinstance(form, BlockForm):
            return form
        site = self.site(unit[0])
        kind, monomials = kind_of(site), form.monomials
        if kind == "simplex":
            candidates: list[Family] = [match_dirichlet(unit, monomials)]
        elif kind == "matrix":
            candidates = [match_wishart(unit, site.shape[0], monomials)]
        else:
            positive = self._positive(unit[0])
            candidates = match_scalar(unit[0], monomials, positive)
        found = [self._judged(unit, form, family) for family in candidates]
        good = [f for f in found if isinstance(f, Found)]
        if good:
            return min(good, key=lambda f: len(f.correction))
        return next(
            (f for f in found if isinstance(f, NotApplicable)), self._outside(form, frozenset())
        )

    def _positive(self, component: Expr) -> bool:
        lower = self.bound[component][0]
        return lower.op == "const" and lower.data >= 0.0

    def _judged(
        self, components: tuple[Expr, ...], form: BlockForm, family: Family
    ) -> Found | NotApplicable:
        """The family with its correction, where that does not grow with the series."""
        left = tuple(i for i in range(len(form.functions)) if i not in family.used)
        growing = [i for i in left if _grows(form, i)]
        if growing:
            return self._outside(form, family.used)
        if not family.used:
            return self._outside(form, frozenset())
        if form.left and not any(_grows(form, i) for i in family.used):
            return form.left[0][1]  # nothing but what was left tells of the block
        return Found(components, form, family, left)

    def _outside(self, form: BlockForm, used: frozenset[int]) -> NotApplicable:
        """The reason naming the functions that no family holds, and the lines they stem from."""
        names = joined(form.components)
        growing: list[int] = []
        others: list[int] = []
        for i in range(len(form.monomials)):
            if i not in used:
                (growing if _grows(form, i) else others).append(i)
        if form.left and not growing:
            return form.left[0][1]
        positions = growing or others or list(range(len(form.functions)))
        if not positions:
            where = self.site(form.components[0]).distribution.location
            reason = f"no density depends on {names}: a constant prior, and no law names it"
            return NotApplicable(reason, where)
        factor = form.origins[form.monomials[positions[0]]][-1]
        text = ", ".join(shorten(to_text(form.functions[i])) for i in positions[:4])
        more = ", ..." if len(positions) > 4 else ""
        laws = sorted(
            {f"{f.role} of {f.site}" for i in positions for f in form.origins[form.monomials[i]]}
        )
        return NotApplicable(
            f"{names} enters the {' and the '.join(laws)} through {text}{more}, outside the span "
            "of every family",
            factor.where,
        )

    # -- blocks
    def found(self) -> list[tuple[tuple[Expr, ...], Found | NotApplicable]]:
        """Blocks that partition the parameters, each with its family or the reason why none."""
        out: list[tuple[tuple[Expr, ...], Found | NotApplicable]] = []
        taken: set[Expr] = set()
        for block in self._normal_blocks():
            found = (
                self._normal_gamma(block, taken)
                or self._matrix_normal(block, taken)
                or self._joint_normal(block)
            )
            if found is not None:
                out.append((found.components, found))
                taken.update(found.components)
        out += [(u, f) for u, f in self.single.items() if taken.isdisjoint(u)]
        return out

    def joint_normals(self) -> list[Found]:
        """The blocks of several components that are jointly Normal, whatever scales them."""
        found = [self._joint_normal(block) for block in self._normal_blocks() if len(block) > 1]
        return [f for f in found if f is not None]

    def _is_normal(self, unit: tuple[Expr, ...]) -> bool:
        found = self.single[unit]
        return isinstance(found, Found) and isinstance(found.family, Normal)

    def _normal_blocks(self) -> list[tuple[Expr, ...]]:
        """Components that are linear and quadratic together, joined where they meet in a term."""
        candidates = [unit[0] for unit in self.single if self._is_normal(unit)]
        blocks: list[tuple[Expr, ...]] = []
        whole = self._quadratic(tuple(candidates)) if len(candidates) > 1 else None
        if whole is not None:
            return _connected(candidates, whole)
        for c in candidates:  # greedily: into the first block that it is jointly quadratic with
            for k, block in enumerate(blocks):
                form = self._quadratic((*block, c))
                if form is not None and len(_connected((*block, c), form)) == 1:
                    blocks[k] = (*block, c)
                    break
            else:
                blocks.append((c,))
        return blocks

    def _independent(self, components: Iterable[Expr]) -> bool:
        """Whether no component's bounds depend on another."""
        block = frozenset(components)
        return not any(block & symbols_of(self.bound[c]) for c in block)

    def _joint_normal(self, block: tuple[Expr, ...]) -> Found | None:
        if len(block) == 1:
            found = self.single[block]
            return found if isinstance(found, Found) else None
        form = self._quadratic(block)
        return None if form is None else self._joint(block, form)

    def _joint(self, block: tuple[Expr, ...], form: BlockForm) -> Found | None:
        family = match_normal(block, form.monomials)
        found = None if family is None else self._judged(block, form, family)
        return found if isinstance(found, Found) else None

    def _quadratic(self, block: tuple[Expr, ...]) -> BlockForm | None:
        """The form of a block that is jointly Normal but for its components' own corrections."""
        if not self._independent(block):
            return None
        form = separate_block(self.data, block, leave=True)
        if not isinstance(form, BlockForm):
            return None
        found = self._joint(block, form)
        return form if found is not None and self._own(found) else None

    def _own(self, found: Found) -> bool:
        """Whether each function left over is one that some component alone cannot take either.

        Otherwise (a prior Normal that is not scaled by the precision) separate updates are exact
        where a joint one would have to reject.
        """
        for j in found.correction:
            monomial = found.form.monomials[j]
            if not any(self._refused_alone(c, monomial) for c in found.components):
                return False
        return all(
            any(factor is other for c in found.components for other in self._left_alone(c))
            for factor, _ in found.form.left
        )

    def _left_alone(self, component: Expr) -> list[Factor]:
        unit = next(u for u in self.single if any(component is c for c in u))
        single = self.single[unit]
        return [factor for factor, _ in single.form.left] if isinstance(single, Found) else []

    def _refused_alone(self, component: Expr, monomial: frozenset) -> bool:
        mine = frozenset((a, e) for a, e in monomial if component in symbols_of(a))
        single = self.single.get((component,))
        if not mine or not isinstance(single, Found):
            return False
        return any(
            frozenset((a, e) for a, e in single.form.monomials[j] if component in symbols_of(a))
            == mine
            for j in single.correction
        )

    def _normal_gamma(self, block: tuple[Expr, ...], taken: set[Expr]) -> Found | None:
        """The block together with the first parameter that scales its precision."""
        for unit, found in self.single.items():
            if not isinstance(found, Found) or not isinstance(found.family, Gamma):
                continue
            v = unit[0]
            if v in taken or v in set(block) or not self._independent((*block, v)):
                continue
            form = separate_block(self.data, (*block, v), leave=True)
            if not isinstance(form, BlockForm):
                continue
            family = match_normal_gamma(block, v, form.monomials)
            if family is None:
                continue
            joint = self._judged((*block, v), form, family)
            if isinstance(joint, Found) and self._own(joint):
                return joint
        return None

    def _matrix_normal(self, block: tuple[Expr, ...], taken: set[Expr]) -> Found | None:
        """The block as a matrix, together with the first matrix that scales its precision."""
        for unit, found in self.single.items():
            if not isinstance(found, Found) or not isinstance(found.family, Wishart):
                continue
            if not taken.isdisjoint(unit) or not self._independent((*block, *unit)):
                continue
            form = separate_block(self.data, (*block, *unit), leave=True)
            if not isinstance(form, BlockForm):
                continue
            family = match_matrix_normal(block, unit, found.family.size, form)
            if family is None:
                continue
            joint = self._judged((*block, *unit), form, family)
            if isinstance(joint, Found) and self._own(joint):
                return joint
        return None


def _grows(form: BlockForm, i: int) -> bool:
    """Whether a function's statistic has a term for each time step."""
    return bool(form.roles(form.monomials[i]) - set(BOUNDED_ROLES))


def _connected(components: Iterable[Expr], form: BlockForm) -> list[tuple[Expr, ...]]:
    """The components in groups that share a function."""
    groups = [{c} for c in components]
    for monomial in form.monomials:
        atoms = symbols_of([a for a, _ in monomial])
        met = [g for g in groups if g & atoms]
        if len(met) > 1:
            groups = [g for g in groups if not g & atoms] + [set().union(*met)]
    order = {c: i for i, c in enumerate(components)}
    ordered = [tuple(sorted(g, key=order.__getitem__)) for g in groups]
    return sorted(ordered, key=lambda g: order[g[0]])


def kind_of(site: Site) -> str:
    support = site.distribution.support().kind
    return {"simplex": "simplex", "positive definite": "matrix"}.get(support, "real")


def bounds_of(site: Site) -> dict[Expr, tuple[Expr, Expr]]:
    """(lower, upper) of each component from its own prior."""
    support = site.distribution.support()
    infinite = (constant(-np.inf), constant(np.inf))
    if support.kind != "interval":
        return dict.fromkeys(site.components, infinite)
    lower = np.broadcast_to(support.lower.view(np.ndarray), site.shape).ravel()
    upper = np.broadcast_to(support.upper.view(np.ndarray), site.shape).ravel()
    return {
        value: (low, high)
        for value, low, high in zip(site.value.ravel(), lower, upper, strict=True)
    }


def _read_by(site: Site) -> frozenset[Expr]:
    """The symbols in the arguments of a law."""
    return symbols_of(e for p in site.distribution.parameters.values() for e in p.ravel())
