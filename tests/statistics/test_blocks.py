"""Joint conjugate blocks through `sample`: posteriors against what is known of them in closed form.

The states are seen almost without noise, so that the conjugate posterior given the states is the
posterior: each sweep of Gibbs is an independent draw from it.
"""

from __future__ import annotations

import numpy as np
from scipy import stats

import ssmppl as ssm

from .checks import assert_within, deviations, seed_of

SPREAD = np.array([[0.5, 0.1], [0.1, 0.3]])  # V
MEAN = np.array([[0.6, 0.2], [-0.2, 0.5]])
DF, SCALE = 6.0, np.array([[2.0, 0.5], [0.5, 1.0]])

sharp = ssm.Model("sharply seen vector autoregression")


@sharp.prior
def sharp_noise():
    return {"Q": ssm.InverseWishart(DF, scale=SCALE)}


@sharp.prior
def sharp_coefficients(Q):
    return {"a": ssm.MvNormal(MEAN.ravel(), covariance=np.kron(Q, SPREAD))}


@sharp.initial
def sharp_initial(Q):
    return {"x": ssm.MvNormal(np.zeros(2), covariance=2 * Q)}


@sharp.transition
def sharp_transition(x, a, Q):
    return {"x": ssm.MvNormal(np.reshape(a, (2, 2)) @ x, covariance=Q)}


@sharp.observation
def sharp_observation(x):
    return {"y": ssm.Normal(x, sd=1e-4)}


def posterior(series):
    """(df, S, M, K): Q ~ inverse Wishart(df, S), A | Q ~ N(M, Q (x) K^-1), given the states.

    Written down by hand: the prior as if it were data, then each series.
    """
    k = np.linalg.inv(SPREAD)
    yy, yz, df = SCALE + MEAN @ k @ MEAN.T, MEAN @ k, DF
    for x in series:
        before, after = x[:-1], x[1:]
        yy = yy + after.T @ after + np.outer(x[0], x[0]) / 2.0
        yz, k, df = yz + after.T @ before, k + before.T @ before, df + len(x)
    mean = yz @ np.linalg.inv(k)
    return df, yy - mean @ yz.T, mean, k


def test_matrix_normal_inverse_wishart_posterior_of_two_experiments():
    truth = {"Q": np.array([[0.4, 0.15], [0.15, 0.2]]), "a": MEAN.ravel()}
    experiments = [
        ssm.simulate(sharp, truth, steps=steps, seed=seed_of("sharp", steps))["y"].values[0]
        for steps in (12, 25)
    ]
    idata = ssm.sample(
        sharp, [{"y": y} for y in experiments], ssm.Gibbs(), draws=1500, warmup=20, chains=1,
        progress=False, states=False, seed=seed_of("sharp posterior"),
    )  # fmt: skip
    df, scale, mean, k = posterior(experiments)
    found, spread = {}, np.linalg.inv(k)
    a, q = idata["posterior"]["a"].values, idata["posterior"]["Q"].values
    for i in range(2):
        law = stats.invgamma((df - 1) / 2, scale=scale[i, i] / 2)  # of Q_ii
        for name, value in deviations(q[..., i, i], law.mean(), law.std()).items():
            found[f"Q[{i}, {i}] {name}"] = value
        for j in range(2):
            t = stats.t(df - 1, mean[i, j], np.sqrt(scale[i, i] * spread[j, j] / (df - 1)))
            for name, value in deviations(a[..., 2 * i + j], t.mean(), t.std()).items():
                found[f"A[{i}, {j}] {name}"] = value
    expected = scale[0, 1] / (df - 3)
    found["Q[0, 1] mean"] = deviations(q[..., 0, 1], expected)["mean"]
    assert_within(found)
