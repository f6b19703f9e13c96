"""Exact answers by other roads than the package's: a dense Gaussian, and a point-mass filter."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from scipy import stats


class DenseGaussian:
    """A linear Gaussian model as one multivariate normal of all states and observations.

    x_1 ~ N(m, P), x_t = A x_{t-1} + b_t + N(0, Q), y_t = C x_t + d_t + N(0, R); b (T, D) holds in
    row t what enters x_t (row 0 without meaning). No recursion over the data: log density and
    moments come from conditioning the joint law on the components of y that are not NaN.
    """

    def __init__(self, y, m, P, A, b, Q, C, d, R):
        y = np.asarray(y, float).reshape(len(y), -1)
        T, D = len(y), len(m)
        A, P, Q, C = (np.asarray(M, float) for M in (A, P, Q, C))
        b = np.broadcast_to(np.asarray(b, float), (T, D))
        mean, cov = np.zeros((T, D)), np.zeros((T, D, T, D))
        mean[0], cov[0, :, 0] = m, P
        for t in range(1, T):
            mean[t] = A @ mean[t - 1] + b[t]
            cov[t, :, :t] = np.tensordot(A, cov[t - 1, :, :t], axes=1)
            cov[:t, :, t] = np.moveaxis(cov[t, :, :t], 0, -1)
            cov[t, :, t] = A @ cov[t - 1, :, t - 1] @ A.T + Q
        K = y.shape[1]
        seen = ~np.isnan(y).ravel()
        H = np.kron(np.eye(T), C)[seen]
        S = cov.reshape(T * D, T * D)
        offset = np.broadcast_to(np.asarray(d, float), (T, K)).ravel()[seen]
        noise = np.kron(np.eye(T), np.asarray(R, float))[np.ix_(seen, seen)]
        expected, spread = H @ mean.ravel() + offset, H @ S @ H.T + noise
        residual = y.ravel()[seen] - expected
        self.log_likelihood = float(stats.multivariate_normal.logpdf(residual, cov=spread))
        self._prior, self._residual, self._spread, self._crossed = mean, residual, spread, H @ S
        self._states = S

    # The moments cost several times the log-likelihood, for which alone many tests ask.

    @cached_property
    def _gain(self):
        return np.linalg.solve(self._spread, self._crossed).T

    @cached_property
    def mean(self):
        return self._prior + (self._gain @ self._residual).reshape(self._prior.shape)

    @cached_property
    def covariance(self):
        return self._states - self._gain @ self._crossed

    @cached_property
    def sd(self):
        return np.sqrt(np.maximum(np.diag(self.covariance), 0)).reshape(self._prior.shape)

    @cached_property
    def lag_one(self):
        T, D = self._prior.shape
        return np.diag(self.covariance, D).reshape(T - 1, D)


def varve_log_likelihood(y, phi, tau, points=600):
    """log p(y | phi, tau) of the varve model, by a point-mass filter.

    The integrands are smooth and vanish at both ends of the grid, so that the trapezoidal rule
    converges faster than any power of its spacing.
    """
    sd = 1 / np.sqrt(tau)
    # beyond 12 the first thickness alone rules a state out, however wide its stationary law
    reach = min(max(9 * sd / np.sqrt(1 - phi**2), 4.5), 12.0)
    x, h = np.linspace(-reach, reach, points, retstep=True)
    density = stats.norm.pdf(x, 0, sd / np.sqrt(1 - phi**2))
    move = stats.norm.pdf(x[:, None], phi * x[None, :], sd) * h
    log_g = stats.gamma.logpdf(np.asarray(y)[:, None], 6.25, scale=np.exp(x) / 0.256)
    total = 0.0
    for t in range(len(y)):
        if t:
            density = move @ density
        top = log_g[t].max()
        density = density * np.exp(log_g[t] - top)
        mass = density.sum() * h
        total += top + np.log(mass)
        density /= mass
    return float(total)


class GridPosterior:
    """The posterior of one scalar parameter on a grid, from log likelihood plus log prior."""

    def __init__(self, log_density, lower, upper, points=101):
        self.x = np.linspace(lower, upper, points)
        log_p = np.array([log_density(v) for v in self.x])
        self.weight = np.exp(log_p - log_p.max())
        edges = max(self.weight[0], self.weight[-1])
        assert edges < 1e-7, f"the grid cuts the posterior off at {edges:.1e} of its height"
        self.weight /= self.weight.sum()
        self.mean = float(self.weight @ self.x)
        self.sd = float(np.sqrt(self.weight @ (self.x - self.mean) ** 2))
