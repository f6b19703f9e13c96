"""Continuous distributions of scalars, and elementwise of arrays.

Densities, moments and quantiles as in Johnson, Kotz and Balakrishnan (1994, 1995),
"Continuous univariate distributions", volumes 1 and 2, in the parametrisations named in each class.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ssmppl.errors import ModelError
from ssmppl.expressions.arrays import ExprArray, array
from ssmppl.expressions.arrays import elementwise as ew
from ssmppl.language.distribution import INFINITY, Distribution, Draws, Support, one_of

LOG_2PI = math.log(2.0 * math.pi)
_NAN = math.nan


def _each(distribution: Distribution, draw: Any) -> ExprArray:
    """An array of independent draws of the distribution's shape."""
    out = np.empty(distribution.shape, dtype=object)
    for i in np.ndindex(distribution.shape):
        out[i] = draw(i)
    return array(out)


def _where(condition: Any, a: Any, b: Any) -> ExprArray:
    return array(ew("where", condition, a, b))


class Normal(Distribution):
    """Normal(mean, sd= | variance= | precision=)."""

    def __init__(self, mean: Any, *, sd: Any = None, variance: Any = None, precision: Any = None):
        self.spread, value = one_of(
            "Normal", {"sd": sd, "variance": variance, "precision": precision}
        )
        self._set(**{"mean_": mean, self.spread: value})
        self._require(self.spread, 0.0)

    def mean(self):
        return self.mean_

    def sd(self) -> ExprArray:
        """Standard deviation, however the spread was given."""
        s = self.parameters[self.spread]
        if self.spread == "sd":
            return s
        return array(ew("sqrt", s if self.spread == "variance" else 1.0 / s))

    def variance(self):
        s = self.parameters[self.spread]
        return {"sd": lambda: s**2, "variance": lambda: s, "precision": lambda: 1.0 / s}[
            self.spread
        ]()

    def log_densities(self, value):
        s, d = self.parameters[self.spread], array(value) - self.mean_
        if self.spread == "precision":
            return 0.5 * ew("log", s) - 0.5 * s * d**2 - 0.5 * LOG_2PI
        if self.spread == "variance":
            return -0.5 * ew("log", s) - 0.5 * d**2 / s - 0.5 * LOG_2PI
        return -ew("log", s) - 0.5 * (d / s) ** 2 - 0.5 * LOG_2PI

    def sample(self, draws):
        sd = self.sd()
        return self.mean_ + _each(self, lambda i: sd[i] * draws.normal())

    def cdf(self, value):
        return array(ew("ndtr", (array(value) - self.mean_) / self.sd()))

    def quantile(self, p):
        return self.mean_ + self.sd() * ew("ndtri", p)

    def log_mass(self, lower, upper):
        # From whichever tail the interval lies in, so that nothing cancels: with a flip where
        # lower is above the mean, P = Phi(b) - Phi(a) for a < b in the lower tail.
        sd = self.sd()
        a, b = (array(lower) - self.mean_) / sd, (array(upper) - self.mean_) / sd
        flip = array(ew("lt", 0.0, a))
        low, high = _where(flip, -b, a), _where(flip, -a, b)
        log_high = array(ew("log_ndtr", high))
        return log_high + ew("log1p", -ew("exp", array(ew("log_ndtr", low)) - log_high))


class LogNormal(Distribution):
    """LogNormal(mean, sd=): exp of a Normal with that mean and standard deviation of the log."""

    def __init__(self, mean: Any, *, sd: Any):
        self._set(mean_=mean, sd=sd)
        self._require("sd", 0.0)
        self._log = Normal(self.mean_, sd=self.sd)

    def support(self):
        return Support("interval", self._full(0.0), self._full(INFINITY))

    def log_densities(self, value):
        log_value = array(ew("log", value))
        return self._log.log_densities(log_value) - log_value

    def sample(self, draws):
        return array(ew("exp", self._log.sample(draws)))

    def mean(self):
        return array(ew("exp", self.mean_ + 0.5 * self.sd**2))

    def variance(self):
        return self.mean() ** 2 * ew("expm1", self.sd**2)

    def cdf(self, value):
        return self._log.cdf(array(ew("log", value)))

    def quantile(self, p):
        return array(ew("exp", self._log.quantile(p)))

    def log_mass(self, lower, upper):
        return self._log.log_mass(array(ew("log", lower)), array(ew("log", upper)))


class StudentT(Distribution):
    """StudentT(df, loc, scale=)."""

    def __init__(self, df: Any, loc: Any, *, scale: Any):
        self._set(df=df, loc=loc, scale=scale)
        self._require("df", 0.0)
        self._require("scale", 0.0)

    def log_densities(self, value):
        z, nu = (array(value) - self.loc) / self.scale, self.df
        norm = ew("gammaln", 0.5 * (nu + 1.0)) - ew("gammaln", 0.5 * nu)
        spread = 0.5 * ew("log", nu * math.pi) + ew("log", self.scale)
        return norm - spread - 0.5 * (nu + 1.0) * ew("log1p", z**2 / nu)

    def sample(self, draws):
        def draw(i):
            half = 0.5 * self.df[i]
            return draws.normal() / ew("sqrt", draws.gamma(half) / half)

        return self.loc + self.scale * _each(self, draw)

    def mean(self):
        return _where(ew("lt", 1.0, self.df), self.loc, _NAN)

    def variance(self):
        finite = self.scale**2 * self.df / (self.df - 2.0)
        infinite = _where(ew("lt", 1.0, self.df), INFINITY, _NAN)
        return _where(ew("lt", 2.0, self.df), finite, infinite)

    def cdf(self, value):
        z, half = (array(value) - self.loc) / self.scale, 0.5 * self.df
        # The tail beyond |z| is I_{nu/(nu+z^2)}(nu/2, 1/2) / 2.
        tail = 0.5 * array(ew("betainc", half, 0.5, self.df / (self.df + z**2)))
        return _where(ew("lt", z, 0.0), tail, 1.0 - tail)

    def quantile(self, p):
        p = array(p)
        tail = array(ew("minimum", p, 1.0 - p))
        x = array(ew("betaincinv", 0.5 * self.df, 0.5, 2.0 * tail))
        z = array(ew("sqrt", self.df * (1.0 - x) / x))
        return self.loc + self.scale * _where(ew("lt", p, 0.5), -z, z)


class Laplace(Distribution):
    """Laplace(loc, scale=): density exp(-|x - loc| / scale) / (2 scale)."""

    def __init__(self, loc: Any, *, scale: Any):
        self._set(loc=loc, scale=scale)
        self._require("scale", 0.0)

    def log_densities(self, value):
        return -ew("log", 2.0 * self.scale) - ew("abs", array(value) - self.loc) / self.scale

    def sample(self, draws):
        return self.quantile(_each(self, lambda i: draws.uniform()))

    def mean(self):
        return self.loc

    def variance(self):
        return 2.0 * self.scale**2

    def cdf(self, value):
        z = (array(value) - self.loc) / self.scale
        tail = 0.5 * array(ew("exp", -ew("abs", z)))
        return _where(ew("lt", z, 0.0), tail, 1.0 - tail)

    def quantile(self, p):
        p = array(p)
        tail = array(ew("log", 2.0 * ew("minimum", p, 1.0 - p)))
        return self.loc + self.scale * _where(ew("lt", p, 0.5), tail, -tail)


class Cauchy(Distribution):
    """Cauchy(loc, scale=)."""

    def __init__(self, loc: Any, *, scale: Any):
        self._set(loc=loc, scale=scale)
        self._require("scale", 0.0)

    def log_densities(self, value):
        z = (array(value) - self.loc) / self.scale
        return -ew("log", math.pi * self.scale) - ew("log1p", z**2)

    def sample(self, draws):
        return self.quantile(_each(self, lambda i: draws.uniform()))

    def mean(self):
        return self._full(_NAN)

    def variance(self):
        return self._full(_NAN)

    def cdf(self, value):
        # arctan2 keeps the lower tail, which 1/2 + arctan(z)/pi would lose to rounding
        z = (array(value) - self.loc) / self.scale
        return array(ew("arctan2", 1.0, -z)) / math.pi

    def quantile(self, p):
        p = array(p)
        tail = 1.0 / array(ew("tan", math.pi * ew("minimum", p, 1.0 - p)))
        return self.loc + self.scale * _where(ew("lt", p, 0.5), -tail, tail)


class _Half(Distribution):
    """|X| for X symmetric round zero."""

    closed = True
    full: Distribution

    def support(self):
        return Support("interval", self._full(0.0), self._full(INFINITY))

    def log_densities(self, value):
        return math.log(2.0) + self.full.log_densities(value)

    def sample(self, draws):
        return array(ew("abs", self.full.sample(draws)))

    def cdf(self, value):
        return _where(ew("lt", value, 0.0), 0.0, 2.0 * self.full.cdf(value) - 1.0)

    def quantile(self, p):
        return self.full.quantile(0.5 + 0.5 * array(p))


class HalfNormal(_Half):
    """HalfNormal(sd=): |X|, X ~ Normal(0, sd=sd)."""

    def __init__(self, *, sd: Any):
        self._set(sd=sd)
        self._require("sd", 0.0)
        self.full = Normal(np.zeros(self.shape), sd=self.sd)

    def mean(self):
        return self.sd * math.sqrt(2.0 / math.pi)

    def variance(self):
        return self.sd**2 * (1.0 - 2.0 / math.pi)

    def log_mass(self, lower, upper):
        lower = array(ew("maximum", lower, 0.0))
        return math.log(2.0) + self.full.log_mass(lower, upper)


class HalfCauchy(_Half):
    """HalfCauchy(scale=): |X|, X ~ Cauchy(0, scale=scale)."""

    def __init__(self, *, scale: Any):
        self._set(scale=scale)
        self._require("scale", 0.0)
        self.full = Cauchy(np.zeros(self.shape), scale=self.scale)

    def mean(self):
        return self._full(INFINITY)

    def variance(self):
        return self._full(_NAN)


class Uniform(Distribution):
    """Uniform(lower, upper)."""

    closed = True

    def __init__(self, lower: Any, upper: Any):
        self._set(lower=lower, upper=upper)
        for a, b in zip(self.lower.ravel(), self.upper.ravel(), strict=True):
            if a.op == b.op == "const" and not -INFINITY < a.data < b.data < INFINITY:
                raise ModelError(
                    f"Uniform: lower = {a.data:g} and upper = {b.data:g}",
                    fix="give finite bounds with lower < upper; an improper prior is ssm.Flat()",
                    where=self.location,
                )

    def support(self):
        return Support("interval", self.lower, self.upper)

    def log_densities(self, value):
        return array(np.broadcast_to(array(-ew("log", self.upper - self.lower)), self.shape))

    def sample(self, draws):
        return self.quantile(_each(self, lambda i: draws.uniform()))

    def mean(self):
        return 0.5 * (self.lower + self.upper)

    def variance(self):
        return (self.upper - self.lower) ** 2 / 12.0

    def cdf(self, value):
        inside = (array(value) - self.lower) / (self.upper - self.lower)
        return array(ew("minimum", 1.0, ew("maximum", 0.0, inside)))

    def quantile(self, p):
        return self.lower + (self.upper - self.lower) * array(p)


class _Positive(Distribution):
    def support(self):
        return Support("interval", self._full(0.0), self._full(INFINITY))


class Exponential(_Positive):
    """Exponential(rate= | scale=); a bare argument is the rate."""

    closed = True

    def __init__(self, rate: Any = None, *, scale: Any = None):
        self.spread, value = one_of("Exponential", {"rate": rate, "scale": scale})
        self._set(**{self.spread: value})
        self._require(self.spread, 0.0)

    def _rate(self) -> ExprArray:
        s = self.parameters[self.spread]
        return s if self.spread == "rate" else 1.0 / s

    def log_densities(self, value):
        return ew("log", self._rate()) - self._rate() * array(value)

    def sample(self, draws):
        return -_each(self, lambda i: ew("log", draws.uniform())) / self._rate()

    def mean(self):
        return 1.0 / self._rate()

    def variance(self):
        return 1.0 / self._rate() ** 2

    def cdf(self, value):
        return -ew("expm1", -self._rate() * ew("maximum", value, 0.0))

    def quantile(self, p):
        return -ew("log1p", -array(p)) / self._rate()


class Gamma(_Positive):
    """Gamma(shape, rate= | scale=)."""

    def __init__(self, shape: Any, *, rate: Any = None, scale: Any = None):
        self.spread, value = one_of("Gamma", {"rate": rate, "scale": scale})
        self._set(**{"shape_": shape, self.spread: value})
        self._require("shape_", 0.0)
        self._require(self.spread, 0.0)

    def _rate(self) -> ExprArray:
        s = self.parameters[self.spread]
        return s if self.spread == "rate" else 1.0 / s

    def log_densities(self, value):
        a, b, v = self.shape_, self._rate(), array(value)
        return a * ew("log", b) + (a - 1.0) * ew("log", v) - b * v - ew("gammaln", a)

    def sample(self, draws):
        return _each(self, lambda i: draws.gamma(self.shape_[i])) / self._rate()

    def mean(self):
        return self.shape_ / self._rate()

    def variance(self):
        return self.shape_ / self._rate() ** 2

    def cdf(self, value):
        return array(ew("gammainc", self.shape_, self._rate() * ew("maximum", value, 0.0)))

    def quantile(self, p):
        return array(ew("gammaincinv", self.shape_, p)) / self._rate()


class InverseGamma(_Positive):
    """InverseGamma(shape, scale=): 1 / X for X ~ Gamma(shape, rate=scale)."""

    def __init__(self, shape: Any, *, scale: Any):
        self._set(shape_=shape, scale=scale)
        self._require("shape_", 0.0)
        self._require("scale", 0.0)

    def log_densities(self, value):
        a, b, v = self.shape_, self.scale, array(value)
        return a * ew("log", b) - (a + 1.0) * ew("log", v) - b / v - ew("gammaln", a)

    def sample(self, draws):
        return self.scale / _each(self, lambda i: draws.gamma(self.shape_[i]))

    def mean(self):
        a = self.shape_
        return _where(ew("lt", 1.0, a), self.scale / (a - 1.0), INFINITY)

    def variance(self):
        a = self.shape_
        finite = self.scale**2 / ((a - 1.0) ** 2 * (a - 2.0))
        return _where(ew("lt", 2.0, a), finite, _where(ew("lt", 1.0, a), INFINITY, _NAN))

    def cdf(self, value):
        inside = 1.0 - array(ew("gammainc", self.shape_, self.scale / array(value)))
        return _where(ew("lt", 0.0, value), inside, 0.0)

    def quantile(self, p):
        return self.scale / array(ew("gammaincinv", self.shape_, 1.0 - array(p)))


class Beta(Distribution):
    """Beta(a, b)."""

    def __init__(self, a: Any, b: Any):
        self._set(a=a, b=b)
        self._require("a", 0.0)
        self._require("b", 0.0)

    def support(self):
        return Support("interval", self._full(0.0), self._full(1.0))

    def log_densities(self, value):
        a, b, v = self.a, self.b, array(value)
        norm = ew("gammaln", a) + ew("gammaln", b) - ew("gammaln", a + b)
        return (a - 1.0) * ew("log", v) + (b - 1.0) * ew("log1p", -v) - norm

    def sample(self, draws):
        def draw(i):
            first, second = draws.gamma(self.a[i]), draws.gamma(self.b[i])
            return first / (first + second)

        return _each(self, draw)

    def mean(self):
        return self.a / (self.a + self.b)

    def variance(self):
        n = self.a + self.b
        return self.a * self.b / (n**2 * (n + 1.0))

    def cdf(self, value):
        clipped = ew("minimum", 1.0, ew("maximum", 0.0, value))
        return array(ew("betainc", self.a, self.b, clipped))

    def quantile(self, p):
        return array(ew("betaincinv", self.a, self.b, p))


class Flat(Distribution):
    """Flat(): an improper prior, constant on the whole line; for likelihoods only."""

    proper = False

    def __init__(self, shape: tuple[int, ...] = ()):
        self._set(zero=np.zeros(shape))

    def log_densities(self, value):
        return self._full(0.0)

    def sample(self, draws: Draws) -> ExprArray:
        raise ModelError(
            f"{type(self).__name__}() is improper and cannot be drawn from",
            fix="give this parameter a proper prior, or its value by parameters= or fixed=",
            where=self.location,
        )

    def mean(self):
        return self._full(_NAN)

    def variance(self):
        return self._full(_NAN)


class HalfFlat(Flat):
    """HalfFlat(): an improper prior, constant on the positive half line; for likelihoods only."""

    def support(self):
        return Support("interval", self._full(0.0), self._full(INFINITY))
