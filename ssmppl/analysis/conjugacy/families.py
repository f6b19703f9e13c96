"""The conjugate families: functions of a block on the left, its law on the right.

    log p(block | rest) = const + sum_i C_i s_i(block)

=================================================  =============================================
functions s_i in the span                          law
=================================================  =============================================
log v, v**k                                        v**k ~ Gamma   (k = 1: precisions, rates;
                                                   k = -1: variances; k = -2: sds)
theta, theta**2; theta_i, theta_i theta_j          Normal, joint Normal
log v, v**k, v**k theta_i, v**k theta_i theta_j    Normal-Gamma: v**k ~ Gamma, theta | v Normal
log p, log(1 - p)                                  Beta
log p_1, ..., log p_K                              Dirichlet
log det P, P_ij                                    Wishart
log det C, (C^-1)_ij                               inverse Wishart
log det W, W_ij, W_ij theta_jk, W_ij theta_ik      matrix Normal-Wishart (W = P) or
theta_jl                                           matrix Normal-inverse-Wishart (W = C^-1)
=================================================  =============================================

(Bernardo and Smith (1994), "Bayesian theory", appendix A.) Each class holds the positions of its
functions among those of the block, from which `parameters` computes the law's parameters out of the
statistics C. C is a list with a 0 at its end, so that position -1 stands for a function that is
absent. `draw` returns None where the law with these statistics is improper.

Conjugate families of matrices: Wishart laws, alone and with a Normal matrix.

Bernardo and Smith (1994), "Bayesian theory", appendix A, for the Wishart laws; Rowe (2003),
"Multivariate Bayesian statistics", section 4.3, for the matrix Normal joint with them. The protocol
is the same.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

Statistics = Sequence[float]
Values = tuple[float, ...]


@dataclass(frozen=True)
class Wishart:
    """P ~ Wishart(df, scale=V), log det P ** ((df - p - 1) / 2), exp(-tr(V^-1 P) / 2).

    entries : positions of the functions P_ij (or (C^-1)_ij), row by row; of the symmetric matrix
    P only those of the lower half. inverse : the block is C = P^-1, an inverse Wishart, whose
    log determinant enters as -(df + p + 1) / 2.
    """

    size: int
    log: int
    entries: tuple[int, ...]
    inverse: bool

    @property
    def name(self) -> str:
        return "inverse Wishart" if self.inverse else "Wishart"

    @property
    def used(self) -> frozenset[int]:
        return frozenset({self.log, *self.entries}) - {-1}

    def parameters(self, c: Statistics) -> tuple[float, np.ndarray]:
        """(df, S): S the inverse scale of a Wishart, the scale of an inverse Wishart."""
        p = self.size
        total = np.asarray(c)[np.array(self.entries)].reshape(p, p)
        matrix = -(total + total.T)
        sign = -1.0 if self.inverse else 1.0
        return sign * 2.0 * c[self.log] + (-p - 1.0 if self.inverse else p + 1.0), matrix

    def draw(self, c: Statistics, rng: np.random.Generator) -> Values | None:
        found = draw_wishart(*self.parameters(c), self.inverse, rng)
        return None if found is None else lower_values(found[0])

    def log_q(self, c: Statistics, v: np.ndarray) -> float:
        df, matrix = self.parameters(c)
        p = self.size
        return log_wishart(df, matrix, symmetric(v, p), self.inverse)


@dataclass(frozen=True)
class MatrixNormalWishart:
    """A (p, k) and a symmetric W (p, p), W = P or W = C^-1:

    log q = C[log] log det(P or C) - tr(W (S_yy - A S_zy - S_yz A' + A K A')) / 2,
    A | W ~ Normal with mean M = S_yz K^-1 and cov(A_ik, A_jl) = (W^-1)_ij (K^-1)_kl,
    W by its Wishart law with S = S_yy - S_yz K^-1 S_zy; its log det loses k / 2 to A.

    rows : A's entries as positions among the thetas. linear, quadratic : positions of the functions
    W_ii theta_ik (S_yz) and W_00 theta_0k theta_0l (K); what multiplies the others follows from
    them. members : all functions of the family. The block is (thetas, the matrix's lower half).
    """

    wishart: Wishart
    rows: tuple[tuple[int, ...], ...]
    linear: tuple[tuple[int, ...], ...]
    quadratic: tuple[tuple[int, ...], ...]
    members: frozenset[int]

    @property
    def name(self) -> str:
        return f"matrix Normal-{'inverse-' if self.wishart.inverse else ''}Wishart"

    @property
    def used(self) -> frozenset[int]:
        return self.members

    @property
    def thetas(self) -> int:
        """How many entries A has."""
        return len(self.rows) * len(self.rows[0])

    def parameters(self, c: Statistics) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
        """(df, S_yy, S_yz, K): df that of W's law, A integrated out."""
        values = np.asarray(c)
        df, total = self.wishart.parameters(c)
        k = -values[np.array(self.quadratic)]
        k[np.diag_indices(len(k))] *= 2.0
        return df - len(k), total, values[np.array(self.linear)], k

    def solve(self, c: Statistics) -> tuple[float, np.ndarray, np.ndarray, np.ndarray] | None:
        """(df, S, M, R^-1 for K = R R'); None where K is not positive definite."""
        df, total, cross, k = self.parameters(c)
        try:
            root = np.linalg.inv(np.linalg.cholesky(k))
        except np.linalg.LinAlgError:
            return None
        half = cross @ root.T
        if not np.all(np.isfinite(half)):
            return None
        return df, total - half @ half.T, half @ root, root

    def draw(self, c: Statistics, rng: np.random.Generator) -> Values | None:
        solved = self.solve(c)
        if solved is None:
            return None
        df, matrix, mean, root = solved
        found = draw_wishart(df, matrix, self.wishart.inverse, rng)
        if found is None:
            return None
        value, spread = found
        a = mean + spread @ rng.standard_normal(mean.shape) @ root
        return (*self.entries(a), *lower_values(value))

    def entries(self, a: np.ndarray) -> Values:
        """A's entries in the order of the thetas."""
        flat = dict(zip((x for row in self.rows for x in row), a.ravel().tolist(), strict=True))
        return tuple(flat[i] for i in range(len(flat)))

    def log_q(self, c: Statistics, v: np.ndarray) -> float:
        df, total, cross, k = self.parameters(c)
        a = v[np.array(self.rows)]
        matrix = total - a @ cross.T - cross @ a.T + a @ k @ a.T
        value = symmetric(v[self.thetas :], self.wishart.size)
        return log_wishart(df + len(k), matrix, value, self.wishart.inverse)


def draw_wishart(
    df: float, matrix: np.ndarray, inverse: bool, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray] | None:
    """(the matrix drawn, R with R R' the covariance that it is or inverts); None if improper.

    df, matrix : as of `Wishart.parameters`. Bartlett's decomposition: K^-1 P K^-T = (A A')^-1.
    """
    p = len(matrix)
    if not df > p - 1.0:
        return None
    try:
        root = np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        return None
    bartlett = np.tril(rng.standard_normal((p, p)), -1)
    bartlett += np.diag(np.sqrt(2.0 * rng.standard_gamma(0.5 * (df - np.arange(p)))))
    try:
        spread = root @ np.linalg.inv(bartlett).T  # S = K K', C = K (A A')^-1 K'
        if inverse:
            return spread @ spread.T, spread
        half = np.linalg.solve(root.T, bartlett)  # P = K^-T A A' K^-1
    except np.linalg.LinAlgError:  # a gamma that underflowed
        return None
    return half @ half.T, spread


def log_wishart(df: float, matrix: np.ndarray, value: np.ndarray, inverse: bool) -> float:
    """Log density up to a constant; df, matrix as of `Wishart.parameters`."""
    p, log_det = len(matrix), float(np.linalg.slogdet(value)[1])
    if inverse:
        trace = float(np.trace(np.linalg.solve(value, matrix)))
        return -0.5 * (df + p + 1.0) * log_det - 0.5 * trace
    return 0.5 * (df - p - 1.0) * log_det - 0.5 * float(np.sum(matrix * value))


def lower_half(p: int) -> list[tuple[int, int]]:
    """(i, j) of a symmetric matrix's components, in the order of `Site.components`."""
    return list(dict.fromkeys((max(i, j), min(i, j)) for i in range(p) for j in range(p)))


def symmetric(v: Sequence[float] | np.ndarray, p: int) -> np.ndarray:
    """The symmetric matrix with these components."""
    out = np.empty((p, p))
    for (i, j), x in zip(lower_half(p), v, strict=True):
        out[i, j] = out[j, i] = x
    return out


def lower_values(value: np.ndarray) -> Values:
    """The components of a symmetric matrix."""
    return tuple(float(value[cell]) for cell in lower_half(len(value)))


@dataclass(frozen=True)
class Gamma:
    """v**power ~ Gamma(shape, rate)."""

    power: float
    log: int
    pow: int

    @property
    def name(self) -> str:
        law = "Gamma" if self.power > 0 else "inverse Gamma"
        size = abs(self.power)
        suffix = {1.0: "", 2.0: " of the square"}.get(size, f" of the power {size:g}")
        return law + suffix

    @property
    def used(self) -> frozenset[int]:
        return frozenset({self.log, self.pow}) - {-1}

    def parameters(self, c: Statistics) -> tuple[float, float]:
        """(shape, rate) of v**power: its density carries the Jacobian of the power."""
        return (c[self.log] + 1.0) / self.power, -c[self.pow]

    def draw(self, c: Statistics, rng: np.random.Generator) -> Values | None:
        shape, rate = self.parameters(c)
        if not (shape > 0.0 and rate > 0.0):
            return None
        g = rng.standard_gamma(shape) / rate
        return (root_of(g, self.power),)

    def log_q(self, c: Statistics, v: np.ndarray) -> float:
        shape, rate = self.parameters(c)
        log_v = math.log(v[0])
        return (shape * self.power - 1.0) * log_v - rate * math.exp(self.power * log_v)


def root_of(g: float, power: float) -> float:
    """v for v**power = g >= 0; 0 or inf where it leaves what floating point holds."""
    if power == 1.0:
        return g
    if power == -1.0:
        return 1.0 / g if g > 0.0 else math.inf
    try:
        return g ** (1.0 / power) if g > 0.0 else (0.0 if power > 0 else math.inf)
    except OverflowError:
        return math.inf


@dataclass(frozen=True)
class Normal:
    """theta ~ Normal(H^-1 h, H^-1), h = C[linear], H = -C[quadratic] (twice on the diagonal)."""

    linear: tuple[int, ...]
    quadratic: tuple[tuple[int, ...], ...]

    @property
    def name(self) -> str:
        return "Normal" if len(self.linear) == 1 else "joint Normal"

    @property
    def used(self) -> frozenset[int]:
        return frozenset({*self.linear, *(i for row in self.quadratic for i in row)}) - {-1}

    def parameters(self, c: Statistics) -> tuple[np.ndarray, np.ndarray]:
        """(h, H)."""
        values = np.asarray(c)
        precision = -values[np.array(self.quadratic)]
        precision[np.diag_indices(len(self.linear))] *= 2.0
        return values[np.array(self.linear)], precision

    def draw(self, c: Statistics, rng: np.random.Generator, scale: float = 1.0) -> Values | None:
        if len(self.linear) == 1:
            h, precision = c[self.linear[0]], -2.0 * c[self.quadratic[0][0]]
            if not precision > 0.0:
                return None
            return (h / precision + rng.standard_normal() / math.sqrt(scale * precision),)
        solved = self.solve(c)
        return None if solved is None else self.draw_solved(solved, rng, scale)

    def solve(self, c: Statistics) -> tuple[np.ndarray, np.ndarray, float] | None:
        """(mean, K^-T, h' H^-1 h) for H = K K'; None where H is not positive definite."""
        h, precision = self.parameters(c)
        try:
            root = np.linalg.inv(np.linalg.cholesky(precision))
        except np.linalg.LinAlgError:
            return None
        z = root @ h
        if not np.all(np.isfinite(root)) or not np.all(np.isfinite(z)):
            return None
        return root.T @ z, root.T, float(z @ z)

    @staticmethod
    def draw_solved(
        solved: tuple[np.ndarray, np.ndarray, float], rng: np.random.Generator, scale: float
    ) -> Values:
        mean, root, _ = solved
        z = rng.standard_normal(len(mean))
        return tuple((mean + root @ z / math.sqrt(scale)).tolist())

    def log_q(self, c: Statistics, v: np.ndarray) -> float:
        h, precision = self.parameters(c)
        return float(h @ v - 0.5 * v @ precision @ v)


@dataclass(frozen=True)
class NormalGamma:
    """v**power = g ~ Gamma(shape, rate), theta | g ~ Normal(H^-1 h, (g H)^-1).

    With n = len(theta): shape = (C[log] + 1) / power - n / 2, rate = -(C[pow] + h' H^-1 h / 2).
    The block is (theta, v).
    """

    power: float
    log: int
    pow: int
    normal: Normal

    @property
    def name(self) -> str:
        inverse = "inverse-" if self.power < 0 else ""
        return f"Normal-{inverse}Gamma"

    @property
    def used(self) -> frozenset[int]:
        return self.normal.used | (frozenset({self.log, self.pow}) - {-1})

    def draw(self, c: Statistics, rng: np.random.Generator) -> Values | None:
        normal = self.normal
        n = len(normal.linear)
        shape = (c[self.log] + 1.0) / self.power - 0.5 * n
        if n == 1:
            h, precision = c[normal.linear[0]], -2.0 * c[normal.quadratic[0][0]]
            if not precision > 0.0:
                return None
            rate = -(c[self.pow] + 0.5 * h * h / precision)
            if not (shape > 0.0 and rate > 0.0):
                return None
            g = rng.standard_gamma(shape) / rate
            if g <= 0.0:
                return (math.nan, math.nan)
            theta = h / precision + rng.standard_normal() / math.sqrt(g * precision)
            return theta, root_of(g, self.power)
        solved = normal.solve(c)
        if solved is None:
            return None
        rate = -(c[self.pow] + 0.5 * solved[2])
        if not (shape > 0.0 and rate > 0.0):
            return None
        g = rng.standard_gamma(shape) / rate
        if g <= 0.0:
            return (math.nan,) * (n + 1)
        return (*normal.draw_solved(solved, rng, g), root_of(g, self.power))

    def given(self, c: Statistics, theta: np.ndarray) -> tuple[float, float]:
        """(shape, rate) of v**power given theta."""
        h, precision = self.normal.parameters(c)
        quadratic = float(h @ theta - 0.5 * theta @ precision @ theta)
        return (c[self.log] + 1.0) / self.power, -(c[self.pow] + quadratic)

    def log_q(self, c: Statistics, v: np.ndarray) -> float:
        theta, n = v[:-1], len(self.normal.linear)
        h, precision = self.normal.parameters(c)
        mean = np.linalg.solve(precision, h)
        log_g = self.power * math.log(v[-1])
        shape = (c[self.log] + 1.0) / self.power - 0.5 * n
        rate = -(c[self.pow] + 0.5 * float(h @ mean))
        d = theta - mean
        gamma = (shape - 1.0) * log_g - rate * math.exp(log_g)
        jacobian = log_g - math.log(v[-1])
        return gamma + jacobian + 0.5 * n * log_g - 0.5 * math.exp(log_g) * float(d @ precision @ d)


@dataclass(frozen=True)
class Beta:
    """p ~ Beta(C[log p] + 1, C[log(1 - p)] + 1)."""

    first: int
    second: int
    name = "Beta"

    @property
    def used(self) -> frozenset[int]:
        return frozenset({self.first, self.second}) - {-1}

    def parameters(self, c: Statistics) -> tuple[float, float]:
        return c[self.first] + 1.0, c[self.second] + 1.0

    def draw(self, c: Statistics, rng: np.random.Generator) -> Values | None:
        a, b = self.parameters(c)
        return (rng.beta(a, b),) if a > 0.0 and b > 0.0 else None

    def log_q(self, c: Statistics, v: np.ndarray) -> float:
        a, b = self.parameters(c)
        return (a - 1.0) * math.log(v[0]) + (b - 1.0) * math.log1p(-v[0])


@dataclass(frozen=True)
class Dirichlet:
    """p ~ Dirichlet(C[log p_k] + 1)."""

    logs: tuple[int, ...]
    name = "Dirichlet"

    @property
    def used(self) -> frozenset[int]:
        return frozenset(self.logs) - {-1}

    def parameters(self, c: Statistics) -> np.ndarray:
        return np.asarray(c)[np.array(self.logs)] + 1.0

    def draw(self, c: Statistics, rng: np.random.Generator) -> Values | None:
        a = self.parameters(c)
        return tuple(rng.dirichlet(a).tolist()) if np.all(a > 0.0) else None

    def log_q(self, c: Statistics, v: np.ndarray) -> float:
        return float((self.parameters(c) - 1.0) @ np.log(v))


Family = Gamma | Normal | NormalGamma | Beta | Dirichlet | Wishart | MatrixNormalWishart
