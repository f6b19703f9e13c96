"""The distributions of single components of an observation, which predictions are made by."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ssmppl.analysis.proposals.proposals import drawn
from ssmppl.expressions.arrays import ExprArray, array
from ssmppl.expressions.expr import Expr, attributed
from ssmppl.language.distributions import (
    Beta,
    Dirichlet,
    Mixture,
    MvNormal,
    Normal,
    ZeroInflated,
)
from ssmppl.language.distributions.base import Distribution
from ssmppl.language.distributions.multivariate import SequentialNormal
from ssmppl.language.model.trace import Site, Trace


@dataclass(frozen=True)
class Channel:
    """One component given x_t. below : P(Y <= y), of its own symbol y. ends : values, of a level,
    between which its inverse lies; of most distributions that itself. whole : whether its values
    are whole numbers."""

    below: Expr
    ends: Callable[[float], list[Expr]]
    whole: bool


def channels(site: Site) -> list[Channel | None]:
    """The channels of every component; None where its distribution has no distribution function, or
    no inverse of it."""
    law, y = of_components(site.distribution), site.value
    parts = _parts(law)
    if law.multivariate or not all(part.inverts() for part in parts):
        return [None] * len(site.components)
    first = {s: i for i, s in reversed(list(enumerate(y.ravel())))}
    places = [first[s] for s in site.components]

    below = law.cdf(y)

    def ends(place: int) -> Callable[[float], list[Expr]]:
        return lambda level: [_at(p.quantile(array(level)), site, place) for p in parts]

    return [Channel(_at(below, site, p), ends(p), law.discrete) for p in places]


def _parts(law: Distribution) -> list[Distribution]:
    """The distributions that a distribution is a mixture of: its quantiles lie between theirs."""
    if isinstance(law, Mixture):
        return [part for component in law.components for part in _parts(component)]
    if isinstance(law, ZeroInflated) and isinstance(law.base, Mixture):
        return [ZeroInflated(part, law.p) for part in _parts(law.base)]
    return [law]


def _at(values: ExprArray, site: Site, place: int) -> Expr:
    wide = array(np.broadcast_to(array(values).view(np.ndarray), site.shape))
    found: Expr = wide.ravel()[place]
    return found


def channel_draws(trace: Trace) -> list[Expr]:
    """A draw of every component of y_t given x_t, in the trace's order, by its own distribution:
    those of one that is jointly Gaussian are independent, which takes no factor of its
    covariance."""
    sites = [replace(s, distribution=alone(s.distribution)) for s in trace.observations.values()]
    return observation_draws(replace(trace, observations={s.name: s for s in sites}))


def observation_draws(trace: Trace) -> list[Expr]:
    """A draw of every component of y_t given x_t, in the trace's order."""
    out: list[Expr] = []
    for site in trace.observations.values():
        with attributed(trace.locations, site.distribution.location):
            sample = drawn(site).ravel()
        by_symbol = dict(zip(site.value.ravel(), sample, strict=True))
        out += [by_symbol[s] for s in site.components]
    return out


def alone(law: Distribution) -> Distribution:
    """The distributions of the components of one that is jointly Gaussian; any other as it is."""
    if not isinstance(law, (MvNormal, SequentialNormal)):
        return law
    found = Normal(law.mean(), variance=law.variance())
    found.location = law.location
    return found


def of_components(law: Distribution) -> Distribution:
    """The distribution of each component alone, of a distribution that has them in closed form; any
    other as it is."""
    return _shares(law) if isinstance(law, Dirichlet) else alone(law)


def _shares(law: Dirichlet) -> Beta:
    """The distributions of single shares."""
    a = law.concentration
    return Beta(a, array(np.sum(a.view(np.ndarray), axis=-1, keepdims=True) - a.view(np.ndarray)))
