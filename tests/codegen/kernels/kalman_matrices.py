"""Random linear Gaussian models in numbers, and their smoothed law as one dense Gaussian."""

import numpy as np

from ssmppl.codegen.kernels.kalman.steps import Matrices
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


def moments_without_data(model, steps):
    """Mean (T, D) and covariance (T D, T D) of the states."""
    m, p, a, b, q = model.m, model.P, model.A[0], model.b[0], model.Q[0]
    d = len(m)
    mean, covariance = np.empty((steps, d)), np.empty((steps, d, steps, d))
    for t in range(steps):
        mean[t] = a @ mean[t - 1] + b if t else m
        covariance[t, :, t] = a @ covariance[t - 1, :, t - 1] @ a.T + q if t else p
        for s in range(t):
            covariance[t, :, s] = a @ covariance[t - 1, :, s]
            covariance[s, :, t] = covariance[t, :, s].T
    return mean, covariance.reshape(steps * d, steps * d)


class DenseFlat:
    """A model with flat components of x_1, by generalised least squares on the dense law.

    Given delta the states and data are jointly normal, with means that are affine in delta.
    log_likelihood : log of the integral of p(y | delta) over delta, which counts with density 1.
    mean (T D,), covariance (T D, T D) of the states given y.
    """

    def __init__(self, model, flat, y, seen):
        keep = seen.ravel() == 1.0
        base = dense(model, y, seen)  # the law given delta = 0
        shifts = [dense(self._shifted(model, i), y, seen) for i in flat]
        self.slopes = np.array([(s.mean - base.mean).ravel() for s in shifts]).T
        c, r = model.C[0], model.R[0]
        steps = len(y)
        # means and covariance of y given delta
        prior, prior_covariance = moments_without_data(model, steps)
        c_all = np.kron(np.eye(steps), c)
        spread = c_all @ prior_covariance @ c_all.T + np.kron(np.eye(steps), r)
        spread = spread[np.ix_(keep, keep)]
        effect = []
        for i in flat:
            moved = moments_without_data(self._shifted(model, i), steps)[0] - prior
            effect.append((moved @ c.T).ravel()[keep])
        effect = np.array(effect).T
        residual = (y - prior @ c.T - model.d[0]).ravel()[keep]
        weight = np.linalg.inv(spread)
        information = effect.T @ weight @ effect
        delta = np.linalg.solve(information, effect.T @ weight @ residual)
        rest = residual - effect @ delta
        n, g = keep.sum(), len(flat)
        self.log_likelihood = -0.5 * (
            (n - g) * np.log(2 * np.pi) + np.linalg.slogdet(spread)[1]
            + np.linalg.slogdet(information)[1] + rest @ weight @ rest
        )  # fmt: skip
        self.mean = base.mean.ravel() + self.slopes @ delta
        told = self.slopes @ np.linalg.inv(information) @ self.slopes.T
        self.covariance = base.covariance + told

    @staticmethod
    def _shifted(model, i):
        return model._replace(m=model.m + np.eye(len(model.m))[i])


def with_flat(model, flat):
    """The model with zeros in m and P for its flat components."""
    flat = list(flat)
    m, p = model.m.copy(), model.P.copy()
    m[flat], p[flat], p[:, flat] = 0.0, 0.0, 0.0
    return model._replace(m=m, P=p)
