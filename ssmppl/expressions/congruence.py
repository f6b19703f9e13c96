"""Matrices M that are linear in a symmetric matrix Q, with M^-1 linear in Q^-1.

L Q L' with L a matrix of numbers, Kronecker products of Q with one, several Q down the diagonal:

    (M^-1)_ij = sum_kl G_ijkl (Q^-1)_kl,        log det M = (n / p) log det Q + c,

n and p the sizes of M and Q. G and c are found from M at a few Q, whatever way M was written, and
the form is taken only if it holds at others.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import Expr, symbols_of

Matrix = Callable[[np.ndarray], np.ndarray]
_POINTS = 4
_TOLERANCE = 1e-11


@dataclass(frozen=True, eq=False)
class Congruence:
    """entries : of Q, row by row, (p * p,). inverse : G, (n, n, p, p). power : n / p."""

    entries: tuple[Expr, ...]
    inverse: np.ndarray
    power: float
    constant: float

    @property
    def size(self) -> int:
        """p."""
        return self.inverse.shape[2]


@lru_cache(maxsize=512)
def congruent(node: Expr) -> Congruence | None:
    """The form of the matrix under a node of `MATRIX_OPS`; None where it has none.

    None also for Q itself, of which nothing is to be said.
    """
    matrix, n = node.args, node.data
    half = _lower_half(symbols_of(matrix))
    if half is None:
        return None
    p = 1 + max(i for i, _ in half)
    entries = tuple(half[max(i, j), min(i, j)] for i in range(p) for j in range(p))
    if n == p and all(a is b for a, b in zip(entries, matrix, strict=True)):
        return None

    def at(q: np.ndarray) -> np.ndarray:
        values = {s: q[cell] for cell, s in half.items()}
        return np.array([float(e) for e in evaluate(matrix, values)]).reshape(n, n)

    def inverted(precision: np.ndarray) -> np.ndarray:
        return np.linalg.inv(at(np.linalg.inv(precision)))

    with np.errstate(all="ignore"):
        try:
            return _fitted(at, inverted, entries, n)
        except np.linalg.LinAlgError:
            return None


def _fitted(at: Matrix, inverted: Matrix, entries: tuple[Expr, ...], n: int) -> Congruence | None:
    """G and c from M^-1 as a function of Q^-1, if they hold at random Q as well."""
    p = math.isqrt(len(entries))
    identity = np.eye(p)
    middle = inverted(identity)
    g = np.zeros((n, n, p, p))
    for i in range(p):
        for j in range(i + 1):
            unit = np.zeros((p, p))
            unit[i, j] = unit[j, i] = 0.5
            change = inverted(identity + unit) - middle
            # of the two places of one number, each carries half: exact, as Q^-1 is symmetric
            g[:, :, i, j] = g[:, :, j, i] = change if i != j else 2.0 * change
    g[np.abs(g) < _TOLERANCE * np.abs(g).max()] = 0.0
    form = Congruence(entries, g, n / p, float(np.linalg.slogdet(at(identity))[1]))
    rng = np.random.default_rng(1)
    for _ in range(_POINTS):
        a = rng.standard_normal((p, p))
        q = a @ a.T + identity
        found, expected = np.linalg.inv(at(q)), np.einsum("ijkl,kl->ij", g, np.linalg.inv(q))
        sign, log_det = np.linalg.slogdet(at(q))
        change = form.power * float(np.linalg.slogdet(q)[1]) + form.constant - log_det
        if not (sign > 0.0 and abs(change) < 1e-9):
            return None
        if not np.all(np.abs(found - expected) < 1e-9 * np.abs(found).max()):
            return None
    return form


def _lower_half(symbols: frozenset[Expr]) -> dict[tuple[int, int], Expr] | None:
    """(i, j) -> symbol, if these are all components of one symmetric matrix, i >= j."""
    if len({s.data[:2] for s in symbols}) != 1 or any(len(s.data[2]) != 2 for s in symbols):
        return None
    half = {s.data[2]: s for s in symbols}
    p = 1 + max(i for i, _ in half)
    return half if set(half) == {(i, j) for i in range(p) for j in range(i + 1)} else None
