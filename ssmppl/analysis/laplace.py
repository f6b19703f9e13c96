"""Gaussian fits to f(x_t | x_{t-1}) g(y_t | x_t) for a Gaussian f, by Newton's method."""

from __future__ import annotations

from typing import Any

import numpy as np

from ssmppl.analysis.structure import GaussianBlock
from ssmppl.expressions.arrays import ExprArray, array
from ssmppl.expressions.calculus import lower_inverse
from ssmppl.expressions.expr import apply, constant, substitute

NEWTON_STEPS = 3
LONGEST_STEP = 2.0  # in standard deviations of the transition


def gaussian_fit(
    block: GaussianBlock, slope: ExprArray, curvature: ExprArray, precision: ExprArray
) -> tuple[ExprArray, ExprArray]:
    """Mode (n,) after a few Newton steps from the transition's mean, and the Cholesky factor (n, n)
    of the precision there, without the part of g that is not concave.

    slope, curvature : of log g in the block's symbols. precision : of the transition.
    """
    n = len(block)
    x = block.mean
    spread = array([apply("sqrt", block.covariance[i, i]) for i in range(n)])
    for _ in range(NEWTON_STEPS):
        g, w = _at(block, x, slope, curvature)
        pull = g - precision @ (x - block.mean)
        if n == 1:
            step = pull / (precision[0] + np.maximum(w[0], 0.0))
        else:
            root = lower_inverse(_factor(w, precision))
            step = array(root.T @ (root @ pull))
        limit = LONGEST_STEP * spread
        x = array(x + np.minimum(np.maximum(step, -limit), limit))
    _, w = _at(block, x, slope, curvature)
    factor = _factor(w, precision)
    # slope or curvature over- or underflowed: the transition itself is a valid proposal
    total = constant(0.0)
    for e in (*x, *np.diagonal(factor.view(np.ndarray))):
        total = total + e
    finite: Any = apply("lt", apply("abs", total), np.inf)
    return array(np.where(finite, x, block.mean)), array(
        np.where(finite, factor, written_cholesky(precision))
    )


def _at(
    block: GaussianBlock, x: ExprArray, slope: ExprArray, curvature: ExprArray
) -> tuple[ExprArray, ExprArray]:
    """Slope (n,) of log g at x, and minus its curvature (n, n)."""
    n = len(block)
    at = dict(zip(block.symbols, x, strict=True))
    flat = substitute([*slope, *curvature.ravel()], at)
    return array(flat[:n]), array(-array(flat[n:]).reshape(n, n))


def _factor(w: ExprArray, precision: ExprArray) -> ExprArray:
    """Cholesky factor of precision + w, or of precision + the positive part of w's diagonal."""
    n = len(w)
    diagonal = np.diag(array(np.maximum(array(np.diagonal(w.view(np.ndarray))), 0.0)))
    safe = written_cholesky(array(precision + diagonal))
    if n == 1:
        return safe
    full = written_cholesky(array(precision + w))
    last = full[n - 1, n - 1]
    concave: Any = apply("eq", last, last)  # nan where the matrix is not positive definite
    return array(np.where(concave, full, safe))


def written_cholesky(a: ExprArray) -> ExprArray:
    """Cholesky factor written out in scalars (nan where a is not positive definite)."""
    n, zero = len(a), constant(0.0)
    out = np.empty((n, n), dtype=object)
    out[...] = [[zero] * n] * n
    for j in range(n):
        total = a[j, j]
        for k in range(j):
            total = total - out[j, k] ** 2
        out[j, j] = apply("sqrt", total)
        for i in range(j + 1, n):
            total = a[i, j]
            for k in range(j):
                total = total - out[i, k] * out[j, k]
            out[i, j] = total / out[j, j]
    return array(out)
