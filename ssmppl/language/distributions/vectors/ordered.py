"""Ordered: independent components, given that they come out in increasing order.

David and Nagaraja (2003), "Order statistics", chapter 2.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from ssmppl.errors import ModelError
from ssmppl.expressions.arrays import ExprArray, array
from ssmppl.expressions.arrays import elementwise as ew
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import symbol, user_location
from ssmppl.language.distributions.base import Distribution, Support
from ssmppl.language.distributions.multivariate import Joint

NODES = 12  # of quadrature between two points
LEAST_LOG_ORDER = -25.0  # of a probability of an order; less is lost in the tails of quadrature


class Ordered(Joint):
    """Ordered(law): components in increasing order, those of `law` given that they come out so.

    The density is that of independent components, ``prod_k f_k(x_k)``, where x_1 < x_2 < ... and 0
    elsewhere, divided by the probability of that order: 1 / K! for K components of one
    distribution, so that they are its order statistics. For labels that could be exchanged: the
    rates of a hidden Markov model's regimes, the means of a mixture. A prior of parameters only.

    Parameters
    ----------
    law : continuous and independent over its elements, of shape (K,), K of at least 2, such as
        ``Normal(np.zeros(3), sd=5)``; or (R, K), each row in increasing order. Where components
        have different distributions these are given as numbers, and nothing can be drawn from it.

    Raises
    ------
    ModelError : `law` is no continuous distribution of independent components, has no two of them,
        or has some of different distributions of parameters, or of different supports.

    Notes
    -----
    The posterior is that of Stan's `ordered` and `positive_ordered` and of PyMC's
    ``transform=ordered``, whose densities lack the probability of the order, as it is constant.
    Draws from the prior are in order, as are not those of PyMC's `sample_prior_predictive`. Order
    statistics: David and Nagaraja (2003), "Order statistics", chapter 2.
    """

    prior_only = True
    truncatable = False
    base: Distribution

    def __init__(self, law: Distribution):
        where = user_location()
        if not isinstance(law, Distribution) or law.joint or law.discrete or law.atoms:
            raise ModelError(
                f"Ordered: {law!r} is no continuous distribution of independent components",
                fix="give one such as ssm.Ordered(ssm.Normal(np.zeros(2), sd=5))",
                where=where,
            )
        if len(law.shape) not in (1, 2) or law.shape[-1] < 2:
            raise ModelError(
                f"Ordered: {type(law).__name__} has shape {law.shape}",
                fix="give an array of at least two components by one of its arguments, as "
                "ssm.Ordered(ssm.Normal(np.zeros(2), sd=5))",
                where=where,
            )
        self._set(**{f"like_{n}": a for n, a in law.parameters.items()})
        self.base = law.rebuilt({n: self.parameters[f"like_{n}"] for n in law.parameters})
        self.shape = law.shape
        self.proper, self.closed, self.open_above = law.proper, law.closed, law.open_above
        self._alike = all(map(_all_one, law.parameters.values()))
        self.drawable = law.drawable and self._alike
        self._log_order = self._log_probability()

    def _log_probability(self) -> float:
        """log P(the components come out in increasing order)."""
        k = self.shape[-1]
        if self._alike:
            return -math.lgamma(k + 1.0) * math.prod(self.shape[:-1])
        for end in (self.base.support().lower, self.base.support().upper):
            if not _all_one(array(end)):
                raise ModelError(
                    f"Ordered: the components of {self.base!r} have different bounds",
                    fix="give them bounds in common, by one number for each argument that is one",
                    where=self.location,
                )
        if any(e.op != "const" for e in self.base.expressions()) or not self.base.proper:
            raise ModelError(
                f"Ordered: the components of {self.base!r} have different distributions of "
                "parameters: the probability of their order has no formula",
                fix="give all components the same arguments, or numbers",
                where=self.location,
            )
        if not self.base.inverts():
            raise ModelError(
                f"Ordered: the components of {self.base!r} differ, and have no quantiles, between "
                "which the probability of their order is summed up",
                fix="give all components the same arguments",
                where=self.location,
            )
        rows = np.ndindex(self.shape[:-1])
        found = sum(_log_in_order([self.base.element((*r, i)) for i in range(k)]) for r in rows)
        if found < LEAST_LOG_ORDER:
            raise ModelError(
                f"Ordered: the components of {self.base!r} all but never come out in increasing "
                f"order: with probability exp({found:.3g})",
                fix="give the component that is meant to be the lowest first",
                where=self.location,
            )
        return found

    def __repr__(self) -> str:
        return f"Ordered({self.base!r})"

    def rebuilt(self, parameters):
        values = {**self.parameters, **parameters}
        law = self.base.rebuilt({n: values[f"like_{n}"] for n in self.base.parameters})
        return self._at_place(Ordered(law))

    def support(self):
        own = self.base.support()
        return Support("ordered", array(own.lower), array(own.upper))

    def in_range(self):
        each = self.base.in_range()
        return None if each is None else array(np.min(each))

    def log_densities(self, value):
        return array(np.sum(array(self.base.log_densities(array(value)))) - self._log_order)

    def guarded_log_densities(self, value):
        value = array(value)
        density = np.sum(array(self.base.guarded_log_densities(value))) - self._log_order
        steps = array(ew("lt", value[..., :-1], value[..., 1:])).ravel()
        for step in steps:
            density = ew("where", step, density, -math.inf)
        return array(density)

    def undrawable(self, why):
        if not self.base.drawable:
            return self.base.undrawable(why)
        return ModelError(
            f"Ordered of different distributions has no sampler, and {why}",
            fix="give all components the same arguments",
            where=self.location,
        )

    def sample(self, draws):
        drawn = np.array(array(self.base.sample(draws)).view(np.ndarray))
        k = self.shape[-1]
        for last in range(k - 1, 0, -1):  # the largest of those left goes to their end
            for i in range(last):
                a, b = drawn[..., i].copy(), drawn[..., i + 1].copy()
                drawn[..., i], drawn[..., i + 1] = ew("minimum", a, b), ew("maximum", a, b)
        return array(drawn)

    def mean(self):
        return self._full(math.nan)

    def variance(self):
        return self._full(math.nan)


def _all_one(values: ExprArray) -> bool:
    """Whether all components of each row have the same value."""
    rows = values.reshape(-1, values.shape[-1]).view(np.ndarray)
    return all(e is row[0] for row in rows for e in row)


def _log_in_order(laws: Sequence[Distribution]) -> float:
    """log P(X_1 < X_2 < ...) of independent X_k, by P(.. < X_k < x) = int f_k(t) P(.. < X_{k-1} <
    t) dt, with Gauss-Legendre nodes between quantiles of all of them."""
    edges = _edges_of(laws)
    at, weights = np.polynomial.legendre.leggauss(NODES)
    # int_-1^{node} of the polynomial through values at the nodes
    powers = np.polynomial.legendre.legvander(at, NODES - 1)
    whole = [np.polynomial.legendre.legint(c, lbnd=-1) for c in np.eye(NODES)]
    upto = np.array([np.polynomial.legendre.legval(at, c) for c in whole]).T
    cumulative = upto @ np.linalg.inv(powers)
    half = 0.5 * np.diff(edges)[:, None]
    x = 0.5 * (edges[1:] + edges[:-1])[:, None] + half * at
    log_below, scale = np.zeros_like(x), 0.0
    for law in laws:
        point = symbol("value", "value")
        with np.errstate(all="ignore"):
            density = np.exp(evaluate(array(law.log_densities(array(point)))[()], {point: x}))
        f = half * np.where(np.isfinite(density), density, 0.0) * np.exp(log_below)
        panels = f @ weights
        total = float(panels.sum())
        if not total > 0.0:
            return -math.inf
        before = np.concatenate([[0.0], np.cumsum(panels)[:-1]])
        below = np.maximum(before[:, None] + f @ cumulative.T, 0.0) / total
        scale += math.log(total)
        with np.errstate(divide="ignore"):
            log_below = np.log(below)
    return scale


def _edges_of(laws: Sequence[Distribution]) -> np.ndarray:
    """Points between which the densities of all the distributions are smooth, in order."""
    tails = 10.0 ** -np.arange(2.0, 17.0)
    inner = np.linspace(0.02, 0.98, 49)
    found: list[Any] = []
    for law in laws:
        for quantile, p in (
            (law.quantile, np.concatenate([tails[::-1], inner])), (law.survival_quantile, tails)
        ):  # fmt: skip
            found.append(np.ravel(evaluate(quantile(array(p)), {})))
        kink = law.kink()
        found += [] if kink is None else [np.ravel(evaluate(array(kink), {}))]
    edges = np.unique(np.concatenate(found))
    return np.asarray(edges[np.isfinite(edges)], dtype=float)
