"""Truncated(dist, lower=, upper=): a distribution restricted to an interval.

The log density is that of the base less log P(lower <= X <= upper); draws invert the base's
distribution function on the part of (0, 1) that is left.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ssmppl.errors import ModelError
from ssmppl.expressions.arrays import ExprArray, array
from ssmppl.expressions.arrays import elementwise as ew
from ssmppl.expressions.expr import user_location
from ssmppl.language.continuous import _each, _where
from ssmppl.language.continuous import Flat, LogNormal, Normal
from ssmppl.language.discrete import Dirac
from ssmppl.language.distribution import Distribution, Support


class Truncated(Distribution):
    """Truncated(dist, lower=None, upper=None): bounds are included for discrete distributions."""

    closed = True

    def __init__(self, dist: Distribution, *, lower: Any = None, upper: Any = None):
        if not isinstance(dist, Distribution) or dist.joint or isinstance(dist, (Dirac, Flat)):
            name = type(dist).__name__
            raise ModelError(
                f"Truncated: cannot truncate {name}",
                fix="truncate a scalar distribution such as Normal, Gamma or Poisson",
                where=user_location(),
            )
        if lower is None and upper is None:
            raise ModelError(
                "Truncated: neither lower nor upper was given",
                fix="give lower=, upper= or both",
                where=user_location(),
            )
        self.base = dist
        self._set(
            lower=-math.inf if lower is None else lower,
            upper=math.inf if upper is None else upper,
            **{f"like_{n}": a for n, a in dist.parameters.items()},
        )
        for a, b in zip(self.lower.ravel(), self.upper.ravel(), strict=True):
            if a.op == b.op == "const" and not a.data < b.data:
                raise ModelError(
                    f"Truncated: lower = {a.data:g} is not below upper = {b.data:g}",
                    fix="give lower < upper",
                    where=self.location,
                )
        self.discrete = dist.discrete

    def __repr__(self) -> str:
        bounds = [f"{n}={self.parameters[n].ravel()[0]!r}" for n in ("lower", "upper")]
        return f"Truncated({self.base!r}, {', '.join(b for b in bounds if 'inf' not in b)})"

    def support(self):
        base = self.base.support()
        kind = "integers" if self.discrete else "interval"
        lower = _tighter("maximum", base.lower, self.lower)
        return Support(kind, lower, _tighter("minimum", base.upper, self.upper))

    def _bounds(self) -> tuple[ExprArray, ExprArray]:
        s = self.support()
        return s.lower, s.upper

    def log_densities(self, value):
        return self.base.log_densities(array(value)) - self.base.log_mass(*self._bounds())

    def log_mass(self, lower, upper):
        low, high = self._bounds()
        inside = self.base.log_mass(array(ew("maximum", lower, low)), ew("minimum", upper, high))
        return inside - self.base.log_mass(low, high)

    def _limits(self) -> tuple[ExprArray, ExprArray]:
        """The base's distribution function at the bounds."""
        lower, upper = self._bounds()
        return self.base.cdf(lower - 1.0 if self.discrete else lower), self.base.cdf(upper)

    def cdf(self, value):
        low, high = self._limits()
        inside = (self.base.cdf(array(value)) - low) / (high - low)
        return array(ew("minimum", 1.0, ew("maximum", 0.0, inside)))

    def quantile(self, p):
        lower, upper = self._bounds()
        if isinstance(self.base, (Normal, LogNormal)):
            inner = self.base if isinstance(self.base, Normal) else self.base._log
            log = isinstance(self.base, LogNormal)
            a, b = (array(ew("log", e)) if log else e for e in (lower, upper))
            x = _normal_quantile(inner, a, b, array(p))
            x = array(ew("exp", x)) if log else x
        else:
            low, high = self._limits()
            x = self.base.quantile(low + array(p) * (high - low))
        return array(ew("minimum", upper, ew("maximum", lower, x)))

    def sample(self, draws):
        return self.quantile(_each(self, lambda i: draws.uniform()))

    def _moment(self, power: int) -> ExprArray:
        """E[X^power] as the integral of the quantile function over (0, 1).

        Gauss-Legendre with 200 nodes: exact to rounding for bounded supports with smooth
        densities, to about 1e-4 for one unbounded tail.
        """
        nodes, weights = np.polynomial.legendre.leggauss(200)
        total = self._full(0.0)
        for node, weight in zip(0.5 * (nodes + 1.0), 0.5 * weights, strict=True):
            total = total + weight * self.quantile(self._full(node)) ** power
        return total

    def mean(self):
        return self._moment(1)

    def variance(self):
        return self._moment(2) - self._moment(1) ** 2


def _tighter(op: str, a: ExprArray, b: ExprArray) -> ExprArray:
    """Elementwise bound; infinite constants drop out."""
    neutral = -math.inf if op == "maximum" else math.inf
    out = np.empty(a.shape, dtype=object)
    for i in np.ndindex(a.shape):
        plain = [e for e in (a[i], b[i]) if not (e.op == "const" and e.data == neutral)]
        out[i] = ew(op, *plain) if len(plain) == 2 else (plain or [a[i]])[0]
    return array(out)


def _normal_quantile(base: Normal, lower: ExprArray, upper: ExprArray, p: ExprArray) -> ExprArray:
    """Quantile of a truncated Normal, computed in the lower tail (flipped where needed)."""
    sd = base.sd()
    a, b = (lower - base.mean_) / sd, (upper - base.mean_) / sd
    flip = array(ew("lt", 0.0, a))
    low, high = array(ew("ndtr", _where(flip, -b, a))), array(ew("ndtr", _where(flip, -a, b)))
    q = _where(flip, 1.0 - p, p)
    z = array(ew("ndtri", low + q * (high - low)))
    return base.mean_ + sd * _where(flip, -z, z)
