"""LKJ: correlation matrices, drawn by their partial correlations.

Lewandowski, Kurowicka and Joe (2009), "Generating random correlation matrices based on vines and
extended onion method", *Journal of Multivariate Analysis* 100.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ssmppl.errors import ModelError
from ssmppl.expressions.arrays import ExprArray, array, log_determinant
from ssmppl.expressions.arrays import elementwise as ew
from ssmppl.expressions.expr import Expr, as_expr, constant, user_location
from ssmppl.language.distributions.base import Support
from ssmppl.language.distributions.multivariate import Joint, where_definite
from ssmppl.language.distributions.positive import log_gamma_draw, needs_log_gamma

SHORT_OF_ONE = 18.0  # whose hyperbolic tangent is the double next but three to 1


class LKJ(Joint):
    """LKJ(dim, eta): correlation matrices R (dim, dim), density in proportion to det(R)^(eta - 1).

    For the correlations of noises, beside scales with priors of their own:
    ``ssm.MvNormal(mean, covariance=sd[:, None] * R * sd[None, :])``. A prior of parameters only.

    Parameters
    ----------
    dim : number of rows, a whole number of at least 2.
    eta : positive; at 1 all correlation matrices are equally likely, above it those near the
        identity are, below it those near singular ones. One correlation alone is ``2 B - 1`` with B
        of distribution ``Beta(b, b)``, b = eta + dim / 2 - 1.

    Raises
    ------
    ModelError : dim is no whole number from 2 on; eta is no positive number.

    Notes
    -----
    Lewandowski, Kurowicka and Joe (2009), with the normalising constant of their equation (16). It
    is `LKJCorr` of PyMC and NumPyro, `lkj_corr` of Stan. Its Cholesky factor, `LKJCholesky` there,
    is ``np.linalg.cholesky(R)``.
    """

    symmetric = unit_diagonal = True
    prior_only = True

    def __init__(self, dim: int, eta: Any):
        whole = _whole(dim)
        if whole < 2:
            raise ModelError(
                f"LKJ: dim is {dim!r}",
                fix="give the number of rows, a whole number of at least 2: ssm.LKJ(2, eta=2)",
                where=user_location(),
            )
        self._set(dim=whole, eta=eta)
        if self.eta.ndim:
            raise ModelError(
                f"LKJ: eta has shape {self.eta.shape}",
                fix="give one number: eta=2",
                where=self.location,
            )
        self._require("eta", 0.0)
        self.dim = whole
        self.shape = (whole, whole)

    def support(self):
        ones = np.eye(self.dim)
        return Support("correlation", array(2.0 * ones - 1.0), array(np.ones(self.shape)))

    def _exponents(self) -> list[Expr]:
        """Of column j: the partial correlations of its rows given the columns before it are
        2 B - 1, B of distribution Beta(b, b), with this b."""
        return [self.eta[()] + 0.5 * (self.dim - 2 - j) for j in range(self.dim - 1)]

    def log_densities(self, value):
        norm = constant(0.0)
        for j, b in enumerate(self._exponents()):
            rows = self.dim - 1.0 - j
            norm = norm + rows * ((2.0 * b - 1.0) * math.log(2.0) + ew("betaln", b, b))
        return array((self.eta[()] - 1.0) * log_determinant(with_unit_diagonal(value)) - norm)

    def guarded_log_densities(self, value):
        density = super().guarded_log_densities(value)
        return array(where_definite(with_unit_diagonal(value), density[()]))

    def sample(self, draws):
        """The partial correlations, and of them the rows of the Cholesky factor."""
        root = np.full(self.shape, constant(0.0), dtype=object)
        root[0, 0] = constant(1.0)
        b = self._exponents()
        for i in range(1, self.dim):
            left: Any = 1.0  # the root of what is left of the row's unit length
            for j in range(i):
                first, second = (
                    log_gamma_draw(draws, b[j]) if needs_log_gamma(array(b)) else
                    ew("log", draws.gamma(b[j])) for _ in range(2)
                )  # fmt: skip
                half = 0.5 * (first - second)  # tanh of it is 2 B - 1, and not rounded to 1
                half = ew("minimum", SHORT_OF_ONE, ew("maximum", -SHORT_OF_ONE, half))
                root[i, j] = left * ew("tanh", half)
                left = left / ew("cosh", half)
            root[i, i] = as_expr(left)
        return with_unit_diagonal(array(root) @ array(root).T)

    def mean(self):
        return array(np.eye(self.dim))

    def variance(self):
        return array((1.0 - np.eye(self.dim)) / (2.0 * self._exponents()[0] + 1.0))


def _whole(dim: Any) -> int:
    """A number of rows, of a distribution too that is built again; 0 where it is none."""
    if isinstance(dim, ExprArray) and dim.shape == () and dim[()].op == "const":
        dim = int(dim[()].data)
    return int(dim) if isinstance(dim, (int, np.integer)) and not isinstance(dim, bool) else 0


def with_unit_diagonal(matrix: Any) -> ExprArray:
    """A correlation matrix without symbols for what is 1."""
    out = np.array(array(matrix).view(np.ndarray))
    out[np.diag_indices(len(out))] = constant(1.0)
    return array(out)
