"""Linear Gaussian models that are singular: in all rows, or where the data say so."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

import ssmppl as ssm

ROWS = 8
DT = np.array([1.0, 0.0, 0.5, 1.0, 0.0, 0.0, 2.0, 1.0])  # two and three measurements at a time
ON = np.array([1.0, 1.0, 0.0, 1.0, 0.0, 1.0, 1.0, 1.0])
EXACT = np.array([1.0, 0.5, 0.0, 0.7, 1.0, 0.0, 1.0, 0.4])  # standard deviations of a sensor
PLANE = np.array([[0.9, 0.2], [-0.1, 0.8]])

Made = tuple[ssm.Model, dict[str, np.ndarray]]


def _model(name: str, transition: Callable, *, size: int = 0, observation: Callable | None = None,
           initial: Callable | None = None, **inputs: np.ndarray) -> Made:  # fmt: skip
    """size : of the state x, 0: a number, whose first component is measured with noise."""
    model = ssm.Model(name, inputs=tuple(inputs))
    start = {"x": ssm.MvNormal(np.zeros(size), covariance=np.eye(size))} if size else {
        "x": ssm.Normal(0.0, sd=1.0)
    }  # fmt: skip
    model.initial(initial or (lambda: start))
    model.transition(transition)
    model.observation(observation or (lambda x: {"y": ssm.Normal(x[0] if size else x, sd=1.0)}))
    return model, inputs


def walk() -> Made:
    return _model("walk", lambda x, dt: {"x": ssm.Normal(x, variance=0.5 * dt)}, dt=DT)


def walk_by_sd() -> Made:
    return _model("walk, sd", lambda x, dt: {"x": ssm.Normal(x, sd=0.7 * np.sqrt(dt))}, dt=DT)


def relaxation() -> Made:
    def transition(x, dt):
        left = np.exp(-0.7 * dt)
        return {"x": ssm.Normal(left * x, variance=0.8 * (1.0 - left**2))}

    return _model("Ornstein-Uhlenbeck", transition, dt=DT)


def switched() -> Made:
    return _model("switched", lambda x, on: {"x": ssm.Normal(0.9 * x, sd=0.6 * on)}, on=ON)


def by_row() -> Made:
    """The noise grows with the row, from nothing."""
    return _model("by row", lambda x, t: {"x": ssm.Normal(0.9 * x, sd=0.3 * (t - 1))})


def _white_noise(dt, q=0.5):
    return q * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])


def velocity() -> Made:
    def transition(x, dt):
        mean = np.array([x[0] + dt * x[1], x[1]])
        return {"x": ssm.MvNormal(mean, covariance=_white_noise(dt))}

    return _model("white-noise acceleration", transition, size=2, dt=DT)


def jerk() -> Made:
    def transition(x, dt):
        mean = np.array([x[0] + dt * x[1] + dt**2 / 2 * x[2], x[1] + dt * x[2], x[2]])
        q = 0.4 * np.array([
            [dt**5 / 20, dt**4 / 8, dt**3 / 6],
            [dt**4 / 8, dt**3 / 3, dt**2 / 2],
            [dt**3 / 6, dt**2 / 2, dt],
        ])  # fmt: skip
        return {"x": ssm.MvNormal(mean, covariance=q)}

    return _model("white-noise jerk", transition, size=3, dt=DT)


def one_force() -> Made:
    """One noise for two states, and none where the step has no length."""

    def transition(x, dt):
        g = np.array([dt**2 / 2, dt])
        return {"x": ssm.MvNormal(np.array([x[0] + dt * x[1], x[1]]),
                                  covariance=0.8 * np.outer(g, g))}  # fmt: skip

    return _model("one force", transition, size=2, dt=DT)


def one_force_always() -> Made:
    g = np.array([0.5, 1.0])

    def transition(x):
        mean = np.array([x[0] + x[1], x[1]])
        return {"x": ssm.MvNormal(mean, covariance=0.8 * np.outer(g, g))}

    return _model("one force, even steps", transition, size=2)


def correlated_switched() -> Made:
    q = np.array([[0.5, 0.2], [0.2, 0.4]])
    return _model(
        "correlated, switched",
        lambda x, on: {"x": ssm.MvNormal(PLANE @ x, covariance=on * q)}, size=2, on=ON,
    )  # fmt: skip


def fully_correlated() -> Made:
    """The correlation is one in some rows."""

    def transition(x, on):
        rho = 0.5 + 0.5 * on
        return {"x": ssm.MvNormal(PLANE @ x, covariance=0.4 * np.array([[1.0, rho], [rho, 1.0]]))}

    return _model("fully correlated", transition, size=2, on=1.0 - ON)


def one_switched() -> Made:
    """One of two noises is off in some rows."""

    def transition(x, on):
        return {"x": ssm.MvNormal(PLANE @ x, covariance=np.array([[0.5 * on, 0.0], [0.0, 0.3]]))}

    return _model("one switched", transition, size=2, on=ON)


def by_factor() -> Made:
    factor = np.array([[0.7, 0.0], [0.2, 0.5]])
    return _model(
        "by factor",
        lambda x, dt: {"x": ssm.MvNormal(PLANE @ x, cholesky=np.sqrt(dt) * factor)}, size=2, dt=DT,
    )  # fmt: skip


def companion() -> Made:
    a = np.array([[0.6, 0.3], [1.0, 0.0]])
    return _model(
        "companion",
        lambda x: {"x": ssm.MvNormal(a @ x, covariance=np.array([[0.5, 0.0], [0.0, 0.0]]))}, size=2,
    )  # fmt: skip


def integrated() -> Made:
    """A position without noise of its own."""
    return _model(
        "integrated",
        lambda x, v, dt: {"x": ssm.Dirac(x + dt * v), "v": ssm.Normal(0.9 * v, sd=np.sqrt(dt))},
        initial=lambda: {"x": ssm.Dirac(0.3), "v": ssm.Normal(0.0, sd=1.0)}, dt=DT,
    )  # fmt: skip


def sure_start() -> Made:
    return _model(
        "sure start", lambda x, s: {"x": ssm.Normal(x, sd=0.6)},
        initial=lambda s: {"x": ssm.Normal(0.2, sd=s)}, s=np.zeros(ROWS),
    )  # fmt: skip


def exact_sensor() -> Made:
    return _model(
        "exact sensor", lambda x, s: {"x": ssm.Normal(0.9 * x, sd=0.6)},
        observation=lambda x, s: {"y": ssm.Normal(x, sd=s)}, s=EXACT,
    )  # fmt: skip


def exact_sensors() -> Made:
    """Two channels at once, of which one is exact in some rows."""

    def observation(x, s):
        return {"y": ssm.MvNormal(x, covariance=np.array([[s**2, 0.1 * s], [0.1 * s, 0.3]]))}

    q = np.array([[0.5, 0.2], [0.2, 0.4]])
    return _model(
        "exact sensors", lambda x, s: {"x": ssm.MvNormal(PLANE @ x, covariance=q)}, size=2,
        observation=observation, s=EXACT,
    )  # fmt: skip


def exact_now_and_then() -> Made:
    """Steps of no length, and a sensor that is exact once."""
    s = np.ones(ROWS)
    s[3] = 0.0
    return _model(
        "exact once", lambda x, dt: {"x": ssm.Normal(x, variance=0.5 * dt)},
        observation=lambda x, s: {"y": ssm.Normal(x, sd=s)}, dt=DT, s=s,
    )  # fmt: skip


def two_states() -> Made:
    """Two states with distributions of their own, of which one stands still in some rows."""
    return _model(
        "two states",
        lambda x, v, dt: {"x": ssm.Normal(x + dt * v, sd=0.4), "v": ssm.Normal(v, variance=dt)},
        initial=lambda: {"x": ssm.Normal(0.0, sd=1.0), "v": ssm.Normal(0.0, sd=1.0)}, dt=DT,
    )  # fmt: skip


QUICK = [walk, velocity, correlated_switched, exact_sensor]
OTHERS = [
    walk_by_sd, relaxation, switched, by_row, jerk, one_force, one_force_always, fully_correlated,
    one_switched, by_factor, companion, integrated, sure_start, exact_sensors, exact_now_and_then,
    two_states,
]  # fmt: skip
