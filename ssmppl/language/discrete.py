"""Labels and points: Bernoulli, elementwise of arrays, Categorical, and Dirac.

Values are whole numbers held as floating point, as all values of a model are.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ssmppl.errors import ModelError
from ssmppl.expressions.arrays import ExprArray, array
from ssmppl.expressions.arrays import elementwise as ew
from ssmppl.expressions.expr import constant
from ssmppl.language.continuous import _each, _where
from ssmppl.language.counts import Binomial, _Counts
from ssmppl.language.distribution import INFINITY, Distribution, Support
from ssmppl.language.nested import holding
from ssmppl.language.shares import check_sum, sum_holds


class Bernoulli(_Counts):
    """Bernoulli(p): 1 with probability p, else 0.

    Parameters
    ----------
    p : the probability.
    """

    def __init__(self, p: Any):
        self._set(p=p)
        self._require("p", 0.0, 1.0, strict=False)

    def support(self):
        return Support("integers", self._full(0.0), self._full(1.0))

    def log_densities(self, value):
        return _where(ew("eq", value, 0.0), ew("log1p", -self.p), ew("log", self.p))

    def sample(self, draws):
        return _each(self, lambda i: ew("lt", draws.uniform(), self.p[i]) * 1.0)

    def mean(self):
        return self.p

    def variance(self):
        return self.p * (1.0 - self.p)

    def cdf(self, value):
        below = _where(ew("lt", value, 1.0), 1.0 - self.p, 1.0)
        return self._below_zero(value, below)

    def survival(self, value):
        above = _where(ew("lt", value, 1.0), self.p, 0.0)
        return self._one_below_zero(value, above)

    def quantile(self, p):
        return _where(ew("le", p, 1.0 - self.p), 0.0, 1.0)

    def weighted(self, power):
        return Binomial(self._full(1.0), self.p).weighted(power)


class Categorical(_Counts):
    """Categorical(p): 0, ..., K-1 with probabilities p.

    Parameters
    ----------
    p : probabilities, shape (K,), of sum 1; a row ``P[state]`` of a transition matrix (K, K) for a
        Markov chain.
    """

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

    discrete = False

    def __init__(self, value: Any):
        self._set(value=value)

    def support(self):
        return Support("point", self.value, self.value)

    def log_densities(self, value):
        return _where(ew("eq", value, self.value), 0.0, -INFINITY)

    def sample(self, draws):
        return self.value

    def mean(self):
        return self.value

    def variance(self):
        return self._full(0.0)

    def cdf(self, value):
        return _where(ew("le", self.value, value), 1.0, 0.0)

    def quantile(self, p):
        return self.value
