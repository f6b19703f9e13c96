"""Exponential, Weibull, Pareto, Gamma, InverseGamma and Beta, elementwise of arrays.

Densities, moments and quantiles as in Johnson, Kotz and Balakrishnan (1994, 1995),
"Continuous univariate distributions", volumes 1 and 2, in the parametrisations named in each class.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar

import numpy as np

from ssmppl.expressions.arrays import ExprArray, array
from ssmppl.expressions.arrays import elementwise as ew
from ssmppl.expressions.expr import Expr, apply, constant
from ssmppl.expressions.properties import never_negative
from ssmppl.language.distributions.base import (
    INFINITY,
    Distribution,
    MeanLink,
    Support,
    one_of,
    where,
)
from ssmppl.language.distributions.draws import Draws
from ssmppl.language.distributions.symmetric import cut_exponential
from ssmppl.language.distributions.truncated_moments import exponential_moments, moments_from_zero

SMALL_SHAPE = 0.1  # below it, gamma draws may be too small for floating point
LEAST_SHARE = float(np.finfo(float).tiny)  # whose logarithm still has an exponential
BELOW_ONE = math.nextafter(1.0, 0.0)


class _Positive(Distribution):
    def support(self):
        return Support("interval", self._full(0.0), self._full(INFINITY))


class Exponential(_Positive):
    """Exponential(rate= | scale=); a bare argument is the rate.

    Parameters
    ----------
    rate : 1 / mean, positive.
    scale : the mean; one of the two is given.
    """

    closed = True
    maximisers: ClassVar = {
        "rate": lambda law, value: 1.0 / value,
        "scale": lambda law, value: value,
    }

    def __init__(self, rate: Any = None, *, scale: Any = None):
        self.spread, value = one_of("Exponential", {"rate": rate, "scale": scale})
        self._set(**{self.spread: value})
        self._require(self.spread, 0.0)
        self.mean_link = MeanLink(self.spread, "log", inverse=self.spread == "rate")

    def _rate(self) -> ExprArray:
        s = self.parameters[self.spread]
        return s if self.spread == "rate" else 1.0 / s

    def log_densities(self, value):
        return ew("log", self._rate()) - self._rate() * array(value)

    def sample(self, draws):
        return -self._each(lambda i: ew("log", draws.uniform())) / self._rate()

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
        whole_right = self.open_sides(array(lower), array(upper))[1]
        lower = array(ew("maximum", lower, 0.0))
        if whole_right:
            return array(-self._rate() * lower)
        width = array(upper) - lower
        return -self._rate() * lower + ew("log", -array(ew("expm1", -self._rate() * width)))

    def quantile_between(self, p, q, lower, upper):
        return lower + cut_exponential(p, q, self._rate() * (upper - lower)) / self._rate()

    def truncated_moments(self, lower, upper):
        return exponential_moments(self, lower, upper)

    def location_and_scale(self):
        return self._full(0.0), self.mean()


class Weibull(_Positive):
    """Weibull(shape, scale=): P(X > x) = ``exp(-(x / scale)^shape)``.

    Times until an event whose rate grows (shape > 1) or falls (shape < 1) with the time waited.

    Parameters
    ----------
    shape : positive; 1 is the exponential distribution.
    scale : positive; 63% lie below it.
    """

    maximisers: ClassVar = {"scale": lambda law, value: value}
    mean_link = MeanLink("scale", "log")

    def __init__(self, shape: Any, *, scale: Any):
        self._set(shape_=shape, scale=scale)
        self._require("shape_", 0.0)
        self._require("scale", 0.0)
        self._hazard = Exponential(rate=np.ones(self.shape))  # the law of (X / scale)^shape

    def _used(self, value: Any) -> ExprArray:
        """(x / scale)^shape, the hazard gone through; 0 and infinity are themselves, as a power of
        them has no derivative by the shape."""

        def used(v: Expr, i: tuple[int, ...]) -> Expr:
            if v.op == "const" and (v.data <= 0.0 or v.data == math.inf):
                return constant(max(v.data, 0.0))
            return apply("pow", apply("maximum", v, 0.0) / self.scale[i], self.shape_[i])

        given = array(value).view(np.ndarray)
        shape = np.broadcast_shapes(given.shape, self.shape)
        wide: Any = np.broadcast_to(given, shape)
        out = np.empty(shape, dtype=object)
        for i in np.ndindex(shape):
            out[i] = used(wide[i], i)
        return array(out)

    def _back(self, used: Any) -> ExprArray:
        return self.scale * ew("pow", used, 1.0 / self.shape_)

    def log_densities(self, value):
        k, log_z = self.shape_, array(ew("log", value)) - ew("log", self.scale)
        return ew("log", k) - ew("log", value) + k * log_z - ew("exp", k * log_z)

    def sample(self, draws):
        return self._back(self._hazard.sample(draws))

    def mean(self):
        return self.scale * ew("exp", ew("gammaln", 1.0 + 1.0 / self.shape_))

    def variance(self):
        first, second = (array(ew("gammaln", 1.0 + power / self.shape_)) for power in (1.0, 2.0))
        return self.mean() ** 2 * ew("expm1", second - 2.0 * first)

    def cdf(self, value):
        return self._hazard.cdf(self._used(value))

    def survival(self, value):
        return self._hazard.survival(self._used(value))

    def log_survival(self, value):
        return self._hazard.log_survival(self._used(value))

    def quantile(self, p):
        return self._back(self._hazard.quantile(p))

    def survival_quantile(self, p):
        return self._back(self._hazard.survival_quantile(p))

    def log_mass(self, lower, upper):
        return self._hazard.log_mass(self._used(lower), self._used(upper))

    def quantile_between(self, p, q, lower, upper):
        bounds = self._used(lower), self._used(upper)
        return self._back(self._hazard.quantile_between(p, q, *bounds))

    def location_and_scale(self):
        return self._full(0.0), self.scale


class Pareto(Distribution):
    """Pareto(shape, scale=): P(X > x) = ``(scale / x)^shape`` from scale on.

    Sizes of floods, claims, cities above a threshold: tails of a power law.

    Parameters
    ----------
    shape : positive, the exponent of the tail; with 1 or less there is no mean, with 2 or less no
        variance.
    scale : positive, the least value.
    """

    closed = True
    maximisers: ClassVar = {
        "shape_": lambda law, value: 1.0 / (ew("log", value) - ew("log", law.scale)),
    }

    def __init__(self, shape: Any, *, scale: Any):
        self._set(shape_=shape, scale=scale)
        self._require("shape_", 0.0)
        self._require("scale", 0.0)
        self._logs = Exponential(rate=self.shape_)  # the law of log(X / scale)

    def support(self):
        return Support("interval", self.scale, self._full(INFINITY))

    def _log(self, value: Any) -> ExprArray:
        """log(x / scale), 0 below the scale."""
        beyond = array(ew("maximum", array(value) - self.scale, 0.0))
        return array(ew("log1p", beyond / self.scale))

    def _back(self, logs: Any) -> ExprArray:
        return self.scale * ew("exp", logs)

    def log_densities(self, value):
        logs = array(ew("log", value))
        away = logs - ew("log", self.scale)
        return ew("log", self.shape_) - logs - self.shape_ * away

    def sample(self, draws):
        return self._back(self._logs.sample(draws))

    def mean(self):
        a = self.shape_
        return where(ew("lt", 1.0, a), a * self.scale / (a - 1.0), INFINITY)

    def variance(self):
        a = self.shape_
        finite = a * self.scale**2 / ((a - 1.0) ** 2 * (a - 2.0))
        return where(ew("lt", 2.0, a), finite, where(ew("lt", 1.0, a), INFINITY, math.nan))

    def has_moment(self, power):
        return array(ew("lt", float(power), self.shape_))

    def cdf(self, value):
        return self._logs.cdf(self._log(value))

    def survival(self, value):
        return self._logs.survival(self._log(value))

    def log_survival(self, value):
        return self._logs.log_survival(self._log(value))

    def quantile(self, p):
        return self._back(self._logs.quantile(p))

    def survival_quantile(self, p):
        return self._back(self._logs.survival_quantile(p))

    def log_mass(self, lower, upper):
        return self._logs.log_mass(self._log(lower), self._log(upper))

    def quantile_between(self, p, q, lower, upper):
        return self._back(self._logs.quantile_between(p, q, self._log(lower), self._log(upper)))

    def location_and_scale(self):
        return self._full(0.0), self.scale


class Gamma(_Positive):
    """Gamma(shape, rate= | scale=): mean shape / rate = shape scale.

    Parameters
    ----------
    shape : positive.
    rate, scale : exactly one of them, positive; scale = 1 / rate.
    """

    maximisers: ClassVar = {
        "rate": lambda law, value: law.shape_ / value,
        "scale": lambda law, value: value / law.shape_,
    }

    def __init__(self, shape: Any, *, rate: Any = None, scale: Any = None):
        self.spread, value = one_of("Gamma", {"rate": rate, "scale": scale})
        self._set(**{"shape_": shape, self.spread: value})
        self._require("shape_", 0.0)
        self._require(self.spread, 0.0)
        self.mean_link = MeanLink(self.spread, "log", inverse=self.spread == "rate")

    def _rate(self) -> ExprArray:
        s = self.parameters[self.spread]
        return s if self.spread == "rate" else 1.0 / s

    def log_densities(self, value):
        a, b, v = self.shape_, self._rate(), array(value)
        return a * ew("log", b) + (a - 1.0) * ew("log", v) - b * v - log_gamma(a)

    def sample(self, draws):
        return self._each(lambda i: draws.gamma(self.shape_[i])) / self._rate()

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

    def location_and_scale(self):
        return self._full(0.0), array(self.mean() / self.shape_)


class InverseGamma(_Positive):
    """InverseGamma(shape, scale=): 1 / X for X ~ Gamma(shape, rate=scale).

    The conjugate prior of a variance.

    Parameters
    ----------
    shape, scale : positive; the mean is scale / (shape - 1) for shape > 1.
    """

    maximisers: ClassVar = {"scale": lambda law, value: law.shape_ * value}

    def __init__(self, shape: Any, *, scale: Any):
        self._set(shape_=shape, scale=scale)
        self._require("shape_", 0.0)
        self._require("scale", 0.0)

    def log_densities(self, value):
        a, b, v = self.shape_, self.scale, array(value)
        return a * ew("log", b) - (a + 1.0) * ew("log", v) - b / v - log_gamma(a)

    def sample(self, draws):
        return self.scale / self._each(lambda i: draws.gamma(self.shape_[i]))

    def mean(self):
        a = self.shape_
        return where(ew("lt", 1.0, a), self.scale / (a - 1.0), INFINITY)

    def variance(self):
        a = self.shape_
        finite = self.scale**2 / ((a - 1.0) ** 2 * (a - 2.0))
        return where(ew("lt", 2.0, a), finite, where(ew("lt", 1.0, a), INFINITY, math.nan))

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

    def location_and_scale(self):
        return self._full(0.0), self.scale


def _lower_end(e: Expr) -> float:
    """A number as it is; 0, the least that a positive parameter can be, for an expression."""
    return e.data if e.op == "const" else 0.0


def log_gamma(a: ExprArray) -> ExprArray:
    """log of the gamma function, NaN below 0: it is finite there, where no distribution has a
    density."""
    if not all(map(never_negative, a.ravel())):
        a = where(ew("le", 0.0, a), a, math.nan)
    return array(ew("gammaln", a))


def needs_log_gamma(shapes: ExprArray) -> bool:
    """Whether ratios of gamma draws of these shapes may be 0 / 0."""
    return min(map(_lower_end, shapes.ravel())) < SMALL_SHAPE


def log_gamma_draw(draws: Draws, shape: Expr) -> Expr:
    """log of a gamma draw of that shape and unit rate: that of shape + 1, times U^(1/shape)."""
    return apply("log", draws.gamma(shape + 1.0)) + apply("log", draws.uniform()) / shape


def within_unit(share: Any) -> Any:
    """A drawn share that was rounded to 0 or 1, where there is no density, next to it."""
    return ew("minimum", BELOW_ONE, ew("maximum", LEAST_SHARE, share))


class Beta(Distribution):
    """Beta(a, b), on (0, 1): mean a / (a + b).

    Parameters
    ----------
    a, b : positive; the larger a + b, the narrower.
    """

    open_above = True

    def __init__(self, a: Any, b: Any):
        self._set(a=a, b=b)
        self._require("a", 0.0)
        self._require("b", 0.0)

    def support(self):
        return Support("interval", self._full(0.0), self._full(1.0))

    def log_densities(self, value):
        a, b, v = self.a, self.b, array(value)
        return (a - 1.0) * ew("log", v) + (b - 1.0) * ew("log1p", -v) - ew("betaln", a, b)

    def sample(self, draws):
        def draw(i):
            a, b = self.a[i], self.b[i]
            if needs_log_gamma(array([a, b])):
                log_odds = log_gamma_draw(draws, b) - log_gamma_draw(draws, a)  # of 1 - x
                return within_unit(1.0 / (1.0 + ew("exp", log_odds)))
            first, second = draws.gamma(a), draws.gamma(b)
            return within_unit(first / (first + second))

        return self._each(draw)

    def mean(self):
        return self.a / (self.a + self.b)

    def variance(self):
        n = self.a + self.b
        return self.a * self.b / (n**2 * (n + 1.0))

    def cdf(self, value):
        clipped = ew("minimum", 1.0, ew("maximum", 0.0, value))
        return array(ew("betainc", self.a, self.b, clipped))

    def survival(self, value):
        clipped = ew("minimum", 1.0, ew("maximum", 0.0, value))
        return array(ew("betaincc", self.a, self.b, clipped))

    def quantile(self, p):
        return array(ew("betaincinv", self.a, self.b, p))

    def survival_quantile(self, p):
        return array(ew("betainccinv", self.a, self.b, p))

    def weighted(self, power):
        moment = math.prod(
            ((self.a + k) / (self.a + self.b + k) for k in range(power)), start=array(1.0)
        )
        return moment, Beta(self.a + power, self.b)

    def truncated_moments(self, lower, upper):
        """From the nearer end, of which the interval may be a small part."""
        flip = array(ew("lt", 0.5, lower))
        a, b = where(flip, self.b, self.a), where(flip, self.a, self.b)
        ends = where(flip, 1.0 - upper, lower), where(flip, 1.0 - lower, upper)
        mean, variance = moments_from_zero(Beta(a, b), *ends)
        return where(flip, 1.0 - mean, mean), variance

    def rounded_inside(self, drawn):
        return array(within_unit(drawn))
