"""Both steps of expectation maximisation, derived.

The complete-data log density is separated jointly in all free parameters (`separation.py`), so that

    Q(theta) = sum_i S_i s_i(theta),        S_i = E[C_i | y],

with the prior among the terms where the posterior is maximised, without it where the likelihood
is.

M-step. Parameters that share no function s_i are maximised apart, in groups. Within a group, Q with
the S_i as symbols is searched for conjugate families just as the density is for Gibbs updates
(`search.py`), whose maxima are in closed form.

E-step of linear Gaussian models. Given y, (x_t, x_{t-1}) is jointly Gaussian, so that a function c
of theirs that is at most quadratic has the expectation

    E[c] = c(means) + trace(H Sigma) / 2,

with its Hessian H and the joint covariance Sigma (Shumway and Stoffer 1982, "An approach to time
series smoothing and forecasting using the EM algorithm", spell this out for their model). In the
expressions below the states' symbols stand for the means, and symbols of kind "moment" for

    covariance (i, j)       Cov(x_t[i], x_t[j]), i >= j
    covariance_prev (i, j)  Cov(x_{t-1}[i], x_{t-1}[j]), i >= j
    cross (i, j)            Cov(x_t[i], x_{t-1}[j])
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ssmppl.analysis.conjugacy.describe import Explanation, joined
from ssmppl.analysis.conjugacy.family import Family
from ssmppl.analysis.conjugacy.numerical_check import verify
from ssmppl.analysis.conjugacy.search import Found, Search, block_kind, connected
from ssmppl.analysis.conjugacy.separation import (
    NOTHING_MISSING,
    ROLES,
    BlockForm,
    CompleteData,
    JointTerm,
    complete_data,
    degenerate,
    restricted,
    separate_block,
)
from ssmppl.analysis.conjugacy.update import Update
from ssmppl.analysis.density import Missing
from ssmppl.errors import NotApplicable
from ssmppl.expressions.calculus import NotDifferentiable, differentiate
from ssmppl.expressions.expr import Expr, constant, depends_on, symbol, symbols_of, to_text
from ssmppl.language.model.trace import Trace

IN_TIME = ("initial", "transition", "observation")


@dataclass(frozen=True)
class ClosedForm:
    """A block of a group and the family of Q as a function of it.

    statistics : the C_i of the family, in S and in Q's other parameters.
    bounds : (lower, upper) of each component.
    exact : whether no function of Q in the block lies outside of the family.
    """

    components: tuple[Expr, ...]
    family: Family
    statistics: tuple[Expr, ...]
    bounds: tuple[tuple[Expr, Expr], ...]
    exact: bool


@dataclass(frozen=True)
class Group:
    """Parameters that Q joins, and how they are maximised.

    functions : the s_i that hold them, at `indices`.
    blocks : closed forms; none where parameters bound each other, as one alone cannot move there.
    reasons : why they are not all of it.
    """

    components: tuple[Expr, ...]
    indices: tuple[int, ...]
    functions: tuple[Expr, ...]
    blocks: tuple[ClosedForm, ...]
    reasons: tuple[NotApplicable, ...]

    @property
    def closed(self) -> bool:
        """Whether the blocks' closed forms are exact and cover the group."""
        covered = sum(len(b.components) for b in self.blocks)
        return covered == len(self.components) and all(b.exact for b in self.blocks)

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
    statistics : the symbols of the S_i in the groups.
    idle : parameters that no function holds; they stay as they are.
    """

    trace: Trace
    update: Update
    statistics: tuple[Expr, ...]
    groups: tuple[Group, ...]
    idle: tuple[Expr, ...]

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
    groups = tuple(_group(search, group, form) for group in _joined(trace, form, free, search))
    moved = frozenset(c for g in groups for c in g.components)
    return MStep(trace, update, statistics, groups, tuple(c for c in free if c not in moved))


def counted(data: CompleteData, posterior: bool) -> CompleteData:
    """The data with the terms that the objective counts.

    Bounds that one parameter's prior sets to another are kept by maximising under them, so that
    only those of states and observations restrict.
    """
    terms = tuple(f for f in data.terms if posterior or f.role != "prior")
    restrictions = tuple(r for r in data.restrictions if r.role != "prior")
    return replace(data, terms=terms, restrictions=restrictions)


def _as_update(free: Sequence[Expr], form: BlockForm) -> Update:
    """Q as an update without a distribution: what sums its statistics and checks its algebra."""
    return Update(
        block=tuple(dict.fromkeys(c.data[1] for c in free)),
        components=tuple(free),
        family_name="Q",
        functions=form.functions,
        coefficients=form.coefficients,
        outside_family=(),
        bounds=(),
        explanation=Explanation(joined(free) if free else "", "expected log density"),
    )


def _pseudo_data(data: CompleteData, form: BlockForm, statistics: Sequence[Expr]) -> CompleteData:
    """Q as if it were a model's density: one term S_i s_i for each function."""
    terms = []
    for s, function, monomial in zip(statistics, form.functions, form.monomials, strict=True):
        source = max(form.origins[monomial], key=lambda f: ROLES.index(f.role))
        density = s * function
        terms.append(
            JointTerm(source.role, source.site, density, source.where, symbols_of(density))
        )
    return CompleteData(data.trace, tuple(terms), ())


def _joined(
    trace: Trace, form: BlockForm, free: Sequence[Expr], search: Search
) -> list[tuple[Expr, ...]]:
    """The free parameters in groups that share a function, a matrix or simplex, or a bound."""
    members = frozenset(free)
    ties = [symbols_of(f) & members for f in form.functions]
    ties += [
        frozenset(site.components) & members
        for site in trace.parameters.values()
        if block_kind(site) != "real"
    ]
    ties += [(symbols_of(bounds) & members) | {c} for c, bounds in search.bound.items()]
    used = frozenset().union(*(symbols_of(f) & members for f in form.functions))
    return [g for g in connected(free, ties) if not used.isdisjoint(g)]


def _group(search: Search, components: tuple[Expr, ...], form: BlockForm) -> Group:
    members = frozenset(components)
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
        reasons += [_left(found, j) for j in found.outside_family]
        totals = [constant(0.0)] * len(found.form.functions)
        for role in ROLES:
            totals = [a + b for a, b in zip(totals, found.form.coefficients[role], strict=True)]
        bounds = tuple(search.bound[c] for c in found.components)
        blocks.append(
            ClosedForm(
                found.components,
                found.family,
                tuple(totals),
                bounds,
                exact=not found.outside_family,
            )
        )
    functions = tuple(form.functions[i] for i in indices)
    return Group(components, indices, functions, tuple(blocks), tuple(reasons))


def _left(found: Found, j: int) -> NotApplicable:
    source = found.form.origins[found.form.monomials[j]][-1]
    return NotApplicable(
        f"the {source.role} distribution of {source.site} leaves {found.form.functions[j]!r} "
        f"outside the {found.family.name} family",
        source.where,
    )


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
    """Covariance of the variables k >= m among (x_t, x_{t-1})."""
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
        for term in data.terms:
            if term.role == role and term.symbols & members:
                total = total + term.density
        found = [total] if role == "prior" else expectation([total], trace)
        if isinstance(found, NotApplicable):
            return found
        summands[role] = found[0]
    return ExpectedDensity(trace, tuple(free), summands)


def unsuited(data: CompleteData, free: Sequence[Expr]) -> NotApplicable | None:
    """Why the states cannot serve as missing data for these parameters, if they cannot.

    Given the states, a deterministic distribution or a support that depends on a parameter
    determines it, or cuts it off, so that Q has no interior maximum.
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
