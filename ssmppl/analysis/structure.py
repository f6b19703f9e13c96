"""Structure of a traced model: which states are Gaussian given the past, which are deterministic,
and which observations are affine and Gaussian in them.
"""

from __future__ import annotations

from collections.abc import Collection, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ssmppl.analysis.new_values import reads_of
from ssmppl.errors import ModelError, NotApplicable
from ssmppl.expressions.algebra import affine
from ssmppl.expressions.arrays import ExprArray, array
from ssmppl.expressions.batched.call import OP
from ssmppl.expressions.expr import (
    Expr,
    constant,
    depends_on,
    substitute,
    symbols_of,
    topological,
)
from ssmppl.language.distributions import Dirac, Flat, MvNormal, Normal
from ssmppl.language.model.covariances import noiseless
from ssmppl.language.model.trace import Site, Trace, once_per_trace, previous


@dataclass(frozen=True)
class GaussianBlock:
    """Components that are jointly Gaussian: symbols (n,), mean (n,), covariance (n, n).

    The mean and the covariance may hold new values of other components, as of a discrete one. late
    : Gaussian sites that read new values of the block in another way than by an affine mean, so
    that they are no part of it, and why.
    """

    symbols: tuple[Expr, ...]
    mean: ExprArray
    covariance: ExprArray
    diagonal: bool
    late: tuple[tuple[Site, NotApplicable], ...] = ()

    def __len__(self) -> int:
        return len(self.symbols)


def gaussian_block(
    sites: Sequence[Site], dirac: bool = False, given: Collection[Expr] = ()
) -> GaussianBlock:
    """The Normal and MvNormal sites stacked, in the order of their distributions; empty where there
    are none. A mean m + B x in new values x of the block has them put in: m + B mean(x), with the
    covariance B cov(x) B' beside its own.

    dirac : the deterministic sites too, with no variance of their own. given : components that are
    no part of it, whatever their distributions.
    """
    symbols: list[Expr] = []
    mean: list[Expr] = []
    covariance = np.empty((0, 0), dtype=object)
    diagonal = True
    late: list[tuple[Site, NotApplicable]] = []
    behind: set[Expr] = set()  # components that are drawn given some of the block
    for site in sites:
        d = site.distribution
        inside = _gaussian(site, dirac) and not set(site.components) & set(given)
        own_mean = list(array(d.mean()).ravel()) if inside else []
        if not own_mean:
            if reads_of(site) & {*symbols, *behind}:
                behind |= set(site.components)
            continue
        if isinstance(d, MvNormal):
            own = d.covariance_matrix().view(np.ndarray)
        else:
            variances = d.variance_in_range() if isinstance(d, Normal) else np.zeros(site.shape)
            own = _diagonal(list(array(variances).ravel()))
        diagonal &= len(own) == 1 or not isinstance(d, MvNormal)
        cross = np.full((len(own), len(symbols)), constant(0.0), dtype=object)
        read = [s for s in symbols if s in reads_of(site)]
        if read or reads_of(site) & behind:
            form = _affine_in(site, own_mean, read, behind)
            if isinstance(form, NotApplicable):
                late.append((site, form))
                behind |= set(site.components)
                continue
            at = [i for i, s in enumerate(symbols) if s in set(read)]
            matrix = form[0].view(np.ndarray)
            own_mean = list(array(form[0] @ array([mean[i] for i in at]) + form[1]))
            cross = matrix @ covariance[at]
            own = own + cross[:, at] @ matrix.T
            diagonal = False
        symbols += list(site.value.ravel())
        mean += own_mean
        covariance = np.block([[covariance, cross.T], [cross, own]])
    return GaussianBlock(tuple(symbols), array(mean), array(covariance), diagonal, tuple(late))


def _gaussian(site: Site, dirac: bool) -> bool:
    return isinstance(site.distribution, (Normal, MvNormal, *((Dirac,) if dirac else ())))


def _diagonal(values: list[Expr]) -> np.ndarray:
    out = np.full((len(values), len(values)), constant(0.0), dtype=object)
    for i, e in enumerate(values):
        out[i, i] = e
    return out


def _affine_in(
    site: Site, mean: list[Expr], read: list[Expr], behind: set[Expr]
) -> tuple[ExprArray, ExprArray] | NotApplicable:
    """The mean as affine in new values that are read; why it is not, or they are not all."""
    where = site.distribution.location
    names = ", ".join(sorted({repr(s) for s in (*read, *(reads_of(site) & behind))}))
    if reads_of(site) & behind:
        return NotApplicable(f"{site.name} follows from new values, of {names}", where)
    form = affine(mean, read)
    if isinstance(form, NotApplicable):
        reason = f"the mean of the transition of {site.name} in the new value of {names}: "
        return NotApplicable(reason + form.reason, where)
    moved = [p for n, p in site.distribution.parameters.items() if n not in ("mean_", "value")]
    if any(depends_on(e, read) for p in moved for e in p.ravel()):
        reason = f"the spread of the transition of {site.name} depends on the new value of {names}"
        return NotApplicable(reason, where)
    return form


def deterministic(sites: Sequence[Site]) -> list[Site]:
    """The Dirac sites."""
    return [s for s in sites if isinstance(s.distribution, Dirac)]


def component_means(sites: Iterable[Site]) -> dict[Expr, Expr]:
    """Component -> its mean, which is the value of a Dirac one."""
    return {
        s: e
        for site in sites
        for s, e in zip(site.value.ravel(), array(site.distribution.mean()).ravel(), strict=True)
    }


def unused_name(name: str, taken: Container[str]) -> str:
    """The name, with underscores behind it where it is taken."""
    while name in taken:
        name += "_"
    return name


@dataclass(frozen=True)
class AffineObservation:
    """y = matrix @ x + offset + Gaussian noise, for the given observed components."""

    symbols: tuple[Expr, ...]
    matrix: ExprArray
    offset: ExprArray
    covariance: ExprArray


def affine_observation(
    sites: Sequence[Site], states: Sequence[Expr], following: Mapping[Expr, Expr] | None = None
) -> AffineObservation | NotApplicable:
    """All observations as one affine Gaussian distribution in `states`; the reason where one is
    not.

    following : further components that are functions of the states, and are put in first.
    """
    known = dict(following or {})
    for site in sites:
        if not isinstance(site.distribution, (Normal, MvNormal, Dirac)):
            kind = type(site.distribution).__name__
            return NotApplicable(f"{site.name} is {kind}", site.distribution.location)
        reason = _not_affine(site, "observation", states, known)
        if reason is not None:
            return reason
    block = gaussian_block(sites, dirac=True)
    form = affine(substitute(list(block.mean), known), states)
    if isinstance(form, NotApplicable):
        return form
    covariance = array(substitute(list(block.covariance.ravel()), known))
    return AffineObservation(
        block.symbols, form[0], form[1], array(covariance.reshape(block.covariance.shape))
    )


def _not_affine(
    site: Site, role: str, states: Sequence[Expr], known: dict[Expr, Expr] | None = None
) -> NotApplicable | None:
    """Why a Gaussian or deterministic distribution is not affine in `states` with a spread free of
    them."""
    d = site.distribution
    form = affine(substitute(list(array(d.mean()).ravel()), known or {}), states)
    if isinstance(form, NotApplicable):
        return NotApplicable(f"the mean of the {role} of {site.name}: {form.reason}", d.location)
    spread = substitute(list(gaussian_block([site], dirac=True).covariance.ravel()), known or {})
    if any(depends_on(e, states) for e in spread):
        reason = f"the spread of the {role} of {site.name} depends on the state"
        return NotApplicable(reason, d.location)
    return None


@dataclass(frozen=True)
class LinearGaussian:
    """x_1 ~ N(m, P), x_t = A x_{t-1} + b + N(0, Q), y_t = C x_t + d + N(0, R); x in trace order.

    Entries may depend on theta, inputs, time and (in A, b, Q) on y_{t-1}; Q and P may be singular
    (Dirac components). flat : components of x_1 whose distribution is Flat; zero in m and P.
    """

    m: ExprArray
    P: ExprArray
    A: ExprArray
    b: ExprArray
    Q: ExprArray
    C: ExprArray
    d: ExprArray
    R: ExprArray
    flat: tuple[int, ...] = ()

    def reordered(self, order: Sequence[int]) -> LinearGaussian:
        """The same model with the states in this order, order[i] the old place of the new i-th."""
        index = list(order)

        def square(matrix: ExprArray) -> ExprArray:
            return array(matrix.view(np.ndarray)[np.ix_(index, index)])

        def vector(values: ExprArray) -> ExprArray:
            return array(values.view(np.ndarray)[index])

        return LinearGaussian(
            vector(self.m), square(self.P), square(self.A), vector(self.b), square(self.Q),
            array(self.C.view(np.ndarray)[:, index]), self.d, self.R,
            tuple(sorted(index.index(i) for i in self.flat)),
        )  # fmt: skip


def linear_gaussian(trace: Trace) -> LinearGaussian | NotApplicable:
    """The whole model as a linear Gaussian one, or the first reason why it is not."""
    states, prev = trace.state_symbols, trace.state_prev_symbols
    laws = []
    for role, sites in (("initial", trace.initial), ("transition", trace.transition)):
        law = _gaussian_law(role, list(sites.values()), states)
        if isinstance(law, NotApplicable):
            return law
        laws.append(law)
    for site in trace.transition.values():
        reason = _not_affine(site, "transition", prev)
        if reason is not None:
            return reason
    (m, p), (mean, q) = laws
    form = affine(mean, prev)
    if isinstance(form, NotApplicable):
        return form
    if any(depends_on(e, prev) for e in q.ravel()):  # a factor of a new value, as in x * z_next
        site = next(s for s in trace.transition.values() if reads_of(s) & set(states))
        return NotApplicable(
            "the states before are factors of new values", site.distribution.location
        )
    if not trace.observations:
        return NotApplicable("there is no observation")
    observation = affine_observation(list(trace.observations.values()), states)
    if isinstance(observation, NotApplicable):
        return observation
    flat = {s for site in flat_start(trace) for s in site.components}
    return LinearGaussian(
        m, p, form[0], form[1], q,
        observation.matrix, observation.offset, observation.covariance,
        tuple(i for i, s in enumerate(states) if s in flat),
    )  # fmt: skip


def _gaussian_law(
    role: str, sites: list[Site], states: list[Expr]
) -> tuple[ExprArray, ExprArray] | NotApplicable:
    """Mean and covariance over `states`; Dirac components with zero variance, Flat ones zero."""
    zero = constant(0.0)
    n = len(states)
    place = {s: i for i, s in enumerate(states)}
    mean = np.empty(n, dtype=object)
    mean[...] = [zero] * n
    covariance = np.empty((n, n), dtype=object)
    covariance[...] = [[zero] * n] * n
    for site in sites:
        d = site.distribution
        if not isinstance(d, (Normal, MvNormal, Dirac)) and type(d) is not Flat:
            reason = f"the {role} distribution of {site.name} is {type(d).__name__}"
            return NotApplicable(reason, d.location)
    block = gaussian_block(sites, dirac=True)
    if block.late:
        return block.late[0][1]
    index = [place[s] for s in block.symbols]
    mean[index] = list(block.mean)
    if index:
        covariance[np.ix_(index, index)] = block.covariance.view(np.ndarray)
    return array(mean), array(covariance)


def singular_covariance(trace: Trace) -> NotApplicable | None:
    """Why states and observations have no joint density beside Dirac components of the states: as
    of `singular_states`, or an observation without noise."""
    singular = singular_states(trace)
    return exact_observation(trace) if singular is None else singular


def singular_states(trace: Trace) -> NotApplicable | None:
    """Why the states have no joint density beside their Dirac components: a covariance that is
    singular whatever the parameters are, in some cases of the conditions in it, or in some row of
    the data."""
    for role, sites in (("initial distribution", trace.initial), ("transition", trace.transition)):
        for site in sites.values():
            root = site.distribution.root if isinstance(site.distribution, MvNormal) else None
            still = noiseless(site.distribution)
            if root is not None or still:
                columns = root.view(np.ndarray).T if root is not None else ()
                full = site.shape[0]
                rank = full - len(still)
                if len(columns):
                    rank = sum(any(e is not constant(0.0) for e in own) for own in columns)
                how = f"(rank {rank} of {full})" if rank < full else "in some cases"
                return NotApplicable(
                    f"the covariance in the {role} of {site.name} is singular {how}, so "
                    "that its density does not exist",
                    site.distribution.location,
                )
    return trace.singular_row


@once_per_trace
def simulators(trace: Trace) -> tuple[Any, ...]:
    """The functions under `@ssm.simulator` that the model's distributions call, by name."""
    sites = (trace.parameters, trace.initial, trace.transition, trace.observations)
    roots = [e for part in sites for site in part.values() for e in site.distribution.expressions()]
    found = {n.data.function for n in topological(roots) if n.op == OP}
    return tuple(sorted(found, key=lambda f: f.name))


def flat_start(trace: Trace) -> list[Site]:
    """The states that have no proper initial distribution."""
    return [s for s in trace.initial.values() if isinstance(s.distribution, Flat)]


def exact_observation(trace: Trace) -> NotApplicable | None:
    """Why an observation has no density: it is Dirac, or without noise in some row of the data;
    None where each has noise."""
    for site in trace.observations.values():
        if isinstance(site.distribution, Dirac):
            return NotApplicable(
                f"{site.name} is observed without noise, so that it has no density given the "
                "states",
                site.distribution.location,
            )
    return trace.noiseless_row


def check_observations(trace: Trace) -> None:
    """Refuse observations without noise but where they are affine in the states: then there are
    exact filters, or proposals that condition on them in closed form.

    Raises
    ------
    ModelError : naming the observation, the line, and why it is not affine.
    """
    exact = exact_observation(trace)
    if exact is None:
        return
    form = affine_observation(list(trace.observations.values()), trace.state_symbols)
    if isinstance(form, NotApplicable):
        raise ModelError(
            f"{exact.reason}: data would have likelihood zero. Observations without noise have to "
            f"be affine in the states, with Gaussian ones beside them, and here {form.reason}",
            fix="give the channel a noise, for example ssm.Normal(value, sd=...)",
            where=exact.where,
        )


def check_start(trace: Trace) -> None:
    """Refuse flat initial distributions but in a linear Gaussian model, where there is an exact
    answer.

    Raises
    ------
    ModelError : naming the state, the line, and why the model is not linear and Gaussian.
    """
    flat = flat_start(trace)
    reason = linear_gaussian(trace) if flat and trace.observations else None
    if isinstance(reason, NotApplicable):
        raise ModelError(
            f"the initial distribution of {flat[0].name!r} is Flat, which only a linear Gaussian "
            f"model may have, and this one is none: {reason}",
            fix="give it a proper distribution of large spread, as ssm.Normal(0, sd=1e4): where "
            "proposals look ahead the filter loses nothing by it, and the log-likelihood falls by "
            "the log of the spread alone",
            where=flat[0].distribution.location,
        )


def without_noise(trace: Trace) -> NotApplicable | None:
    """None if every state follows from parameters, inputs and earlier observations, at t = 1 too;
    else which one does not."""
    for role, sites in (("initial distribution", trace.initial), ("transition", trace.transition)):
        for site in sites.values():
            if not isinstance(site.distribution, Dirac):
                kind = type(site.distribution).__name__
                return NotApplicable(
                    f"the {role} of {site.name} is {kind}", site.distribution.location
                )
    return None


def noisy_start(trace: Trace) -> list[Site]:
    """The states whose initial distribution has noise, where no transition has any; else none."""
    if any(not isinstance(s.distribution, Dirac) for s in trace.transition.values()):
        return []
    return [s for s in trace.initial.values() if not isinstance(s.distribution, Dirac)]


def deterministic_memory(trace: Trace) -> int | None:
    """Steps after which the Dirac components have forgotten their past, given the noisy ones.

    0 where there are none; None where they never do (a position that integrates a velocity).
    """
    value = component_means(deterministic(list(trace.transition.values())))
    prev = {previous(s): s for s in trace.state_symbols}
    feeds = {s: {prev[p] for p in symbols_of(e) if p in prev} for s, e in value.items()}
    depth: dict[Expr, int] = {}
    for _ in range(len(value) + 1):
        for s, sources in feeds.items():
            inner = [q for q in sources if q in value]
            if all(q in depth for q in inner):
                depth[s] = max((depth[q] for q in inner), default=0) + (1 if sources else 0)
    return max(depth.values(), default=0) if len(depth) == len(value) else None
