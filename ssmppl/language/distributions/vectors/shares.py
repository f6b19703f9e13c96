"""LogisticNormal: shares of a whole whose logarithms are jointly Gaussian.

Aitchison and Shen (1980), "Logistic-normal distributions: some properties and uses", *Biometrika*
67.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ssmppl.expressions.arrays import ExprArray, array
from ssmppl.expressions.arrays import elementwise as ew
from ssmppl.language.distributions.base import LOG_2PI, Support
from ssmppl.language.distributions.multivariate import Centred, MvNormal
from ssmppl.language.distributions.positive import LEAST_SHARE


class LogisticNormal(Centred):
    """LogisticNormal(mean, covariance= | precision= | cholesky=): shares (d + 1,) of sum 1.

    Their log ratios to the last, ``np.log(x[:-1] / x[-1])``, are MvNormal: shares that rise and
    fall together, which those of a Dirichlet distribution cannot.

    Parameters
    ----------
    mean : of the log ratios, (d,), or one number for all.
    covariance, precision, cholesky : exactly one of them, (d, d), as of MvNormal.

    Notes
    -----
    Mean and variance of the shares have no closed form; predictions have NaN for them.
    """

    margins = False

    def __init__(
        self, mean: Any, *, covariance: Any = None, precision: Any = None, cholesky: Any = None
    ):
        spreads = {"covariance": covariance, "precision": precision, "cholesky": cholesky}
        self._set_centre("mean_", mean, spreads)
        self.shape = (len(self.mean_) + 1,)

    def ratios(self) -> MvNormal:
        """The distribution of the log ratios."""
        law = MvNormal(self.mean_, **{self.spread: self.parameters[self.spread]})
        law.location = self.location
        return law

    def support(self):
        return Support("simplex", self._full(0.0), self._full(1.0))

    def log_densities(self, value):
        logs = array(ew("log", array(value)))
        away = logs[:-1] - logs[-1] - self.mean_
        square, volume = self._square_and_volume(away)
        return array(-0.5 * len(away) * LOG_2PI + volume - 0.5 * square - np.sum(logs))

    def guarded_log_densities(self, value):
        value = array(value)
        density = super().guarded_log_densities(value)
        return array(ew("where", ew("lt", 0.0, np.min(value)), density[()], -math.inf))

    def sample(self, draws):
        z = array(np.append(self.ratios().sample(draws).view(np.ndarray), 0.0))
        powers = array(ew("exp", z - np.max(z)))
        return array(ew("maximum", LEAST_SHARE, powers / np.sum(powers)))  # none rounded to 0

    def mean(self) -> ExprArray:
        return self._full(math.nan)

    def variance(self) -> ExprArray:
        return self._full(math.nan)
