"""Linear Gaussian examples by statsmodels: its Kalman filter on matrices written down here, its
own local level and regime switching models; two finite states by hmmlearn as well.

statsmodels' transition is that out of row t, and its noise has a loading of its own.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy import stats

import ssmppl as ssm
from examples.check.rows import (
    Estimate,
    Row,
    check,
    files,
    log_likelihood,
    posterior_mean,
    stated,
)

KALMAN = "statsmodels: Kalman filter"


def kalman(y: Any, mean: Any, covariance: Any, **matrices: Any) -> float:
    """log p(y) of a linear Gaussian model: y (T, k) with NaN where it is missing, start (d,) and
    (d, d), and statsmodels' system matrices, with a last axis where they vary in time."""
    from statsmodels.tsa.statespace.kalman_filter import KalmanFilter

    y = np.asarray(y, float).reshape(len(y), -1)
    d = len(mean)
    model = KalmanFilter(k_endog=y.shape[1], k_states=d, k_posdef=d)
    model.tolerance = 0.0  # no shortcut once the gain has converged
    model.bind(np.ascontiguousarray(y))
    model["selection"] = np.eye(d)
    for name, value in matrices.items():
        model[name] = np.asarray(value, float)
    model.initialize_known(np.asarray(mean, float), np.asarray(covariance, float))
    return float(model.filter().llf)


def lgss_log_likelihood(theta: float) -> float:
    y = files("lgss")[1][0]["y"].to_numpy()
    return kalman(
        y, [0.0], [[1 / (0.51 * theta)]], transition=[[0.7]], state_cov=[[1 / theta]],
        design=[[0.5]], obs_cov=[[0.1]],
    )  # fmt: skip


@check("lgss", "statsmodels")
def lgss() -> Iterator[Row]:
    theta = {"theta": 1.0}
    exact = Estimate(lgss_log_likelihood(1.0))
    yield Row("lgss", stated(theta), "Kalman", KALMAN, log_likelihood("lgss", theta), exact)

    grid = np.linspace(0.2, 2.2, 401)
    log_p = np.array(
        [lgss_log_likelihood(v) + stats.gamma.logpdf(v, 0.01, scale=100) for v in grid]
    )
    weight = np.exp(log_p - log_p.max())
    model, data = files("lgss")
    idata = ssm.sample(
        model, data, ssm.Gibbs(), draws=3000, warmup=200, states=False, seed=1, progress=False
    )
    yield Row(
        "lgss", "posterior mean of theta", "Gibbs", "statsmodels: Kalman filter, quadrature",
        posterior_mean(idata, "theta"), Estimate(float(weight @ grid / weight.sum())),
    )  # fmt: skip


@check("nile", "statsmodels")
def nile() -> Iterator[Row]:
    from statsmodels.tsa.statespace.structural import UnobservedComponents

    theta = {"step": -285.0, "q": 525.0, "r": 15400.0}
    step, q, r = theta.values()
    table = files("nile")[1][0]
    model = UnobservedComponents(table["y"].to_numpy(), "llevel", exog=table["dam"].to_numpy())
    model.ssm.tolerance = 0.0
    model.ssm.loglikelihood_burn = 0  # it would leave out the first row, as for a diffuse start
    model.ssm.initialize_known(np.array([1000.0]), np.array([[300.0**2]]))
    values = {"sigma2.irregular": r, "sigma2.level": q, "beta.x1": step}
    exact = model.loglike(np.array([values[name] for name in model.param_names]))
    yield Row(
        "nile", stated(theta), "Kalman", "statsmodels: UnobservedComponents",
        log_likelihood("nile", theta), Estimate(float(exact)),
    )  # fmt: skip


@check("heating", "statsmodels")
def heating() -> Iterator[Row]:
    theta = {"a": 0.85, "b": 1.5, "q": 0.04, "r": 0.25}
    a, b, q, r = theta.values()
    table = files("heating")[1][0]
    exact = kalman(
        table["y"], [0.0], [[25.0]], transition=[[a]], state_cov=[[q]], design=[[1.0]],
        obs_cov=[[r]], state_intercept=b * table["u"].to_numpy()[None, :],
    )  # fmt: skip
    yield Row("heating", stated(theta), "Kalman", KALMAN,
              log_likelihood("heating", theta), Estimate(exact))  # fmt: skip


@check("fan", "statsmodels")
def fan() -> Iterator[Row]:
    theta = {"b": 1.2, "c": 1.2, "q": 0.02, "r": 0.03}
    b, c, q, r = theta.values()
    table = files("fan")[1][0]
    exact = kalman(
        table["y"], [0.0], [[0.25]], transition=[[1 - 0.05 * c]], state_cov=[[q**2]],
        design=[[1.0]], obs_cov=[[r**2]],
        state_intercept=0.05 * b * table["u"].to_numpy()[None, :],
    )  # fmt: skip
    yield Row("fan", stated(theta), "Kalman", KALMAN, log_likelihood("fan", theta), Estimate(exact))


@check("vehicle", "statsmodels")
def vehicle() -> Iterator[Row]:
    theta = {
        "c_front": 7.0, "c_rear": 8.5, "q_v": 1e-3, "q_w": 2e-5, "r_gyro": 1e-4, "r_position": 0.04,
    }  # fmt: skip
    h, mass, inertia, front, rear = 0.04, 1500.0, 2500.0, 1.2, 1.5
    cf, cr = 7e4, 8.5e4
    total = 0.0
    for table in files("vehicle")[1]:
        speed, steer = table["speed"].to_numpy()[0], table["steer"].to_numpy()
        lean = (rear * cr - front * cf) / speed
        A = np.array([  # of (v, w, heading, position), in continuous time
            [-(cf + cr) / (mass * speed), lean / mass - speed, 0, 0],
            [lean / inertia, -(front**2 * cf + rear**2 * cr) / (inertia * speed), 0, 0],
            [0, 1, 0, 0],
            [1, 0, speed, 0],
        ])  # fmt: skip
        push = np.array([cf / mass, front * cf / inertia, 0, 0])
        total += kalman(
            table[["gyro", "place"]], np.zeros(4), np.diag([0.1, 0.02, 0.02, 0.5]) ** 2,
            transition=np.eye(4) + h * A, state_intercept=h * np.outer(push, steer),
            state_cov=np.diag([1e-3, 2e-5, 0, 0]), design=[[0, 1, 0, 0], [0, 0, 0, 1]],
            obs_cov=np.diag([1e-4, 0.04]),
        )  # fmt: skip
    yield Row("vehicle", stated(theta), "Kalman", f"{KALMAN}, sum of three",
              log_likelihood("vehicle", theta), Estimate(total))  # fmt: skip


GROWTH = {"stay_low": 0.8, "stay_high": 0.95, "low": -1.5, "high": 4.0, "precision": 0.1}


@check("us_growth", "hmmlearn")
def us_growth() -> Iterator[Row]:
    from hmmlearn.hmm import GaussianHMM

    y = files("us_growth")[1][0]["growth"].to_numpy()
    peer = GaussianHMM(n_components=2, covariance_type="spherical", init_params="", params="")
    peer.startprob_ = np.array([0.2, 0.8])
    peer.transmat_ = np.array([[0.8, 0.2], [0.05, 0.95]])
    peer.means_, peer.covars_ = np.array([[-1.5], [4.0]]), np.array([10.0, 10.0])
    yield Row(
        "us_growth", stated(GROWTH), "forward", "hmmlearn: GaussianHMM",
        log_likelihood("us_growth", GROWTH), Estimate(float(peer.score(y[:, None]))),
    )  # fmt: skip


@check("us_growth", "statsmodels")
def us_growth_switching() -> Iterator[Row]:
    from statsmodels.tsa.regime_switching.markov_regression import MarkovRegression

    y = files("us_growth")[1][0]["growth"].to_numpy()
    peer = MarkovRegression(y, k_regimes=2)
    peer.initialize_known(np.array([0.2, 0.8]))
    values = {"p[0->0]": 0.8, "p[1->0]": 0.05, "const[0]": -1.5, "const[1]": 4.0, "sigma2": 10.0}
    exact = peer.loglike(np.array([values[name] for name in peer.param_names]))
    yield Row(
        "us_growth", stated(GROWTH), "forward", "statsmodels: MarkovRegression",
        log_likelihood("us_growth", GROWTH), Estimate(float(exact)),
    )  # fmt: skip
