"""The M-step, derived: what maximises the expected complete-data log density.

The complete-data log density is separated jointly in all free parameters (`sufficient.py`), so that

    Q(theta) = sum_i S_i s_i(theta),        S_i = E[C_i | y],

with the prior among the factors where the posterior is maximised, without it where the likelihood
is. Parameters that share no function s_i are maximised apart, in groups. Within a group, Q with the
S_i as symbols is searched for conjugate families just as the density is for Gibbs updates
(`search.py`); what they find is maximised in closed form (`modes.py`).

- One block that is all of the group, and all of it inside a family: its mode is the maximum.
- Several such blocks (a Normal vector and a precision matrix): each in turn given the others, until
  nothing moves (conditional maximisation, Meng and Rubin 1993, "Maximum likelihood estimation via
  the ECM algorithm").
- Else Newton's method on the unconstrained scale (`climber.py`), from the present value or from the
  closed form that leaves out the functions outside of the family, whichever has the larger Q
  (Schön et al. 2015, appendix, do so for their log(1 - phi**2)).

No M-step lowers Q by more than rounding.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ssmppl.analysis.check import verify
from ssmppl.analysis.climber import Climber
from ssmppl.analysis.density import Missing
from ssmppl.analysis.describe import Explanation, joined
from ssmppl.analysis.families import Family
from ssmppl.analysis.modes import mode
from ssmppl.analysis.pythontext import DOMAIN, Function, python_function
from ssmppl.analysis.search import Found, Search, kind_of
from ssmppl.analysis.sufficient import (
    NOTHING_MISSING,
    ROLES,
    BlockForm,
    CompleteData,
    Factor,
    complete_data,
    separate_block,
)
from ssmppl.analysis.update import Update
from ssmppl.errors import NotApplicable
from ssmppl.expressions.expr import Expr, constant, symbol, symbols_of
from ssmppl.language.traced import Trace

SWEEPS = 50  # of conditional maximisations in one M-step
SETTLED = 1e-13  # relative change at which they stop
ROUNDING = 1e-12  # of the summed sizes of the terms of Q


@dataclass(frozen=True)
class ClosedForm:
    """A block of a group and the family of Q as a function of it.

    statistics : (S, theta) -> the C_i of the family, with Q's other parameters as they stand.
    limits : (S, theta) -> lower and upper bound of each component, alternating.
    exact : whether no function of Q in the block lies outside of the family.
    """

    where: np.ndarray
    family: Family
    statistics: Function
    limits: Function
    exact: bool

    def mode(self, s: Sequence[float], theta: np.ndarray) -> np.ndarray | None:
        """The block's values where Q, without what lies outside of the family, is largest."""
        v = [*s, *theta.tolist()]
        try:
            c = [*self.statistics(v), 0.0]
            bounds = self.limits(v)
        except DOMAIN:
            return None
        limits = list(zip(bounds[::2], bounds[1::2], strict=True))
        return mode(self.family, c, limits, theta[self.where])


@dataclass(frozen=True)
class Group:
    """Parameters that Q joins, and how they are maximised.

    where : positions in theta. functions : (S, theta) -> the s_i that hold them, at `indices`.
    blocks : closed forms; none where parameters bound each other, as one alone cannot move there.
    """

    data: CompleteData
    components: tuple[Expr, ...]
    where: np.ndarray
    indices: tuple[int, ...]
    functions: Function
    blocks: tuple[ClosedForm, ...]
    reasons: tuple[NotApplicable, ...]
    objective: Expr
    statistics: tuple[Expr, ...]

    @property
    def closed(self) -> bool:
        """Whether the blocks' closed forms are exact and cover the group."""
        covered = sum(len(b.where) for b in self.blocks)
        return covered == len(self.components) and all(b.exact for b in self.blocks)

    @cached_property
    def climber(self) -> Climber:
        return Climber(self.data.trace, self.components, self.objective, self.statistics)

    def value(self, s: Sequence[float], theta: np.ndarray) -> tuple[float, float]:
        """(Q's part, the sum of its terms' sizes); -inf outside of its domain."""
        try:
            functions = self.functions([*s, *theta.tolist()])
        except DOMAIN:
            return -math.inf, 0.0
        terms = [s[i] * f for i, f in zip(self.indices, functions, strict=True) if s[i] != 0.0]
        total = math.fsum(terms) if all(map(math.isfinite, terms)) else -math.inf
        return total, math.fsum(map(abs, terms)) if total > -math.inf else 0.0

    def maximise(self, s: Sequence[float], theta: np.ndarray) -> np.ndarray:
        """theta with the group's parameters where Q is largest, or at least as large as it was."""
        before, size = self.value(s, theta)
        trial, settled = self.closed_forms(s, theta)
        if not (self.closed and settled):
            start = trial if self.value(s, trial)[0] > before else theta
            trial = self.climber.climb(s, start)
        after = self.value(s, trial)[0]
        return trial if after >= before - ROUNDING * size else theta

    def closed_forms(self, s: Sequence[float], theta: np.ndarray) -> tuple[np.ndarray, bool]:
        """(theta after the closed forms in turn, whether that is the maximum if all are exact)."""
        theta = theta.copy()
        for _ in range(SWEEPS if self.closed else 1):
            old = theta[self.where]
            for block in self.blocks:
                values = block.mode(s, theta)
                if values is None:
                    return theta, False
                theta[block.where] = values
            if len(self.blocks) == 1:
                return theta, True
            if np.all(np.abs(theta[self.where] - old) <= SETTLED * np.abs(old)):
                return theta, True
        return theta, False

    def __str__(self) -> str:
        title = joined(self.components)
        if self.closed:
            names = ", ".join(b.family.name for b in self.blocks)
            in_turn = " in turn" if len(self.blocks) > 1 else ""
            return f"{title}: closed form{in_turn} ({names})"
        why = "; ".join(r.reason for r in self.reasons)
        return f"{title}: Newton's method on the unconstrained scale" + (f": {why}" if why else "")


@dataclass(frozen=True)
class MStep:
    """Q's functions, their statistics, and the groups in which Q is maximised.

    update : what the statistics of a trajectory are compiled from: Q as an `Update` of all free
        parameters, whose coefficients C_i are summed by role.
    idle : parameters that no function holds; they stay as they are.
    """

    trace: Trace
    update: Update
    groups: tuple[Group, ...]
    idle: tuple[Expr, ...]
    prior: Function

    def maximise(self, s: np.ndarray, theta: np.ndarray) -> np.ndarray:
        """theta (P,) with the free parameters where Q with the statistics S is largest."""
        totals = np.asarray(s, dtype=float).tolist()
        for group in self.groups:
            theta = group.maximise(totals, theta)
        return theta

    def value(self, s: np.ndarray, theta: np.ndarray) -> float:
        """Q(theta), up to what does not depend on the free parameters."""
        totals = np.asarray(s, dtype=float).tolist()
        return sum(g.value(totals, theta)[0] for g in self.groups)

    def __str__(self) -> str:
        lines = [str(g) for g in self.groups]
        lines += [f"{joined(self.idle)}: in no density, left as it is"] if self.idle else []
        return "\n".join(lines)


def derive_m_step(
    trace: Trace,
    fixed: Iterable[str] = (),
    missing: Missing = NOTHING_MISSING,
    posterior: bool = False,
) -> MStep | NotApplicable:
    """The M-step of all parameters that are not fixed; the reason where Q does not separate.

    posterior : whether the prior counts.
    """
    held = frozenset(fixed)
    free = [c for n, site in trace.parameters.items() if n not in held for c in site.components]
    data = counted(complete_data(trace, missing), posterior)
    form = separate_block(data, free)
    if not isinstance(form, BlockForm):
        return form
    update = _as_update(free, form)
    failure = verify(data, update) if form.functions else None
    if failure is not None:
        return failure
    statistics = tuple(symbol("statistic", "S", (i,)) for i in range(len(form.functions)))
    q = _pseudo_data(data, form, statistics)
    search = Search(q, held)
    groups = tuple(
        _group(q, search, group, form, statistics) for group in _joined(trace, form, free, search)
    )
    moved = frozenset(c for g in groups for c in g.components)
    idle = tuple(c for c in free if c not in moved)
    prior = python_function(form.coefficients["prior"], trace.parameter_symbols)
    return MStep(trace, update, groups, idle, prior)


def counted(data: CompleteData, posterior: bool) -> CompleteData:
    """The data with the factors that the objective counts.

    Bounds that one parameter's prior sets to another are kept by maximising under them, so that
    only those of states and observations restrict.
    """
    factors = tuple(f for f in data.factors if posterior or f.role != "prior")
    restrictions = tuple(r for r in data.restrictions if r.role != "prior")
    return replace(data, factors=factors, restrictions=restrictions)


def _as_update(free: Sequence[Expr], form: BlockForm) -> Update:
    """Q as an update without a law: what sums its statistics and checks its algebra."""
    return Update(
        block=tuple(dict.fromkeys(c.data[1] for c in free)),
        components=tuple(free),
        family="Q",
        functions=form.functions,
        coefficients=form.coefficients,
        correction=(),
        bounds=(),
        explanation=Explanation(joined(free) if free else "", "expected log density"),
    )


def _pseudo_data(data: CompleteData, form: BlockForm, statistics: Sequence[Expr]) -> CompleteData:
    """Q as if it were a model's density: one factor S_i s_i for each function."""
    factors = []
    for s, function, monomial in zip(statistics, form.functions, form.monomials, strict=True):
        source = max(form.origins[monomial], key=lambda f: ROLES.index(f.role))
        density = s * function
        factors.append(Factor(source.role, source.site, density, source.where, symbols_of(density)))
    return CompleteData(data.trace, tuple(factors), ())


def _joined(
    trace: Trace, form: BlockForm, free: Sequence[Expr], search: Search
) -> list[tuple[Expr, ...]]:
    """The free parameters in groups that share a function, a matrix or simplex, or a bound."""
    members = frozenset(free)
    ties = [symbols_of(f) & members for f in form.functions]
    ties += [
        frozenset(site.components) & members
        for site in trace.parameters.values()
        if kind_of(site) != "real"
    ]
    ties += [(symbols_of(bounds) & members) | {c} for c, bounds in search.bound.items()]
    used = frozenset().union(*(symbols_of(f) & members for f in form.functions))
    groups: list[frozenset[Expr]] = [frozenset({c}) for c in free]
    for tie in ties:
        met = [g for g in groups if g & tie]
        if len(met) > 1:
            groups = [g for g in groups if not g & tie] + [frozenset().union(*met)]
    order = {c: i for i, c in enumerate(free)}
    ordered = [tuple(sorted(g, key=order.__getitem__)) for g in groups if g & used]
    return sorted(ordered, key=lambda g: order[g[0]])


def _group(
    q: CompleteData, search: Search, components: tuple[Expr, ...], form: BlockForm,
    statistics: Sequence[Expr],
) -> Group:  # fmt: skip
    trace, members = q.trace, frozenset(components)
    arguments = [*statistics, *trace.parameter_symbols]
    place = {s: i for i, s in enumerate(trace.parameter_symbols)}
    indices = tuple(i for i, f in enumerate(form.functions) if symbols_of(f) & members)
    blocks: list[ClosedForm] = []
    reasons: list[NotApplicable] = []
    bound = {c: symbols_of(search.bound[c]) & members for c in components}
    if any(bound.values()):
        first = next(c for c in components if bound[c])
        where = search.site(first).distribution.location
        reasons.append(NotApplicable(f"{first!r} is bounded by {joined([*bound[first]])}", where))
    for unit, found in search.found():
        if not members & set(unit) or any(bound.values()):
            continue
        if not isinstance(found, Found):
            reasons.append(found)
            continue
        reasons += [_left(found, j) for j in found.correction]
        totals = [constant(0.0)] * len(found.form.functions)
        for role in ROLES:
            totals = [a + b for a, b in zip(totals, found.form.coefficients[role], strict=True)]
        bounds = [e for c in found.components for e in search.bound[c]]
        blocks.append(
            ClosedForm(
                np.array([place[c] for c in found.components]),
                found.family,
                python_function(totals, arguments),
                python_function(bounds, arguments),
                exact=not found.correction,
            )
        )
    objective = constant(0.0)
    for i in indices:
        objective = objective + statistics[i] * form.functions[i]
    return Group(
        q, components, np.array([place[c] for c in components]), indices,
        python_function([form.functions[i] for i in indices], arguments),
        tuple(blocks), tuple(reasons), objective, tuple(statistics),
    )  # fmt: skip


def _left(found: Found, j: int) -> NotApplicable:
    source = found.form.origins[found.form.monomials[j]][-1]
    return NotApplicable(
        f"the {source.role} law of {source.site} leaves {found.form.functions[j]!r} outside the "
        f"{found.family.name} family",
        source.where,
    )
