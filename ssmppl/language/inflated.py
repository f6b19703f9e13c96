"""ZeroInflated: a law of counts with more zeros than are its own.

Lambert (1992), "Zero-inflated Poisson regression, with an application to defects in
manufacturing", *Technometrics* 34.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ssmppl.errors import ModelError
from ssmppl.expressions.arrays import ExprArray, array
from ssmppl.expressions.arrays import elementwise as ew
from ssmppl.expressions.expr import user_location
from ssmppl.language.continuous import _each, _where
from ssmppl.language.distribution import Distribution, Support
from ssmppl.language.nested import cut, exists, holding
from ssmppl.language.shares import log_sum, none_below_zero


class ZeroInflated(Distribution):
    """ZeroInflated(law, p): 0 with probability p, else a draw of `law`, which may be 0 too.

    Parameters
    ----------
    law : a distribution of counts: Poisson, NegativeBinomial, Binomial, BetaBinomial. Of a law
        without zeros, ``Truncated(Poisson(rate), lower=1)``, it makes a hurdle model.
    p : probability of a structural zero, one that is none of the law's: the `zi` of brms, the
        `gate` of NumPyro, 1 - `psi` of PyMC.
    """

    discrete = True
    base: Distribution

    def __init__(self, law: Distribution, p: Any):
        name = type(law).__name__
        counts = isinstance(law, Distribution) and law.discrete and not law.joint
        if (
            not counts
            or isinstance(law, ZeroInflated)
            or not all(e.op == "const" and e.data >= 0.0 for e in law.support().lower.ravel())
        ):
            raise ModelError(
                f"ZeroInflated: {name} is no law of counts",
                fix="give one of whole numbers from 0 on, such as ssm.Poisson(rate)",
                where=user_location(),
            )
        self._set(p=p, **{f"like_{n}": a for n, a in law.parameters.items()})
        self.base = law.rebuilt({n: self.parameters[f"like_{n}"] for n in law.parameters})
        self.drawable = self.base.drawable
        self._require("p", 0.0, 1.0, strict=False)

    def __repr__(self) -> str:
        return f"ZeroInflated({self.base!r}, p={self.p.ravel()[0]!r})"

    def support(self):
        return Support("integers", self._full(0.0), self.base.support().upper)

    def rebuilt(self, parameters):
        values = {**self.parameters, **parameters}
        law = self.base.rebuilt({n: values[f"like_{n}"] for n in self.base.parameters})
        return self._at_place(ZeroInflated(law, values["p"]))

    def in_range(self) -> ExprArray | None:
        return holding([super().in_range(), exists(self.base)])

    def log_densities(self, value):
        v, p = array(value), self.p
        parts = [self._full(0.0), self._of_base(array(np.zeros(v.shape)))]
        rest = array(ew("log1p", -none_below_zero(p)))
        return _where(ew("eq", v, 0.0), log_sum([p, 1.0 - p], parts), rest + self._of_base(v))

    def _of_base(self, value: ExprArray) -> ExprArray:
        """The law's own log density from 0 on; -inf at zeros that it does not have."""
        from_zero = all(e.data == 0.0 for e in self.base.support().lower.ravel())
        return array(self.base.log_densities(value) if from_zero else cut(self.base, value))

    def sample(self, draws):
        u = _each(self, lambda i: draws.uniform())
        return _where(ew("lt", u, self.p), 0.0, self.base.sample(draws))

    def mean(self):
        return (1.0 - self.p) * self.base.mean()

    def variance(self):
        return (1.0 - self.p) * (self.base.variance() + self.p * self.base.mean() ** 2)

    def cdf(self, value):
        inside = self.p + (1.0 - self.p) * self.base.cdf(value)
        return _where(ew("lt", value, 0.0), 0.0, inside)

    def survival(self, value):
        inside = (1.0 - self.p) * self.base.survival(value)
        return _where(ew("lt", value, 0.0), 1.0, inside)

    def quantile(self, p):
        left = array(p) - self.p
        law = self.base.quantile(array(ew("maximum", left, 0.0)) / (1.0 - self.p))
        return _where(ew("le", left, 0.0), 0.0, law)

    def survival_quantile(self, p):
        above = array(p) / (1.0 - self.p)
        law = self.base.survival_quantile(array(ew("minimum", above, 1.0)))
        return _where(ew("le", 1.0, above), 0.0, law)

    def sample_above(self, draws, lower):
        above_zero = all(e.op == "const" and e.data >= 1.0 for e in array(lower).ravel())
        return self.base.sample_above(draws, lower) if above_zero else None

    def weighted(self, power):
        found = self.base.weighted(power)
        return None if found is None else ((1.0 - self.p) * found[0], found[1])
