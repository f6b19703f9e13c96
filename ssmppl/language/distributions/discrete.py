"""Counts: Poisson, NegativeBinomial, Binomial, BetaBinomial and Bernoulli, and Skellam, the
difference of two, elementwise of arrays; Categorical; and Dirac, which is a point.

Johnson, Kemp and Kotz (2005), "Univariate discrete distributions". Values are whole numbers held
as floating point, as all values of a model are.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from ssmppl.errors import ModelError
from ssmppl.expressions.arrays import ExprArray, array
from ssmppl.expressions.arrays import elementwise as ew
from ssmppl.expressions.expr import constant
from ssmppl.language.distributions.base import INFINITY, Distribution, MeanLink, Support, where
from ssmppl.language.distributions.nested import check_sum, holding, sum_holds
from ssmppl.language.distributions.positive import Beta

TINY = 1e-12  # in place of a rate or probability of zero, where logs would not be finite


def log_of_count(count: Any, log_p: Any) -> ExprArray:
    """The log of p to the power of a count: 0 where the count is 0, whatever p is."""
    return where(ew("eq", count, 0.0), 0.0, array(count) * log_p)


def _xlogy(count: ExprArray, p: ExprArray, log: str = "log") -> ExprArray:
    return log_of_count(count, ew(log, p))


def whole(n: ExprArray) -> ExprArray | None:
    """Whether numbers of trials are whole ones, element by element; None where all are known."""
    if all(e.op == "const" for e in n.ravel()):
        return None
    return array(ew("eq", n, ew("floor", n)))


def require_whole(law: Distribution, name: str) -> None:
    """Refuse numbers of trials that are no whole ones."""
    for e in law.parameters[name].ravel():
        if e.op == "const" and not e.data.is_integer():
            raise ModelError(
                f"{type(law).__name__}: {name} = {e.data:g} is no whole number",
                fix="give a whole number of trials",
                where=law.location,
            )


def _events(lower: Any) -> tuple[Any, Any]:
    """How many events a count of at least `lower` has for sure, and the number of the last of them;
    1 where there is none, whose time is 0."""
    k = ew("maximum", lower, 0.0)
    return k, ew("maximum", k, 1.0)


class _Counts(Distribution):
    discrete = True

    def support(self):
        return Support("integers", self._full(0.0), self._full(INFINITY))

    def _floor(self, value: Any) -> ExprArray:
        return array(ew("floor", value))

    def _count(self, value: Any) -> ExprArray:
        """The whole number below, at least 0."""
        return array(ew("maximum", self._floor(value), 0.0))

    def _below_zero(self, value: Any, otherwise: Any) -> ExprArray:
        return where(ew("lt", value, 0.0), 0.0, otherwise)

    def _one_below_zero(self, value: Any, otherwise: Any) -> ExprArray:
        return where(ew("lt", value, 0.0), 1.0, otherwise)


class Poisson(_Counts):
    """Poisson(rate): counts 0, 1, 2, ...

    Parameters
    ----------
    rate : mean and variance, not negative.
    """

    maximisers: ClassVar = {"rate": lambda law, value: ew("maximum", value, TINY)}
    mean_link = MeanLink("rate", "log")

    def __init__(self, rate: Any):
        self._set(rate=rate)
        self._require("rate", 0.0, strict=False)

    def log_densities(self, value):
        v = array(value)
        return _xlogy(v, self.rate) - self.rate - ew("gammaln", v + 1.0)

    def sample(self, draws):
        return self._each(lambda i: draws.poisson(self.rate[i]))

    def mean(self):
        return self.rate

    def variance(self):
        return self.rate

    def cdf(self, value):
        return self._below_zero(value, ew("gammaincc", self._count(value) + 1.0, self.rate))

    def survival(self, value):
        return self._one_below_zero(value, ew("gammainc", self._count(value) + 1.0, self.rate))

    def quantile(self, p):
        return array(ew("poisson_quantile", self.rate, p))

    def survival_quantile(self, p):
        return array(ew("poisson_survival_quantile", self.rate, p))

    def sample_above(self, draws, lower):
        # X >= k where the k-th event of a unit Poisson process comes before `rate`: draw its
        # time, Gamma(k) cut off there, then the events of the time that is left.
        def draw(i):
            (k, nth), rate = _events(lower[i]), self.rate[i]
            time = ew("gammaincinv", nth, draws.uniform() * ew("gammainc", nth, rate))
            time = ew("where", ew("lt", k, 1.0), 0.0, time)
            return k + draws.poisson(ew("maximum", rate - time, 0.0))

        return self._each(draw)

    def weighted(self, power):
        return self.rate**power, self


class NegativeBinomial(_Counts):
    """NegativeBinomial(mean, dispersion=): counts of variance mean + mean^2 / dispersion.

    Parameters
    ----------
    mean : not negative.
    dispersion : positive; the larger, the nearer to Poisson(mean).
    """

    maximisers: ClassVar = {"mean_": lambda law, value: ew("maximum", value, TINY)}
    mean_link = MeanLink("mean_", "log")

    def __init__(self, mean: Any, *, dispersion: Any):
        self._set(mean_=mean, dispersion=dispersion)
        self._require("mean_", 0.0, strict=False)
        self._require("dispersion", 0.0)

    def log_densities(self, value):
        v, m, r = array(value), self.mean_, self.dispersion
        choose = array(ew("gammaln_rise", r, v)) - ew("gammaln", v + 1.0)
        return choose - r * ew("log1p", m / r) + _xlogy(v, m / (r + m))

    def sample(self, draws):
        def draw(i):
            r = self.dispersion[i]
            return draws.poisson(draws.gamma(r) * self.mean_[i] / r)

        return self._each(draw)

    def mean(self):
        return self.mean_

    def variance(self):
        return self.mean_ + self.mean_**2 / self.dispersion

    def cdf(self, value):
        k, r = self._count(value), self.dispersion
        # by the smaller share, of which 1 - share keeps its digits
        shares, few = r + self.mean_, ew("lt", self.mean_, r)
        by_mean = ew("betaincc", k + 1.0, r, self.mean_ / shares)
        by_rest = ew("betainc", r, k + 1.0, r / shares)
        return self._below_zero(value, where(few, by_mean, by_rest))

    def survival(self, value):
        k, r = self._count(value), self.dispersion
        return self._one_below_zero(value, ew("betainc", k + 1.0, r, self.mean_ / (r + self.mean_)))

    def quantile(self, p):
        return array(ew("negbinomial_quantile", self.dispersion, self.mean_, p))

    def survival_quantile(self, p):
        return array(ew("negbinomial_survival_quantile", self.dispersion, self.mean_, p))

    def sample_above(self, draws, lower):
        # As for Poisson, with the process run at a gamma distributed speed g for the time m / r:
        # time / (1 + time) of the k-th event ~ Beta(k, r), and g ~ Gamma(r + k, 1 + time) given it.
        def draw(i):
            (k, nth), r, m = _events(lower[i]), self.dispersion[i], self.mean_[i]
            below = draws.uniform() * ew("betainc", nth, r, m / (r + m))
            share = ew("where", ew("lt", k, 1.0), 0.0, ew("betaincinv", nth, r, below))
            left = m / r - share / (1.0 - share)
            speed = draws.gamma(r + k) * (1.0 - share)
            return k + draws.poisson(speed * ew("maximum", left, 0.0))

        return self._each(draw)

    def weighted(self, power):
        # X - k given the weight: shape r + k, the same odds m / r
        r, factor = self.dispersion, array(1.0)
        for k in range(power):
            factor = factor * (r + k) * (self.mean_ / r)
        return factor, NegativeBinomial(self.mean_ * (r + power) / r, dispersion=r + power)


class Skellam(_Counts):
    """Skellam(rate1, rate2): N1 - N2 of independent counts Poisson(rate1) and Poisson(rate2).

    Goals of two teams, up and down ticks of a price, arrivals less departures; the value may be any
    whole number. (Johnson, Kemp and Kotz 2005, section 4.12.3.)

    Parameters
    ----------
    rate1, rate2 : not negative; the mean is rate1 - rate2, the variance rate1 + rate2.
    """

    highest = 0.0

    def __init__(self, rate1: Any, rate2: Any):
        self._set(rate1=rate1, rate2=rate2)
        self._require("rate1", 0.0, strict=False)
        self._require("rate2", 0.0, strict=False)

    def support(self):
        return Support("integers", self._full(-INFINITY), self._full(INFINITY))

    def log_densities(self, value):
        return array(ew("skellam_log_mass", value, self.rate1, self.rate2))

    def sample(self, draws):
        def draw(i):
            return draws.poisson(self.rate1[i]) - draws.poisson(self.rate2[i])

        return self._each(draw)

    def mean(self):
        return self.rate1 - self.rate2

    def variance(self):
        return self.rate1 + self.rate2

    def cdf(self, value):
        return array(ew("skellam_cdf", value, self.rate1, self.rate2))

    def survival(self, value):  # of N2 - N1, which has the rates in turn
        return array(ew("skellam_cdf", -self._floor(value) - 1.0, self.rate2, self.rate1))

    def quantile(self, p):
        return array(ew("skellam_quantile", self.rate1, self.rate2, p))

    def survival_quantile(self, p):
        return -array(ew("skellam_quantile", self.rate2, self.rate1, p))

    def truncated_moments(self, lower, upper):
        # sums of k P(k) = a P(k - 1) - b P(k + 1), by what they lack at the bounds of those of P(k)
        a, b, log_mass = self.rate1, self.rate2, self.log_mass(lower, upper)

        def share(k: Any) -> ExprArray:
            return array(ew("exp", self.log_densities(array(k)) - log_mass))

        before, first = share(lower - 1.0), share(lower)
        last, after = share(upper), share(upper + 1.0)
        down, up = before - last, after - first
        by = a * down - b * up
        twice_down = down + share(lower - 2.0) - share(upper - 1.0)
        twice_up = up + share(upper + 2.0) - share(lower + 1.0)
        variance = a * (1.0 + down) + b * (1.0 + up) + a**2 * twice_down + b**2 * twice_up
        variance = variance - by * (2.0 * (a - b) + by)
        several = where(ew("eq", lower, upper), 0.0, 1.0)
        return a - b + by, several * ew("maximum", variance, 0.0)


class _OutOf(_Counts):
    """Successes out of n."""

    trials = "n"

    def _require_trials(self) -> None:
        self._require("n", 0.0, strict=False)
        require_whole(self, "n")

    def in_range(self):
        return holding([super().in_range(), whole(self.n)])

    def support(self):
        return Support("integers", self._full(0.0), self.n)

    def _log_choose(self, v: ExprArray) -> ExprArray:
        choose = ew("gammaln", self.n + 1.0) - array(ew("gammaln", v + 1.0))
        return array(choose - ew("gammaln", self.n - v + 1.0))


class Binomial(_OutOf):
    """Binomial(n, p): successes out of n.

    Parameters
    ----------
    n : number of trials, a whole number; it may depend on states.
    p : probability of each success.
    """

    maximisers: ClassVar = {
        "p": lambda law, value: ew("minimum", ew("maximum", array(value / law.n), TINY), 1.0 - TINY)
    }
    mean_link = MeanLink("p", "logit")

    def __init__(self, n: Any, p: Any):
        self._set(n=n, p=p)
        self._require_trials()
        self._require("p", 0.0, 1.0, strict=False)

    def log_densities(self, value):
        v, n = array(value), self.n
        return self._log_choose(v) + _xlogy(v, self.p) + _xlogy(n - v, -self.p, "log1p")

    def sample(self, draws):
        return self._each(lambda i: draws.binomial(self.n[i], self.p[i]))

    def mean(self):
        return self.n * self.p

    def variance(self):
        return self.n * self.p * (1.0 - self.p)

    def cdf(self, value):
        k = self._count(value)
        inside = ew("betainc", ew("maximum", self.n - k, 0.5), k + 1.0, 1.0 - self.p)
        return self._below_zero(value, where(ew("le", self.n, k), 1.0, inside))

    def survival(self, value):
        k = self._count(value)
        inside = ew("betainc", k + 1.0, ew("maximum", self.n - k, 0.5), self.p)
        return self._one_below_zero(value, where(ew("le", self.n, k), 0.0, inside))

    def quantile(self, p):
        return array(ew("binomial_quantile", self.n, self.p, p))

    def survival_quantile(self, p):  # of the failures n - X
        return self.n - ew("binomial_quantile", self.n, 1.0 - self.p, p)

    def sample_above(self, draws, lower):
        # X >= k where the k-th smallest of n uniforms, Beta(k, n - k + 1), is below p; the others
        # that are larger than it are uniform up to 1.
        def draw(i):
            (k, nth), n, p = _events(lower[i]), self.n[i], self.p[i]
            b = ew("maximum", n - k + 1.0, 1.0)
            kth = ew("betaincinv", nth, b, draws.uniform() * ew("betainc", nth, b, p))
            kth = ew("where", ew("lt", k, 1.0), 0.0, kth)
            chance = ew("maximum", p - kth, 0.0) / (1.0 - kth)
            return k + draws.binomial(ew("maximum", n - k, 0.0), chance)

        return self._each(draw)

    def weighted(self, power):
        factor = array(1.0)
        for k in range(power):
            factor = factor * ew("maximum", self.n - float(k), 0.0) * self.p
        return factor, Binomial(ew("maximum", self.n - float(power), 0.0), self.p)


class BetaBinomial(_OutOf):
    """BetaBinomial(n, a, b): successes out of n, whose probability is drawn from Beta(a, b).

    Proportions that scatter more than Binomial: with mean m and s trials' worth of knowledge write
    ``BetaBinomial(n, s * m, s * (1 - m))``; its variance is that of Binomial(n, m) times
    (s + n) / (s + 1).

    Parameters
    ----------
    n : number of trials, a whole number; it may depend on states.
    a, b : positive; the mean is n a / (a + b).
    """

    highest = 0.0

    def __init__(self, n: Any, a: Any, b: Any):
        self._set(n=n, a=a, b=b)
        self._require_trials()
        self._require("a", 0.0)
        self._require("b", 0.0)

    def log_densities(self, value):
        v, n, a, b = array(value), self.n, self.a, self.b
        successes, failures = array(ew("gammaln_rise", a, v)), ew("gammaln_rise", b, n - v)
        return self._log_choose(v) + successes + failures - ew("gammaln_rise", a + b, n)

    def sample(self, draws):
        p = Beta(self.a, self.b).sample(draws)
        return self._each(lambda i: draws.binomial(self.n[i], p[i]))

    def mean(self):
        return self.n * self.a / (self.a + self.b)

    def variance(self):
        n, s = self.n, self.a + self.b
        return n * self.a * self.b * (s + n) / (s**2 * (s + 1.0))

    def cdf(self, value):
        k = self._count(value)
        inside = ew("betabinomial_cdf", k, self.n, self.a, self.b)
        return self._below_zero(value, inside)

    def survival(self, value):  # the failures n - X are the same law with a and b in turn
        k = self._count(value)
        inside = ew("betabinomial_cdf", self.n - k - 1.0, self.n, self.b, self.a)
        return self._one_below_zero(value, inside)

    def quantile(self, p):
        return array(ew("betabinomial_quantile", self.n, self.a, self.b, p))

    def survival_quantile(self, p):
        return self.n - ew("betabinomial_quantile", self.n, self.b, self.a, p)

    def weighted(self, power):
        factor = array(1.0)
        for k in range(power):
            trials = ew("maximum", self.n - float(k), 0.0)
            factor = factor * trials * (self.a + k) / (self.a + self.b + k)
        left = ew("maximum", self.n - float(power), 0.0)
        return factor, BetaBinomial(left, self.a + power, self.b)


class Bernoulli(_Counts):
    """Bernoulli(p): 1 with probability p, else 0.

    Parameters
    ----------
    p : the probability.
    """

    highest = 0.0
    mean_link = MeanLink("p", "logit")

    def __init__(self, p: Any):
        self._set(p=p)
        self._require("p", 0.0, 1.0, strict=False)

    def support(self):
        return Support("integers", self._full(0.0), self._full(1.0))

    def log_densities(self, value):
        return where(ew("eq", value, 0.0), ew("log1p", -self.p), ew("log", self.p))

    def sample(self, draws):
        return self._each(lambda i: ew("lt", draws.uniform(), self.p[i]) * 1.0)

    def mean(self):
        return self.p

    def variance(self):
        return self.p * (1.0 - self.p)

    def cdf(self, value):
        below = where(ew("lt", value, 1.0), 1.0 - self.p, 1.0)
        return self._below_zero(value, below)

    def survival(self, value):
        above = where(ew("lt", value, 1.0), self.p, 0.0)
        return self._one_below_zero(value, above)

    def quantile(self, p):
        return where(ew("le", p, 1.0 - self.p), 0.0, 1.0)

    def weighted(self, power):
        return Binomial(self._full(1.0), self.p).weighted(power)


class Categorical(_Counts):
    """Categorical(p): 0, ..., K-1 with probabilities p.

    Parameters
    ----------
    p : probabilities, shape (K,), of sum 1; a row ``P[state]`` of a transition matrix (K, K) for a
        Markov chain.
    """

    highest = 0.0

    def __init__(self, p: Any):
        self.joint, self.shape = True, ()
        self._set(p=p)
        if self.p.ndim != 1 or len(self.p) < 2:
            raise ModelError(
                f"Categorical: p has shape {self.p.shape}",
                fix="give a vector of at least two probabilities; for a transition matrix, "
                "select its row: Categorical(P[state])",
                where=self.location,
            )
        self._require("p", 0.0, 1.0, strict=False)
        check_sum(self.p, "Categorical", "p sums", "divide p by its sum", self.location)

    def in_range(self) -> ExprArray | None:
        return holding([super().in_range(), sum_holds(self.p)])

    def shares(self):
        return "probabilities", list(self.p)

    def support(self):
        return Support("integers", self._full(0.0), self._full(len(self.p) - 1.0))

    def log_densities(self, value):
        v, total = array(value)[()], constant(0.0)
        for k, p in enumerate(self.p):
            total = total + ew("where", ew("eq", v, float(k)), ew("log", p), 0.0)
        return array(total)

    def sample(self, draws):
        u = draws.uniform()
        return self.quantile(array(u))

    def quantile(self, p):
        # the count of cumulative probabilities below p
        below, out, p = constant(0.0), constant(0.0), array(p)[()]
        for probability in self.p[:-1]:
            below = below + probability
            out = out + ew("lt", below, p) * 1.0
        return array(out)

    def cdf(self, value):
        v, total = array(value)[()], constant(0.0)
        for k, p in enumerate(self.p):
            total = total + ew("where", ew("le", float(k), v), p, 0.0)
        return array(total)

    def mean(self):
        return array(np.sum(self.p * np.arange(len(self.p))))

    def variance(self):
        k = np.arange(len(self.p))
        return array(np.sum(self.p * k**2)) - self.mean() ** 2


class Dirac(Distribution):
    """Dirac(value): a deterministic component.

    Parameters
    ----------
    value : what it is.
    """

    truncatable = False
    mean_link = MeanLink("value", "identity")

    def __init__(self, value: Any):
        self._set(value=value)

    def support(self):
        return Support("point", self.value, self.value)

    def log_densities(self, value):
        return where(ew("eq", value, self.value), 0.0, -INFINITY)

    def sample(self, draws):
        return self.value

    def mean(self):
        return self.value

    def variance(self):
        return self._full(0.0)

    def cdf(self, value):
        return where(ew("le", self.value, value), 1.0, 0.0)

    def quantile(self, p):
        return self.value
