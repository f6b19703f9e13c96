"""Every distribution of the language at several settings, beside SciPy's of the same law.

`CASES` holds those of scalars, `JOINT_CASES` those of vectors and matrices, `TRUNCATED_CASES`
truncations. A case keeps class and parameters apart, so that a test may put symbols in place of
the numbers (`Case.with_symbols`), as the compiled samplers and densities need it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy.stats as st
from scipy import special

import ssmppl.language.distributions as D
from ssmppl.expressions.arrays import ExprArray, array
from ssmppl.expressions.expr import Expr, symbol


@dataclass(frozen=True)
class Case:
    """One distribution at one setting; `reference` is SciPy's frozen law of the same name."""

    cls: type[D.Distribution]
    parameters: dict[str, Any]
    reference: Any
    whole: frozenset[str] = field(default=frozenset())

    @property
    def id(self) -> str:
        text = ",".join(f"{k}={v:g}" if np.isscalar(v) else k for k, v in self.parameters.items())
        return f"{self.cls.__name__}({text})"

    def build(self) -> D.Distribution:
        """The distribution, its parameters as numbers."""
        return self.cls(**self.parameters)

    def with_symbols(self) -> tuple[D.Distribution, dict[Expr, float]]:
        """The distribution with a symbol for each number, and their values."""
        values: dict[Expr, float] = {}
        symbolic = {}
        for name, value in self.parameters.items():
            plain = np.asarray(value, dtype=float)
            out = np.empty(plain.shape, dtype=object)
            for index in np.ndindex(plain.shape):
                if plain.ndim == 2 and index[1] > index[0] and name == "cholesky":
                    out[index] = 0.0
                    continue
                low = index if plain.ndim < 2 else tuple(sorted(index, reverse=True))
                out[index] = symbol("parameter", name, low)
                values[out[index]] = float(plain[index])
            symbolic[name] = array(out) if plain.ndim else out[()]
        return self.cls(**symbolic), values

    def points(self) -> np.ndarray:
        """Values in the support, from the far lower to the far upper tail."""
        p = np.array([1e-100, 1e-30, 1e-12, 1e-6, 1e-3, 0.05, 0.3, 0.5])
        with np.errstate(all="ignore"):
            x = np.concatenate([self.reference.ppf(p), self.reference.isf(p)])
        low, high = self.reference.support()
        x = x[np.isfinite(x)]
        if not self.cls.discrete:
            x = x[(x > low) & (x < high) & (np.abs(x) < 1e150)]
            x = x[(x == 0) | (np.abs(x) > 1e-150)]
        return np.unique(x)


def _normal(mean, sd):
    return st.norm(mean, sd)


def _gamma(shape, rate):
    return st.gamma(shape, scale=1.0 / rate)


def _negative_binomial(mean, r):
    return st.nbinom(r, r / (r + mean))


def _categorical(p):
    return st.rv_discrete(values=(np.arange(len(p)), p))


def _weibull(shape, scale):
    return st.weibull_min(shape, scale=scale)


def _pareto(shape, scale):
    """SciPy's pareto loses its lower tail; lomax, the excess over the scale, does not."""
    return st.lomax(shape, loc=scale, scale=scale)


class Counted:
    """A law of whole numbers by its masses at first, first + 1, ..., both tails summed from their
    own ends."""

    def __init__(self, log_masses, first=0):
        self.first = first
        self.log_masses = np.asarray(log_masses, dtype=float)
        masses = np.exp(self.log_masses)
        self._below = np.concatenate([[0.0], np.minimum(np.cumsum(masses), 1.0)])
        self._below[-1] = 1.0
        self._above = np.concatenate([np.cumsum(masses[::-1])[::-1], [0.0]])
        k = first + np.arange(len(masses))
        self._mean = float(k @ masses)
        self._var = float((k - self._mean) ** 2 @ masses)

    def support(self):
        return float(self.first), float(self.first + len(self.log_masses) - 1)

    def _at(self, x):
        return np.clip(np.floor(x) - self.first, -1, len(self.log_masses) - 1).astype(int)

    def logpmf(self, x):
        i = x - self.first
        inside = (i >= 0) & (i < len(self.log_masses)) & (i == np.floor(i))
        return np.where(inside, self.log_masses[np.maximum(self._at(x), 0)], -np.inf)

    def pmf(self, x):
        return np.exp(self.logpmf(np.asarray(x)))

    def cdf(self, x):
        return self._below[self._at(x) + 1]

    def sf(self, x):
        return self._above[self._at(x) + 1]

    def ppf(self, p):
        below = np.searchsorted(self._below[1:], p)
        return self.first + np.minimum(below, len(self.log_masses) - 1) * 1.0

    def isf(self, p):
        below = np.searchsorted(-self._above[1:], -np.asarray(p))
        return self.first + np.minimum(below, len(self.log_masses) - 1) * 1.0

    def logcdf(self, x):
        return np.log(self.cdf(x))

    def logsf(self, x):
        return np.log(self.sf(x))

    def mean(self):
        return self._mean

    def var(self):
        return self._var

    def std(self):
        return math.sqrt(self._var)


class Difference(Counted):
    """Of two Poisson counts: the sum over the second, from far in one tail to far in the other."""

    def __init__(self, rate1, rate2):
        away = int(45.0 * math.sqrt(rate1 + rate2)) + 450
        k = int(rate1 - rate2) + np.arange(-away, away + 1)[:, None]
        second = np.arange(int(rate1 + rate2) + 2 * away)
        logs = st.poisson.logpmf(second + k, rate1) + st.poisson.logpmf(second, rate2)
        super().__init__(special.logsumexp(logs, axis=1), int(k[0, 0]))

    def support(self):
        return -math.inf, math.inf


def _beta_binomial(n, a, b):
    return Counted(st.betabinom(int(n), a, b).logpmf(np.arange(n + 1)))


class Skewed:
    """SciPy's skew normal, its tails by quadrature of its density, as SciPy's own lose them."""

    def __init__(self, shape, loc, scale):
        self.law = st.skewnorm(shape, loc, scale)
        self.support, self.logpdf = self.law.support, self.law.logpdf
        self.mean, self.var = self.law.mean, self.law.var
        nodes, weights = np.polynomial.legendre.leggauss(40)
        ends = scale * np.concatenate([[0.0], 2.0 ** np.arange(-24, 7)])
        half = 0.5 * np.diff(ends)[:, None]
        self._away = (ends[:-1, None] + half * (1.0 + nodes)).ravel()
        self._weights = (half * weights).ravel()
        self._low, self._high = loc - 45.0 * scale, loc + 45.0 * scale

    def cdf(self, x):
        return self._tail(x, -1.0)

    def sf(self, x):
        return self._tail(x, 1.0)

    def ppf(self, p):
        return self._root(lambda x: self.cdf(x) < p, p)

    def isf(self, p):
        return self._root(lambda x: self.sf(x) > p, p)

    def _tail(self, x, sign):
        above = sign * (np.asarray(x, dtype=float) - self.law.median()) > 0  # on the tail's side
        at = np.asarray(x, dtype=float)[..., None] + np.where(above, sign, -sign)[..., None] * (
            self._away
        )
        tail = np.exp(self.law.logpdf(at)) @ self._weights
        return np.where(above, tail, 1.0 - tail)

    def _root(self, left, p):
        low, high = np.full(np.shape(p), self._low), np.full(np.shape(p), self._high)
        for _ in range(80):
            middle = 0.5 * (low + high)
            below = left(middle)
            low, high = np.where(below, middle, low), np.where(below, high, middle)
        return 0.5 * (low + high)


class Circle:
    """Von Mises by quadrature round its mean; its moments are the circular ones."""

    def __init__(self, mean, concentration):
        self.m, self.k = mean, concentration
        self._norm = math.log(2 * math.pi * special.i0e(concentration))
        nodes, weights = np.polynomial.legendre.leggauss(100)
        self._nodes, self._weights = 0.5 * (nodes + 1.0), 0.5 * weights

    def support(self):
        return -math.pi, math.pi

    def logpdf(self, x):
        return self.k * (np.cos(x - self.m) - 1.0) - self._norm

    def _between(self, a, b):
        t = a + (b - a) * self._nodes
        return (b - a) * self._weights @ np.exp(self.logpdf(t))

    def cdf(self, x):
        x = np.clip(x, -np.pi, np.pi)
        return np.vectorize(lambda v: self._between(-np.pi, v), otypes=[float])(x)

    def sf(self, x):
        x = np.clip(x, -np.pi, np.pi)
        return np.vectorize(lambda v: self._between(v, np.pi), otypes=[float])(x)

    def ppf(self, p):
        return self._root(lambda x: self.cdf(x) < p, p)

    def isf(self, p):
        return self._root(lambda x: self.sf(x) > p, p)

    def _root(self, left, p):
        low, high = np.full(np.shape(p), -np.pi), np.full(np.shape(p), np.pi)
        for _ in range(60):
            middle = 0.5 * (low + high)
            below = left(middle)
            low, high = np.where(below, middle, low), np.where(below, high, middle)
        return high

    def mean(self):
        return self.m

    def var(self):
        return 1.0 - special.i1e(self.k) / special.i0e(self.k)


CASES = [
    Case(D.Normal, {"mean": 0.0, "sd": 1.0}, _normal(0, 1)),
    Case(D.Normal, {"mean": -3.5, "variance": 1e-8}, _normal(-3.5, 1e-4)),
    Case(D.Normal, {"mean": 1e3, "precision": 0.04}, _normal(1e3, 5)),
    Case(D.Normal, {"mean": 2.0, "sd": 1e6}, _normal(2, 1e6)),
    Case(D.LogNormal, {"mean": 0.0, "sd": 1.0}, st.lognorm(1.0)),
    Case(D.LogNormal, {"mean": -2.0, "sd": 0.01}, st.lognorm(0.01, scale=math.exp(-2.0))),
    Case(D.LogNormal, {"mean": 5.0, "sd": 3.0}, st.lognorm(3.0, scale=math.exp(5.0))),
    Case(D.StudentT, {"df": 4.0, "loc": 0.0, "scale": 1.0}, st.t(4)),
    Case(D.StudentT, {"df": 1.5, "loc": 3.0, "scale": 0.2}, st.t(1.5, 3.0, 0.2)),
    Case(D.StudentT, {"df": 0.7, "loc": -1.0, "scale": 10.0}, st.t(0.7, -1.0, 10.0)),
    Case(D.StudentT, {"df": 60.0, "loc": 0.0, "scale": 2.0}, st.t(60, 0.0, 2.0)),
    Case(D.Laplace, {"loc": 0.0, "scale": 1.0}, st.laplace()),
    Case(D.Laplace, {"loc": 4.0, "scale": 0.01}, st.laplace(4.0, 0.01)),
    Case(D.Laplace, {"loc": -1.0, "scale": 300.0}, st.laplace(-1.0, 300.0)),
    Case(D.Cauchy, {"loc": 0.0, "scale": 1.0}, st.cauchy()),
    Case(D.Cauchy, {"loc": -2.0, "scale": 0.1}, st.cauchy(-2.0, 0.1)),
    Case(D.Cauchy, {"loc": 1.0, "scale": 1e4}, st.cauchy(1.0, 1e4)),
    # halfnorm.ppf loses its lower tail; chi with one degree of freedom is the same law
    Case(D.HalfNormal, {"sd": 1.0}, st.chi(1)),
    Case(D.HalfNormal, {"sd": 1e-3}, st.chi(1, scale=1e-3)),
    Case(D.HalfNormal, {"sd": 50.0}, st.chi(1, scale=50.0)),
    Case(D.HalfCauchy, {"scale": 1.0}, st.halfcauchy()),
    Case(D.HalfCauchy, {"scale": 0.02}, st.halfcauchy(scale=0.02)),
    Case(D.HalfCauchy, {"scale": 25.0}, st.halfcauchy(scale=25.0)),
    Case(D.Uniform, {"lower": 0.0, "upper": 1.0}, st.uniform()),
    Case(D.Uniform, {"lower": -1.0, "upper": 1.0}, st.uniform(-1.0, 2.0)),
    Case(D.Uniform, {"lower": 100.0, "upper": 100.5}, st.uniform(100.0, 0.5)),
    Case(D.Exponential, {"rate": 1.0}, st.expon()),
    Case(D.Exponential, {"rate": 250.0}, st.expon(scale=1 / 250.0)),
    Case(D.Exponential, {"scale": 40.0}, st.expon(scale=40.0)),
    Case(D.Weibull, {"shape": 1.7, "scale": 3.0}, _weibull(1.7, 3.0)),
    Case(D.Weibull, {"shape": 0.6, "scale": 0.02}, _weibull(0.6, 0.02)),
    Case(D.Weibull, {"shape": 25.0, "scale": 400.0}, _weibull(25.0, 400.0)),
    Case(D.Logistic, {"loc": 0.0, "scale": 1.0}, st.logistic()),
    Case(D.Logistic, {"loc": -40.0, "scale": 0.03}, st.logistic(-40.0, 0.03)),
    Case(D.SkewNormal, {"loc": 0.0, "scale": 1.0, "shape": 4.0}, Skewed(4.0, 0.0, 1.0)),
    Case(D.SkewNormal, {"loc": -3.0, "scale": 0.02, "shape": -1.3}, Skewed(-1.3, -3.0, 0.02)),
    Case(D.SkewNormal, {"loc": 50.0, "scale": 9.0, "shape": 0.0}, Skewed(0.0, 50.0, 9.0)),
    Case(D.Pareto, {"shape": 2.5, "scale": 1.2}, _pareto(2.5, 1.2)),
    Case(D.Pareto, {"shape": 0.7, "scale": 300.0}, _pareto(0.7, 300.0)),
    Case(D.Pareto, {"shape": 40.0, "scale": 1e-3}, _pareto(40.0, 1e-3)),
    Case(D.VonMises, {"mean": 0.0, "concentration": 2.0}, Circle(0.0, 2.0)),
    Case(D.VonMises, {"mean": 0.4, "concentration": 0.1}, Circle(0.4, 0.1)),
    Case(D.VonMises, {"mean": -2.8, "concentration": 1.5}, Circle(-2.8, 1.5)),
    Case(D.Gamma, {"shape": 2.5, "rate": 1.0}, _gamma(2.5, 1.0)),
    Case(D.Gamma, {"shape": 0.2, "rate": 3.0}, _gamma(0.2, 3.0)),
    Case(D.Gamma, {"shape": 6.25, "scale": 4.0}, _gamma(6.25, 0.25)),
    Case(D.Gamma, {"shape": 400.0, "rate": 20.0}, _gamma(400.0, 20.0)),
    Case(D.InverseGamma, {"shape": 3.0, "scale": 2.0}, st.invgamma(3.0, scale=2.0)),
    Case(D.InverseGamma, {"shape": 0.8, "scale": 0.1}, st.invgamma(0.8, scale=0.1)),
    Case(D.InverseGamma, {"shape": 1.5, "scale": 5.0}, st.invgamma(1.5, scale=5.0)),
    Case(D.InverseGamma, {"shape": 60.0, "scale": 59.0}, st.invgamma(60.0, scale=59.0)),
    Case(D.Beta, {"a": 2.0, "b": 3.0}, st.beta(2, 3)),
    Case(D.Beta, {"a": 0.5, "b": 0.5}, st.beta(0.5, 0.5)),
    Case(D.Beta, {"a": 0.05, "b": 4.0}, st.beta(0.05, 4.0)),
    Case(D.Beta, {"a": 300.0, "b": 20.0}, st.beta(300.0, 20.0)),
    Case(D.Poisson, {"rate": 4.0}, st.poisson(4.0)),
    Case(D.Poisson, {"rate": 0.02}, st.poisson(0.02)),
    Case(D.Poisson, {"rate": 900.0}, st.poisson(900.0)),
    Case(D.NegativeBinomial, {"mean": 5.0, "dispersion": 2.0}, _negative_binomial(5.0, 2.0)),
    Case(D.NegativeBinomial, {"mean": 0.3, "dispersion": 0.1}, _negative_binomial(0.3, 0.1)),
    Case(D.NegativeBinomial, {"mean": 80.0, "dispersion": 30.0}, _negative_binomial(80.0, 30.0)),
    Case(D.Binomial, {"n": 10.0, "p": 0.3}, st.binom(10, 0.3)),
    Case(D.Binomial, {"n": 1.0, "p": 0.999}, st.binom(1, 0.999)),
    Case(D.Binomial, {"n": 5000.0, "p": 0.01}, st.binom(5000, 0.01)),
    Case(D.BetaBinomial, {"n": 12.0, "a": 2.0, "b": 3.0}, _beta_binomial(12, 2.0, 3.0)),
    Case(D.BetaBinomial, {"n": 40.0, "a": 0.3, "b": 0.5}, _beta_binomial(40, 0.3, 0.5)),
    Case(D.BetaBinomial, {"n": 300.0, "a": 80.0, "b": 900.0}, _beta_binomial(300, 80.0, 900.0)),
    Case(D.Bernoulli, {"p": 0.5}, st.bernoulli(0.5)),
    Case(D.Bernoulli, {"p": 1e-4}, st.bernoulli(1e-4)),
    Case(D.Bernoulli, {"p": 0.97}, st.bernoulli(0.97)),
    Case(D.Skellam, {"rate1": 3.0, "rate2": 1.5}, Difference(3.0, 1.5)),
    Case(D.Skellam, {"rate1": 0.02, "rate2": 0.4}, Difference(0.02, 0.4)),
    Case(D.Skellam, {"rate1": 90.0, "rate2": 250.0}, Difference(90.0, 250.0)),
    Case(D.Categorical, {"p": [0.2, 0.5, 0.3]}, _categorical([0.2, 0.5, 0.3])),
    Case(D.Categorical, {"p": [0.999, 0.001]}, _categorical([0.999, 0.001])),
    Case(D.Categorical, {"p": [0.25] * 4}, _categorical([0.25] * 4)),
]

_A = np.array([[2.0, 0.3, -0.2], [0.3, 1.0, 0.4], [-0.2, 0.4, 0.7]])
_B = np.array([[1e-6, 2e-4], [2e-4, 5.0]])
_M = np.array([1.0, -2.0, 0.5])


def _inverse_wishart(df, scale):
    return st.invwishart(df, scale)


class Ratios:
    """Shares whose log ratios to the last are Gaussian, by SciPy's law of these."""

    def __init__(self, mean, cov):
        self.ratios = st.multivariate_normal(mean, cov)

    def rvs(self, random_state):
        powers = np.exp(np.append(self.ratios.rvs(random_state=random_state), 0.0))
        return powers / powers.sum()

    def logpdf(self, x):
        return self.ratios.logpdf(np.log(x[:-1] / x[-1])) - np.log(x).sum()


JOINT_CASES = [
    Case(D.MvNormal, {"mean": _M, "covariance": _A}, st.multivariate_normal(_M, _A)),
    Case(D.MvNormal, {"mean": _M, "precision": _A},
         st.multivariate_normal(_M, np.linalg.inv(_A))),
    Case(D.MvNormal, {"mean": _M, "cholesky": np.linalg.cholesky(_A)},
         st.multivariate_normal(_M, _A)),
    Case(D.MvNormal, {"mean": [0.0, 0.0], "covariance": _B},
         st.multivariate_normal([0, 0], _B)),
    Case(D.MvNormal, {"mean": [3.0], "covariance": [[0.25]]},
         st.multivariate_normal([3.0], [[0.25]])),
    Case(D.Dirichlet, {"concentration": [1.0, 2.0, 3.5]}, st.dirichlet([1.0, 2.0, 3.5])),
    Case(D.Dirichlet, {"concentration": [0.3, 0.2]}, st.dirichlet([0.3, 0.2])),
    Case(D.Dirichlet, {"concentration": [0.05, 0.4, 2.0]}, st.dirichlet([0.05, 0.4, 2.0])),
    Case(D.Dirichlet, {"concentration": [200.0, 20.0, 2.0, 7.0]},
         st.dirichlet([200.0, 20.0, 2.0, 7.0])),
    Case(D.LogisticNormal, {"mean": _M, "covariance": _A}, Ratios(_M, _A)),
    Case(D.LogisticNormal, {"mean": [0.5], "precision": [[4.0]]}, Ratios([0.5], [[0.25]])),
    Case(D.LogisticNormal, {"mean": _M, "cholesky": np.linalg.cholesky(_A)}, Ratios(_M, _A)),
    Case(D.MvStudentT, {"df": 4.0, "loc": _M, "scale": _A}, st.multivariate_t(_M, _A, df=4.0)),
    Case(D.MvStudentT, {"df": 0.8, "loc": _M, "cholesky": np.linalg.cholesky(_A)},
         st.multivariate_t(_M, _A, df=0.8)),
    Case(D.MvStudentT, {"df": 60.0, "loc": _M, "precision": _A},
         st.multivariate_t(_M, np.linalg.inv(_A), df=60.0)),
    Case(D.MvStudentT, {"df": 1.5, "loc": [3.0], "scale": [[0.25]]},
         st.multivariate_t([3.0], [[0.25]], df=1.5)),
    Case(D.Wishart, {"df": 5.0, "scale": _A}, st.wishart(5.0, _A)),
    Case(D.Wishart, {"df": 2.5, "scale": _A}, st.wishart(2.5, _A)),
    Case(D.Wishart, {"df": 3.0, "scale": [[0.5]]}, st.wishart(3.0, [[0.5]])),
    Case(D.InverseWishart, {"df": 8.0, "scale": _A}, st.invwishart(8.0, _A)),
    Case(D.InverseWishart, {"df": 4.5, "scale": _A}, st.invwishart(4.5, _A)),
    Case(D.InverseWishart, {"df": 6.0, "scale": [[0.5]]}, st.invwishart(6.0, [[0.5]])),
]  # fmt: skip


@dataclass(frozen=True)
class TruncatedCase:
    """A scalar case restricted to [lower, upper]."""

    base: Case
    lower: float = -math.inf
    upper: float = math.inf

    @property
    def id(self) -> str:
        return f"{self.base.id}[{self.lower:g},{self.upper:g}]"

    def bounds(self) -> dict[str, float]:
        """The keywords: only the finite ones."""
        given = {"lower": self.lower, "upper": self.upper}
        return {k: v for k, v in given.items() if math.isfinite(v)}

    def build(self) -> D.Distribution:
        return D.Truncated(self.base.build(), **self.bounds())

    def log_mass(self) -> float:
        """log P(lower <= X <= upper) from SciPy's tails."""
        law, below = self.base.reference, self.lower - (1.0 if self.base.cls.discrete else 0.0)
        if self.upper == math.inf:
            return float(law.logsf(below))
        if self.lower == -math.inf:
            return float(law.logcdf(self.upper))
        if law.cdf(below) < 0.5:
            a, b = law.logcdf(self.upper), law.logcdf(below)
        else:
            a, b = law.logsf(below), law.logsf(self.upper)
        return float(a + np.log1p(-np.exp(b - a)))


def _truncated(cls, parameters, reference, *intervals) -> list[TruncatedCase]:
    base = Case(cls, parameters, reference)
    return [TruncatedCase(base, *interval) for interval in intervals]


_INF = math.inf
TRUNCATED_CASES = [
    *_truncated(D.Normal, {"mean": 0.0, "sd": 1.0}, _normal(0, 1), (0.0, _INF), (8.0, _INF),
                (-_INF, -8.0), (-_INF, 3.0), (-1.0, 2.0), (9.0, 9.5), (-9.5, -9.0),
                (45.0, _INF), (-_INF, -45.0), (45.0, 45.01), (-60.0, 60.0)),
    *_truncated(D.Normal, {"mean": 5.0, "precision": 4.0}, _normal(5, 0.5), (0.0, _INF),
                (5.0, 5.001)),
    *_truncated(D.LogNormal, {"mean": 0.5, "sd": 0.8}, st.lognorm(0.8, scale=math.exp(0.5)),
                (1.0, _INF), (-_INF, 0.01), (500.0, _INF), (0.5, 3.0), (-1.0, 2.0)),
    *_truncated(D.StudentT, {"df": 5.0, "loc": 1.0, "scale": 2.0}, st.t(5, 1.0, 2.0),
                (0.0, _INF), (1e4, _INF), (-_INF, -1e4), (-3.0, 4.0), (200.0, 300.0)),
    *_truncated(D.StudentT, {"df": 1.5, "loc": 0.0, "scale": 1.0}, st.t(1.5), (1.0, _INF)),
    *_truncated(D.Logistic, {"loc": 1.0, "scale": 2.0}, st.logistic(1.0, 2.0), (0.0, _INF),
                (-3.0, 4.0), (90.0, _INF), (-_INF, -90.0)),
    *_truncated(D.Pareto, {"shape": 3.0, "scale": 1.5}, _pareto(3.0, 1.5), (2.0, _INF),
                (-_INF, 4.0), (1e6, _INF), (2.0, 3.0), (0.5, 9.0)),
    *_truncated(D.Gamma, {"shape": 2.5, "rate": 0.5}, _gamma(2.5, 0.5), (1.0, _INF),
                (-_INF, 0.01), (150.0, _INF), (3.0, 4.0), (200.0, 210.0)),
    *_truncated(D.Exponential, {"rate": 2.0}, st.expon(scale=0.5), (1.0, _INF), (-_INF, 0.3),
                (600.0, _INF), (600.0, 600.2), (-1.0, 1.0)),
    *_truncated(D.Weibull, {"shape": 1.7, "scale": 3.0}, _weibull(1.7, 3.0), (2.0, _INF),
                (-_INF, 0.01), (60.0, _INF), (1.0, 1.5), (60.0, 61.0)),
    *_truncated(D.Beta, {"a": 2.0, "b": 5.0}, st.beta(2, 5), (0.5, _INF), (-_INF, 1e-6),
                (0.999, _INF), (0.2, 0.3), (0.99, 0.995)),
    *_truncated(D.Cauchy, {"loc": 0.0, "scale": 1.0}, st.cauchy(), (0.0, _INF), (1e6, _INF),
                (-_INF, -1e6), (-2.0, 5.0), (1e6, 2e6)),
    *_truncated(D.Laplace, {"loc": 1.0, "scale": 0.5}, st.laplace(1.0, 0.5), (0.0, _INF),
                (30.0, _INF), (-_INF, -30.0), (-1.0, 2.0), (300.0, 301.0), (1.0, 3.0)),
    *_truncated(D.HalfNormal, {"sd": 2.0}, st.chi(1, scale=2.0), (20.0, _INF), (-_INF, 1e-4),
                (1.0, 3.0)),
    *_truncated(D.HalfCauchy, {"scale": 2.0}, st.halfcauchy(scale=2.0), (-_INF, 10.0)),
    *_truncated(D.InverseGamma, {"shape": 3.0, "scale": 2.0}, st.invgamma(3.0, scale=2.0),
                (-_INF, 0.05), (50.0, _INF), (0.5, 2.0)),
    *_truncated(D.Uniform, {"lower": -1.0, "upper": 3.0}, st.uniform(-1.0, 4.0), (0.0, _INF),
                (-_INF, 0.5), (0.0, 1.0)),
    *_truncated(D.Poisson, {"rate": 4.0}, st.poisson(4.0), (1.0, _INF), (30.0, _INF),
                (-_INF, 2.0), (3.0, 6.0), (25.0, 27.0), (30.0, 32.0)),
    *_truncated(D.Poisson, {"rate": 60.0}, st.poisson(60.0), (-_INF, 10.0)),
    *_truncated(D.Skellam, {"rate1": 3.0, "rate2": 1.5}, Difference(3.0, 1.5), (0.0, _INF),
                (20.0, _INF), (-_INF, 4.0), (-_INF, -12.0), (-2.0, 3.0), (-15.0, -14.0)),
    *_truncated(D.Skellam, {"rate1": 90.0, "rate2": 250.0}, Difference(90.0, 250.0),
                (-_INF, -170.0), (-120.0, _INF)),
    *_truncated(D.Binomial, {"n": 20.0, "p": 0.3}, st.binom(20, 0.3), (1.0, _INF), (18.0, _INF),
                (-_INF, 3.0), (5.0, 9.0)),
    *_truncated(D.NegativeBinomial, {"mean": 5.0, "dispersion": 2.0}, _negative_binomial(5.0, 2.0),
                (1.0, _INF), (150.0, _INF), (-_INF, 3.0), (2.0, 20.0)),
]  # fmt: skip

NOT_IN_SCIPY = {
    "Multinomial", "EulerMultinomial",
    "Truncated", "Mixture", "ZeroInflated", "Dirac", "Flat", "HalfFlat", "LKJ", "Ordered",
    "Censored",
}  # fmt: skip


def scalars(values: Any) -> ExprArray:
    """Constants of the shape of `values`."""
    return array(np.asarray(values, dtype=float))
