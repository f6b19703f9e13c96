"""Laws that read new values of other states in the step, with exact answers by hand.

correlated  linear Gaussian: one noise in two states, a draw of the step that both read
counts      finitely many values: a flow, a deterministic count, a switch that reads both
regimes     linear and Gaussian given the regime that the step leads to
volatility  a spread that is the exponential of another state's new value
"""

import itertools

import numpy as np
from scipy import special, stats

import ssmppl as ssm

correlated = ssm.Model("correlated")


@correlated.prior
def correlated_prior():
    return {
        "a": ssm.Normal(0.5, sd=0.3),
        "rho": ssm.Normal(0, sd=1),
        "q": ssm.InverseGamma(3, scale=1),
    }


@correlated.initial
def correlated_initial():
    return {"v": ssm.Normal(0, sd=0.5), "x": ssm.Normal(0, sd=1), "lag": ssm.Dirac(0.0)}


@correlated.transition
def shocks():
    return {"shock": ssm.Normal(0, sd=0.4)}


@correlated.transition
def first(x, a, shock_next):
    return {"x": ssm.Normal(a * x + shock_next, sd=0.7)}


@correlated.transition
def second(v, x, x_next, a, rho, q, shock_next):
    return {"v": ssm.Normal(0.8 * v + rho * (x_next - a * x) - shock_next, variance=q)}


@correlated.transition
def third(x_next, v):
    return {"lag": ssm.Dirac(0.5 * x_next + v)}


@correlated.observation
def correlated_observation(x, v, lag):
    return {"y": ssm.Normal(x + v, sd=0.5), "w": ssm.Normal(lag, sd=0.4)}


def correlated_moments(theta, steps):
    """Mean 0 and covariance (3 T, 3 T) of (v, x, lag) of all rows, by the noises (T, 3) of shock,
    x and v: every state is a sum of these, of which the weights are worked out one row after the
    other."""
    a, rho, q = theta["a"], theta["rho"], theta["q"]
    sd = np.array([0.4, 0.7, np.sqrt(q)])
    total = 2 + 3 * (steps - 1)
    v, x, lag = 0.5 * np.eye(total)[0], np.eye(total)[1], np.zeros(total)
    rows = [v, x, lag]
    for t in range(1, steps):
        shock, e, f = sd[:, None] * np.eye(total)[2 + 3 * (t - 1) :][:3]
        new = a * x + shock + e
        v, lag = 0.8 * v + rho * (new - a * x) - shock + f, 0.5 * new + v
        x = new
        rows += [v, x, lag]
    weights = np.array(rows)
    return weights @ weights.T


def correlated_answer(theta, y, w):
    """log p(y, w), and mean and sd (T, 3) of (v, x, lag) given them; nan is missing."""
    steps = len(y)
    prior = correlated_moments(theta, steps)
    read = np.zeros((2 * steps, 3 * steps))
    for t in range(steps):
        read[2 * t, 3 * t : 3 * t + 2] = 1.0
        read[2 * t + 1, 3 * t + 2] = 1.0
    data = np.column_stack([y, w]).ravel()
    seen = np.isfinite(data)
    read, data = read[seen], data[seen]
    noise = np.diag(np.tile([0.25, 0.16], steps)[seen])
    cover = read @ prior @ read.T + noise
    gain = prior @ read.T @ np.linalg.inv(cover)
    left = prior - gain @ read @ prior
    log_z = stats.multivariate_normal(np.zeros(len(data)), cover).logpdf(data)
    sd = np.sqrt(np.maximum(np.diagonal(left), 0.0))
    return log_z, (gain @ data).reshape(steps, 3), sd.reshape(steps, 3)


counts = ssm.Model("counts")


@counts.prior
def counts_prior():
    return {"p": ssm.Beta(2, 3), "r": ssm.Beta(3, 2)}


@counts.initial
def counts_initial():
    return {"n": ssm.Bernoulli(0.5), "k": ssm.Dirac(1.0)}


@counts.transition
def flow(p, n):
    return {"leave": ssm.Bernoulli(p * (0.5 + 0.5 * n))}


@counts.transition
def count(n, leave_next):
    return {"n": ssm.Dirac(np.maximum(1 - leave_next, 1 - n))}


@counts.transition
def switch(k, n_next, leave_next, r):
    return {"k": ssm.Bernoulli(np.where(leave_next > 0, r, 0.2 + 0.4 * n_next * k))}


@counts.observation
def counts_observation(k, n):
    return {"y": ssm.Normal(k - n, sd=0.7)}


def counts_paths(theta, y):
    """(paths (M, T, 3) of (n, k, leave), log p(path, y) (M,)): all that are possible."""
    p, r = theta["p"], theta["r"]
    paths, total = [], []
    for n, *steps in itertools.product((0, 1), *((0, 1, 2, 3),) * (len(y) - 1)):
        k, log_p, path = 1, np.log(0.5), [(n, 1, 0)]
        for step in steps:
            leave, new = divmod(step, 2)
            chance = p * (0.5 + 0.5 * n)
            log_p += np.log(chance if leave else 1 - chance)
            n = max(1 - leave, 1 - n)
            chance = r if leave else 0.2 + 0.4 * n * k
            log_p += np.log(chance if new else 1 - chance)
            k = new
            path.append((n, k, leave))
        path = np.array(path, dtype=float)
        off = (y - path[:, 1] + path[:, 0]) / 0.7
        paths.append(path)
        total.append(log_p - np.sum(0.5 * off**2 + np.log(0.7 * np.sqrt(2 * np.pi))))
    return np.array(paths), np.array(total)


def counts_posterior(y, points=12):
    """Means of p and r given y, by Gauss-Legendre quadrature over both."""
    nodes, weights = np.polynomial.legendre.leggauss(points)
    nodes, weights = (nodes + 1) / 2, weights / 2
    height = np.array([
        [special.logsumexp(counts_paths({"p": p, "r": r}, y)[1])
         + stats.beta.logpdf(p, 2, 3) + stats.beta.logpdf(r, 3, 2) for r in nodes]
        for p in nodes
    ])  # fmt: skip
    mass = np.exp(height - height.max()) * np.outer(weights, weights)
    mass /= mass.sum()
    return {"p": float(mass.sum(1) @ nodes), "r": float(mass.sum(0) @ nodes)}


regimes = ssm.Model("regimes to come")


@regimes.initial
def regimes_initial():
    return {"s": ssm.Bernoulli(0.5), "x": ssm.Normal(0, sd=1), "z": ssm.Normal(0, sd=1)}


@regimes.transition
def regime(s):
    return {"s": ssm.Bernoulli(np.where(s > 0, 0.8, 0.3))}


@regimes.transition
def moved(s_next, x):
    return {"x": ssm.Normal(np.where(s_next > 0, -0.5, 0.9) * x + s_next, sd=0.5)}


@regimes.transition
def followed(x_next, z, s):
    return {"z": ssm.Normal(0.7 * z + (0.5 + s) * x_next, sd=0.3)}


@regimes.observation
def regimes_observation(z):
    return {"y": ssm.Normal(z, sd=0.4)}


def regimes_answer(y):
    """log p(y), and means (T, 3) of (s, x, z) given y: a dense Gaussian for each path of s."""
    steps = len(y)
    log_z, means = [], []
    for path in itertools.product((0, 1), repeat=steps):
        log_p, total = np.log(0.5), 2 * steps
        x, z = np.eye(total)[0], np.eye(total)[1]
        constant_x = constant_z = 0.0
        rows, constants = [x, z], [0.0, 0.0]
        for t in range(1, steps):
            before, now = path[t - 1], path[t]
            chance = 0.8 if before else 0.3
            log_p += np.log(chance if now else 1 - chance)
            a = -0.5 if now else 0.9
            x = a * x + 0.5 * np.eye(total)[2 * t]
            constant_x = a * constant_x + now
            z = 0.7 * z + (0.5 + before) * x + 0.3 * np.eye(total)[2 * t + 1]
            constant_z = 0.7 * constant_z + (0.5 + before) * constant_x
            rows += [x, z]
            constants += [constant_x, constant_z]
        weights, middle = np.array(rows), np.array(constants)
        prior, read = weights @ weights.T, np.arange(1, total, 2)
        cover = prior[np.ix_(read, read)] + 0.16 * np.eye(steps)
        log_z.append(log_p + stats.multivariate_normal(middle[read], cover).logpdf(y))
        given = middle + prior[:, read] @ np.linalg.solve(cover, y - middle[read])
        means.append(np.column_stack([path, given.reshape(steps, 2)]))
    total = special.logsumexp(log_z)
    return total, np.einsum("m,mti->ti", np.exp(np.array(log_z) - total), np.array(means))


volatility = ssm.Model("volatility to come")


@volatility.initial
def volatility_initial():
    return {"h": ssm.Normal(0, sd=1), "x": ssm.Normal(0, sd=1)}


@volatility.transition
def volatility_first(h):
    return {"h": ssm.Normal(0.8 * h, sd=0.4)}


@volatility.transition
def volatility_second(x, h, h_next):
    mean = 0.9 * x + 0.5 * (h_next - 0.8 * h)
    return {"x": ssm.Normal(mean, sd=np.exp(0.5 * h_next))}


@volatility.observation
def volatility_observation(x):
    return {"y": ssm.Normal(x, sd=0.3)}


def volatility_answer(y, points=40):
    """log p(y): quadrature over the noises of h (Gauss-Hermite), given which x is Gaussian."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(points)
    grids = np.meshgrid(*(nodes,) * len(y), indexing="ij")
    mass = np.ones(grids[0].shape)
    for axis in np.meshgrid(*(weights / weights.sum(),) * len(y), indexing="ij"):
        mass = mass * axis
    h, mean, variance = grids[0], np.zeros_like(mass), np.ones_like(mass)
    log_g = np.zeros_like(mass)
    for t, value in enumerate(y):
        if t:
            new = 0.8 * h + 0.4 * grids[t]
            mean = 0.9 * mean + 0.5 * (new - 0.8 * h)
            variance = 0.81 * variance + np.exp(new)
            h = new
        log_g += stats.norm.logpdf(value, mean, np.sqrt(variance + 0.09))
        gain = variance / (variance + 0.09)
        mean, variance = mean + gain * (value - mean), variance * (1 - gain)
    return float(np.log(np.sum(mass * np.exp(log_g))))
