"""Distributions of vectors and matrices with one joint density: MvNormal, Dirichlet, Wishart and
InverseWishart (others are in `vectors`); `SequentialNormal`, channels that are Gaussian one
after the other, is made by analyses only.

Gelman et al. (2013), "Bayesian data analysis", appendix A, for densities and moments; samplers:
Cholesky (MvNormal), normalised gammas (Dirichlet), Bartlett's decomposition (Wishart), Smith and
Hocking (1972), algorithm AS 53. Matrices that are parameters are checked where the distribution is
made.
"""

from __future__ import annotations

import math
from functools import reduce
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
from ssmppl.expressions.expr import Expr, as_expr, constant, topological
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
    if name == "covariance":  # components without noise, which states may have
        noisy = np.any(numbers != 0.0, axis=0) | np.any(numbers != 0.0, axis=1)
        if noisy.any():
            numbers = numbers[np.ix_(noisy, noisy)]
    lower = name == "cholesky"
    symmetric = lower or np.allclose(numbers, numbers.T, rtol=1e-10, atol=0)
    if lower:
        positive = bool(np.all(np.diagonal(numbers) > 0))
    else:
        least = np.linalg.eigvalsh(numbers)[0] if symmetric else -1.0
        # a singular one too, q G G', which states may have; see `covariances.py`
        rounding = ROUNDING * np.abs(numbers).max() if name == "covariance" else 0.0
        positive = bool(least > -rounding)
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
                fix="give both the same value; of a matrix M of an input, (M + M.T) / 2",
                where=law.location,
            )


class Joint(Distribution):
    """One density for all components."""

    joint = True

    def _where_definite(self, m: ExprArray, density: ExprArray) -> ExprArray:
        """`where_definite`, unless m surely is."""
        return density if surely_positive(m) else array(where_definite(m, density[()]))


class Centred(Joint):
    """A vector's centre, and a matrix: a covariance or what is like one, its inverse, or its lower
    Cholesky factor, whichever of them was given."""

    spread: str  # the name of the matrix
    centre: ExprArray  # (d,)
    margins = True  # whether some components alone have the same family
    root: ExprArray | None = None  # of a singular covariance, (d, d); see `covariances.py`

    def _set_centre(self, name: str, centre: Any, spreads: dict[str, Any], **others: Any) -> None:
        kind = type(self).__name__
        self.spread, value = one_of(kind, spreads)
        self._set(**others, **{name: centre, self.spread: value})
        matrix, own = checked_matrix(self, self.spread), self.parameters[name]
        if own.ndim == 0:
            own = self.parameters[name] = array(np.full(len(matrix), own[()]))
        if own.shape != (len(matrix),):
            said = name.rstrip("_")
            raise ModelError(
                f"{kind}: {said} has shape {own.shape}, {self.spread} {matrix.shape}",
                fix=f"give a {said} of shape (d,) and a matrix of shape (d, d)",
                where=self.location,
            )
        self.shape, self.centre = own.shape, own

    def whole_matrix(self) -> ExprArray:
        """(d, d) the covariance, or what is like one, however it was given."""
        m = self.parameters[self.spread]
        if self.spread == "precision":
            return inverse(m)
        if self.spread != "cholesky":
            return m
        whole = squared(m)
        return array(m @ m.T) if whole is None else whole

    def _square_and_volume(self, away: Any) -> tuple[Any, Any]:
        """(d' C^-1 d, -log det C / 2) of the matrix C."""
        m = self.parameters[self.spread]
        whole = squared(m) if self.spread == "cholesky" else None
        if whole is not None:  # the density of a covariance, by whichever name it came
            m = whole
        elif self.spread == "cholesky":
            z = lower_inverse(m) @ away
            logs = array([ew("log", e) for e in np.diagonal(m.view(np.ndarray))])
            return np.sum(z**2), -np.sum(logs)
        if self.spread == "precision":
            return away @ m @ away, 0.5 * log_determinant(m)
        return away @ inverse(m) @ away, -0.5 * log_determinant(m)

    def of_form(self, square: Any, volume: Any, n: Any) -> Any:
        """Log density of n of the components, of any if `margins`, given d' C^-1 d and -log det C /
        2 of their deviations and their part C of the matrix."""
        raise AttributeError

    def guarded_log_densities(self, value):
        density, m = self.log_densities(value), self.parameters[self.spread]
        return density if self.spread == "cholesky" else self._where_definite(m, density)

    def factor(self) -> ExprArray:
        """A matrix L, (d, d), with L L' = the covariance, or what is like one."""
        m = self.parameters[self.spread]
        if self.root is not None:
            return self.root
        if self.spread == "cholesky":
            return m
        if self.spread == "precision":
            return array(lower_inverse(cholesky(m)).T)  # P = K K', so (K^-T)(K^-T)' = P^-1
        return cholesky(m)


class MvNormal(Centred):
    """MvNormal(mean, covariance= | precision= | cholesky=): a vector (d,).

    Parameters
    ----------
    mean : shape (d,), or one number for all components.
    covariance, precision, cholesky : exactly one of them, (d, d): the covariance, its inverse, or
        its lower factor L with L L' = covariance. As the distribution of states a covariance may
        have rows and columns of zeros, as that of a companion form has: these components follow
        without noise, as of `Dirac`. It may also be singular otherwise, as q G G' is, for all
        values of its symbols or in some cases of the conditions in it: methods that need no density
        of the transition take it.
    """

    gaussian_noise = True
    maximisers: ClassVar = {"mean_": lambda law, value: value}
    mean_link = MeanLink("mean_", "identity")

    def __init__(
        self, mean: Any, *, covariance: Any = None, precision: Any = None, cholesky: Any = None
    ):
        spreads = {"covariance": covariance, "precision": precision, "cholesky": cholesky}
        self._set_centre("mean_", mean, spreads)
        power = {"covariance": 1.0, "precision": -1.0, "cholesky": 0.5}[self.spread]
        self.variance_link = VarianceLink(self.spread, power)

    def mean(self):
        return self.mean_

    def covariance_matrix(self) -> ExprArray:
        """(d, d), however the spread was given."""
        return self.whole_matrix()

    def variance(self):
        return array(np.diagonal(self.whole_matrix().view(np.ndarray)))

    def log_densities(self, value):
        if self.spread == "covariance" and singular_numbers(self.parameters["covariance"]):
            return array(constant(-math.inf))  # there is no density
        square, volume = self._square_and_volume(array(value) - self.mean_)
        return array(self.of_form(square, volume, len(self.mean_)))

    def of_form(self, square, volume, n):
        return -0.5 * n * LOG_2PI + volume - 0.5 * square

    def standard(self, value: Any) -> ExprArray:
        """The standard normal draws (d,) behind a value."""
        away = array(array(value) - self.mean_)
        if self.spread == "precision":
            return array(array(cholesky(self.parameters["precision"])).T @ away)
        return array(lower_inverse(self.factor()) @ away)

    def sample(self, draws):
        z = array([draws.normal() for _ in range(len(self.mean_))])
        return array(self.mean_ + self.factor() @ z)


def where_definite(m: ExprArray, density: Expr, singular: bool = False) -> Expr:
    """A density in which the matrix m stands, and -inf where m is not positive definite: its
    determinant may be positive all the same.

    singular : whether m may be singular, as in the density of a sum.
    """
    pivots = np.diagonal(cholesky(m).view(np.ndarray))  # 0 where m is singular, nan where negative
    least = "le" if singular else "lt"
    definite = reduce(lambda a, b: ew("and", a, b), [ew(least, 0.0, p) for p in pivots])
    return array(ew("where", definite, density, -math.inf))[()]


def singular_numbers(m: ExprArray) -> bool:
    """Whether a matrix is one of numbers whose rank is less than its size."""
    if any(e.op != "const" for e in m.ravel()):
        return False
    numbers = np.array([e.data for e in m.ravel()]).reshape(m.shape)
    return bool(np.linalg.matrix_rank(numbers, hermitian=True) < len(numbers))


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


class Dirichlet(Joint):
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


class _WishartFamily(Joint):
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
