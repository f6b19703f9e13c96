"""Distributions symmetric round a centre, and of their absolute values, elementwise of arrays.

Densities, moments and quantiles as in Johnson, Kotz and Balakrishnan (1994, 1995),
"Continuous univariate distributions", volumes 1 and 2, in the parametrisations named in each class.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar

import numpy as np

from ssmppl.expressions.arrays import ExprArray, array
from ssmppl.expressions.arrays import elementwise as ew
from ssmppl.language.distributions.base import (
    INFINITY,
    Distribution,
    MeanLink,
    Support,
    VarianceLink,
    where,
)
from ssmppl.language.distributions.continuous import Normal


class _Symmetric(Distribution):
    """loc + scale * Z with Z symmetric round zero."""

    maximisers: ClassVar = {"loc": lambda law, value: value}
    mean_link = MeanLink("loc", "identity")
    variance_link = VarianceLink("scale", 0.5)

    def location_and_scale(self):
        return self.loc, self.scale

    def noise_free(self):
        return self.loc

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
    """StudentT(df, loc, scale=): loc + scale Z, Z Student's t.

    Parameters
    ----------
    df : degrees of freedom, positive; the smaller, the heavier the tails.
    loc : its centre, the mean where df > 1.
    scale : positive; the variance is scale^2 df / (df - 2) where df > 2.
    """

    def __init__(self, df: Any, loc: Any, *, scale: Any):
        self._set(df=df, loc=loc, scale=scale)
        self._require("df", 0.0)
        self._require("scale", 0.0)

    def log_densities(self, value):
        z, nu = (array(value) - self.loc) / self.scale, self.df
        norm = ew("gammaln_rise", 0.5 * nu, 0.5)
        spread = 0.5 * ew("log", nu * math.pi) + ew("log", self.scale)
        return norm - spread - 0.5 * (nu + 1.0) * ew("log1p", z**2 / nu)

    def sample(self, draws):
        def draw(i):
            half = 0.5 * self.df[i]
            return draws.normal() / ew("sqrt", draws.gamma(half) / half)

        return self.loc + self.scale * self._each(draw)

    def mean(self):
        return where(ew("lt", 1.0, self.df), self.loc, math.nan)

    def variance(self):
        finite = self.scale**2 * self.df / (self.df - 2.0)
        infinite = where(ew("lt", 1.0, self.df), INFINITY, math.nan)
        return where(ew("lt", 2.0, self.df), finite, infinite)

    def has_moment(self, power):
        return array(ew("lt", float(power), self.df))

    def _standard_cdf(self, z):
        # Both tails beyond |z| are I_{nu/(nu+z^2)}(nu/2, 1/2), and 1 - I_{z^2/(nu+z^2)}(1/2, nu/2):
        # by the argument that is not close to 1.
        half, total = 0.5 * self.df, self.df + z**2
        near = ew("betaincc", 0.5, half, z**2 / total)
        far = ew("betainc", half, 0.5, self.df / total)
        tail = 0.5 * where(ew("lt", z**2, self.df), near, far)
        return where(ew("lt", z, 0.0), tail, 1.0 - tail)

    def _standard_quantile(self, p):
        # likewise by z^2/(nu+z^2) where z^2 < nu, else by nu/(nu+z^2)
        half, tails = 0.5 * self.df, 2.0 * array(ew("minimum", p, 1.0 - p))
        near = ew("lt", ew("betainc", half, 0.5, 0.5), tails)
        x = array(ew("betainccinv", 0.5, half, where(near, tails, 1.0)))
        y = array(ew("betaincinv", half, 0.5, where(near, 1.0, tails)))
        z = array(ew("sqrt", self.df * where(near, x / (1.0 - x), (1.0 - y) / y)))
        return where(ew("lt", p, 0.5), -z, z)


class Laplace(_Symmetric):
    """Laplace(loc, scale=): density ``exp(-|x - loc| / scale) / (2 scale)``.

    Parameters
    ----------
    loc : its mean.
    scale : positive; the variance is 2 scale^2.
    """

    def __init__(self, loc: Any, *, scale: Any):
        self._set(loc=loc, scale=scale)
        self._require("scale", 0.0)

    def log_densities(self, value):
        return -ew("log", 2.0 * self.scale) - ew("abs", array(value) - self.loc) / self.scale

    def sample(self, draws):
        return self.quantile(self._each(lambda i: draws.uniform()))

    def mean(self):
        return self.loc

    def variance(self):
        return 2.0 * self.scale**2

    def _standard_cdf(self, z):
        tail = 0.5 * array(ew("exp", -ew("abs", z)))
        return where(ew("lt", z, 0.0), tail, 1.0 - tail)

    def _standard_quantile(self, p):
        tail = array(ew("log", 2.0 * ew("minimum", p, 1.0 - p)))
        return where(ew("lt", p, 0.5), tail, -tail)

    def kink(self):
        return self.loc

    def _standard_log_cdf(self, z):
        above = ew("log1p", -0.5 * array(ew("exp", -ew("abs", z))))
        return where(ew("lt", z, 0.0), z - math.log(2.0), above)

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
        one_side = where(ew("le", 0.0, a), above, below)
        crosses = ew("and", array(ew("lt", a, 0.0)), array(ew("lt", 0.0, b)))
        return self.loc + self.scale * where(crosses, across, one_side)


class Logistic(_Symmetric):
    """Logistic(loc, scale=): tails between those of Normal and Laplace; P(X <= x) is the logistic
    function of (x - loc) / scale.

    Parameters
    ----------
    loc : its mean.
    scale : positive; the variance is pi^2 scale^2 / 3.
    """

    def __init__(self, loc: Any, *, scale: Any):
        self._set(loc=loc, scale=scale)
        self._require("scale", 0.0)

    def _z(self, value: Any) -> ExprArray:
        return array((array(value) - self.loc) / self.scale)

    def log_densities(self, value):
        return self.log_cdf(value) + self.log_survival(value) - ew("log", self.scale)

    def sample(self, draws):
        return self.quantile(self._each(lambda i: draws.uniform()))

    def mean(self):
        return self.loc

    def variance(self):
        return (math.pi**2 / 3.0) * self.scale**2

    def _standard_cdf(self, z):
        return 1.0 / (1.0 + array(ew("exp", -z)))

    def _standard_quantile(self, p):
        return array(ew("log", p)) - ew("log1p", -p)

    def log_cdf(self, value):
        return -array(ew("logaddexp", 0.0, -self._z(value)))

    def log_survival(self, value):
        return -array(ew("logaddexp", 0.0, self._z(value)))


def cut_exponential(p: ExprArray, q: ExprArray, width: ExprArray) -> ExprArray:
    """Quantile at p, q = 1 - p of an exponential with unit rate restricted to [0, width]."""
    near_zero = ew("log1p", p * array(ew("expm1", -width)))
    near_width = ew("log", q + p * array(ew("exp", -width)))
    return -where(ew("lt", p, 0.5), near_zero, near_width)


class Cauchy(_Symmetric):
    """Cauchy(loc, scale=): tails so heavy that there is no mean.

    Parameters
    ----------
    loc : its median.
    scale : half of the distance between the quartiles, positive.
    """

    def __init__(self, loc: Any, *, scale: Any):
        self._set(loc=loc, scale=scale)
        self._require("scale", 0.0)

    def log_densities(self, value):
        z = (array(value) - self.loc) / self.scale
        return -ew("log", math.pi * self.scale) - ew("log1p", z**2)

    def sample(self, draws):
        return self.quantile(self._each(lambda i: draws.uniform()))

    def mean(self):
        return self._full(math.nan)

    def variance(self):
        return self._full(math.nan)

    def has_moment(self, power):
        return self._full(0.0)

    def _standard_cdf(self, z):
        # arctan2 keeps the lower tail, which 1/2 + arctan(z)/pi would lose to rounding
        return array(ew("arctan2", 1.0, -z)) / math.pi

    def _standard_quantile(self, p):
        tail = 1.0 / array(ew("tan", math.pi * ew("minimum", p, 1.0 - p)))
        return where(ew("lt", p, 0.5), -tail, tail)


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
    """HalfNormal(sd=): ``|X|`` for X ~ Normal(0, sd=sd).

    Parameters
    ----------
    sd : standard deviation of X, positive; the mean of ``|X|`` is 0.80 sd.
    """

    maximisers: ClassVar = {"sd": lambda law, value: value}

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

    def truncated_moments(self, lower, upper):
        return self.full.truncated_moments(lower, upper)

    def location_and_scale(self):
        return self._full(0.0), self.sd


class HalfCauchy(_Half):
    """HalfCauchy(scale=): ``|X|`` for X ~ Cauchy(0, scale=scale).

    Parameters
    ----------
    scale : the median of ``|X|``, positive.
    """

    maximisers: ClassVar = {"scale": lambda law, value: value}

    def __init__(self, *, scale: Any):
        self._set(scale=scale)
        self._require("scale", 0.0)
        self.full = Cauchy(np.zeros(self.shape), scale=self.scale)

    def mean(self):
        return self._full(INFINITY)

    def variance(self):
        return self._full(math.nan)

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

    def location_and_scale(self):
        return self._full(0.0), self.scale
