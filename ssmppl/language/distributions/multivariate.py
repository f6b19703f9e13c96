"""Distributions of vectors and matrices with one joint density: MvNormal, Dirichlet, Wishart,
InverseWishart, LKJ and Ordered; `SequentialNormal`, channels that are Gaussian one after the other, is made by
analyses only.

Gelman et al. (2013), "Bayesian data analysis", appendix A, for densities and moments; samplers:
Cholesky (MvNormal), normalised gammas (Dirichlet), Bartlett's decomposition (Wishart), Smith and
Hocking (1972), algorithm AS 53. Correlation matrices: Lewandowski, Kurowicka and Joe (2009),
"Generating random correlation matrices based on vines and extended onion method", *Journal of
Multivariate Analysis* 100. Matrices that are parameters are checked where the distribution is
made.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np

from ssmppl.errors import ModelError
from ssmppl.expressions.arrays import (
    ExprArray,
    array,
    cholesky,
    inverse,
    log_determinant,
    squared,
)
from ssmppl.expressions.arrays import elementwise as ew
from ssmppl.expressions.calculus import lower_inverse
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import Expr, as_expr, constant, symbol, topological, user_location
from ssmppl.expressions.test_points import moderate, with_cases
from ssmppl.language.distributions.base import (
    LOG_2PI,
    Distribution,
    MeanLink,
    Support,
    VarianceLink,
    one_of,
)
from ssmppl.language.distributions.continuous import Normal
from ssmppl.language.distributions.draws import Draws
from ssmppl.language.distributions.positive import (
    LEAST_SHARE,
    log_gamma,
    log_gamma_draw,
    needs_log_gamma,
)

# By which share two entries that are meant to be one may differ: of themselves, and of variances.
UNEQUAL, ROUNDING = 1e-6, 1e-10
SHORT_OF_ONE = 18.0  # whose hyperbolic tangent is the double next but three to 1
NODES = 12  # of quadrature between two points
LEAST_LOG_ORDER = -25.0  # of a probability of an order; less is lost in the tails of quadrature


def checked_matrix(law: Distribution, name: str) -> ExprArray:
    """A parameter that must be a square, symmetric, positive definite matrix, or of the name
    "cholesky" the lower factor of one; of symbols as far as can be known.

    Raises
    ------
    ModelError : it is none.
    """
    m, kind = law.parameters[name], type(law).__name__
    if m.ndim != 2 or m.shape[0] != m.shape[1]:
        raise ModelError(
            f"{kind}: {name} has shape {m.shape}", fix="give a square matrix", where=law.location
        )
    above = [m[i, j] for i in range(len(m)) for j in range(i + 1, len(m))]
    if name == "cholesky" and any(e is not constant(0.0) for e in above):
        raise ModelError(
            f"{kind}: cholesky is not lower triangular",
            fix="give the lower factor L with L L' = covariance, as np.linalg.cholesky does",
            where=law.location,
        )
    if all(e.op == "const" for e in m.ravel()):
        _check_numbers(law, name, m)
    elif name != "cholesky":
        _check_symmetry(law, name, m)
    return m


def _check_numbers(law: Distribution, name: str, m: ExprArray) -> None:
    numbers = np.array([e.data for e in m.ravel()]).reshape(m.shape)
    lower = name == "cholesky"
    symmetric = lower or np.allclose(numbers, numbers.T, rtol=1e-10, atol=0)
    positive = (
        bool(np.all(np.diagonal(numbers) > 0))
        if lower
        else symmetric and bool(np.all(np.linalg.eigvalsh(numbers) > 0))
    )
    if not symmetric or not positive:
        what = "positive definite" if symmetric else "symmetric"
        raise ModelError(
            f"{type(law).__name__}: {name} is not {what}: {numbers.tolist()}",
            fix="check its entries; a noise that is exactly zero is ssm.Dirac",
            where=law.location,
        )


def _check_symmetry(law: Distribution, name: str, m: ExprArray) -> None:
    """Of symbols: for what reads one half only, and for what reads both, it would be two
    distributions."""
    pairs = [(i, j) for i in range(len(m)) for j in range(i) if m[i, j] is not m[j, i]]
    if not pairs:
        return
    entries = [m[i, j] for i, j in pairs] + [m[j, i] for i, j in pairs] + list(np.diagonal(m))
    if any(n.op == "call" for n in topological(entries)):
        return  # a primitive may have no value at numbers that no model gives it
    forms = with_cases(entries)
    with np.errstate(all="ignore"):
        found = [np.asarray(v, float) for v in evaluate(forms, moderate(forms))]
    diagonal = found[2 * len(pairs) :]
    for (i, j), a, b in zip(pairs, found, found[len(pairs) :], strict=False):
        # at every point: where it is no number nothing is known, and rounding may part some
        rounding = ROUNDING * np.sqrt(np.abs(diagonal[i] * diagonal[j]))
        if np.all(np.abs(a - b) > UNEQUAL * (np.abs(a) + np.abs(b)) + rounding):
            raise ModelError(
                f"{type(law).__name__}: {name} is not symmetric: its entry [{i}, {j}] is "
                f"{m[i, j]}, and [{j}, {i}] is {m[j, i]}",
                fix="give both the same value",
                where=law.location,
            )


class _Joint(Distribution):
    joint = True

    def _where_definite(self, m: ExprArray, density: ExprArray) -> ExprArray:
        """`where_definite`, unless m surely is."""
        return density if surely_positive(m) else array(where_definite(m, density[()]))


class MvNormal(_Joint):
    """MvNormal(mean, covariance= | precision= | cholesky=): a vector (d,).

    Parameters
    ----------
    mean : shape (d,), or one number for all components.
    covariance, precision, cholesky : exactly one of them, (d, d): the covariance, its inverse, or
        its lower factor L with L L' = covariance. As the distribution of states a covariance may be
        singular, as q G G' is, for all values of its symbols or in some cases of the conditions in
        it: methods that need no density of the transition take it.
    """

    gaussian_noise = True
    maximisers: ClassVar = {"mean_": lambda law, value: value}
    mean_link = MeanLink("mean_", "identity")
    root: ExprArray | None = None  # of a singular covariance, (d, d); see `covariances.py`

    def __init__(
        self, mean: Any, *, covariance: Any = None, precision: Any = None, cholesky: Any = None
    ):
        options = {"covariance": covariance, "precision": precision, "cholesky": cholesky}
        self.spread, value = one_of("MvNormal", options)
        self._set(**{"mean_": mean, self.spread: value})
        matrix = checked_matrix(self, self.spread)
        if self.mean_.ndim == 0:
            self.parameters["mean_"] = array(np.full(len(matrix), self.mean_[()]))
        if self.mean_.shape != (len(matrix),):
            raise ModelError(
                f"MvNormal: mean has shape {self.mean_.shape}, {self.spread} {matrix.shape}",
                fix="give a mean of shape (d,) and a matrix of shape (d, d)",
                where=self.location,
            )
        self.shape = self.mean_.shape
        power = {"covariance": 1.0, "precision": -1.0, "cholesky": 0.5}[self.spread]
        self.variance_link = VarianceLink(self.spread, power)

    def mean(self):
        return self.mean_

    def covariance_matrix(self) -> ExprArray:
        """(d, d), however the spread was given."""
        m = self.parameters[self.spread]
        if self.spread == "covariance":
            return m
        if self.spread == "precision":
            return inverse(m)
        whole = squared(m)
        return array(m @ m.T) if whole is None else whole

    def variance(self):
        return array(np.diagonal(self.covariance_matrix().view(np.ndarray)))

    def log_densities(self, value):
        m, d = self.parameters[self.spread], array(value) - self.mean_
        constant_term = -0.5 * len(d) * LOG_2PI
        whole = squared(m) if self.spread == "cholesky" else None
        if whole is not None:  # the density of a covariance, by whichever name it came
            m = whole
        elif self.spread == "cholesky":
            z = lower_inverse(m) @ d
            log_root = np.sum(array([ew("log", e) for e in np.diagonal(m.view(np.ndarray))]))
            return array(constant_term - log_root - 0.5 * np.sum(z**2))
        if self.spread == "precision":
            return array(constant_term + 0.5 * log_determinant(m) - 0.5 * (d @ m @ d))
        return array(constant_term - 0.5 * log_determinant(m) - 0.5 * (d @ inverse(m) @ d))

    def guarded_log_densities(self, value):
        density, m = self.log_densities(value), self.parameters[self.spread]
        return density if self.spread == "cholesky" else self._where_definite(m, density)

    def factor(self) -> ExprArray:
        """A matrix L, (d, d), with L L' = covariance."""
        m = self.parameters[self.spread]
        if self.root is not None:
            return self.root
        if self.spread == "cholesky":
            return m
        if self.spread == "covariance":
            return cholesky(m)
        return array(lower_inverse(cholesky(m)).T)  # P = K K', so (K^-T)(K^-T)' = P^-1

    def standard(self, value: Any) -> ExprArray:
        """The standard normal draws (d,) behind a value."""
        away = array(array(value) - self.mean_)
        if self.spread == "precision":
            return array(array(cholesky(self.parameters["precision"])).T @ away)
        return array(lower_inverse(self.factor()) @ away)

    def sample(self, draws):
        z = array([draws.normal() for _ in range(len(self.mean_))])
        return array(self.mean_ + self.factor() @ z)


def where_definite(m: ExprArray, density: Expr) -> Expr:
    """A density in which the matrix m stands, and -inf where m is not positive definite: its
    determinant may be positive all the same."""
    last = cholesky(m)[-1, -1]  # nan where the matrix is not positive definite
    return array(ew("where", ew("lt", 0.0, last), density, -math.inf))[()]


def surely_positive(m: ExprArray) -> bool:
    """Whether a matrix is one of numbers (checked before), a parameter with that support, or the
    inverse of one: what its own distribution keeps positive definite. Of a diagonal one the logs
    see to it.
    """
    entries = [as_expr(e) for e in m.ravel()]
    off = [as_expr(m[i, j]) for i, j in np.ndindex(m.shape) if i != j]
    if all(e.op == "const" for e in entries) or all(e.op == "const" and e.data == 0 for e in off):
        return True
    if all(e.op == "item" and e.args[0].op == "inverse" for e in entries):
        entries = list(entries[0].args[0].args)
    n = len(m)
    return all(
        e.op == "symbol" and e.data[2] == (max(i, j), min(i, j))
        for e, (i, j) in zip(entries, np.ndindex(n, n), strict=True)
    )


class Dirichlet(_Joint):
    """Dirichlet(concentration): positive shares of sum 1.

    Parameters
    ----------
    concentration : positive, (K,); or (R, K) for R independent rows of shares, as in the transition
        matrix of a Markov chain.
    """

    def __init__(self, concentration: Any):
        self._set(concentration=concentration)
        if self.concentration.ndim not in (1, 2) or self.concentration.shape[-1] < 2:
            raise ModelError(
                f"Dirichlet: concentration has shape {self.concentration.shape}",
                fix="give a vector of at least two concentrations, or a matrix of such rows",
                where=self.location,
            )
        self._require("concentration", 0.0)
        self.shape = self.concentration.shape

    def support(self):
        return Support("simplex", self._full(0.0), self._full(1.0))

    def _rows(self):
        return [array(a) for a in self.concentration.reshape(-1, self.shape[-1]).view(np.ndarray)]

    def log_densities(self, value):
        total, rows = constant(0.0), array(value).reshape(-1, self.shape[-1]).view(np.ndarray)
        for a, v in zip(self._rows(), rows, strict=True):
            # the beta functions of sticks that are broken off one by one
            norm = np.sum([ew("betaln", a[k], np.sum(a[k + 1 :])) for k in range(len(a) - 1)])
            total = total + np.sum((a - 1.0) * ew("log", array(v))) - norm
        return array(total)

    def guarded_log_densities(self, value):
        """-inf also where a share is 0 whose concentration may be below 1: the formula has +inf."""
        pairs = zip(self.concentration.ravel(), array(value).ravel(), strict=True)
        steep = [v for a, v in pairs if not (a.op == "const" and a.data >= 1.0)]
        density = self.log_densities(value)
        if not steep:
            return density
        return array(ew("where", ew("lt", 0.0, np.min(array(steep))), density[()], -math.inf))

    def sample(self, draws):
        rows = [self._draw(a, draws) for a in self._rows()]
        return array(np.concatenate([r.view(np.ndarray) for r in rows]).reshape(self.shape))

    @staticmethod
    def _draw(concentration, draws):
        if not needs_log_gamma(concentration):
            g = array([draws.gamma(a) for a in concentration])
            return array(g / np.sum(g))
        log_g = array([log_gamma_draw(draws, a) for a in concentration])
        g = array(ew("exp", log_g - np.max(log_g)))
        return array(ew("maximum", LEAST_SHARE, g / np.sum(g)))  # none was rounded to 0

    def mean(self):
        return array(self.concentration / np.sum(self.concentration, axis=-1, keepdims=True))

    def variance(self):
        m, total = self.mean(), np.sum(self.concentration, axis=-1, keepdims=True)
        return array(m * (1.0 - m) / (total + 1.0))


def _log_gamma_p(x: Any, p: int) -> Any:
    """log of the multivariate gamma function of dimension p."""
    total = constant(0.25 * p * (p - 1) * math.log(math.pi))
    for j in range(p):
        total = total + log_gamma(array(x - 0.5 * j))
    return total


class _WishartFamily(_Joint):
    symmetric = True

    def __init__(self, df: Any, *, scale: Any):
        self._set(df=df, scale=scale)
        p = len(checked_matrix(self, "scale"))
        if self.df.ndim:
            raise ModelError(
                f"{type(self).__name__}: df has shape {self.df.shape}",
                fix="give one number of degrees of freedom",
                where=self.location,
            )
        self._require("df", p - 1.0)
        self.shape = (p, p)

    def support(self):
        return Support("positive definite", self._full(-math.inf), self._full(math.inf))

    def guarded_log_densities(self, value):
        return self._where_definite(self.scale, super().guarded_log_densities(value))

    def _bartlett(self, draws: Draws) -> ExprArray:
        """A with A A' ~ Wishart(df, identity)."""
        p, zero = len(self.scale), constant(0.0)
        out = np.empty((p, p), dtype=object)
        for i in range(p):
            for j in range(p):
                if i == j:
                    out[i, j] = ew("sqrt", 2.0 * draws.gamma(0.5 * (self.df[()] - i)))
                else:
                    out[i, j] = draws.normal() if j < i else zero
        return array(out)


class Wishart(_WishartFamily):
    """Wishart(df, scale=V): positive definite matrices (p, p) of mean df V.

    Parameters
    ----------
    df : degrees of freedom, more than p - 1.
    scale : V, (p, p), symmetric and positive definite.
    """

    def log_densities(self, value):
        x, p, nu = array(value), len(self.scale), self.df[()]
        trace = np.sum(inverse(self.scale) * x)
        norm = 0.5 * nu * (p * math.log(2.0) + log_determinant(self.scale))
        log_det = log_determinant(x)
        return array(
            0.5 * (nu - p - 1.0) * log_det - 0.5 * trace - norm - _log_gamma_p(0.5 * nu, p)
        )

    def sample(self, draws):
        root = cholesky(self.scale) @ self._bartlett(draws)
        return array(root @ root.T)

    def mean(self):
        return array(self.df[()] * self.scale)

    def variance(self):
        d = array(np.diagonal(self.scale.view(np.ndarray)))
        return array(self.df[()] * (self.scale**2 + np.outer(d, d)))


class InverseWishart(_WishartFamily):
    """InverseWishart(df, scale=S): X^-1 ~ Wishart(df, scale=S^-1).

    The conjugate prior of a covariance matrix.

    Parameters
    ----------
    df : degrees of freedom, more than p - 1.
    scale : S, (p, p), symmetric and positive definite; the mean is S / (df - p - 1) where
        df > p + 1.
    """

    def log_densities(self, value):
        x, p, nu = array(value), len(self.scale), self.df[()]
        trace = np.sum(self.scale * inverse(x))
        norm = 0.5 * nu * (log_determinant(self.scale) - p * math.log(2.0))
        log_det = log_determinant(x)
        return array(
            norm - 0.5 * (nu + p + 1.0) * log_det - 0.5 * trace - _log_gamma_p(0.5 * nu, p)
        )

    def sample(self, draws):
        # X = C (A A')^-1 C' for S = C C', from X^-1 = C^-T (A A') C^-1
        root = cholesky(self.scale) @ lower_inverse(self._bartlett(draws)).T
        return array(root @ root.T)

    def mean(self):
        p, nu = len(self.scale), self.df[()]
        return array(ew("where", ew("lt", p + 1.0, nu), self.scale / (nu - p - 1.0), math.nan))

    def variance(self):
        p, nu = len(self.scale), self.df[()]
        d = array(np.diagonal(self.scale.view(np.ndarray)))
        top = (nu - p + 1.0) * self.scale**2 + (nu - p - 1.0) * np.outer(d, d)
        bottom = (nu - p) * (nu - p - 1.0) ** 2 * (nu - p - 3.0)
        return array(ew("where", ew("lt", p + 3.0, nu), top / bottom, math.nan))


class LKJ(_Joint):
    """LKJ(dim, eta): correlation matrices R (dim, dim), density in proportion to det(R)^(eta - 1).

    For the correlations of noises, beside scales with priors of their own:
    ``ssm.MvNormal(mean, covariance=sd[:, None] * R * sd[None, :])``. A prior of parameters only.

    Parameters
    ----------
    dim : number of rows, a whole number of at least 2.
    eta : positive; at 1 all correlation matrices are equally likely, above it those near the
        identity are, below it those near singular ones. One correlation alone is ``2 B - 1`` with B
        of distribution ``Beta(b, b)``, b = eta + dim / 2 - 1.

    Notes
    -----
    Lewandowski, Kurowicka and Joe (2009), with the normalising constant of their equation (16). It
    is `LKJCorr` of PyMC and NumPyro, `lkj_corr` of Stan. Its Cholesky factor, `LKJCholesky` there,
    is ``np.linalg.cholesky(R)``.

    Raises
    ------
    ModelError : dim is no whole number from 2 on; eta is no positive number.
    """

    symmetric = unit_diagonal = True
    prior_only = True

    def __init__(self, dim: int, eta: Any):
        if isinstance(dim, bool) or not isinstance(dim, (int, np.integer)) or dim < 2:
            raise ModelError(
                f"LKJ: dim is {dim!r}",
                fix="give the number of rows, a whole number of at least 2: ssm.LKJ(2, eta=2)",
                where=user_location(),
            )
        self._set(eta=eta)
        if self.eta.ndim:
            raise ModelError(
                f"LKJ: eta has shape {self.eta.shape}",
                fix="give one number: eta=2",
                where=self.location,
            )
        self._require("eta", 0.0)
        self.dim = int(dim)
        self.shape = (self.dim, self.dim)

    def __repr__(self) -> str:
        return f"LKJ(dim={self.dim}, eta={self.eta[()]!r})"

    def rebuilt(self, parameters):
        return self._at_place(LKJ(self.dim, parameters.get("eta", self.eta)))

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


def with_unit_diagonal(matrix: Any) -> ExprArray:
    """A correlation matrix without symbols for what is 1."""
    out = np.array(array(matrix).view(np.ndarray))
    out[np.diag_indices(len(out))] = constant(1.0)
    return array(out)


class Ordered(_Joint):
    """Ordered(law): components in increasing order, those of `law` given that they come out so.

    The density is that of independent components, ``prod_k f_k(x_k)``, where x_1 < x_2 < ... and 0
    elsewhere, divided by the probability of that order: 1 / K! for K components of one
    distribution, so that they are its order statistics. For labels that could be exchanged: the
    rates of a hidden Markov model's regimes, the means of a mixture. A prior of parameters only.

    Parameters
    ----------
    law : continuous and independent over its elements, of shape (K,), K of at least 2, such as
        ``Normal(np.zeros(3), sd=5)``; or (R, K), each row in increasing order. Where components
        have different distributions these are given as numbers, and nothing can be drawn from it.

    Notes
    -----
    The posterior is that of Stan's `ordered` and `positive_ordered` and of PyMC's
    ``transform=ordered``, whose densities lack the probability of the order, as it is constant.
    Draws from the prior are in order, as are not those of PyMC's `sample_prior_predictive`. The
    distribution function of order statistics and their moments: David and Nagaraja (2003), "Order
    statistics", chapters 2 and 3.

    Raises
    ------
    ModelError : `law` is no continuous distribution of independent components, has no two of them,
        or has some of different distributions of parameters, or of different supports.
    """

    prior_only = True
    truncatable = False
    base: Distribution

    def __init__(self, law: Distribution):
        where = user_location()
        if not isinstance(law, Distribution) or law.joint or law.discrete:
            raise ModelError(
                f"Ordered: {law!r} is no continuous distribution of independent components",
                fix="give one such as ssm.Ordered(ssm.Normal(np.zeros(2), sd=5))",
                where=where,
            )
        if len(law.shape) not in (1, 2) or law.shape[-1] < 2:
            raise ModelError(
                f"Ordered: {type(law).__name__} has shape {law.shape}",
                fix="give an array of at least two components by one of its arguments, as "
                "ssm.Ordered(ssm.Normal(np.zeros(2), sd=5))",
                where=where,
            )
        self._set(**{f"like_{n}": a for n, a in law.parameters.items()})
        self.base = law.rebuilt({n: self.parameters[f"like_{n}"] for n in law.parameters})
        self.shape = law.shape
        self.proper, self.closed, self.open_above = law.proper, law.closed, law.open_above
        self._alike = all(map(_all_one, law.parameters.values()))
        self.drawable = law.drawable and self._alike
        self._log_order = self._log_probability()

    def _log_probability(self) -> float:
        """log P(the components come out in increasing order)."""
        k = self.shape[-1]
        if self._alike:
            return -math.lgamma(k + 1.0) * math.prod(self.shape[:-1])
        for end in (self.base.support().lower, self.base.support().upper):
            if not _all_one(array(end)):
                raise ModelError(
                    f"Ordered: the components of {self.base!r} have different bounds",
                    fix="give them bounds in common, by one number for each argument that is one",
                    where=self.location,
                )
        if any(e.op != "const" for e in self.base.expressions()) or not self.base.proper:
            raise ModelError(
                f"Ordered: the components of {self.base!r} have different distributions of "
                "parameters: the probability of their order has no formula",
                fix="give all components the same arguments, or numbers",
                where=self.location,
            )
        if not self.base.inverts():
            raise ModelError(
                f"Ordered: the components of {self.base!r} differ, and have no quantiles, between "
                "which the probability of their order is summed up",
                fix="give all components the same arguments",
                where=self.location,
            )
        rows = np.ndindex(self.shape[:-1])
        found = sum(_log_in_order([self.base.element((*r, i)) for i in range(k)]) for r in rows)
        if found < LEAST_LOG_ORDER:
            raise ModelError(
                f"Ordered: the components of {self.base!r} all but never come out in increasing "
                f"order: with probability exp({found:.3g})",
                fix="give the component that is meant to be the lowest first",
                where=self.location,
            )
        return found

    def __repr__(self) -> str:
        return f"Ordered({self.base!r})"

    def rebuilt(self, parameters):
        values = {**self.parameters, **parameters}
        law = self.base.rebuilt({n: values[f"like_{n}"] for n in self.base.parameters})
        return self._at_place(Ordered(law))

    def support(self):
        own = self.base.support()
        return Support("ordered", array(own.lower), array(own.upper))

    def in_range(self):
        each = self.base.in_range()
        return None if each is None else array(np.min(each))

    def log_densities(self, value):
        return array(np.sum(array(self.base.log_densities(array(value)))) - self._log_order)

    def guarded_log_densities(self, value):
        value = array(value)
        density = np.sum(array(self.base.guarded_log_densities(value))) - self._log_order
        steps = array(ew("lt", value[..., :-1], value[..., 1:])).ravel()
        for step in steps:
            density = ew("where", step, density, -math.inf)
        return array(density)

    def undrawable(self, why):
        if not self.base.drawable:
            return self.base.undrawable(why)
        return ModelError(
            f"Ordered of different distributions has no sampler, and {why}",
            fix="give all components the same arguments",
            where=self.location,
        )

    def sample(self, draws):
        drawn = np.array(array(self.base.sample(draws)).view(np.ndarray))
        k = self.shape[-1]
        for last in range(k - 1, 0, -1):  # the largest of those left goes to their end
            for i in range(last):
                a, b = drawn[..., i].copy(), drawn[..., i + 1].copy()
                drawn[..., i], drawn[..., i + 1] = ew("minimum", a, b), ew("maximum", a, b)
        return array(drawn)

    def mean(self):
        return self._full(math.nan)

    def variance(self):
        return self._full(math.nan)


def _all_one(values: ExprArray) -> bool:
    """Whether all components of each row have the same value."""
    rows = values.reshape(-1, values.shape[-1]).view(np.ndarray)
    return all(e is row[0] for row in rows for e in row)


def _log_in_order(laws: Sequence[Distribution]) -> float:
    """log P(X_1 < X_2 < ...) of independent X_k, by P(.. < X_k < x) = int f_k(t) P(.. < X_{k-1} <
    t) dt, with Gauss-Legendre nodes between quantiles of all of them."""
    edges = _edges_of(laws)
    at, weights = np.polynomial.legendre.leggauss(NODES)
    # int_-1^{node} of the polynomial through values at the nodes
    powers = np.polynomial.legendre.legvander(at, NODES - 1)
    whole = [np.polynomial.legendre.legint(c, lbnd=-1) for c in np.eye(NODES)]
    upto = np.array([np.polynomial.legendre.legval(at, c) for c in whole]).T
    cumulative = upto @ np.linalg.inv(powers)
    half = 0.5 * np.diff(edges)[:, None]
    x = 0.5 * (edges[1:] + edges[:-1])[:, None] + half * at
    log_below, scale = np.zeros_like(x), 0.0
    for law in laws:
        point = symbol("value", "value")
        with np.errstate(all="ignore"):
            density = np.exp(evaluate(array(law.log_densities(array(point)))[()], {point: x}))
        f = half * np.where(np.isfinite(density), density, 0.0) * np.exp(log_below)
        panels = f @ weights
        total = float(panels.sum())
        if not total > 0.0:
            return -math.inf
        before = np.concatenate([[0.0], np.cumsum(panels)[:-1]])
        below = np.maximum(before[:, None] + f @ cumulative.T, 0.0) / total
        scale += math.log(total)
        with np.errstate(divide="ignore"):
            log_below = np.log(below)
    return scale


def _edges_of(laws: Sequence[Distribution]) -> np.ndarray:
    """Points between which the densities of all the distributions are smooth, in order."""
    tails = 10.0 ** -np.arange(2.0, 17.0)
    inner = np.linspace(0.02, 0.98, 49)
    found: list[Any] = []
    for law in laws:
        for quantile, p in (
            (law.quantile, np.concatenate([tails[::-1], inner])), (law.survival_quantile, tails)
        ):  # fmt: skip
            found.append(np.ravel(evaluate(quantile(array(p)), {})))
        kink = law.kink()
        found += [] if kink is None else [np.ravel(evaluate(array(kink), {}))]
    edges = np.unique(np.concatenate(found))
    return np.asarray(edges[np.isfinite(edges)], dtype=float)


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
