"""Every component, alone and with others, against statsmodels: likelihoods and smoothed states.

statsmodels counts a diffuse state without the factor sqrt(2 pi) of a flat one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

import ssmppl as ssm

structural = pytest.importorskip("statsmodels.tsa.statespace.structural")
initialization = pytest.importorskip("statsmodels.tsa.statespace.initialization")
kalman_smoother = pytest.importorskip("statsmodels.tsa.statespace.kalman_smoother")
st = ssm.structural

ROWS = 60
RNG = np.random.default_rng(7)
Y = 5.0 + np.cumsum(RNG.normal(size=ROWS)) + np.tile([1.0, -0.5, 0.3, -0.8], ROWS // 4)
Y[[3, 21, 22]] = np.nan
U, V = RNG.normal(size=(2, ROWS))
DATA = {"y": Y, "u": U, "v": V}


@dataclass(frozen=True)
class Case:
    """parts : adds components. theta : by our names. spec, params : of statsmodels', its parameters
    by its names. diffuse : how many states are flat."""

    parts: Callable[[ssm.Model], list[Any]]
    theta: dict[str, Any]
    spec: dict[str, Any]
    params: dict[str, float]
    diffuse: int
    state: str = ""
    column: int = 0


def ar3() -> np.ndarray:
    return np.array([0.5, -0.3, 0.2])


LEVEL = {"level_sd": 0.7}
CASES = {
    "level": Case(
        lambda m: [st.level(m)], LEVEL, {"level": "llevel"}, {"sigma2.level": 0.49}, 1, "level"
    ),
    "level that does not move": Case(
        lambda m: [st.level(m, sd=0)], {}, {"level": "dconstant"}, {}, 1, "level"
    ),
    "trend": Case(
        lambda m: [st.trend(m)], LEVEL | {"slope_sd": 0.1}, {"level": "lltrend"},
        {"sigma2.level": 0.49, "sigma2.trend": 0.01}, 2, "slope", 1,
    ),
    "smooth trend": Case(
        lambda m: [st.trend(m, level_sd=0)], {"slope_sd": 0.1}, {"level": "strend"},
        {"sigma2.trend": 0.01}, 2, "level",
    ),
    "drift": Case(
        lambda m: [st.trend(m, slope_sd=0)], LEVEL, {"level": "lldtrend"},
        {"sigma2.level": 0.49}, 2, "level",
    ),
    "season": Case(
        lambda m: [st.level(m), st.seasonal(m, 4)], LEVEL | {"season_sd": 0.2},
        {"level": "llevel", "seasonal": 4}, {"sigma2.level": 0.49, "sigma2.seasonal": 0.04},
        4, "season", 1,
    ),
    "season of two": Case(
        lambda m: [st.level(m), st.seasonal(m, 2)], LEVEL | {"season_sd": 0.2},
        {"level": "llevel", "seasonal": 2}, {"sigma2.level": 0.49, "sigma2.seasonal": 0.04},
        2, "season", 1,
    ),
    "season that does not change": Case(
        lambda m: [st.level(m), st.seasonal(m, 12, sd=0)], LEVEL,
        {"level": "llevel", "seasonal": 12, "stochastic_seasonal": False},
        {"sigma2.level": 0.49}, 12, "season", 1,
    ),
    "harmonics": Case(
        lambda m: [st.level(m), st.seasonal(m, 7, form="trigonometric")],
        LEVEL | {"season_sd": 0.2},
        {"level": "llevel", "freq_seasonal": [{"period": 7, "harmonics": 3}]},
        {"sigma2.level": 0.49, "sigma2.freq_seasonal_7(3)": 0.04}, 7,
    ),
    "two harmonics of twelve": Case(
        lambda m: [st.level(m), st.seasonal(m, 12, form="trigonometric", harmonics=2)],
        LEVEL | {"season_sd": 0.2},
        {"level": "llevel", "freq_seasonal": [{"period": 12, "harmonics": 2}]},
        {"sigma2.level": 0.49, "sigma2.freq_seasonal_12(2)": 0.04}, 5,
    ),
    "cycle": Case(
        lambda m: [st.level(m), st.cycle(m, (5, 40), initial=ssm.Flat())],
        LEVEL | {"cycle_period": 9.0, "cycle_damping": 0.9, "cycle_sd": 0.3},
        {"level": "llevel", "cycle": True, "stochastic_cycle": True, "damped_cycle": True},
        {"sigma2.level": 0.49, "sigma2.cycle": 0.09, "frequency.cycle": 2 * np.pi / 9,
         "damping.cycle": 0.9}, 3,
    ),
    "cycle that lasts": Case(
        lambda m: [st.level(m), st.cycle(m, (5, 40), damping=1)],
        LEVEL | {"cycle_period": 9.0, "cycle_sd": 0.3},
        {"level": "llevel", "cycle": True, "stochastic_cycle": True},
        {"sigma2.level": 0.49, "sigma2.cycle": 0.09, "frequency.cycle": 2 * np.pi / 9}, 3,
    ),
    "regression": Case(
        lambda m: [st.level(m), st.regression(m, ["u", "v"])],
        LEVEL | {"u_coefficient": 0.4, "v_coefficient": -1.2},
        {"level": "llevel", "exog": np.stack([U, V], axis=1)},
        {"sigma2.level": 0.49, "beta.x1": 0.4, "beta.x2": -1.2}, 1, "level",
    ),
    "coefficients integrated out": Case(
        lambda m: [st.level(m), st.regression(m, ["u", "v"], random_walk=True, sd=0)], LEVEL,
        {"level": "llevel", "exog": np.stack([U, V], axis=1), "mle_regression": False},
        {"sigma2.level": 0.49}, 3, "v_coefficient", 2,
    ),
    "step": Case(
        lambda m: [st.level(m), st.intervention(m, 31)], LEVEL | {"step_31": 2.5},
        {"level": "llevel", "exog": (np.arange(1, ROWS + 1) >= 31).astype(float)},
        {"sigma2.level": 0.49, "beta.x1": 2.5}, 1,
    ),
    "pulse": Case(
        lambda m: [st.level(m), st.intervention(m, 31, kind="pulse")],
        LEVEL | {"pulse_31": 2.5},
        {"level": "llevel", "exog": (np.arange(1, ROWS + 1) == 31).astype(float)},
        {"sigma2.level": 0.49, "beta.x1": 2.5}, 1,
    ),
    "ramp": Case(
        lambda m: [st.level(m), st.intervention(m, 31, kind="ramp")], LEVEL | {"ramp_31": 0.2},
        {"level": "llevel", "exog": np.maximum(np.arange(1, ROWS + 1) - 30.0, 0.0)},
        {"sigma2.level": 0.49, "beta.x1": 0.2}, 1,
    ),
    "autoregression": Case(
        lambda m: [st.level(m), st.autoregression(m)],
        LEVEL | {"ar_coefficient": 0.6, "ar_sd": 0.5},
        {"level": "llevel", "autoregressive": 1},
        {"sigma2.level": 0.49, "sigma2.ar": 0.25, "ar.L1": 0.6}, 1, "ar", 1,
    ),
    "autoregression of order 3": Case(
        lambda m: [
            st.level(m), st.autoregression(m, 3, coefficients=ssm.Normal(0, sd=0.5))
        ],
        LEVEL | {"ar_coefficients": ar3(), "ar_sd": 0.5},
        {"level": "llevel", "autoregressive": 3},
        {"sigma2.level": 0.49, "sigma2.ar": 0.25,
         **{f"ar.L{k + 1}": c for k, c in enumerate(ar3())}}, 1,
    ),
    "all together": Case(
        lambda m: [
            st.trend(m), st.seasonal(m, 4), st.cycle(m, (5, 40), initial=ssm.Flat()),
            st.regression(m, "u"), st.autoregression(m, 2),
        ],
        LEVEL | {
            "slope_sd": 0.1, "season_sd": 0.2, "cycle_period": 9.0, "cycle_damping": 0.9,
            "cycle_sd": 0.3, "u_coefficient": 0.4, "ar_partial": np.array([0.4, -0.3]),
            "ar_sd": 0.5,
        },
        {"level": "lltrend", "seasonal": 4, "cycle": True, "stochastic_cycle": True,
         "damped_cycle": True, "autoregressive": 2, "exog": U},
        {"sigma2.level": 0.49, "sigma2.trend": 0.01, "sigma2.seasonal": 0.04,
         "sigma2.cycle": 0.09, "frequency.cycle": 2 * np.pi / 9, "damping.cycle": 0.9,
         "sigma2.ar": 0.25, "ar.L1": 0.4 * 1.3, "ar.L2": -0.3, "beta.x1": 0.4}, 7, "season", 2,
    ),
}  # fmt: skip


def built(case: Case) -> ssm.Model:
    model = ssm.Model("structural", inputs=("u", "v"))
    st.observe(model, "y", *case.parts(model))
    return model


@pytest.mark.parametrize("name", CASES)
def test_against_statsmodels(name: str):
    case = CASES[name]
    model, theta = built(case), case.theta | {"y_sd": 0.6}
    peer = structural.UnobservedComponents(Y, **case.spec, use_exact_diffuse=True)
    params = case.params | {"sigma2.irregular": 0.36}
    assert set(params) == set(peer.param_names)
    exact = peer.smooth([params[n] for n in peer.param_names])
    expected = exact.llf + 0.5 * case.diffuse * np.log(2 * np.pi)
    assert ssm.log_likelihood(model, DATA, theta) == pytest.approx(expected, rel=1e-8)
    if case.state:
        found = ssm.smooth(model, DATA, theta)[case.state].to_numpy()[0]
        np.testing.assert_allclose(found, exact.smoothed_state[case.column], rtol=1e-6, atol=1e-6)


def by_matrices(
    a: np.ndarray, q: np.ndarray, c: np.ndarray, diffuse: int | None = None
) -> tuple[float, np.ndarray]:
    """statsmodels' log-likelihood and smoothed states of given matrices. diffuse : how many states
    are, of which the others are stationary; None: all. c : (D,), or (D, T)."""
    n = len(a)
    peer = kalman_smoother.KalmanSmoother(1, n, n)
    peer.bind(Y[:, None])
    peer["transition"], peer["state_cov"], peer["selection"] = a, q, np.eye(n)
    peer["design"] = c[None, :] if c.ndim == 1 else c[None]
    peer["obs_cov"] = np.array([[0.36]])
    diffuse = n if diffuse is None else diffuse
    start = initialization.Initialization(n)
    start.set((0, diffuse), "diffuse")
    if diffuse < n:
        start.set((diffuse, n), "stationary")
    peer.initialize(start)
    found = peer.smooth()
    return found.llf + 0.5 * diffuse * np.log(2 * np.pi), found.smoothed_state


def test_a_cycle_starts_in_its_stationary_distribution():
    model = ssm.Model("cycle")
    st.observe(model, "y", st.level(model), st.cycle(model, (5, 40)))
    theta = LEVEL | {"cycle_period": 9.0, "cycle_damping": 0.9, "cycle_sd": 0.3, "y_sd": 0.6}
    cos, sin = 0.9 * np.cos(2 * np.pi / 9), 0.9 * np.sin(2 * np.pi / 9)
    a = np.array([[1.0, 0.0, 0.0], [0.0, cos, sin], [0.0, -sin, cos]])
    q, c = np.diag([0.49, 0.09, 0.09]), np.array([1.0, 1.0, 0.0])
    expected, _ = by_matrices(a, q, c, diffuse=1)
    assert ssm.log_likelihood(model, DATA, theta) == pytest.approx(expected, rel=1e-8)


def test_a_damped_trend():
    model = ssm.Model("damped")
    st.observe(model, "y", st.trend(model, damping=True))
    theta = LEVEL | {"slope_sd": 0.1, "damping": 0.8, "y_sd": 0.6}
    expected, states = by_matrices(
        np.array([[1.0, 1.0], [0.0, 0.8]]), np.diag([0.49, 0.01]), np.array([1.0, 0.0])
    )
    assert ssm.log_likelihood(model, DATA, theta) == pytest.approx(expected, rel=1e-8)
    found = ssm.smooth(model, DATA, theta)["slope"].to_numpy()[0]
    np.testing.assert_allclose(found, states[1], rtol=1e-6, atol=1e-6)


def test_coefficients_that_move():
    model = ssm.Model("moving", inputs=("u", "v"))
    st.observe(model, "y", st.level(model), st.regression(model, ["u", "v"], random_walk=True))
    theta = LEVEL | {"u_coefficient_sd": 0.2, "v_coefficient_sd": 0.3, "y_sd": 0.6}
    q, c = np.diag([0.49, 0.04, 0.09]), np.stack([np.ones(ROWS), U, V])
    expected, states = by_matrices(np.eye(3), q, c)
    assert ssm.log_likelihood(model, DATA, theta) == pytest.approx(expected, rel=1e-8)
    found = ssm.smooth(model, DATA, theta)["v_coefficient"].to_numpy()[0]
    np.testing.assert_allclose(found, states[2], rtol=1e-6, atol=1e-6)


def test_all_harmonics_of_an_even_period():
    """The last has one state: statsmodels has a second, which no data ever tell of. By harmonics of
    a fixed pattern as by dummies, as both are all patterns of sum 0."""
    model = ssm.Model("harmonics")
    st.observe(model, "y", st.level(model), st.seasonal(model, 4, form="trigonometric"))
    a = np.zeros((4, 4))
    a[0, 0], a[1, 2], a[2, 1], a[3, 3] = 1.0, 1.0, -1.0, -1.0
    q, c = np.diag([0.49, 0.04, 0.04, 0.04]), np.array([1.0, 1.0, 0.0, 1.0])
    expected, _ = by_matrices(a, q, c)
    theta = LEVEL | {"season_sd": 0.2, "y_sd": 0.6}
    assert ssm.log_likelihood(model, DATA, theta) == pytest.approx(expected, rel=1e-8)
    fixed = {}
    for form in ("dummy", "trigonometric"):
        model = ssm.Model("fixed pattern")
        st.observe(model, "y", st.level(model), st.seasonal(model, 4, form=form, sd=0))
        fixed[form] = ssm.smooth(model, DATA, LEVEL | {"y_sd": 0.6})["level"].to_numpy()
    np.testing.assert_allclose(*fixed.values(), rtol=1e-6)


def test_stationary_covariances():
    """Of partial autocorrelations as of coefficients, against the solution of P = A P A' + Q."""
    partial = np.array([0.4, -0.3, 0.5, -0.2])
    c = st.ar_coefficients(partial)
    a = np.zeros((4, 4))
    a[0], a[range(1, 4), range(3)] = c, 1.0
    q = np.zeros((4, 4))
    q[0, 0] = 0.7**2
    p = np.linalg.solve(np.eye(16) - np.kron(a, a), q.ravel()).reshape(4, 4)
    np.testing.assert_allclose(st.ar_covariance(0.7, partial=partial), p, rtol=1e-10)
    np.testing.assert_allclose(st.ar_covariance(0.7, coefficients=c), p, rtol=1e-10)
    assert np.abs(np.linalg.eigvals(a)).max() < 1.0
    not_stationary = st.ar_covariance(0.7, coefficients=np.array([1.5, 0.9]))
    assert np.linalg.eigvalsh(not_stationary)[0] < 0.0
