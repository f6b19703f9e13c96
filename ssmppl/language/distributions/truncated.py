"""Truncated(dist, lower=, upper=): a distribution restricted to an interval; Censored, one of which
what lies beyond limits is read as the limit (Tobin 1958, "Estimation of relationships for limited
dependent variables", *Econometrica* 26).

The log density of what is truncated is that of the base less log P(lower <= X <= upper); draws
invert the base's distribution function on the part of (0, 1) that is left, from the tail that the
interval is in.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ssmppl.errors import ModelError
from ssmppl.expressions.arrays import ExprArray, array
from ssmppl.expressions.arrays import elementwise as ew
from ssmppl.expressions.evaluate import numbers
from ssmppl.expressions.expr import symbols_of, user_location
from ssmppl.language.distributions.base import Distribution, Support, in_order, is_infinite, where
from ssmppl.language.distributions.continuous import Flat
from ssmppl.language.distributions.discrete import Dirac
from ssmppl.language.distributions.from_density import UserDefined
from ssmppl.language.distributions.mixtures import Mixture, ZeroInflated
from ssmppl.language.distributions.nested import holding
from ssmppl.language.distributions.truncated_moments import weighted_moments

MOST_COUNTED = 64  # values of a truncated discrete law that are counted one by one
MOST_SUMMED = 256  # and that its moments are summed over, where they have no formula


class Truncated(Distribution):
    """Truncated(dist, lower=, upper=): dist given that it lies between the bounds, normalised.

    Parameters
    ----------
    dist : a distribution of numbers, continuous or discrete.
    lower, upper : the bounds, one of them or both; of discrete distributions they are included.
    """

    by_name = "bounds"
    base: Distribution

    def __init__(self, dist: Distribution, *, lower: Any = None, upper: Any = None):
        name, mixed = type(dist).__name__, isinstance(dist, Mixture)
        if not isinstance(dist, Distribution) or dist.joint or not dist.truncatable:
            raise ModelError(
                f"Truncated: cannot truncate {name}",
                fix="truncate each component, with weights in proportion to how much of it lies "
                "between the bounds"
                if mixed
                else "truncate a scalar distribution such as Normal, Gamma or Poisson",
                where=user_location(),
            )
        if isinstance(dist, UserDefined) and not dist.inverts():
            raise ModelError(
                f"Truncated: {dist.origin.name} has no distribution function, or no inverse of it",
                fix=f"declare both, @{dist.origin.name}.cdf and @{dist.origin.name}.quantile; or "
                "give the bounds to the distribution itself, with the density between them",
                where=user_location(),
            )
        if lower is None and upper is None:
            raise ModelError(
                "Truncated: neither lower nor upper was given",
                fix="give lower=, upper= or both",
                where=user_location(),
            )
        self._set(
            lower=-math.inf if lower is None else lower,
            upper=math.inf if upper is None else upper,
            **{f"like_{n}": a for n, a in dist.parameters.items()},
        )
        if isinstance(dist, Truncated):  # of the innermost, by the tighter bounds
            own = {f"like_{n}": self.parameters[f"like_like_{n}"] for n in dist.base.parameters}
            lower = _tighter("maximum", self.lower, self.like_lower)
            upper = _tighter("minimum", self.upper, self.like_upper)
            self.parameters = {"lower": lower, "upper": upper, **own}
            dist = dist.base
        if dist.shape != self.shape:  # bounds for each element of what is one law
            dist = dist.rebuilt({n: self.parameters[f"like_{n}"] for n in dist.parameters})
        if dist.discrete:
            self.parameters["lower"] = array(ew("ceil", self.lower))
            self.parameters["upper"] = array(ew("floor", self.upper))
        self.base, self.discrete = dist, dist.discrete
        whole = dist.open_sides(self.lower, self.upper)  # where nothing is cut off
        self.closed, self.open_above = dist.closed or not whole[0], dist.open_above and whole[1]
        for a, b in zip(self.lower.ravel(), self.upper.ravel(), strict=True):
            if a.op == b.op == "const" and not (
                a.data < b.data or (dist.discrete and a.data == b.data)
            ):
                raise ModelError(
                    f"Truncated: lower = {a.data:g} is not below upper = {b.data:g}",
                    fix="give lower < upper",
                    where=self.location,
                )
        self._refuse_empty()

    def rebuilt(self, parameters):
        values = {**self.parameters, **parameters}
        base = self.base.rebuilt({n: values[f"like_{n}"] for n in self.base.parameters})
        bounds = {n: _as_given(values[n], self.discrete) for n in ("lower", "upper")}
        return self._at_place(_between(base, bounds))

    def given_bounds(self) -> dict[str, ExprArray]:
        """Both as the user gave them, without the whole numbers taken of them."""
        return {n: _as_given(self.parameters[n], self.discrete) for n in ("lower", "upper")}

    def with_base(self, base: Distribution) -> Distribution:
        """Another distribution between the same bounds."""
        return self._at_place(_between(base, self.given_bounds()))

    def _refuse_empty(self) -> None:
        """Numbers that leave (nearly) nothing of the base."""
        mass = array(self.base.log_mass(*self._bounds()))
        known = [e for e in mass.ravel() if not symbols_of(e)]
        for value in numbers(known):
            if not math.isfinite(value):
                raise ModelError(
                    f"{self!r} leaves no probability, or too little to be computed",
                    fix="move the bounds to where the distribution lives",
                    where=self.location,
                )

    def __repr__(self) -> str:
        bounds = [
            f"{name}={self.parameters[name].ravel()[0]!r}"
            for name in ("lower", "upper")
            if not is_infinite(self.parameters[name])
        ]
        return f"Truncated({', '.join([repr(self.base), *bounds])})"

    def support(self):
        base = self.base.support()
        kind = "integers" if self.discrete else "interval"
        lower = _tighter("maximum", base.lower, self.lower)
        return Support(kind, lower, _tighter("minimum", base.upper, self.upper))

    def in_range(self) -> ExprArray | None:
        # quantiles between bounds in the wrong order are numbers, of no law
        ordered = in_order("le" if self.discrete else "lt", *self._bounds())
        return holding([self.base.in_range(), ordered])

    def _bounds(self) -> tuple[ExprArray, ExprArray]:
        s = self.support()
        return s.lower, s.upper

    def log_densities(self, value):
        return self.base.log_densities(array(value)) - self.base.log_mass(*self._bounds())

    def guarded_log_densities(self, value):
        """As of any distribution; NaN where so little of the base lies between the bounds that
        there is no number for it, whose logarithm would make the density infinite."""
        density, mass = super().guarded_log_densities(value), self.base.log_mass(*self._bounds())
        if not any(symbols_of(e) for e in array(mass).ravel()):
            return density  # looked at when the law was made
        return where(ew("lt", -math.inf, mass), density, math.nan)

    def _clip(self, value: Any) -> ExprArray:
        lower, upper = self._bounds()
        return array(ew("minimum", upper, ew("maximum", lower, value)))

    def log_mass(self, lower, upper):
        inside = self.base.log_mass(self._clip(lower), self._clip(upper))
        return inside - self.base.log_mass(*self._bounds())

    def _share(self, lower: ExprArray, upper: ExprArray) -> ExprArray:
        part = self.base.log_mass(lower, upper) - self.base.log_mass(*self._bounds())
        return array(ew("minimum", 1.0, ew("exp", part)))

    def cdf(self, value):
        lower, upper = self._bounds()
        value = array(ew("floor", value)) if self.discrete else array(value)
        inside = self._share(lower, array(ew("minimum", upper, value)))
        below = ew("lt" if self.discrete else "le", value, lower)
        return where(below, 0.0, where(ew("le", upper, value), 1.0, inside))

    def survival(self, value):
        lower, upper = self._bounds()
        value = array(ew("floor", value)) if self.discrete else array(value)
        start = value + 1.0 if self.discrete else value
        inside = self._share(array(ew("maximum", lower, start)), upper)
        below = ew("lt" if self.discrete else "le", value, lower)
        return where(below, 1.0, where(ew("le", upper, value), 0.0, inside))

    def _quantile(self, p: ExprArray, q: ExprArray) -> ExprArray:
        width = self._width()
        if width is not None:
            return self._counted(width, p)
        return self._clip(self.base.quantile_between(p, q, *self._bounds()))

    def quantile(self, p):
        return self._quantile(array(p), 1.0 - array(p))

    def _counted(self, width: int, p: ExprArray) -> ExprArray:
        """lower + how many of the values before the last have a distribution function below p.

        From the probabilities themselves, which no tail is too far for.
        """
        lower, _ = self._bounds()
        log_p = [array(self.base.log_densities(lower + float(k))) for k in range(width + 1)]
        top = log_p[0]
        for other in log_p[1:]:
            top = array(ew("maximum", top, other))
        parts = [array(ew("exp", one - top)) for one in log_p]
        total = parts[0]
        for part in parts[1:]:
            total = total + part
        below, out = self._full(0.0), lower
        for part in parts[:-1]:
            below = below + part
            out = out + where(ew("lt", below, p * total), 1.0, 0.0)
        return array(out)

    def _width(self, most: int = MOST_COUNTED) -> int | None:
        """upper - lower for a discrete distribution between a few numbers, else None."""
        bounds = [a.ravel() for a in self._bounds()]
        if not self.discrete or any(e.op != "const" for a in bounds for e in a):
            return None
        widths = {b.data - a.data for a, b in zip(*bounds, strict=True)}
        width = widths.pop()
        return int(width) if not widths and width <= most else None

    def survival_quantile(self, p):
        return self._quantile(1.0 - array(p), array(p))

    def sample(self, draws):
        lower, upper = self._bounds()
        if self.discrete and self.base.open_sides(lower, upper) == (False, True):
            above = self.base.sample_above(draws, lower)
            if above is not None:
                return above
        drawn = self.quantile(self._each(lambda i: draws.uniform()))
        return self.base.rounded_inside(drawn)

    # -- moments
    def mean(self):
        return self._moments()[0]

    def variance(self):
        return self._moments()[1]

    def _moments(self) -> tuple[ExprArray, ExprArray]:
        """Mean and variance: in closed form, else by quadrature; infinite where they diverge."""
        lower, upper = self._bounds()
        if all(self.base.open_sides(lower, upper)):
            return self.base.mean(), self.base.variance()
        own = self.base.truncated_moments(lower, upper)
        if own is not None:
            return own
        if self.base.weighted(1) is not None:
            return weighted_moments(self.base, lower, upper)
        if isinstance(self.base, ZeroInflated):
            return self._inflated_moments(self.base, lower, upper)
        if self.discrete:
            return self._summed_moments()
        mean, variance = self._quadrature()
        infinite = [is_infinite(b) for b in (lower, upper)]
        if any(infinite):
            limit = math.inf if infinite[1] else -math.inf
            finite = self.base.has_moment(1)
            divergent = where(finite, math.inf, math.nan)
            mean = where(finite, mean, limit)
            variance = where(self.base.has_moment(2), variance, divergent)
        return mean, variance

    def _inflated_moments(
        self, base: ZeroInflated, lower: ExprArray, upper: ExprArray
    ) -> tuple[ExprArray, ExprArray]:
        """From those of the distribution that zeros were added to, cut likewise."""
        inner = Truncated(base.base, lower=lower, upper=upper)
        mass = base.base.log_mass(*inner._bounds()) - base.log_mass(lower, upper)
        share, mean = (1.0 - base.p) * ew("exp", mass), inner.mean()
        return share * mean, share * (inner.variance() + (1.0 - share) * mean**2)

    def _summed_moments(self) -> tuple[ExprArray, ExprArray]:
        """Sums over the values of a discrete distribution between a few numbers; else NaN."""
        width = self._width(MOST_SUMMED)
        if width is None:
            return self._full(math.nan), self._full(math.nan)
        values = [self._bounds()[0] + float(k) for k in range(width + 1)]
        shares = [array(ew("exp", self.log_densities(k))) for k in values]
        mean = array(sum(p * k for p, k in zip(shares, values, strict=True)))
        parts = (p * (k - mean) ** 2 for p, k in zip(shares, values, strict=True))
        return mean, array(sum(parts))

    def _quadrature(self) -> tuple[ExprArray, ExprArray]:
        """Moments as integrals of the quantile function over (0, 1).

        The double exponential rule of Takahasi and Mori (1974), *Publ. RIMS* 9, which takes the
        singularities at the ends; in two parts where the density has a kink.
        """
        parts = [(0.0, 1.0, 0.0)]  # where it begins, its width, and what is left above it
        centre = self.quantile(self._full(0.5))
        kink = self.base.kink()
        if kink is not None:
            at_kink = self.cdf(kink)
            parts = [(0.0, at_kink, 1.0 - at_kink), (at_kink, 1.0 - at_kink, 0.0)]
        first = second = self._full(0.0)
        for start, width, rest in parts:
            for p, q, weight in _double_exponential():
                low = start + width * p
                high = rest + width * q
                d = self._node(self._full(0.0) + low, self._full(0.0) + high) - centre
                first, second = first + weight * width * d, second + weight * width * d**2
        return centre + first, second - first**2

    def _node(self, p: ExprArray, q: ExprArray) -> ExprArray:
        """The quantile at p, q = 1 - p, by the tail of the base that it lies in.

        Unlike draws, nodes go on to where only one of p and q has digits, and to bounds that are
        far in the tails.
        """
        base, (lower, upper), kink = self.base, self._bounds(), self.base.kink()
        own = type(base).quantile_between is not Distribution.quantile_between
        if own and kink is None:
            return self._quantile(p, q)  # by logarithms of its tails
        open_below, open_above = base.open_sides(lower, upper)
        left = q * (0.0 if open_below else base.cdf(lower))
        left = left + p * (1.0 if open_above else base.cdf(upper))
        right = q * (1.0 if open_below else base.survival(lower))
        right = right + p * (0.0 if open_above else base.survival(upper))
        value = where(ew("lt", left, 0.5), base.quantile(left), base.survival_quantile(right))
        if kink is not None:  # by logarithms on one side of the kink only
            beside = ew("or", ew("le", kink, lower), ew("le", upper, kink))
            value = where(beside, self._quantile(p, q), value)
        return self._clip(value)


class Censored(Distribution):
    """Censored(dist, lower=, upper=): what is read of dist by an instrument with limits.

    Values below `lower` are read as `lower`, with probability P(X <= lower), those above `upper` as
    `upper`; between them the density is that of dist. For concentrations below a detection limit, a
    sensor that saturates, a stock that is sold out. Where nothing is read at all beyond the limits,
    `Truncated` is meant. For observations only.

    Parameters
    ----------
    dist : a distribution of numbers, continuous or of whole numbers.
    lower, upper : the limits, one of them or both: numbers, or inputs where they change from row to
        row. In the data a value beyond a limit is the limit itself.

    Raises
    ------
    ModelError : dist has no distribution function, no limit is given, lower is not below upper, or
        a limit of whole numbers is none.
    """

    by_name = "limits"
    truncatable = False
    guards_range = True
    closed = True
    base: Distribution

    def __init__(self, dist: Distribution, *, lower: Any = None, upper: Any = None):
        known = isinstance(dist, Distribution)
        if not known or dist.joint or dist.atoms or isinstance(dist, (Dirac, Flat)):
            raise ModelError(
                f"Censored: {type(dist).__name__ if known else repr(dist)} has no distribution "
                "function",
                fix="give a distribution of numbers, as ssm.Censored(ssm.Normal(x, sd=1), lower=0)",
                where=user_location(),
            )
        if isinstance(dist, UserDefined) and not dist.has_cdf:
            raise ModelError(
                f"Censored: {dist.origin.name} has no distribution function",
                fix=f"declare it: @{dist.origin.name}.cdf",
                where=user_location(),
            )
        if lower is None and upper is None:
            raise ModelError(
                "Censored: neither lower nor upper was given",
                fix="give lower=, upper= or both",
                where=user_location(),
            )
        self._set(
            lower=-math.inf if lower is None else lower,
            upper=math.inf if upper is None else upper,
            **{f"like_{n}": a for n, a in dist.parameters.items()},
        )
        if dist.shape != self.shape:  # limits for each element of what is one law
            dist = dist.rebuilt({n: self.parameters[f"like_{n}"] for n in dist.parameters})
        self.base, self.discrete, self.atoms = dist, dist.discrete, not dist.discrete
        self.drawable = dist.drawable
        for a, b in zip(self.lower.ravel(), self.upper.ravel(), strict=True):
            if a.op == b.op == "const" and not a.data < b.data:
                raise ModelError(
                    f"Censored: lower = {a.data:g} is not below upper = {b.data:g}",
                    fix="give lower < upper",
                    where=self.location,
                )
        for name in ("lower", "upper") if self.discrete else ():
            for e in self.parameters[name].ravel():
                if e.op == "const" and math.isfinite(e.data) and e.data != math.floor(e.data):
                    raise ModelError(
                        f"Censored: {name} = {e.data:g} is no whole number, as {dist!r} is one of "
                        "such",
                        fix="give the limit that is read",
                        where=self.location,
                    )

    def __repr__(self) -> str:
        bounds = [
            f"{name}={self.parameters[name].ravel()[0]!r}"
            for name in ("lower", "upper")
            if not is_infinite(self.parameters[name])
        ]
        return f"Censored({', '.join([repr(self.base), *bounds])})"

    def given_bounds(self) -> dict[str, ExprArray]:
        """Both limits."""
        return {n: self.parameters[n] for n in ("lower", "upper")}

    def rebuilt(self, parameters):
        values = {**self.parameters, **parameters}
        base = self.base.rebuilt({n: values[f"like_{n}"] for n in self.base.parameters})
        bounds = {n: array(values[n]) for n in ("lower", "upper")}
        given = {n: b for n, b in bounds.items() if not is_infinite(b)}
        return self._at_place(Censored(base, **(given or bounds)))

    def support(self):
        own = self.base.support()
        kind = "integers" if self.discrete else "interval"
        lower = _tighter("maximum", own.lower, self.lower)
        return Support(kind, lower, _tighter("minimum", own.upper, self.upper))

    def in_range(self) -> ExprArray | None:
        return holding([self.base.in_range(), in_order("lt", self.lower, self.upper)])

    def log_densities(self, value):
        v = array(value)
        out = array(self.base.log_densities(v))
        if not is_infinite(self.lower):
            out = where(ew("le", v, self.lower), self.base.log_cdf(self.lower), out)
        if not is_infinite(self.upper):
            above = self.upper - 1.0 if self.discrete else self.upper
            out = where(ew("le", self.upper, v), self.base.log_survival(array(above)), out)
        return out

    def _read(self, value: Any) -> ExprArray:
        return array(ew("minimum", self.upper, ew("maximum", self.lower, value)))

    def sample(self, draws):
        return self._read(self.base.sample(draws))

    def cdf(self, value):
        inside = where(ew("lt", value, self.lower), 0.0, self.base.cdf(array(value)))
        return where(ew("le", self.upper, value), 1.0, inside)

    def cdf_below(self, value):
        inside = where(ew("le", value, self.lower), 0.0, self.base.cdf_below(array(value)))
        return where(ew("lt", self.upper, value), 1.0, inside)

    def quantile(self, p):
        return self._read(self.base.quantile(p))

    def noise_free(self):
        return self._read(self.base.noise_free())

    def mean(self):
        return self._moments()[0]

    def variance(self):
        return self._moments()[1]

    def _moments(self) -> tuple[ExprArray, ExprArray]:
        """Of what is between the limits, and the limits with their probabilities."""
        inner = self.base
        if not all(inner.open_sides(self.lower, self.upper)):
            own = {n: b for n, b in self.given_bounds().items() if not is_infinite(b)}
            inner = Truncated(inner, **own)
        inside = array(ew("exp", self.base.log_mass(self.lower, self.upper)))
        mean, variance = inner.mean(), inner.variance()
        shares, first = [(inside, mean)], inside * mean
        limits = (
            (self.lower, array(self.base.cdf_below(self.lower))),
            (self.upper, self.base.survival(self.upper)),
        )
        for limit, share in limits:
            if not is_infinite(limit):
                shares.append((share, limit))
                first = first + share * limit
        second = inside * variance
        for share, value in shares:
            second = second + share * (value - first) ** 2
        return array(first), array(second)


def _double_exponential(step: float = 0.0625, end: float = 6.0) -> list[tuple[float, float, float]]:
    """Nodes p, 1 - p and weights on (0, 1): p = 1 / (1 + exp(-pi sinh t))."""
    out = []
    for t in np.arange(-end, end + 0.5 * step, step):
        s = math.pi * math.sinh(t)
        p, q = (1.0 / (1.0 + math.exp(-s)), 1.0 / (1.0 + math.exp(s)))
        out.append((p, q, step * math.pi * math.cosh(t) * p * q))
    return out


def _between(base: Distribution, bounds: dict[str, ExprArray]) -> Truncated:
    """With these bounds but for infinite ones; one distribution of several may have no others,
    which it is given as they are."""
    return Truncated(base, **({n: b for n, b in bounds.items() if not is_infinite(b)} or bounds))


def _as_given(bound: Any, discrete: bool) -> ExprArray:
    """Without the whole number that was taken of it where the distribution is discrete."""
    given = [
        e.args[0] if discrete and e.op in ("ceil", "floor") else e for e in array(bound).ravel()
    ]
    return array(array(given).reshape(array(bound).shape))


def _tighter(op: str, a: ExprArray, b: ExprArray) -> ExprArray:
    """Elementwise bound; infinite constants drop out."""
    neutral = -math.inf if op == "maximum" else math.inf
    out = np.empty(a.shape, dtype=object)
    for i in np.ndindex(a.shape):
        plain = [e for e in (a[i], b[i]) if not (e.op == "const" and e.data == neutral)]
        out[i] = ew(op, *plain) if len(plain) == 2 else (plain or [a[i]])[0]
    return array(out)
