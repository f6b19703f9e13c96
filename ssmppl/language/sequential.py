"""Channels that are Gaussian one after the other; no user writes this law, analyses make it."""

from __future__ import annotations

from typing import Any

from ssmppl.expressions.arrays import ExprArray, array
from ssmppl.language.continuous import Normal
from ssmppl.language.distribution import Distribution


class SequentialNormal(Distribution):
    """Components with p(y) = prod_i N(y_i; m_i(y_1, ..., y_{i-1}), s_i).

    mean, variance : of each component alone, which predictions need; they are not those of the
        factors unless the components are independent.
    conditional_mean, conditional_variance : m_i, s_i; the means hold the symbols of the earlier
        components, and leave out those that were not measured.
    """

    def __init__(
        self, mean: Any, *, variance: Any, conditional_mean: Any, conditional_variance: Any
    ):
        self._set(
            mean_=mean, variance_=variance, conditional_mean=conditional_mean,
            conditional_variance=conditional_variance,
        )  # fmt: skip

    def mean(self) -> ExprArray:
        return self.mean_

    def variance(self) -> ExprArray:
        return self.variance_

    def log_densities(self, value: ExprArray) -> ExprArray:
        return Normal(self.conditional_mean, variance=self.conditional_variance).log_densities(
            array(value)
        )

    def cdf(self, value: ExprArray) -> ExprArray:
        return Normal(self.mean_, variance=self.variance_).cdf(value)
