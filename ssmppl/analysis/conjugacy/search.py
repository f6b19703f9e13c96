"""The search for blocks of parameters with a closed-form conditional.

Largest first: a Normal vector together with its precision, joint Normal vectors, then one unit at a
time (a number, a simplex, a matrix). Which family holds a block is determined by its functions
alone (`families.py`); what a family does not hold becomes a correction, or a refusal.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from ssmppl.analysis.conjugacy.describe import joined
from ssmppl.analysis.conjugacy.families import SCALED, SINGLE, Gamma, Normal
from ssmppl.analysis.conjugacy.family import Family, ScaledFamily
from ssmppl.analysis.conjugacy.separation import (
    BOUNDED_ROLES,
    BlockForm,
    CompleteData,
    JointTerm,
    separate_block,
    shorten,
)
from ssmppl.errors import NotApplicable
from ssmppl.expressions.expr import Expr, constant, symbols_of, to_text
from ssmppl.language.model.trace import Site


@dataclass(frozen=True)
class Found:
    """A family for a block, and what it leaves over."""

    components: tuple[Expr, ...]
    form: BlockForm
    family: Family
    outside_family: tuple[int, ...]


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
            kind = block_kind(site)
            if kind == "simplex":  # a vector, or each row of a matrix
                out += [tuple(row) for row in site.value.reshape(-1, site.shape[-1])]
            elif kind in ("matrix", "correlation"):
                out.append(tuple(site.components))
            else:
                out += [(c,) for c in site.components]
        return out

    def unread(self, components: Iterable[Expr]) -> list[str] | None:
        """None where some distribution reads one of these components; else the parameters that
        their own prior depends on."""
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
        kind = block_kind(self.site(unit[0]))
        if kind == "matrix" and len(unit) == 1:  # a precision or a variance
            candidates: list[Family] = [*Gamma.match(unit, form, positive=True)[:1]]
        else:
            positive = self._positive(unit[0])
            candidates = [
                family
                for law in SINGLE
                if law.kind == kind
                for family in law.match(unit, form, positive)
            ]
        found = [self._judged(unit, form, family) for family in candidates]
        good = [f for f in found if isinstance(f, Found)]
        if good:
            return min(good, key=lambda f: len(f.outside_family))
        return next(
            (f for f in found if isinstance(f, NotApplicable)), self._outside(form, frozenset())
        )

    def _positive(self, component: Expr) -> bool:
        lower = self.bound[component][0]
        while lower in self.bound and lower.data[1] == component.data[1]:  # the one below it
            lower = self.bound[lower][0]
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
        if form.inseparable and not any(_grows(form, i) for i in family.used):
            return form.inseparable[0][1]  # nothing but what was left tells of the block
        return Found(components, form, family, left)

    def _outside(self, form: BlockForm, used: frozenset[int]) -> NotApplicable:
        """The reason naming the functions that no family holds, and the lines they stem from."""
        names = joined(form.components)
        growing: list[int] = []
        others: list[int] = []
        for i in range(len(form.monomials)):
            if i not in used:
                (growing if _grows(form, i) else others).append(i)
        if form.inseparable and not growing:
            return form.inseparable[0][1]
        positions = growing or others or list(range(len(form.functions)))
        if not positions:
            where = self.site(form.components[0]).distribution.location
            reason = (
                f"no density depends on {names}: a constant prior, and no distribution names it"
            )
            return NotApplicable(reason, where)
        term = form.origins[form.monomials[positions[0]]][-1]
        text = ", ".join(shorten(to_text(form.functions[i])) for i in positions[:4])
        more = ", ..." if len(positions) > 4 else ""
        laws = sorted(
            {f"{f.role} of {f.site}" for i in positions for f in form.origins[form.monomials[i]]}
        )
        return NotApplicable(
            f"{names} is not conjugate: its full conditional contains {text}{more}, from the "
            f"{' and the '.join(laws)}",
            term.where,
        )

    # -- blocks
    def found(self) -> list[tuple[tuple[Expr, ...], Found | NotApplicable]]:
        """Blocks that partition the parameters, each with its family or the reason why none."""
        out: list[tuple[tuple[Expr, ...], Found | NotApplicable]] = []
        taken: set[Expr] = set()
        for block in self._normal_blocks():
            scaled = (self._scaled(law, block, taken) for law in SCALED)
            found = next(filter(None, scaled), None) or self._joint_normal(block)
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
            return connected(candidates, _ties(whole))
        for c in candidates:  # greedily: into the first block that it is jointly quadratic with
            for k, block in enumerate(blocks):
                form = self._quadratic((*block, c))
                if form is not None and len(connected((*block, c), _ties(form))) == 1:
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
        for family in Normal.match(block, form, positive=False):
            found = self._judged(block, form, family)
            if isinstance(found, Found):
                return found
        return None

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
        for j in found.outside_family:
            monomial = found.form.monomials[j]
            if not any(self._refused_alone(c, monomial) for c in found.components):
                return False
        return all(
            any(term is other for c in found.components for other in self._left_alone(c))
            for term, _ in found.form.inseparable
        )

    def _left_alone(self, component: Expr) -> list[JointTerm]:
        unit = next(u for u in self.single if any(component is c for c in u))
        single = self.single[unit]
        return [term for term, _ in single.form.inseparable] if isinstance(single, Found) else []

    def _refused_alone(self, component: Expr, monomial: frozenset) -> bool:
        mine = frozenset((a, e) for a, e in monomial if component in symbols_of(a))
        single = self.single.get((component,))
        if not mine or not isinstance(single, Found):
            return False
        return any(
            frozenset((a, e) for a, e in single.form.monomials[j] if component in symbols_of(a))
            == mine
            for j in single.outside_family
        )

    def _scaled(
        self, law: type[ScaledFamily], block: tuple[Expr, ...], taken: set[Expr]
    ) -> Found | None:
        """The block together with the first unit that scales its precision."""
        met = frozenset().union(*(term.symbols for term in self.data.holding(block)))
        for unit, found in self.single.items():
            if not isinstance(found, Found) or not isinstance(found.family, law.scale):
                continue
            if met.isdisjoint(unit):  # in no term together
                continue
            whole = (*block, *unit)
            if not (taken | set(block)).isdisjoint(unit) or not self._independent(whole):
                continue
            form = separate_block(self.data, whole, leave=True)
            family = law.match_scaled(block, unit, form) if isinstance(form, BlockForm) else None
            if family is None or not isinstance(form, BlockForm):
                continue
            joint = self._judged(whole, form, family)
            if isinstance(joint, Found) and self._own(joint):
                return joint
        return None


def _grows(form: BlockForm, i: int) -> bool:
    """Whether a function's statistic has a term for each time step."""
    return bool(form.roles(form.monomials[i]) - set(BOUNDED_ROLES))


def _ties(form: BlockForm) -> list[frozenset[Expr]]:
    """The symbols of each function."""
    return [symbols_of([a for a, _ in monomial]) for monomial in form.monomials]


def connected(
    components: Sequence[Expr], ties: Iterable[frozenset[Expr]]
) -> list[tuple[Expr, ...]]:
    """The components in groups, those together that are in one tie."""
    groups = [frozenset({c}) for c in components]
    for tie in ties:
        met = [g for g in groups if g & tie]
        if len(met) > 1:
            groups = [g for g in groups if not g & tie] + [frozenset().union(*met)]
    order = {c: i for i, c in enumerate(components)}
    ordered = [tuple(sorted(g, key=order.__getitem__)) for g in groups]
    return sorted(ordered, key=lambda g: order[g[0]])


def block_kind(site: Site) -> str:
    support = site.distribution.support().kind
    kinds = {
        "simplex": "simplex", "positive definite": "matrix", "correlation": "correlation"
    }  # fmt: skip
    return kinds.get(support, "real")


def bounds_of(site: Site) -> dict[Expr, tuple[Expr, Expr]]:
    """(lower, upper) of each component from its own prior; of ordered ones, their neighbours."""
    support = site.distribution.support()
    infinite = (constant(-np.inf), constant(np.inf))
    if support.kind not in ("interval", "ordered"):
        return dict.fromkeys(site.components, infinite)
    lower = np.broadcast_to(support.lower.view(np.ndarray), site.shape).ravel()
    upper = np.broadcast_to(support.upper.view(np.ndarray), site.shape).ravel()
    if support.kind == "ordered":
        k, (lower, upper) = site.shape[-1], (lower.copy(), upper.copy())
        for i, c in enumerate(site.value.ravel()):
            if i % k:
                lower[i], upper[i - 1] = site.value.ravel()[i - 1], c
    return {
        value: (low, high)
        for value, low, high in zip(site.value.ravel(), lower, upper, strict=True)
    }


def _read_by(site: Site) -> frozenset[Expr]:
    """The symbols in the arguments of a distribution."""
    return symbols_of(e for p in site.distribution.parameters.values() for e in p.ravel())
