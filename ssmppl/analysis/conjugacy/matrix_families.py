"""Conjugate families of symmetric matrices: Wishart distributions, alone and with a Normal matrix.

Bernardo and Smith (1994), "Bayesian theory", appendix A, for the Wishart distributions; Rowe
(2003), "Multivariate Bayesian statistics", section 4.3, for the matrix Normal joint with them. The
table of all families is in `families.py`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from ssmppl.analysis.bounds import WHOLE, Interval
from ssmppl.analysis.conjugacy.family import (
    Family,
    Limits,
    ScaledFamily,
    Statistics,
    Values,
    held,
)
from ssmppl.analysis.conjugacy.separation import BlockForm
from ssmppl.expressions.expr import Expr, item, matrix_op
from ssmppl.expressions.zero import cancels

if TYPE_CHECKING:
    from ssmppl.analysis.conjugacy.describe import MatrixWording, Wording

FLAT = 1e-12  # an eigenvalue relative to the largest, at which a matrix counts as singular


@dataclass(frozen=True)
class Wishart(Family):
    """P ~ Wishart(df, scale=V), log det P ** ((df - p - 1) / 2), exp(-tr(V^-1 P) / 2).

    entries : positions of the functions P_ij (or (C^-1)_ij), row by row; of the symmetric matrix
    P only those of the lower half. inverse : the block is C = P^-1, an inverse Wishart, whose
    log determinant enters as -(df + p + 1) / 2.
    """

    size: int
    log: int
    entries: tuple[int, ...]
    inverse: bool
    kind = "matrix"
    written_out = False

    @classmethod
    def match(cls, components: Sequence[Expr], form: BlockForm, positive: bool) -> list[Wishart]:
        """The lower half of one symmetric matrix: a Wishart or an inverse Wishart, by its
        functions."""
        size = size_of_matrix(len(components))
        cells = [(i, j) for i in range(size) for j in range(size)]
        entries = _cells(components, size, inverse=False)
        log_det = matrix_op("logdet", [entries[cell] for cell in cells], size)
        log = form.places.get(frozenset({(log_det, 1.0)}), -1)
        inverse = _cells(components, size, inverse=True)
        inverted = tuple(form.places.get(frozenset({(inverse[c], 1.0)}), -1) for c in cells)
        if any(i >= 0 for i in inverted):
            return [cls(size, log, inverted, True)]
        linear = tuple(
            form.places.get(frozenset({(entries[i, j], 1.0)}), -1) if i >= j else -1
            for i, j in cells
        )
        return [cls(size, log, linear, False)]

    @property
    def name(self) -> str:
        return "inverse Wishart" if self.inverse else "Wishart"

    @cached_property
    def used(self) -> frozenset[int]:
        return held({self.log, *self.entries})

    @property
    def support(self) -> list[Interval]:
        return [WHOLE] * len(lower_half(self.size))

    @property
    def matrix_size(self) -> int:
        return self.size

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
        return log_wishart(df, matrix, symmetric(v, self.size), self.inverse)

    def mode(self, c: Statistics, limits: Limits, present: np.ndarray) -> np.ndarray | None:
        value = self.mode_of(self.parameters(c)[1], c[self.log])
        return None if value is None else np.array(value)

    def mode_of(self, matrix: np.ndarray, log: float) -> Values | None:
        """P = 2 c S^-1 of c log det P - tr(S P) / 2; the inverse's C = S / (-2 c)."""
        values = np.linalg.eigvalsh(matrix)
        if not values[0] > FLAT * values[-1]:
            return None
        if self.inverse:
            return lower_values(matrix / (-2.0 * log)) if log < 0.0 else None
        return lower_values(2.0 * log * np.linalg.inv(matrix)) if log > 0.0 else None

    def law(self, words: Wording) -> str:
        p = self.size
        sign, plus = (-2.0, -p - 1.0) if self.inverse else (2.0, p + 1.0)
        matrix = "scale S" if self.inverse else "inverse scale S"
        law = "inverse Wishart" if self.inverse else "Wishart"
        return f"{words.name} ~ {law}(df = {words.linear(self.log, sign, plus)}, {matrix})"

    def matrix_statistics(self, words: MatrixWording) -> tuple[str, ...] | None:
        return words.wishart()


@dataclass(frozen=True)
class MatrixNormalWishart(ScaledFamily):
    """A (p, k) and a symmetric W (p, p), W = P or W = C^-1:

    log q = C[log] log det(P or C) - tr(W (S_yy - A S_zy - S_yz A' + A K A')) / 2,
    A | W ~ Normal with mean M = S_yz K^-1 and cov(A_ik, A_jl) = (W^-1)_ij (K^-1)_kl,
    W by its Wishart distribution with S = S_yy - S_yz K^-1 S_zy; its log det loses k / 2 to A.

    rows : A's entries as positions among the thetas. linear, quadratic : positions of the functions
    W_ii theta_ik (S_yz) and W_00 theta_0k theta_0l (K); what multiplies the others follows from
    them. members : all functions of the family. The block is (thetas, the matrix's lower half).
    """

    wishart: Wishart
    rows: tuple[tuple[int, ...], ...]
    linear: tuple[tuple[int, ...], ...]
    quadratic: tuple[tuple[int, ...], ...]
    members: frozenset[int]
    scale = Wishart
    written_out = False

    @classmethod
    def match_scaled(
        cls, thetas: Sequence[Expr], scale: Sequence[Expr], form: BlockForm
    ) -> MatrixNormalWishart | None:
        """A Normal matrix A whose rows the symmetric matrix of these components joins, W or W^-1.

        theta is in row i where W_ii theta**2 is a function; its column is its place among the
        thetas of the row. All that W multiplies must have the coefficients that one S_yz and one K
        give.
        """
        (wishart,) = Wishart.match(scale, form, positive=False)
        size, places = wishart.size, form.places
        cells = _cells(scale, size, wishart.inverse)

        def at(i: int, j: int, *others: Expr) -> tuple[int, ...]:
            """Positions of W_ij times these, by either name of the cell."""
            power = frozenset((x, float(sum(y is x for y in others))) for x in others)
            names = dict.fromkeys((cells[i, j], cells[j, i]))
            return tuple(places[m] for w in names if (m := power | {(w, 1.0)}) in places)

        rows: list[list[int]] = [[] for _ in range(size)]
        for place, theta in enumerate(thetas):
            mine = [i for i in range(size) if at(i, i, theta, theta)]
            if len(mine) != 1:
                return None
            rows[mine[0]].append(place)
        if len({len(row) for row in rows}) != 1:
            return None
        a = [[thetas[place] for place in row] for row in rows]
        columns = range(len(a[0]))
        linear = [[at(i, i, a[i][k]) for k in columns] for i in range(size)]
        quadratic = [[at(0, 0, a[0][k], a[0][m]) for m in columns] for k in columns]
        members = set(wishart.used)
        for i, j in cells:
            for k in columns:
                found = at(i, j, a[j][k])
                members.update(found)
                if not _same(form, found, linear[i][k]):
                    return None
                for m in columns:
                    found, twice = at(i, j, a[i][k], a[j][m]), i != j and k == m
                    members.update(found)
                    if not _same(form, found, quadratic[k][m] * (2 if twice else 1)):
                        return None
        return cls(
            wishart, tuple(map(tuple, rows)), _first(linear), _first(quadratic), frozenset(members)
        )

    @property
    def name(self) -> str:
        return f"matrix Normal-{'inverse-' if self.wishart.inverse else ''}Wishart"

    @cached_property
    def used(self) -> frozenset[int]:
        return self.members

    @property
    def support(self) -> list[Interval]:
        return [WHOLE] * self.thetas + self.wishart.support

    @property
    def matrix_size(self) -> int:
        return self.wishart.size

    @property
    def thetas(self) -> int:
        """How many entries A has."""
        return len(self.rows) * len(self.rows[0])

    def parameters(self, c: Statistics) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
        """(df, S_yy, S_yz, K): df that of W's distribution, A integrated out."""
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

    def mode(self, c: Statistics, limits: Limits, present: np.ndarray) -> np.ndarray | None:
        """A = S_yz K^-1 whatever the matrix is, and that from what A leaves of S_yy; None where A
        is not within the limits."""
        solved = self.solve(c)
        if solved is None:
            return None
        _, matrix, mean, _ = solved
        value = self.wishart.mode_of(matrix, c[self.wishart.log])
        a = self.entries(mean)
        within = all(low < x < high for x, (low, high) in zip(a, limits, strict=False))
        return np.array([*a, *value]) if value is not None and within else None

    def law(self, words: Wording) -> str:
        wishart, name = self.wishart, words.form.components[-1].data[1]
        sign, plus = (-2.0, -1.0) if wishart.inverse else (2.0, 1.0)
        df = words.linear(wishart.log, sign, plus * (wishart.size + 1.0) - len(self.rows[0]))
        law, scale = (
            ("inverse Wishart", "scale S") if wishart.inverse else ("Wishart", "scale S^-1")
        )
        rows = name if wishart.inverse else f"{name}^-1"
        return (
            f"{name} ~ {law}(df = {df}, {scale}), S = S_yy - S_yz K^-1 S_yz'; A | {name} ~ Normal("
            f"mean = S_yz K^-1, covariance = {rows} (x) K^-1)"
        )

    def matrix_statistics(self, words: MatrixWording) -> tuple[str, ...] | None:
        return words.matrix_normal(self.thetas, self.rows[0])


# -- symmetric matrices and their components
def size_of_matrix(components: int) -> int:
    """p of the symmetric (p, p) matrix with so many components."""
    return round((math.sqrt(8.0 * components + 1.0) - 1.0) / 2.0)


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


def _cells(components: Sequence[Expr], size: int, inverse: bool) -> dict[tuple[int, int], Expr]:
    """W_ij, as functions of the block name it: those of a precision by its lower half."""
    half = dict(zip(lower_half(size), components, strict=True))
    entries = {(i, j): half[max(i, j), min(i, j)] for i in range(size) for j in range(size)}
    if not inverse:
        return entries
    node = matrix_op("inverse", entries.values(), size)
    return {(i, j): item(node, i, j) for i, j in entries}


def _same(form: BlockForm, first: tuple[int, ...], second: tuple[int, ...]) -> bool:
    """Whether the coefficients at these positions have the same sum, in each role."""
    if first == second:
        return True
    for coefficients in form.coefficients.values():
        parts = [coefficients[i] for i in first] + [-coefficients[i] for i in second]
        parts = [p for p in parts if not (p.op == "const" and p.data == 0.0)]
        if parts and not cancels(parts):
            return False
    return True


def _first(found: list[list[tuple[int, ...]]]) -> tuple[tuple[int, ...], ...]:
    return tuple(tuple(places[0] if places else -1 for places in row) for row in found)


# -- Wishart laws
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
