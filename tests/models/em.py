"""Models for EM with exact answers: linear Gaussian, so that the Kalman likelihood tells the truth.

Each with its matrices, written by hand, for the dense Gaussian of `tests/statistics/exact.py`.
"""

from __future__ import annotations

import numpy as np

import ssmppl as ssm
from ssmppl.data import check_parameters
from ssmppl.inference.exact.kalman import kalman_model
from ssmppl.inference.run.problem import pose
from ssmppl.language.tracing import trace

# --- AR(2) in companion form: noisy laws with parameters, a deterministic state without ----------

companion = ssm.Model("companion")


@companion.prior
def companion_prior():
    return {
        "a": ssm.Normal(np.zeros(2), sd=1),
        "q": ssm.InverseGamma(3, scale=1),
        "r": ssm.InverseGamma(3, scale=1),
    }


@companion.initial
def companion_initial():
    return {"x": ssm.Normal(0, sd=1), "before": ssm.Dirac(0.0)}


@companion.transition
def companion_transition(x, before, a, q):
    return {"x": ssm.Normal(a[0] * x + a[1] * before, variance=q), "before": ssm.Dirac(x)}


@companion.observation
def companion_observation(x, r):
    return {"y": ssm.Normal(x, variance=r)}


COMPANION = {"a": [0.9, -0.4], "q": 0.5, "r": 0.4}
COMPANION_MATRICES = {
    "m": [0.0, 0.0], "P": np.diag([1.0, 0.0]), "A": [[0.9, -0.4], [1.0, 0.0]], "b": [0.0, 0.0],
    "Q": np.diag([0.5, 0.0]), "C": [[1.0, 0.0]], "d": [0.0], "R": [[0.4]],
}  # fmt: skip

# --- two states with a matrix, a covariance and a vector channel; an input -----------------------

vector = ssm.Model("vector", inputs=("u",))


@vector.prior
def vector_prior():
    return {
        "A": ssm.Normal(np.zeros((2, 2)), sd=1),
        "b": ssm.Normal(np.zeros(2), sd=1),
        "Q": ssm.InverseWishart(4, scale=np.eye(2)),
        "c": ssm.Normal(1, sd=1),
        "r": ssm.Gamma(np.full(2, 2.0), rate=1),
    }


@vector.initial
def vector_initial():
    return {"x": ssm.MvNormal(np.zeros(2), covariance=np.eye(2))}


@vector.transition
def vector_transition(x, u, A, b, Q):
    return {"x": ssm.MvNormal(A @ x + b * u, covariance=Q)}


@vector.observation
def vector_observation(x, c, r):
    return {"y": ssm.Normal(np.stack([x[0] + c * x[1], x[1]]), precision=r)}


VECTOR = {
    "A": [[0.7, 0.2], [-0.3, 0.6]], "b": [0.5, -0.2], "Q": [[0.6, 0.2], [0.2, 0.4]], "c": 0.5,
    "r": [2.0, 3.0],
}  # fmt: skip


def vector_matrices(u):
    b = np.zeros((len(u), 2))
    b[1:] = np.outer(u[:-1], VECTOR["b"])
    return {
        "m": [0.0, 0.0], "P": np.eye(2), "A": VECTOR["A"], "b": b, "Q": VECTOR["Q"],
        "C": [[1.0, 0.5], [0.0, 1.0]], "d": [0.0, 0.0], "R": np.diag([1 / 2.0, 1 / 3.0]),
    }  # fmt: skip


# --- one state, everything unknown, the initial law stationary: no closed form for phi -----------

stationary = ssm.Model("stationary")


@stationary.prior
def stationary_prior():
    return {
        "phi": ssm.Uniform(-1, 1),
        "tau": ssm.Gamma(2, rate=1),
        "mu": ssm.Normal(0, sd=2),
        "r": ssm.InverseGamma(3, scale=1),
    }


@stationary.initial
def stationary_initial(mu, phi, tau):
    return {"x": ssm.Normal(mu, precision=(1 - phi**2) * tau)}


@stationary.transition
def stationary_transition(x, mu, phi, tau):
    return {"x": ssm.Normal(mu + phi * (x - mu), precision=tau)}


@stationary.observation
def stationary_observation(x, r):
    return {"y": ssm.Normal(x, variance=r)}


STATIONARY = {"phi": 0.8, "tau": 1.5, "mu": 1.0, "r": 0.3}

# --- irregular sampling: the decay enters through exp(-k dt), which does not separate ------------

decay = ssm.Model("decay", inputs=("dt",))


@decay.prior
def decay_prior():
    return {"k": ssm.Gamma(2, rate=1), "s": ssm.InverseGamma(3, scale=1)}


@decay.initial
def decay_initial():
    return {"x": ssm.Normal(0, sd=1)}


@decay.transition
def decay_transition(x, dt, k, s):
    share = np.exp(-k * dt)
    return {"x": ssm.Normal(share * x, variance=s * (1 - share**2))}


@decay.observation
def decay_observation(x):
    return {"y": ssm.Normal(x, sd=0.3)}


DECAY = {"k": 0.7, "s": 1.2}


def simulated(model, parameters, steps, seed, missing=0.0, inputs=None):
    """A data set of a linear Gaussian model, some of it missing, and its inputs; uncompiled."""
    rng = np.random.default_rng(seed)
    shape = trace(model).observations["y"].shape
    problem = pose(model, {"y": np.zeros((steps, *shape)), **(inputs or {})})
    theta = check_parameters(problem.trace, parameters)
    given = kalman_model(problem.trace).matrices(problem.experiments[0], theta)
    A, b, Q, C, d, R = (np.broadcast_to(a, (steps, *a.shape[1:])) for a in given[2:])
    y, x = np.empty((steps, R.shape[1])), given.m
    for t in range(steps):
        mean, spread = (A[t] @ x + b[t], Q[t]) if t else (given.m, given.P)
        x = mean + _noise(spread, rng)
        y[t] = C[t] @ x + d[t] + _noise(R[t], rng)
    y[rng.random(y.shape) < missing] = np.nan
    return {"y": y.reshape(steps, *shape), **(inputs or {})}


def _noise(covariance, rng):
    values, vectors = np.linalg.eigh(covariance)
    return vectors @ (np.sqrt(np.maximum(values, 0.0)) * rng.standard_normal(len(values)))
