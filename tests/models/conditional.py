"""Models that are linear and Gaussian given some of their states, and their exact answers: every
path of the discrete states, with all of z and y as one Gaussian vector."""

import itertools
from dataclasses import dataclass

import numpy as np
from scipy import stats
from scipy.special import logsumexp

import ssmppl as ssm

STAY = np.array([[0.8, 0.2], [0.3, 0.7]])
START = np.array([0.6, 0.4])


def regimes():
    """A regime that sets how a pair of states moves; one channel of each regime's own noise, and
    a pair of channels with correlated noise."""
    model = ssm.Model("regimes", inputs=("u",))
    model.prior(lambda: {"a": ssm.Uniform(-1, 1), "q": ssm.Gamma(2, rate=2)})
    model.initial(lambda: {
        "k": ssm.Categorical(START),
        "z": ssm.MvNormal(np.array([0.5, -0.5]), covariance=np.array([[1.0, 0.3], [0.3, 0.5]])),
    })  # fmt: skip

    def transition(k, z, u, t, a, q):
        f = np.where(k == 1, a, 0.9)
        mean = np.stack([f * z[0] + 0.2 * z[1] + u, 0.5 * z[1] - 0.3 * z[0] + 0.1 * t])
        return {
            "k": ssm.Categorical(np.where(k == 1, STAY[1], STAY[0])),
            "z": ssm.MvNormal(mean, covariance=q * np.array([[0.5, 0.1], [0.1, 0.4]])),
        }

    def observation(k, z):
        return {
            "y": ssm.Normal(z[0] + k, variance=np.where(k == 1, 1.5, 0.3)),
            "v": ssm.MvNormal(
                np.stack([z[1], z[0] - z[1]]), covariance=np.array([[0.8, -0.4], [-0.4, 0.6]])
            ),
        }

    model.transition(transition)
    model.observation(observation)
    return model


THETA = {"a": -0.6, "q": 1.3}


@dataclass(frozen=True)
class Exact:
    """log p(y_{1:s}) for s = 1..T; and for each s and t <= s of (k, z_1, z_2)_t given y_{1:s}, the
    mean (3,) and covariance (3, 3) as [s][t]."""

    log_likelihood: np.ndarray
    means: list[list[np.ndarray]]
    covariances: list[list[np.ndarray]]


def enumerated(data, a, q) -> Exact:
    """By every path of k; y of shape (T,), v (T, 2), NaN where missing."""
    y, v, u = (np.asarray(data[n], float) for n in ("y", "v", "u"))
    steps = len(y)
    totals, means, covariances = [], [], []
    for s in range(1, steps + 1):
        logs, firsts, seconds = [], [], []
        for path in itertools.product((0, 1), repeat=s):
            log_p, mean, covariance = _given(path, y[:s], v[:s], u, a, q)
            logs.append(log_p)
            first = np.array([[path[t], *mean[2 * t : 2 * t + 2]] for t in range(s)])
            second = np.einsum("ti,tj->tij", first, first)
            for t in range(s):
                own = slice(2 * t, 2 * t + 2)
                second[t, 1:, 1:] += covariance[own, own]
            firsts.append(first), seconds.append(second)
        total = logsumexp(logs)
        w = np.exp(np.array(logs) - total)
        m = np.einsum("p,pti->ti", w, np.array(firsts))
        c = np.einsum("p,ptij->tij", w, np.array(seconds)) - np.einsum("ti,tj->tij", m, m)
        totals.append(total), means.append(list(m)), covariances.append(list(c))
    return Exact(np.array(totals), means, covariances)


def _given(path, y, v, u, a, q):
    """log p(path, y) and the moments of z given both, from one big Gaussian vector."""
    steps = len(path)
    log_p = np.log(START[path[0]]) + sum(np.log(STAY[i, j]) for i, j in itertools.pairwise(path))
    # z = mean + root e, stacked
    mean, root = np.zeros(2 * steps), np.zeros((2 * steps, 2 * steps))
    mean[:2] = [0.5, -0.5]
    root[:2, :2] = np.linalg.cholesky([[1.0, 0.3], [0.3, 0.5]])
    noise = np.linalg.cholesky(q * np.array([[0.5, 0.1], [0.1, 0.4]]))
    for t in range(1, steps):
        f = np.array([[a if path[t - 1] else 0.9, 0.2], [-0.3, 0.5]])
        before, now = slice(2 * t - 2, 2 * t), slice(2 * t, 2 * t + 2)
        mean[now] = f @ mean[before] + [u[t - 1], 0.1 * t]
        root[now] = f @ root[before]
        root[now, now] = noise
    c = np.zeros((3 * steps, 2 * steps))
    r = np.zeros((3 * steps, 3 * steps))
    offset, values = np.zeros(3 * steps), np.zeros(3 * steps)
    for t, k in enumerate(path):
        own, z = slice(3 * t, 3 * t + 3), slice(2 * t, 2 * t + 2)
        c[own, z] = [[1, 0], [0, 1], [1, -1]]
        r[own, own] = [[1.5 if k else 0.3, 0, 0], [0, 0.8, -0.4], [0, -0.4, 0.6]]
        offset[3 * t], values[own] = k, [y[t], *v[t]]
    there = np.isfinite(values)
    prior = root @ root.T
    c, spread = c[there], c[there] @ prior @ c[there].T + r[np.ix_(there, there)]
    predicted = c @ mean + offset[there]
    log_p += stats.multivariate_normal.logpdf(values[there], predicted, spread)
    gain = np.linalg.solve(spread, c @ prior).T
    return log_p, mean + gain @ (values[there] - predicted), prior - gain @ c @ prior


def four_states():
    """A linear Gaussian model of which two states may be sampled: all noise is correlated, and one
    state follows the others without noise."""
    model = ssm.Model("four states", inputs=("u",))
    model.initial(lambda: {
        "x": ssm.MvNormal(np.array([1.0, 0.0, -1.0]), covariance=np.array(
            [[1.0, 0.4, 0.2], [0.4, 1.0, 0.3], [0.2, 0.3, 1.0]])),
        "lag": ssm.Normal(0.0, sd=0.5),
    })  # fmt: skip
    a = np.array([[0.8, 0.3, 0.0], [-0.2, 0.7, 0.2], [0.1, 0.2, 0.6]])
    q = np.array([[0.5, 0.2, -0.1], [0.2, 0.4, 0.1], [-0.1, 0.1, 0.3]])
    model.transition(lambda x, lag, u: {
        "x": ssm.MvNormal(a @ x + np.stack([u, 0.2 * lag, 0.0]), covariance=q),
        "lag": ssm.Dirac(x[1] - 0.5 * x[2]),
    })  # fmt: skip
    model.observation(lambda x, lag: {
        "y": ssm.MvNormal(np.stack([x[0] + lag, x[2]]), covariance=np.array(
            [[0.5, 0.2], [0.2, 0.6]])),
        "w": ssm.Normal(x[1] - x[0], sd=0.7),
    })  # fmt: skip
    return model
