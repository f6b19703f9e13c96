"""A measured vector whose scales may be zero, with components missing; and its posterior without
the package.

The parameters of a two-dimensional state, the noises' standard deviations and correlation with it:
log likelihoods in NumPy, of the linear model by a Kalman filter, of the other by particles, for
many parameters at once. They are made a posterior of by importance sampling: draws of a t law with
weights, independent of each other, so that the errors of all means are known. With an unbiased
estimate in place of the likelihood that is exact too (Tran, Scharth, Pitt and Kohn 2013,
"Importance sampling squared for Bayesian inference in latent variable models").
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import stats
from scipy.special import logsumexp

import ssmppl as ssm

STEPS = 60
A = np.array([[0.8, 0.1], [-0.1, 0.7]])
TRUE = {"s": (0.6, 0.8), "rho": 0.3, "S": ((0.5, 0.1), (0.1, 0.4))}
QUANTITIES = ("s[0]", "s[1]", "rho", "S[0, 0]", "S[1, 0]", "S[1, 1]")
DEGREES = 5.0  # of freedom of the t law


def model(nonlinear: bool) -> ssm.Model:
    m = ssm.Model("scales at zero")
    m.prior(lambda: {
        "s": ssm.HalfNormal(sd=np.ones(2)), "rho": ssm.Uniform(-1, 1),
        "S": ssm.InverseWishart(4, scale=np.eye(2)),
    })  # fmt: skip
    m.initial(lambda: {"x": ssm.MvNormal(np.zeros(2), covariance=np.eye(2))})
    if nonlinear:
        m.transition(lambda x, S: {"x": ssm.MvNormal(A @ np.sin(x), covariance=S)})
    else:
        m.transition(lambda x, S: {"x": ssm.MvNormal(A @ x, covariance=S)})

    def observation(x, s, rho):
        c = rho * s[0] * s[1]
        return {"y": ssm.MvNormal(x, covariance=np.array([[s[0] ** 2, c], [c, s[1] ** 2]]))}

    m.observation(observation)
    return m


def data(seed: int, nonlinear: bool) -> np.ndarray:
    """(STEPS, 2): rows 5 to 11 lack the first component, rows 30 to 33 both."""
    rng = np.random.default_rng(seed)
    s, c = np.array(TRUE["s"]), TRUE["rho"] * TRUE["s"][0] * TRUE["s"][1]
    noise = rng.multivariate_normal(np.zeros(2), [[s[0] ** 2, c], [c, s[1] ** 2]], STEPS)
    moved = rng.multivariate_normal(np.zeros(2), TRUE["S"], STEPS)
    x = np.empty((STEPS, 2))
    x[0] = rng.standard_normal(2)
    for t in range(1, STEPS):
        x[t] = A @ (np.sin(x[t - 1]) if nonlinear else x[t - 1]) + moved[t]
    y = x + noise
    y[5:12, 0] = np.nan
    y[30:34] = np.nan
    return y


def quantities(s, rho, covariance) -> np.ndarray:
    """(..., 6) of s (..., 2), rho (...,), S (..., 2, 2), in the order of `QUANTITIES`."""
    s, covariance = np.asarray(s), np.asarray(covariance)
    columns = [s[..., 0], s[..., 1], np.asarray(rho), covariance[..., 0, 0],
               covariance[..., 1, 0], covariance[..., 1, 1]]  # fmt: skip
    return np.stack(columns, axis=-1)


def unconstrained(q: np.ndarray) -> np.ndarray:
    """(n, 6): the scales, artanh of rho, and S by its Cholesky factor, the diagonal by logs."""
    first = np.sqrt(q[:, 3])
    last = np.sqrt(q[:, 5] - (q[:, 4] / first) ** 2)
    columns = [q[:, 0], q[:, 1], np.arctanh(q[:, 2]), np.log(first), q[:, 4] / first, np.log(last)]
    return np.stack(columns, axis=1)


def natural(z: np.ndarray) -> np.ndarray:
    """The quantities (n, 6) of z (n, 6)."""
    first, last = np.exp(z[:, 3]), np.exp(z[:, 5])
    columns = [z[:, 0], z[:, 1], np.tanh(z[:, 2]), first**2, first * z[:, 4],
               z[:, 4] ** 2 + last**2]  # fmt: skip
    return np.stack(columns, axis=1)


def log_prior(z: np.ndarray) -> np.ndarray:
    """(n,) log density of z: that of the parameters, and of the change of variables."""
    q, first, last = natural(z), np.exp(z[:, 3]), np.exp(z[:, 5])
    out = stats.halfnorm.logpdf(q[:, :2]).sum(axis=1)
    out += np.log(0.5) + np.log1p(-(q[:, 2] ** 2))
    law = stats.invwishart(4, np.eye(2))
    out += [law.logpdf(np.array([[a, b], [b, c]])) for a, b, c in q[:, 3:]]
    return out + np.log(4.0 * first**3 * last**2)  # dS = 4 l00^2 l11 dL, dl_ii = l_ii d log l_ii


def _spread(q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Variances and the covariance of the noise in y, each (n,)."""
    return q[:, 0] ** 2, q[:, 2] * q[:, 0] * q[:, 1], q[:, 1] ** 2


def kalman(y: np.ndarray, q: np.ndarray) -> np.ndarray:
    """(n,) log p(y) of the linear model, components taken in one after another: the first, and the
    second given it, whose noises are independent."""
    r00, r01, r11 = _spread(q)
    moved = np.stack([q[:, 3], q[:, 4], q[:, 4], q[:, 5]], axis=1).reshape(-1, 2, 2)
    m, p = np.zeros((len(q), 2)), np.tile(np.eye(2), (len(q), 1, 1))
    slope = r01 / r00
    total = np.zeros(len(q))

    def take(row, value, noise):
        """The scalar row'x + N(0, noise) was measured as value."""
        nonlocal m, p, total
        gain = np.einsum("nij,nj->ni", p, row)
        spread = np.einsum("ni,ni->n", row, gain) + noise
        away = value - np.einsum("ni,ni->n", row, m)
        total = total - 0.5 * (np.log(2.0 * np.pi * spread) + away**2 / spread)
        m = m + gain * (away / spread)[:, None]
        p = p - gain[:, :, None] * gain[:, None, :] / spread[:, None, None]

    one, zero = np.ones(len(q)), np.zeros(len(q))
    for t in range(STEPS):
        if t:
            m, p = m @ A.T, A @ p @ A.T + moved
        if np.isfinite(y[t, 0]):
            take(np.stack([one, zero], axis=1), y[t, 0] * one, r00)
            if np.isfinite(y[t, 1]):  # y_1 - slope y_0, whose noise is independent of the first's
                value = y[t, 1] - slope * y[t, 0]
                take(np.stack([-slope, one], axis=1), value, r11 - slope * r01)
        elif np.isfinite(y[t, 1]):
            take(np.stack([zero, one], axis=1), y[t, 1] * one, r11)
    return total


def particles(y: np.ndarray, q: np.ndarray, rng: np.random.Generator, n: int = 200) -> np.ndarray:
    """(n,) unbiased estimates of p(y) of the nonlinear model, as logs: particles drawn from
    p(x_t | x_{t-1}, y_t), weighed by p(y_t | x_{t-1}), resampled systematically."""
    r00, r01, r11 = _spread(q)
    r = np.stack([r00, r01, r01, r11], axis=1).reshape(-1, 2, 2)
    moved = np.stack([q[:, 3], q[:, 4], q[:, 4], q[:, 5]], axis=1).reshape(-1, 2, 2)
    x, total = np.zeros((len(q), n, 2)), np.zeros(len(q))
    for t in range(STEPS):
        spread = moved if t else np.tile(np.eye(2), (len(q), 1, 1))
        mean = np.sin(x) @ A.T if t else np.zeros_like(x)
        seen = np.flatnonzero(np.isfinite(y[t]))
        log_w = np.zeros((len(q), n))
        if len(seen):
            s = spread[:, seen][:, :, seen] + r[:, seen][:, :, seen]
            gain = spread[:, :, seen] @ np.linalg.inv(s)
            away = y[t, seen] - mean[:, :, seen]
            white = np.linalg.solve(np.linalg.cholesky(s)[:, None], away[..., None])[..., 0]
            log_w = -0.5 * (white**2).sum(axis=2) - 0.5 * np.linalg.slogdet(s)[1][:, None]
            log_w -= 0.5 * len(seen) * np.log(2.0 * np.pi)
            mean = mean + np.einsum("nij,nkj->nki", gain, away)
            spread = spread - gain @ spread[:, seen]
        spread = 0.5 * (spread + spread.transpose(0, 2, 1)) + 1e-14 * np.eye(2)
        normals = rng.standard_normal(x.shape)
        x = mean + np.einsum("nij,nkj->nki", np.linalg.cholesky(spread), normals)
        top = log_w.max(axis=1, keepdims=True)
        w = np.exp(log_w - top)
        total += np.log(w.mean(axis=1)) + top[:, 0]
        below = np.cumsum(w, axis=1)
        below /= below[:, -1:]
        points = (np.arange(n) + rng.random((len(q), 1))) / n
        shift = 2.0 * np.arange(len(q))[:, None]  # one search for all rows
        index = np.searchsorted((below + shift).ravel(), (points + shift).ravel())
        x = x.reshape(-1, 2)[np.minimum(index, x.shape[0] * n - 1)].reshape(x.shape)
    return total


@dataclass(frozen=True)
class Posterior:
    """Quantities (n, 6) of weighted draws, weights (n,) of sum 1."""

    q: np.ndarray
    w: np.ndarray

    @property
    def ess(self) -> float:
        return float(1.0 / (self.w**2).sum())

    def mean(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Means (K,) of values (n, K), and their standard errors."""
        mean = self.w @ values
        return mean, np.sqrt((self.w**2) @ (values - mean) ** 2)


def importance(
    log_likelihood: Callable[[np.ndarray], np.ndarray], near: np.ndarray, n: int,
    rng: np.random.Generator,
) -> Posterior:  # fmt: skip
    """The posterior by a t law of the mean and covariance of the points z `near` (m, 6), a little
    wider, whose scales are reflected at zero. It is the right one whatever the points are."""
    centre, root = near.mean(axis=0), np.linalg.cholesky(1.2 * np.cov(near.T))
    mixing = np.sqrt(DEGREES / rng.chisquare(DEGREES, n))
    z = centre + mixing[:, None] * rng.standard_normal((n, 6)) @ root.T
    z[:, :2] = np.abs(z[:, :2])
    parts = []
    for signs in itertools.product((1.0, -1.0), repeat=2):
        u = np.linalg.solve(root, (z * np.array([*signs, 1.0, 1.0, 1.0, 1.0]) - centre).T)
        parts.append(-0.5 * (DEGREES + 6.0) * np.log1p((u**2).sum(axis=0) / DEGREES))
    log_w = log_prior(z) + log_likelihood(natural(z)) - logsumexp(parts, axis=0)
    w = np.exp(log_w - log_w.max())
    return Posterior(natural(z), w / w.sum())
