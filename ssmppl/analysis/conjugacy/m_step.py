"""The M-step, derived: what maximises the expected complete-data log density.

The complete-data log density is separated jointly in all free parameters (`sufficient.py`), so that

    Q(theta) = sum_i S_i s_i(theta),        S_i = E[C_i | y],

with the prior among the factors where the posterior is maximised, without it where the likelihood
is. Parameters that share no function s_i are maximised apart, in groups. Within a group, Q with the
S_i as symbols is searched for conjugate families just as the density is for Gibbs updates
(`search.py`); what they find is maximised in closed form (`mode`).

- One block that is all of the group, and all of it inside a family: its mode is the maximum.
- Several such blocks (a Normal vector and a precision matrix): each in turn given the others, until
  nothing moves (conditional maximisation, Meng and Rubin 1993, "Maximum likelihood estimation via
  the ECM algorithm").
- Else Newton's method on the unconstrained scale (`climber.py`), from the present value or from the
  closed form that leaves out the functions outside of the family, whichever has the larger Q
  (Schön et al. 2015, appendix, do so for their log(1 - phi**2)).

No M-step lowers Q by more than rounding.

Where sum_i C_i s_i(block) of a family is largest: the closed forms of the M-step.

The functions s_i are those of `families.py`. What is maximised is the sum as it stands, on the
block's own scale (for statistics that hold a prior: the mode of the conditional, not that of its
logarithm). Bounds are respected: a maximum beyond one lies just inside of it, as supports are
open, by the share `MARGIN` of their width (of the bound's size where the other is infinite).

Normal-Gamma: v > 0 only scales the quadratic form in theta, so theta is found first, whatever the
bounds are; so it is with a Normal matrix and the covariance of its columns, without bounds. A
quadratic form under bounds is a least-squares problem with bounds, solved exactly by the active
sets of Stark and Parker (1995), "Bounded-variable least-squares".

The exact E-step of linear Gaussian models, as expressions of the smoothed moments.

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

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy

from ssmppl.analysis.climber import Climber
from ssmppl.analysis.conjugacy.check import verify
from ssmppl.analysis.conjugacy.describe import Explanation, joined
from ssmppl.analysis.conjugacy.families import (
    Beta,
    Dirichlet,
    Family,
    Gamma,
    MatrixNormalWishart,
    Normal,
    NormalGamma,
    Values,
    lower_values,
)
from ssmppl.analysis.conjugacy.search import Found, Search, kind_of
from ssmppl.analysis.conjugacy.sufficient import (
    NOTHING_MISSING,
    ROLES,
    BlockForm,
    CompleteData,
    Factor,
    complete_data,
    degenerate,
    restricted,
    separate_block,
)
from ssmppl.analysis.conjugacy.update import Update
from ssmppl.analysis.density import Missing
from ssmppl.analysis.lambdify import DOMAIN, Function, python_function
from ssmppl.errors import NotApplicable
from ssmppl.expressions.calculus import NotDifferentiable, differentiate
from ssmppl.expressions.expr import Expr, constant, depends_on, symbol, symbols_of, to_text
from ssmppl.language.model.traced import Trace

MARGIN = 1e-9
FLAT = 1e-12  # relative curvature below which a direction counts as flat
LEAST_SHARE = 1e-12
Limits = Sequence[tuple[float, float]]


def mode(
    family: Family, c: Sequence[float], limits: Limits, present: np.ndarray
) -> np.ndarray | None:
    """The block's values at the maximum, in the order of its components.

    Parameters
    ----------
    c : the statistics C_i, with a 0 at the end for functions that are absent.
    limits : (lower, upper) of each component.
    present : kept along directions in which the sum is flat.

    Returns
    -------
    None where the sum has no maximum within the limits.
    """
    if not np.all(np.isfinite(c)):
        return None
    if isinstance(family, Gamma):
        v = _power(c[family.log], c[family.pow], family.power, limits[0])
        return None if v is None else np.array([v])
    if isinstance(family, Normal):
        return _quadratic(*family.parameters(c), limits, present)
    if isinstance(family, NormalGamma):
        return _normal_gamma(family, c, limits, present)
    if isinstance(family, Beta):
        return _beta(c[family.first], c[family.second], limits[0])
    if isinstance(family, Dirichlet):
        return _dirichlet(np.asarray(c)[np.array(family.logs)])
    if isinstance(family, MatrixNormalWishart):
        return _matrix_normal(family, c, limits)
    value = _wishart(family.parameters(c)[1], c[family.log], family.inverse)
    return None if value is None else np.array(value)


def inside(value: float, low: float, high: float) -> float:
    """The value, or where it lies outside of (low, high), the nearest one just inside."""
    width = high - low
    margin = MARGIN * width if math.isfinite(width) else 0.0
    if value <= low:
        return low + (margin or MARGIN * max(abs(low), MARGIN))
    if value >= high:
        return high - (margin or MARGIN * max(abs(high), MARGIN))
    return value


def _power(a: float, b: float, k: float, limits: tuple[float, float]) -> float | None:
    """The v > 0 that maximises a log v + b v**k."""
    low, high = max(limits[0], 0.0), limits[1]
    if b > 0.0 or (a == 0.0 and b == 0.0):
        return None
    if b < 0.0 and a / k > 0.0:
        return inside(math.exp(math.log(-a / (k * b)) / k), low, high)
    rising = a > 0.0 or (a == 0.0 and k < 0.0)  # monotone in v
    if rising:
        return inside(math.inf, low, high) if high < math.inf else None
    return inside(-math.inf, low, high) if low > 0.0 else None


def _quadratic(
    h: np.ndarray, precision: np.ndarray, limits: Limits, present: np.ndarray
) -> np.ndarray | None:
    """The theta within the limits that maximises h' theta - theta' H theta / 2."""
    values, vectors = np.linalg.eigh(precision)
    largest = float(np.abs(values).max())
    curved = values > FLAT * largest
    if not largest > 0.0 or values.min() < -FLAT * largest:
        return None
    slope = h - precision @ present
    along = vectors.T @ slope
    if np.any(np.abs(along[~curved]) > 1e-9 * (np.abs(h).max() + largest)):
        return None  # rises for ever in a direction without curvature
    root = vectors[:, curved] * np.sqrt(values[curved])
    target = along[curved] / np.sqrt(values[curved])
    theta = present + vectors[:, curved] @ (target / np.sqrt(values[curved]))
    if all(low < x < high for x, (low, high) in zip(theta, limits, strict=True)):
        return theta
    low, high = (np.array(b) for b in zip(*limits, strict=True))
    found = scipy.optimize.lsq_linear(
        root.T, target, bounds=(low - present, high - present), method="bvls"
    )
    moved = present + found.x
    return np.array([inside(x, *b) for x, b in zip(moved, limits, strict=True)])


def _normal_gamma(
    family: NormalGamma, c: Sequence[float], limits: Limits, present: np.ndarray
) -> np.ndarray | None:
    h, precision = family.normal.parameters(c)
    theta = _quadratic(h, precision, limits[:-1], present[:-1])
    if theta is None:
        return None
    level = c[family.pow] + float(h @ theta - 0.5 * theta @ precision @ theta)
    v = _power(c[family.log], level, family.power, limits[-1])
    return None if v is None else np.array([*theta, v])


def _beta(a: float, b: float, limits: tuple[float, float]) -> np.ndarray | None:
    """The p that maximises a log p + b log(1 - p)."""
    low, high = max(limits[0], 0.0), min(limits[1], 1.0)
    if a >= 0.0 and b >= 0.0 and a + b > 0.0:
        return np.array([inside(a / (a + b), low, high)])
    return None


def _dirichlet(c: np.ndarray) -> np.ndarray | None:
    if np.any(c < 0.0) or not c.sum() > 0.0:
        return None
    p = np.maximum(c / c.sum(), LEAST_SHARE)
    return p / p.sum()


def _wishart(matrix: np.ndarray, log: float, inverse: bool) -> Values | None:
    """P = 2 c S^-1 of c log det P - tr(S P) / 2; the inverse's C = S / (-2 c)."""
    values = np.linalg.eigvalsh(matrix)
    if not values[0] > FLAT * values[-1]:
        return None
    if inverse:
        return lower_values(matrix / (-2.0 * log)) if log < 0.0 else None
    return lower_values(2.0 * log * np.linalg.inv(matrix)) if log > 0.0 else None


def _matrix_normal(
    family: MatrixNormalWishart, c: Sequence[float], limits: Limits
) -> np.ndarray | None:
    """A = S_yz K^-1 whatever the matrix is, and that from what A leaves of S_yy."""
    solved = family.solve(c)
    if solved is None:
        return None
    _, matrix, mean, _ = solved
    value = _wishart(matrix, c[family.wishart.log], family.wishart.inverse)
    a = family.entries(mean)
    inside = all(low < x < high for x, (low, high) in zip(a, limits, strict=False))
    return np.array([*a, *value]) if value is not None and inside else None


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
