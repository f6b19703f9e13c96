"""Kalman's filter in expressions: Gaussians conditioned on one scalar after the other.

So no matrix is inverted, all of it is written out and vectorises across particles, and a channel
that was not measured is left out by its own guard.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from ssmppl.analysis.density import Missing
from ssmppl.expressions.expr import Expr, apply, constant
from ssmppl.language.model.trace import seen

ZERO = constant(0.0)


@dataclass(frozen=True)
class GaussianMoments:
    """A Gaussian distribution of z: mean (n,), covariance (n, n), as arrays of Exprs."""

    mean: np.ndarray
    covariance: np.ndarray

    def updated(
        self, row: np.ndarray, offset: Expr, noise: Expr, value: Expr, measured: Expr | None
    ) -> tuple[GaussianMoments, Expr, Expr]:
        """After value = row @ z + offset + N(0, noise); and its predicted mean and variance.

        measured : 1 where the value is there; None: always.
        """
        n = len(self.mean)
        cross = [_dot(self.covariance[i], row) for i in range(n)]
        mean, variance = _dot(row, self.mean) + offset, _dot(row, cross) + noise
        weight, residual = 1.0 / variance, value - mean
        if noise is ZERO:  # where nothing is left to learn, nothing is learnt
            weight = apply("where", apply("lt", 0.0, variance), weight, 0.0)
        if measured is not None:
            weight = apply("where", measured, weight, 0.0)
            residual = apply("where", measured, residual, 0.0)
        gain = [c * weight for c in cross]
        new_mean = objects([m + g * residual for m, g in zip(self.mean, gain, strict=True)])
        new = np.empty((n, n), dtype=object)
        for i in range(n):
            for j in range(i + 1):
                new[i, j] = new[j, i] = self.covariance[i, j] - gain[i] * cross[j]
        return GaussianMoments(new_mean, new), mean, variance

    def predicted(self, a: np.ndarray, b: np.ndarray, q: np.ndarray) -> GaussianMoments:
        """Moments of a z + b + N(0, q)."""
        rows = [[_dot(a[i], self.covariance[:, j]) for j in range(len(self.mean))]
                for i in range(len(b))]  # fmt: skip
        new = np.empty((len(b), len(b)), dtype=object)
        for i in range(len(b)):
            for j in range(i + 1):
                new[i, j] = new[j, i] = _dot(rows[i], a[j]) + q[i, j]
        mean = objects([_dot(a[i], self.mean) + b[i] for i in range(len(b))])
        return GaussianMoments(mean, new)

    def given_exactly(self, values: Sequence[Expr]) -> GaussianMoments:
        """Moments of the later components, given the first ones."""
        k, found = len(values), self
        for value in values:
            row = np.array([constant(1.0)] + [ZERO] * (len(found.mean) - 1), dtype=object)
            found = found.updated(row, ZERO, ZERO, value, None)[0]
            found = GaussianMoments(found.mean[1:], found.covariance[1:, 1:])
        assert len(found.mean) == len(self.mean) - k
        return found


def _dot(a: Iterable[Expr], b: Iterable[Expr]) -> Expr:
    total = ZERO
    for x, y in zip(a, b, strict=True):
        total = total + x * y
    return total


def objects(values: Sequence[Expr]) -> np.ndarray:
    out = np.empty(len(values), dtype=object)
    out[:] = values
    return out


def block_diagonal(blocks: Sequence[np.ndarray]) -> np.ndarray:
    """Square blocks along the diagonal."""
    size = sum(map(len, blocks))
    out = np.full((size, size), ZERO, dtype=object)
    at = 0
    for b in blocks:
        out[at : at + len(b), at : at + len(b)] = b
        at += len(b)
    return out


def updated_by_channels(
    moments: GaussianMoments, c: np.ndarray, d: np.ndarray, r: np.ndarray, values: Sequence[Expr],
    missing: Missing,
) -> tuple[GaussianMoments, list[tuple[Expr, Expr]]]:  # fmt: skip
    """Moments of z after y = c z + d + N(0, r); and (mean, variance) of each channel given the
    earlier ones. Correlated noise joins z for as long as it takes."""
    n, k = len(moments.mean), len(d)
    together = any(r[i, j] is not ZERO for i in range(k) for j in range(i))
    if together:
        mean = objects([*moments.mean, *[ZERO] * k])
        moments = GaussianMoments(mean, block_diagonal([moments.covariance, r]))
    laws: list[tuple[Expr, Expr]] = []
    for i, value in enumerate(values):
        row: np.ndarray = c[i]
        noise: Expr = r[i, i]
        if together:
            unit = [constant(1.0) if j == i else ZERO for j in range(k)]
            row, noise = np.concatenate([row, objects(unit)]), ZERO
        measured = None if missing.none else seen(value)
        moments, *law = moments.updated(row, d[i], noise, value, measured)
        laws.append((law[0], law[1]))
    return GaussianMoments(moments.mean[:n], moments.covariance[:n, :n]), laws
