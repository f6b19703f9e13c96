"""The model that is left when the linear states are integrated out.

With x the states that are sampled and z the linear ones (`conditional.py`), p(z_t | x_{1:t},
y_{1:t-1}) is Gaussian with moments m_t, P_t that the Kalman filter carries along. So (x_t, m_t,
P_t) is itself a Markov process, observed through p(y_t | x_t, m_t, P_t):

    correct by y_t        as usual, one channel after the other
    draw x_{t+1}          from p(x_{t+1} | x_t, m, P); of the coupled ones N(., A P A' + Q)
    correct by x_{t+1}    the coupled ones are measurements of z without noise of their own
    predict z_{t+1}       m_{t+1}, P_{t+1}: deterministic

A particle filter of that model is the Rao-Blackwellised one of the original (Doucet, de Freitas,
Murphy and Russell 2000; Schön, Gustafsson and Nordlund 2005, algorithm 1): its estimate of the
likelihood is unbiased for the same p(y), and all that is known of filters holds for it.

All is written out in scalars, channel by channel, so that the particles' filters vectorise and a
channel that was not measured is left out.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ssmppl.analysis.density import Missing
from ssmppl.analysis.elimination.conditional import (
    ConditionallyLinear,
    conditionally_linear,
    correlated,
    gaussian,
)
from ssmppl.analysis.elimination.moments import (
    ZERO,
    GaussianMoments,
    block_diagonal,
    objects,
    updated_by_channels,
)
from ssmppl.analysis.new_values import in_order, reads_of
from ssmppl.analysis.structure import (
    GaussianBlock,
    LinearGaussian,
    gaussian_block,
    unused_name,
)
from ssmppl.errors import Location, NotApplicable
from ssmppl.expressions.algebra import affine
from ssmppl.expressions.arrays import ExprArray, array
from ssmppl.expressions.expr import Expr, constant, substitute, symbol, symbols_of
from ssmppl.language.distributions import Dirac, MvNormal, Normal
from ssmppl.language.distributions.base import Distribution
from ssmppl.language.distributions.multivariate import SequentialNormal
from ssmppl.language.model.trace import Site, Trace, previous


@dataclass(frozen=True)
class Marginal:
    """The marginal model and the way back from it.

    trace : of x and the predicted moments. mean (n,), covariance (n, n) : the symbols of m_t, P_t.
    filtered_mean, filtered_covariance : of z_t given y_t too, in symbols of step t.
    given : the distribution of (coupled x, z) given the path of x, as a linear Gaussian model whose
        observations are the channels, then the coupled x without noise.
    channels : components of y that tell of z, with those that share a distribution with them.
    """

    split: ConditionallyLinear
    trace: Trace
    mean: tuple[Expr, ...]
    covariance: ExprArray
    filtered_mean: ExprArray
    filtered_covariance: ExprArray
    given: LinearGaussian
    channels: tuple[Expr, ...]


def marginal(
    trace: Trace, missing: Missing, split: ConditionallyLinear | None = None
) -> Marginal | NotApplicable:
    """The model of x and the moments of z; the reason where no state is linear given the others.

    split : to integrate out less than can be.
    """
    found = split or conditionally_linear(trace)
    return found if isinstance(found, NotApplicable) else _Build(trace, found, missing).marginal()


class _Build:
    """One marginal model in the making; `order` is (coupled x, z)."""

    def __init__(self, trace: Trace, split: ConditionallyLinear, missing: Missing):
        self.trace, self.split, self.missing = trace, split, missing
        self.linear = set(split.linear)
        self.order = [*split.coupled, *split.linear]
        taken = {s.data[1] for s in trace.state_symbols}
        n = len(split.linear)
        mean, covariance = unused_name("mean", taken), unused_name("covariance", taken)
        self.mean = tuple(symbol("state", mean, (i,)) for i in range(n))
        self.covariance = np.empty((n, n), dtype=object)
        for i in range(n):
            for j in range(i + 1):
                s = symbol("state", covariance, (i, j))
                self.covariance[i, j] = self.covariance[j, i] = s

    def marginal(self) -> Marginal | NotApplicable:
        trace = self.trace
        late = _block(trace.transition, self.order).late
        if late:
            return late[0][1]
        filtered, observations = self._observe()
        initial = self._sites(trace.initial, None)
        transition = in_order(self._sites(trace.transition, filtered))
        if transition is None:
            first = trace.law_of(self.split.linear[0]).distribution
            reason = (
                "states that move with the linear ones, and others, read each other's new values"
            )
            return NotApplicable(reason, first.location)
        made = replace(
            trace, initial=initial, transition=transition, observations=observations, proposal={}
        )
        return Marginal(
            self.split, made, self.mean, array(self.covariance), array(filtered.mean),
            array(filtered.covariance), self._given(),
            tuple(s for site in self._telling() for s in site.value.ravel()),
        )  # fmt: skip

    def _telling(self) -> list[Site]:
        """The observations that tell of z."""
        channels = set(self.split.channels)
        return [s for s in self.trace.observations.values() if channels & set(s.components)]

    # -- the observation: y_t given x_t, m_t, P_t
    def _observe(self) -> tuple[GaussianMoments, dict[str, Site]]:
        """What is known of z_t after y_t, and the distributions of the channels."""
        telling, z = self._telling(), list(self.split.linear)
        moments = GaussianMoments(objects(self.mean), self.covariance)
        before = moments
        single = len(telling) == 1 and len(telling[0].components) == 1
        sites: dict[str, Site] = {}
        for name, site in self.trace.observations.items():
            if all(site is not s for s in telling):
                sites[name] = site
                continue
            c, d, r = _affine(site, z)
            moments, laws = updated_by_channels(
                moments, c, d, r, list(site.value.ravel()), self.missing
            )
            alone = [self._predicted(before, c[i], d[i], r[i, i]) for i in range(len(d))]
            sites[name] = replace(site, distribution=_observed(laws, alone, site, single=single))
        return moments, sites

    @staticmethod
    def _predicted(moments: GaussianMoments, row: np.ndarray, offset: Expr, noise: Expr) -> tuple:
        return moments.updated(row, offset, noise, ZERO, None)[1:]

    # -- x_t and the moments of z_t given what came before
    def _sites(
        self, sites: Mapping[str, Site], filtered: GaussianMoments | None
    ) -> dict[str, Site]:
        """The distributions of x, then of the moments; `filtered` is None for the first row."""
        joint, coupled = self._joint(sites, filtered)
        given = joint.given_exactly(coupled)
        found: dict[str, Site] = {}
        for name, site in sites.items():
            free = [s for s in site.components if s not in self.linear and s not in set(coupled)]
            if free:
                found[name] = _restricted(site, free)
        first = next(iter(sites.values()))
        where = sites[self.split.linear[0].data[1]].distribution.location
        if coupled:
            k = len(coupled)
            law: Distribution
            if k == 1:
                law = Normal(
                    array(joint.mean[:1]), variance=array(np.diagonal(joint.covariance)[:1])
                )
            else:
                law = MvNormal(array(joint.mean[:k]), covariance=array(joint.covariance[:k, :k]))
            where_coupled = sites[coupled[0].data[1]].distribution.location
            found[unused_name("coupled", set(found))] = _site(
                "coupled", first.role, law, coupled, where_coupled
            )
        lower = [(i, j) for i in range(len(self.mean)) for j in range(i + 1)]
        for symbols, values in (
            (list(self.mean), list(given.mean)),
            ([self.covariance[i] for i in lower], [given.covariance[i] for i in lower]),
        ):
            name = symbols[0].data[1]
            found[name] = _site(name, first.role, Dirac(array(values)), symbols, where)
        return found

    def _joint(
        self, sites: Mapping[str, Site], filtered: GaussianMoments | None
    ) -> tuple[GaussianMoments, list[Expr]]:
        """The distribution of (coupled x, z) given the past, and which x these are."""
        if filtered is None:
            coupled = correlated(sites.values(), self.linear)
            order = [*(s for s in self.trace.state_symbols if s in coupled), *self.split.linear]
            mean, q = _law(sites, order)
            return GaussianMoments(mean, q), order[: len(coupled)]
        mean, q = _law(sites, self.order)
        a, b = self._transition(mean)
        earlier = GaussianMoments(
            objects(_previous(filtered.mean)),
            objects(_previous(filtered.covariance.ravel())).reshape(filtered.covariance.shape),
        )
        return earlier.predicted(a, b, q), list(self.split.coupled)

    def _transition(self, mean: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A, b of mean = A z_{t-1} + b."""
        form = affine(mean, [previous(s) for s in self.split.linear])
        assert not isinstance(form, NotApplicable)
        return form[0].view(np.ndarray), form[1].view(np.ndarray)

    # -- z given the path of x
    def _given(self) -> LinearGaussian:
        k, n = len(self.split.coupled), len(self.split.linear)
        joint, coupled = self._joint(self.trace.initial, None)
        start = joint.given_exactly(coupled)
        mean, q = _law(self.trace.transition, self.order)
        a, b = self._transition(mean)
        c: list[np.ndarray] = []
        d: list[np.ndarray] = []
        r: list[np.ndarray] = []
        for site in self._telling():
            for part, own in zip((c, d, r), _affine(site, list(self.split.linear)), strict=True):
                part.append(own)
        nothing = np.full((k, n), ZERO, dtype=object)
        one = np.full((k, k), ZERO, dtype=object)
        np.fill_diagonal(one, constant(1.0))
        observed = np.concatenate(c) if c else np.empty((0, n), dtype=object)
        blank = np.full((len(observed), k), ZERO, dtype=object)
        from_coupled = np.full((k + n, k), ZERO, dtype=object)
        exact = np.full((k, k), ZERO, dtype=object)
        return LinearGaussian(
            m=array(objects([*[ZERO] * k, *start.mean])),
            P=array(block_diagonal([one, start.covariance])),
            A=array(np.hstack([from_coupled, a])),
            b=array(b),
            Q=array(q),
            C=array(np.block([[blank, observed], [one, nothing]])),
            d=array(objects([*(e for own in d for e in own), *[ZERO] * k])),
            R=array(block_diagonal([*r, exact])),
        )


# -- the parts


def _previous(expressions: Iterable[Expr]) -> list[Expr]:
    """The same quantities one step earlier."""
    expressions = list(expressions)
    earlier = {s: previous(s) for s in symbols_of(expressions) if s.data[0] != "parameter"}
    return substitute(expressions, earlier)


def _block(sites: Mapping[str, Site], order: Sequence[Expr]) -> GaussianBlock:
    """The components of `order`, Gaussian or deterministic ones, given new values of others."""
    own = [s for s in sites.values() if gaussian(s) and set(s.components) & set(order)]
    beside = {c for s in own for c in s.components} - set(order)
    if any(reads_of(s) & beside for s in own):
        own = [_restricted(s, [c for c in s.components if c in set(order)]) for s in own]
    return gaussian_block(own, dirac=True)


def _law(sites: Mapping[str, Site], order: Sequence[Expr]) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of components with Gaussian or deterministic distributions, in this
    order."""
    block = _block(sites, order)
    place = {s: i for i, s in enumerate(block.symbols)}
    index = [place[s] for s in order]
    return objects([block.mean[i] for i in index]), block.covariance.view(np.ndarray)[
        np.ix_(index, index)
    ]


def _affine(site: Site, z: Sequence[Expr]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """C, d, R of a Gaussian channel."""
    form = affine(array(site.distribution.mean()).ravel(), z)
    assert not isinstance(form, NotApplicable)
    return (
        form[0].view(np.ndarray),
        form[1].view(np.ndarray),
        gaussian_block([site], dirac=True).covariance.view(np.ndarray),
    )


def _observed(
    laws: Sequence[tuple[Expr, Expr]], alone: Sequence[tuple[Expr, Expr]], site: Site, single: bool
) -> Distribution:
    """The distribution of a site's channels, of the site's shape."""

    def shaped(pairs: Sequence[tuple[Expr, Expr]], which: int) -> ExprArray:
        return array(objects([p[which] for p in pairs]).reshape(site.shape))

    made: Distribution
    if single:
        made = Normal(shaped(laws, 0), variance=shaped(laws, 1))
    else:
        made = SequentialNormal(
            shaped(alone, 0), variance=shaped(alone, 1), conditional_mean=shaped(laws, 0),
            conditional_variance=shaped(laws, 1),
        )  # fmt: skip
    made.location = site.distribution.location
    return made


def _restricted(site: Site, components: Sequence[Expr]) -> Site:
    """A site of some of its components."""
    if len(components) == len(site.components):
        return site
    at = [i for i, s in enumerate(site.value.ravel()) if s in set(components)]
    d = site.distribution
    mean = array(array(d.mean()).ravel()[at])
    law: Distribution
    if isinstance(d, Dirac):
        law = Dirac(mean)
    elif isinstance(d, MvNormal):
        law = MvNormal(mean, covariance=array(d.covariance_matrix()[np.ix_(at, at)]))
    else:
        assert isinstance(d, Normal)
        law = Normal(mean, variance=array(d.variance_in_range().ravel()[at]))
    return _site(site.name, site.role, law, components, d.location)


def _site(
    name: str, role: str, law: Distribution, symbols: Sequence[Expr], where: Location
) -> Site:
    law.location = where
    return Site(name, role, law, array(list(symbols)), where)
