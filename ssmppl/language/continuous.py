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
from ssmppl.expressions.expr import Expr, apply
from ssmppl.language.distribution import (
    INFINITY,
    Distribution,
    Draws,
    Support,
    log_difference,
    one_of,
)

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

    def _standard(self, value: Any) -> ExprArray:
        return array((array(value) - self.mean_) / self.sd())

    def cdf(self, value):
        return array(ew("ndtr", self._standard(value)))

    def survival(self, value):
        return array(ew("ndtr", -self._standard(value)))

    def log_cdf(self, value):
        return array(ew("log_ndtr", self._standard(value)))

    def log_survival(self, value):
        return array(ew("log_ndtr", -self._standard(value)))

    def quantile(self, p):
        return self.mean_ + self.sd() * ew("ndtri", p)

    def survival_quantile(self, p):
        return self.mean_ - self.sd() * ew("ndtri", p)

    def _in_lower_tail(
        self, lower: ExprArray, upper: ExprArray
    ) -> tuple[ExprArray | bool, ExprArray, ExprArray]:
        """(flip, a, b): the interval, standardised, mirrored where it lies above the mean."""
        a, b = self._standard(lower), self._standard(upper)
        whole_left, whole_right = self.open_sides(lower, upper)
        if whole_left:
            return False, a, b
        if whole_right:
            return True, -b, -a
        flip = array(ew("lt", 0.0, a))
        return flip, _where(flip, -b, a), _where(flip, -a, b)

    def log_mass(self, lower, upper):
        _, low, high = self._in_lower_tail(array(lower), array(upper))
        return _log_ndtr_between(low, high)

    def quantile_between(self, p, q, lower, upper):
        flip, low, high = self._in_lower_tail(lower, upper)
        if isinstance(flip, bool):
            p, q = (q, p) if flip else (p, q)
        else:
            p, q = _where(flip, q, p), _where(flip, p, q)
        z = array(ew("ndtri", q * ew("ndtr", low) + p * ew("ndtr", high)))
        # Beyond 30 standard deviations: Newton's method for log Phi(z) = target, from the tail's
        # leading term exp(-z^2 / 2); two steps are exact to rounding there.
        log_high = array(ew("log_ndtr", high))
        target = log_high + ew("log", p)
        if not _all_infinite(low):
            target = array(ew("logaddexp", target, array(ew("log_ndtr", low)) + ew("log", q)))
        far = -array(ew("sqrt", high**2 - 2.0 * (target - log_high)))
        for _ in range(2):
            value = array(ew("log_ndtr", far))
            slope = array(ew("exp", -0.5 * far**2 - 0.5 * LOG_2PI - value))
            far = far - (value - target) / slope
        z = _where(ew("lt", high, -30.0), far, z)
        if isinstance(flip, bool):
            z = -z if flip else z
        else:
            z = _where(flip, -z, z)
        return self.mean_ + self.sd() * z


def _log_ndtr_between(low: Any, high: Any) -> ExprArray:
    log_high = array(ew("log_ndtr", high))
    return log_high if _all_infinite(low) else log_difference(log_high, ew("log_ndtr", low))


def _all_infinite(a: Any) -> bool:
    return all(e.op == "const" and e.data == -INFINITY for e in array(a).ravel())


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
        return self._log.cdf(_log_of_positive(value))

    def survival(self, value):
        return self._log.survival(_log_of_positive(value))

    def log_cdf(self, value):
        return self._log.log_cdf(_log_of_positive(value))

    def log_survival(self, value):
        return self._log.log_survival(_log_of_positive(value))

    def quantile(self, p):
        return array(ew("exp", self._log.quantile(p)))

    def survival_quantile(self, p):
        return array(ew("exp", self._log.survival_quantile(p)))

    def log_mass(self, lower, upper):
        return self._log.log_mass(_log_of_positive(lower), _log_of_positive(upper))

    def quantile_between(self, p, q, lower, upper):
        bounds = _log_of_positive(lower), _log_of_positive(upper)
        return array(ew("exp", self._log.quantile_between(p, q, *bounds)))

    def weighted(self, power):
        moment = ew("exp", power * self.mean_ + 0.5 * power**2 * self.sd**2)
        return array(moment), LogNormal(self.mean_ + power * self.sd**2, sd=self.sd)


def _log_of_positive(value: Any) -> ExprArray:
    return array(ew("log", ew("maximum", value, 0.0)))


class _Symmetric(Distribution):
    """loc + scale * Z with Z symmetric round zero."""

    def _standard_cdf(self, z: ExprArray) -> ExprArray:
        raise AttributeError

    def _standard_quantile(self, p: ExprArray) -> ExprArray:
        raise AttributeError

    def cdf(self, value):
        return self._standard_cdf((array(value) - self.loc) / self.scale)

    def survival(self, value):
        return self._standard_cdf((self.loc - array(value)) / self.scale)

    def quantile(self, p):
        return self.loc + self.scale * self._standard_quantile(array(p))

    def survival_quantile(self, p):
        return self.loc - self.scale * self._standard_quantile(array(p))


class StudentT(_Symmetric):
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

    def has_moment(self, power):
        return array(ew("lt", float(power), self.df))

    def _standard_cdf(self, z):
        # The tail beyond |z| is I_{nu/(nu+z^2)}(nu/2, 1/2) / 2; in the middle, where that argument
        # is close to 1, its complement I_{z^2/(nu+z^2)}(1/2, nu/2).
        half, middle = 0.5 * self.df, array(ew("lt", z**2, self.df))
        a, b = _where(middle, 0.5, half), _where(middle, half, 0.5)
        x = _where(middle, z**2, self.df) / (self.df + z**2)
        part = 0.5 * array(ew("betainc", a, b, x))
        tail = _where(middle, 0.5 - part, part)
        return _where(ew("lt", z, 0.0), tail, 1.0 - tail)

    def _standard_quantile(self, p):
        half, tail = 0.5 * self.df, array(ew("minimum", p, 1.0 - p))
        middle = array(ew("lt", 0.25, tail))
        a, b = _where(middle, 0.5, half), _where(middle, half, 0.5)
        x = array(ew("betaincinv", a, b, _where(middle, 1.0 - 2.0 * tail, 2.0 * tail)))
        ratio = _where(middle, x, 1.0 - x) / _where(middle, 1.0 - x, x)
        z = array(ew("sqrt", self.df * ratio))
        return _where(ew("lt", p, 0.5), -z, z)


class Laplace(_Symmetric):
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

    def _standard_cdf(self, z):
        tail = 0.5 * array(ew("exp", -ew("abs", z)))
        return _where(ew("lt", z, 0.0), tail, 1.0 - tail)

    def _standard_quantile(self, p):
        tail = array(ew("log", 2.0 * ew("minimum", p, 1.0 - p)))
        return _where(ew("lt", p, 0.5), tail, -tail)

    def _standard_log_cdf(self, z):
        above = ew("log1p", -0.5 * array(ew("exp", -ew("abs", z))))
        return _where(ew("lt", z, 0.0), z - math.log(2.0), above)

    def log_cdf(self, value):
        return self._standard_log_cdf((array(value) - self.loc) / self.scale)

    def log_survival(self, value):
        return self._standard_log_cdf((self.loc - array(value)) / self.scale)

    def quantile_between(self, p, q, lower, upper):
        # On one side of loc: an exponential cut off at the interval's width, from its inner end.
        a, b = (array(lower) - self.loc) / self.scale, (array(upper) - self.loc) / self.scale
        above = a + cut_exponential(p, q, array(b - a))
        below = b - cut_exponential(q, p, array(b - a))
        across = (super().quantile_between(p, q, lower, upper) - self.loc) / self.scale
        one_side = _where(ew("le", 0.0, a), above, below)
        crosses = ew("and", array(ew("lt", a, 0.0)), array(ew("lt", 0.0, b)))
        return self.loc + self.scale * _where(crosses, across, one_side)


def cut_exponential(p: ExprArray, q: ExprArray, width: ExprArray) -> ExprArray:
    """Quantile at p, q = 1 - p of an exponential with unit rate restricted to [0, width]."""
    near_zero = ew("log1p", p * array(ew("expm1", -width)))
    near_width = ew("log", q + p * array(ew("exp", -width)))
    return -_where(ew("lt", p, 0.5), near_zero, near_width)


class Cauchy(_Symmetric):
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

    def has_moment(self, power):
        return self._full(0.0)

    def _standard_cdf(self, z):
        # arctan2 keeps the lower tail, which 1/2 + arctan(z)/pi would lose to rounding
        return array(ew("arctan2", 1.0, -z)) / math.pi

    def _standard_quantile(self, p):
        tail = 1.0 / array(ew("tan", math.pi * ew("minimum", p, 1.0 - p)))
        return _where(ew("lt", p, 0.5), -tail, tail)


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

    def cdf(self, value):
        return array(ew("erf", ew("maximum", value, 0.0) / (math.sqrt(2.0) * self.sd)))

    def survival(self, value):
        return array(ew("erfc", ew("maximum", value, 0.0) / (math.sqrt(2.0) * self.sd)))

    def log_survival(self, value):
        return math.log(2.0) + self.full.log_survival(array(ew("maximum", value, 0.0)))

    def quantile(self, p):  # X^2 / (2 sd^2) ~ Gamma(1/2, 1)
        return self.sd * ew("sqrt", 2.0 * array(ew("gammaincinv", 0.5, p)))

    def survival_quantile(self, p):
        return self.sd * ew("sqrt", 2.0 * array(ew("gammainccinv", 0.5, p)))

    def quantile_between(self, p, q, lower, upper):
        if self.open_sides(lower, upper)[0]:
            return super().quantile_between(p, q, lower, upper)
        return self.full.quantile_between(p, q, array(ew("maximum", lower, 0.0)), upper)


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

    def has_moment(self, power):
        return self._full(0.0)

    def cdf(self, value):
        z = array(ew("maximum", value, 0.0)) / self.scale
        return array(ew("arctan", z)) * (2.0 / math.pi)

    def survival(self, value):
        z = array(ew("maximum", value, 0.0)) / self.scale
        return array(ew("arctan2", 1.0, z)) * (2.0 / math.pi)

    def quantile(self, p):
        return self.scale * ew("tan", 0.5 * math.pi * array(p))

    def survival_quantile(self, p):
        return self.scale / array(ew("tan", 0.5 * math.pi * array(p)))


class Uniform(Distribution):
    """Uniform(lower, upper)."""

    closed = True

    def __init__(self, lower: Any, upper: Any):
        self._set(lower=lower, upper=upper)
        for a, b in zip(self.lower.ravel(), self.upper.ravel(), strict=True):
            infinite = any(e.op == "const" and math.isinf(e.data) for e in (a, b))
            if infinite or (a.op == b.op == "const" and not a.data < b.data):
                raise ModelError(
                    f"Uniform: lower = {a!r} and upper = {b!r}",
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

    def survival(self, value):
        inside = (self.upper - array(value)) / (self.upper - self.lower)
        return array(ew("minimum", 1.0, ew("maximum", 0.0, inside)))

    def quantile(self, p):
        return self.lower + (self.upper - self.lower) * array(p)

    def survival_quantile(self, p):
        return self.upper - (self.upper - self.lower) * array(p)

    def log_mass(self, lower, upper):
        inside = ew("minimum", upper, self.upper) - array(ew("maximum", lower, self.lower))
        return array(ew("log", ew("maximum", inside, 0.0)) - ew("log", self.upper - self.lower))

    def quantile_between(self, p, q, lower, upper):
        return q * lower + p * upper


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

    def survival(self, value):
        return array(ew("exp", self.log_survival(value)))

    def log_survival(self, value):
        return -self._rate() * ew("maximum", value, 0.0)

    def quantile(self, p):
        return -ew("log1p", -array(p)) / self._rate()

    def survival_quantile(self, p):
        return -ew("log", p) / self._rate()

    # Without memory: beyond `lower` it starts anew, whatever the tail.
    def log_mass(self, lower, upper):
        lower = array(ew("maximum", lower, 0.0))
        width = array(upper) - lower
        return -self._rate() * lower + ew("log", -array(ew("expm1", -self._rate() * width)))

    def quantile_between(self, p, q, lower, upper):
        return lower + cut_exponential(p, q, self._rate() * (upper - lower)) / self._rate()


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

    def survival(self, value):
        return array(ew("gammaincc", self.shape_, self._rate() * ew("maximum", value, 0.0)))

    def quantile(self, p):
        return array(ew("gammaincinv", self.shape_, p)) / self._rate()

    def survival_quantile(self, p):
        return array(ew("gammainccinv", self.shape_, p)) / self._rate()

    def weighted(self, power):
        rising = math.prod((self.shape_ + k for k in range(power)), start=array(1.0))
        return rising / self._rate() ** power, Gamma(self.shape_ + power, rate=self._rate())


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
        return array(ew("gammaincc", self.shape_, self.scale / array(ew("maximum", value, 0.0))))

    def survival(self, value):
        return array(ew("gammainc", self.shape_, self.scale / array(ew("maximum", value, 0.0))))

    def quantile(self, p):
        return self.scale / array(ew("gammainccinv", self.shape_, p))

    def survival_quantile(self, p):
        return self.scale / array(ew("gammaincinv", self.shape_, p))

    def has_moment(self, power):
        return array(ew("lt", float(power), self.shape_))


SMALL_SHAPE = 0.1  # below it, gamma draws may be too small for floating point


def _lower_end(e: Expr) -> float:
    """A number as it is; 0, the least that a positive parameter can be, for an expression."""
    return e.data if e.op == "const" else 0.0


def needs_log_gamma(shapes: ExprArray) -> bool:
    """Whether ratios of gamma draws of these shapes may be 0 / 0."""
    return min(map(_lower_end, shapes.ravel())) < SMALL_SHAPE


def log_gamma_draw(draws: Draws, shape: Expr) -> Expr:
    """log of a gamma draw of that shape and unit rate: that of shape + 1, times U^(1/shape)."""
    return apply("log", draws.gamma(shape + 1.0)) + apply("log", draws.uniform()) / shape


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
            a, b = self.a[i], self.b[i]
            if needs_log_gamma(array([a, b])):
                return 1.0 / (1.0 + ew("exp", log_gamma_draw(draws, b) - log_gamma_draw(draws, a)))
            first, second = draws.gamma(a), draws.gamma(b)
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

    def survival(self, value):
        clipped = array(ew("minimum", 1.0, ew("maximum", 0.0, value)))
        near_one = ew("betainc", self.b, self.a, 1.0 - clipped)
        return _where(ew("lt", clipped, 0.5), 1.0 - self.cdf(clipped), near_one)

    def quantile(self, p):
        return array(ew("betaincinv", self.a, self.b, p))

    def survival_quantile(self, p):
        p = array(p)
        near_one = 1.0 - array(ew("betaincinv", self.b, self.a, p))
        return _where(ew("lt", p, 0.5), near_one, ew("betaincinv", self.a, self.b, 1.0 - p))

    def weighted(self, power):
        moment = math.prod(
            ((self.a + k) / (self.a + self.b + k) for k in range(power)), start=array(1.0)
        )
        return moment, Beta(self.a + power, self.b)


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
