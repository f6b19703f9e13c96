"""Conjugate families of matrices: Wishart laws, alone and with a Normal matrix.

Bernardo and Smith (1994), "Bayesian theory", appendix A, for the Wishart laws; Rowe (2003),
"Multivariate Bayesian statistics", section 4.3, for the matrix Normal joint with them. The protocol
is that of `families.py`.
"""

from __future__ import annotations

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
