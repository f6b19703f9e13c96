"""MvStudentT: the multivariate Student distribution, heavy tails for a whole vector at once.

Kotz and Nadarajah (2004), "Multivariate t distributions and their applications", chapter 1.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ssmppl.errors import ModelError
from ssmppl.expressions.arrays import array
from ssmppl.expressions.arrays import elementwise as ew
from ssmppl.language.distributions.base import INFINITY
from ssmppl.language.distributions.multivariate import Centred
from ssmppl.language.distributions.positive import log_gamma


class MvStudentT(Centred):
    """MvStudentT(df, loc, scale= | precision= | cholesky=): a vector (d,) with heavy tails.

    ``loc + z / np.sqrt(w)`` with z ~ MvNormal(0, covariance=scale) and w ~ Gamma(df / 2, rate=df /
    2): one outlier moves all components. Where each has its own, ``StudentT`` with arrays is meant.

    Parameters
    ----------
    df : degrees of freedom, positive, one number: 1 has no mean, from 30 on it is nearly Gaussian.
    loc : centre, (d,), or one number for all components.
    scale, precision, cholesky : exactly one of them, (d, d): a matrix, of which the covariance is
        df / (df - 2) times where df > 2; its inverse; or its lower Cholesky factor. Of one
        component it is the square of the scale of StudentT.

    Raises
    ------
    ModelError : df is not one positive number, the matrix is not symmetric and positive definite,
        or the shapes differ.
    """

    def __init__(
        self, df: Any, loc: Any, *, scale: Any = None, precision: Any = None, cholesky: Any = None
    ):
        spreads = {"scale": scale, "precision": precision, "cholesky": cholesky}
        self._set_centre("loc", loc, spreads, df=df)
        if self.df.ndim:
            raise ModelError(
                f"MvStudentT: df has shape {self.df.shape}",
                fix="give one number of degrees of freedom; where components have their own, "
                "ssm.StudentT with arrays",
                where=self.location,
            )
        self._require("df", 0.0)

    def log_densities(self, value):
        square, volume = self._square_and_volume(array(value) - self.loc)
        return array(self.of_form(square, volume, len(self.loc)))

    def of_form(self, square, volume, n):
        nu = self.df[()]
        norm = log_gamma(array(0.5 * (nu + n))) - log_gamma(array(0.5 * nu))
        norm = norm - 0.5 * n * (math.log(math.pi) + ew("log", nu))
        return array(norm + volume - 0.5 * (nu + n) * ew("log1p", square / nu))[()]

    def sample(self, draws):
        z = array([draws.normal() for _ in range(len(self.loc))])
        nu = self.df[()]
        return array(self.loc + self.factor() @ z * ew("sqrt", 0.5 * nu / draws.gamma(0.5 * nu)))

    def mean(self):
        return array(ew("where", ew("lt", 1.0, self.df[()]), self.loc, math.nan))

    def noise_free(self):
        return self.loc

    def variance(self):
        nu = self.df[()]
        finite = nu / (nu - 2.0) * np.diagonal(self.whole_matrix().view(np.ndarray))
        rest = ew("where", ew("lt", 1.0, nu), INFINITY, math.nan)
        return array(ew("where", ew("lt", 2.0, nu), array(finite), rest))
