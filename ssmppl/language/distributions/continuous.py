"""Normal, SkewNormal, LogNormal, Uniform, the improper Flat, and VonMises, elementwise of arrays.

Densities, moments and quantiles as in Johnson, Kotz and Balakrishnan (1994, 1995),
"Continuous univariate distributions", volumes 1 and 2, in the parametrisations named in each class;
of VonMises as in Mardia and Jupp (2000), "Directional statistics", section 3.5.4, of SkewNormal as
in Azzalini (1985), "A class of distributions which includes the normal ones".
"""

from __future__ import annotations

import math
from typing import Any, ClassVar

import numpy as np

from ssmppl.errors import ModelError
from ssmppl.expressions.arrays import ExprArray, array
from ssmppl.expressions.arrays import elementwise as ew
from ssmppl.expressions.expr import apply
from ssmppl.expressions.properties import never_negative
from ssmppl.language.distributions.base import (
    INFINITY,
    LOG_2PI,
    Distribution,
    MeanLink,
    Support,
    VarianceLink,
    in_order,
    log_difference,
    one_of,
    where,
)
from ssmppl.language.distributions.draws import Draws
from ssmppl.language.distributions.truncated_moments import normal_moments


class Normal(Distribution):
    """Normal(mean, sd= | variance= | precision=).

    Parameters
    ----------
    mean : its mean.
    sd, variance, precision : its spread, exactly one of them: standard deviation, variance or
        1 / variance, positive.
    """

    gaussian_noise = True
    maximisers: ClassVar = {"mean_": lambda law, value: value}
    mean_link = MeanLink("mean_", "identity")

    def __init__(self, mean: Any, *, sd: Any = None, variance: Any = None, precision: Any = None):
        self.spread, value = one_of(
            "Normal", {"sd": sd, "variance": variance, "precision": precision}
        )
        self._set(**{"mean_": mean, self.spread: value})
        self._require(self.spread, 0.0)
        power = {"sd": 0.5, "variance": 1.0, "precision": -1.0}[self.spread]
        self.variance_link = VarianceLink(self.spread, power)

    def in_range(self) -> ExprArray | None:
        # the square root of a negative variance or precision is no number without being asked
        return super().in_range() if self.spread == "sd" else None

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

    def variance_in_range(self) -> ExprArray:
        """The variance; NaN where the standard deviation, whose square it is, is negative."""
        variance = array(self.variance())
        if self.spread != "sd":
            return variance
        sd = self.parameters["sd"]
        forms = zip(sd.ravel(), variance.ravel(), strict=True)
        own = [v if never_negative(s) else apply("where", apply("le", 0.0, s), v, math.nan)
               for s, v in forms]  # fmt: skip
        return array(array(own).reshape(variance.shape))

    def log_densities(self, value):
        s, d = self.parameters[self.spread], array(value) - self.mean_
        if self.spread == "precision":
            return 0.5 * ew("log", s) - 0.5 * s * d**2 - 0.5 * LOG_2PI
        if self.spread == "variance":
            return -0.5 * ew("log", s) - 0.5 * d**2 / s - 0.5 * LOG_2PI
        return -ew("log", s) - 0.5 * (d / s) ** 2 - 0.5 * LOG_2PI

    def sample(self, draws):
        sd = self.sd()
        return self.mean_ + self._each(lambda i: sd[i] * draws.normal())

    def standard(self, value: Any) -> ExprArray:
        """The standard normal draw behind a value."""
        return array((array(value) - self.mean_) / self.sd())

    def cdf(self, value):
        return array(ew("ndtr", self.standard(value)))

    def survival(self, value):
        return array(ew("ndtr", -self.standard(value)))

    def log_cdf(self, value):
        return array(ew("log_ndtr", self.standard(value)))

    def log_survival(self, value):
        return array(ew("log_ndtr", -self.standard(value)))

    def quantile(self, p):
        return self.mean_ + self.sd() * ew("ndtri", p)

    def survival_quantile(self, p):
        return self.mean_ - self.sd() * ew("ndtri", p)

    def _in_lower_tail(
        self, lower: ExprArray, upper: ExprArray
    ) -> tuple[ExprArray | bool, ExprArray, ExprArray]:
        """(flip, a, b): the interval, standardised, mirrored where it lies above the mean.

        An open side is -inf itself, not so by the mean and sd: these have no slope there.
        """
        a, b = self.standard(lower), self.standard(upper)
        whole_left, whole_right = self.open_sides(lower, upper)
        if whole_left:
            return False, self._full(-INFINITY), b
        if whole_right:
            return True, self._full(-INFINITY), -a
        flip = array(ew("lt", 0.0, a))
        return flip, where(flip, -b, a), where(flip, -a, b)

    def log_mass(self, lower, upper):
        _, low, high = self._in_lower_tail(array(lower), array(upper))
        return _log_ndtr_between(low, high)

    def quantile_between(self, p, q, lower, upper):
        flip, low, high = self._in_lower_tail(lower, upper)
        if isinstance(flip, bool):
            p, q = (q, p) if flip else (p, q)
        else:
            p, q = where(flip, q, p), where(flip, p, q)
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
        z = where(ew("lt", high, -30.0), far, z)
        if isinstance(flip, bool):
            z = -z if flip else z
        else:
            z = where(flip, -z, z)
        return self.mean_ + self.sd() * z

    def truncated_moments(self, lower, upper):
        return normal_moments(self, lower, upper)


def _log_ndtr_between(low: Any, high: Any) -> ExprArray:
    log_high = array(ew("log_ndtr", high))
    return log_high if _all_infinite(low) else log_difference(log_high, ew("log_ndtr", low))


def _all_infinite(a: Any) -> bool:
    return all(e.op == "const" and e.data == -INFINITY for e in array(a).ravel())


class SkewNormal(Distribution):
    """SkewNormal(loc, scale=, shape=): loc + scale Z, Z of density ``2 phi(z) Phi(shape z)``.

    Parameters
    ----------
    loc : where the mean would be with shape 0; that is loc + scale d sqrt(2 / pi), where
        d = shape / sqrt(1 + shape^2).
    scale : positive; the variance is scale^2 (1 - 2 d^2 / pi).
    shape : any number: positive for a long right tail, 0 for the normal distribution.
    """

    def __init__(self, loc: Any, *, scale: Any, shape: Any):
        self._set(loc=loc, scale=scale, shape_=shape)
        self._require("scale", 0.0)

    def log_densities(self, value):
        z = self._z(value)
        normal = math.log(2.0) - 0.5 * LOG_2PI - ew("log", self.scale) - 0.5 * z**2
        return normal + ew("log_ndtr", self.shape_ * z)

    def sample(self, draws):  # of two normals correlated by d the one, turned round where the
        d = self._share()  # other is negative (Azzalini's representation)
        own, other = self._each(lambda i: draws.normal()), self._each(lambda i: draws.normal())
        rest = array(ew("sqrt", 1.0 - d**2))
        return self.loc + self.scale * (d * array(ew("abs", other)) + rest * own)

    def mean(self):
        return self.loc + self.scale * self._share() * math.sqrt(2.0 / math.pi)

    def variance(self):
        return self.scale**2 * (1.0 - (2.0 / math.pi) * self._share() ** 2)

    def cdf(self, value):
        return ew("skewnormal_cdf", self.shape_, self._z(value))

    def survival(self, value):  # of -Z, which has the opposite shape
        return ew("skewnormal_cdf", -self.shape_, -self._z(value))

    def quantile(self, p):
        return self.loc + self.scale * ew("skewnormal_quantile", self.shape_, p)

    def survival_quantile(self, p):
        return self.loc - self.scale * ew("skewnormal_quantile", -self.shape_, p)

    def location_and_scale(self):
        return self.loc, self.scale

    def noise_free(self):
        return self.mean()

    def _z(self, value: Any) -> ExprArray:
        return array((array(value) - self.loc) / self.scale)

    def _share(self) -> ExprArray:
        """The correlation of the two normals of which Z is made."""
        return array(self.shape_ / ew("sqrt", 1.0 + self.shape_**2))


class LogNormal(Distribution):
    """LogNormal(mean, sd=): exp of a Normal variable.

    Parameters
    ----------
    mean, sd : mean and standard deviation of the *logarithm*; the median is exp(mean).
    """

    gaussian_noise = True
    maximisers: ClassVar = {"mean_": lambda law, value: ew("log", value)}
    mean_link = MeanLink("mean_", "mean of the log")
    variance_link = VarianceLink("sd", 0.5)

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

    def standard(self, value: Any) -> ExprArray:
        """The standard normal draw behind a value."""
        return self._log.standard(_log_of_positive(value))

    def mean(self):
        return array(ew("exp", self.mean_ + 0.5 * self.sd**2))

    def variance(self):
        return self.mean() ** 2 * ew("expm1", self.sd**2)

    def noise_free(self):
        return array(ew("exp", self.mean_))

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


class Uniform(Distribution):
    """Uniform(lower, upper).

    Parameters
    ----------
    lower, upper : the bounds, finite, lower < upper.
    """

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

    def in_range(self) -> ExprArray | None:
        return in_order("le", self.lower, self.upper)  # equal ones are a law at one point

    def log_densities(self, value):
        return array(np.broadcast_to(array(-ew("log", self.upper - self.lower)), self.shape))

    def sample(self, draws):
        return self.quantile(self._each(lambda i: draws.uniform()))

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

    def truncated_moments(self, lower, upper):
        return 0.5 * (lower + upper), (upper - lower) ** 2 / 12.0

    def location_and_scale(self):
        return self.lower, array(self.upper - self.lower)


class Flat(Distribution):
    """Flat(): an improper prior, constant on the whole line; for likelihoods only.

    Parameters
    ----------
    shape : of the variable; () is a number.
    """

    proper = False
    truncatable = False

    def __init__(self, shape: tuple[int, ...] = ()):
        self._set(zero=np.zeros(shape))

    def __repr__(self) -> str:
        shape = ", ".join(map(str, self.shape))
        text = shape if len(self.shape) == 1 else f"({shape})"
        return f"{type(self).__name__}({f'shape={text}' if self.shape else ''})"

    def rebuilt(self, parameters):
        return self

    def repeated(self, n):
        return self._at_place(type(self)((n, *self.shape)))

    def log_densities(self, value):
        return self._full(0.0)

    def sample(self, draws: Draws) -> ExprArray:
        raise ModelError(
            f"{type(self).__name__}() is improper and cannot be drawn from",
            fix="give this parameter a proper prior, or its value by parameters= or fixed=",
            where=self.location,
        )

    def mean(self):
        return self._full(math.nan)

    def variance(self):
        return self._full(math.nan)


class HalfFlat(Flat):
    """HalfFlat(): an improper prior, constant on the positive half line; for likelihoods only.

    Parameters
    ----------
    shape : of the variable; () is a number.
    """

    def support(self):
        return Support("interval", self._full(0.0), self._full(INFINITY))


class VonMises(Distribution):
    """VonMises(mean, concentration=): an angle, in radians, on (-pi, pi].

    Its density is ``exp(concentration * cos(x - mean)) / (2 pi I0(concentration))``: nearly
    Normal(mean, precision=concentration) where that is large, and without an edge where the
    circle is cut.

    Parameters
    ----------
    mean : the direction; any number of turns may be added to it.
    concentration : not negative; 0 is uniform on the circle.

    Notes
    -----
    `mean` and `variance`, as in the predictions of a filter, are the circular ones: the direction
    within (-pi, pi], and 1 - I1(concentration) / I0(concentration), which lies in (0, 1].
    A particle filter averages the directions of its particles as numbers: where they lie on both
    sides of the cut, the average says nothing, and the PIT values still do.
    """

    closed = True
    truncatable = False
    maximisers: ClassVar = {"mean_": lambda law, value: value}
    mean_link = MeanLink("mean_", "identity")
    variance_link = VarianceLink("concentration", -1.0)

    def __init__(self, mean: Any, *, concentration: Any):
        self._set(mean_=mean, concentration=concentration)
        self._require("concentration", 0.0, strict=False)

    def support(self):
        return Support("interval", self._full(-math.pi), self._full(math.pi))

    def _allowed(self) -> ExprArray:
        """The concentration; NaN below 0, where the formulas are those of the opposite mean."""
        k = self.concentration
        return k if all(map(never_negative, k.ravel())) else where(ew("le", 0.0, k), k, math.nan)

    def log_densities(self, value):
        k = self._allowed()
        away = array(ew("cos", array(value) - self.mean_)) - 1.0
        return k * away - LOG_2PI - ew("log", ew("i0e", k))

    def sample(self, draws):
        drawn = self.mean_ + self._each(lambda i: draws.vonmises(self.concentration[i]))
        return _within(drawn)

    def mean(self):
        return _within(self.mean_)

    def variance(self):
        k = self._allowed()
        return 1.0 - array(ew("i1e", k)) / ew("i0e", k)

    def noise_free(self):
        return self.mean_

    def _unrolled(self, value: Any) -> ExprArray:
        """The distribution function on the whole line, which grows by 1 with each turn."""
        away = array(value) - self.mean_
        return array(_turns(away) + ew("vonmises_cdf", self._allowed(), _within(away)))

    def _from_cut(self) -> ExprArray:
        """That function where the circle is cut."""
        return self._unrolled(self._full(-math.pi))

    def _clip(self, value: Any) -> ExprArray:
        return array(ew("minimum", math.pi, ew("maximum", -math.pi, value)))

    def cdf(self, value):
        return self._unrolled(self._clip(value)) - self._from_cut()

    def survival(self, value):
        return self._unrolled(self._full(math.pi)) - self._unrolled(self._clip(value))

    def quantile(self, p):
        total = array(p) + self._from_cut()
        turns = array(ew("floor", total))
        away = ew("vonmises_quantile", self._allowed(), total - turns)
        return self._clip(self.mean_ + 2.0 * math.pi * turns + away)


def _turns(angle: Any) -> ExprArray:
    """How many whole turns to take off for an angle within (-pi, pi]."""
    return array(ew("ceil", (array(angle) - math.pi) / (2.0 * math.pi)))


def _within(angle: Any) -> ExprArray:
    return array(array(angle) - 2.0 * math.pi * _turns(angle))
