"""Random linear Gaussian models in numbers, and their smoothed law as one dense Gaussian."""

import numpy as np

from ssmppl.codegen.kernels.kalman_steps import Matrices
from tests.statistics.exact import DenseGaussian


def random_model(rng, d, k, rank=None, initial_rank=None):
    """Stable matrices with Q and P of these ranks (None: full)."""

    def covariance(n, r):
        half = rng.normal(size=(n, n if r is None else r))
        return half @ half.T

    a = rng.normal(size=(d, d))
    a *= 0.95 / np.abs(np.linalg.eigvals(a)).max()
    return Matrices(
        rng.normal(size=d), covariance(d, initial_rank), a[None], rng.normal(size=(1, d)),
        covariance(d, rank)[None], rng.normal(size=(1, k, d)), rng.normal(size=(1, k)),
        covariance(k, None)[None] + 0.1 * np.eye(k),
    )  # fmt: skip


def random_data(rng, model, steps, missing):
    """y and seen (T, K), with one row that is missing altogether if any is."""
    k = model.C.shape[1]
    seen = (rng.random((steps, k)) >= missing).astype(float)
    if missing:
        seen[steps // 2] = 0.0
    return np.where(seen == 1.0, 2 * rng.normal(size=(steps, k)), 0.0), seen


def dense(model, y, seen):
    """The joint law of a model with constant matrices."""
    rows = np.where(seen == 1.0, y, np.nan)
    rest = (f[0] for f in model[2:])
    return DenseGaussian(rows, model.m, model.P, *rest)
