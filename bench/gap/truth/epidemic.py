"""An epidemic that smoulders: the share still susceptible and the log of the share infectious; the
day's new cases are counted, people's contacts are known.

Outside the catalogue: caution, by which contacts count for less the more cases there are, with a
taste for the middle of the range.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from bench.gap.truth import forms as f
from bench.gap.truth.system import Effect, System

STEPS = 500
WANING = 0.02


@njit
def step(s, u, t, p, e, mean, sd):
    x, i, z1, z2, lag = s[0], s[1], s[2], s[3], s[4]
    beta, gamma, b, q = p[0], p[1], p[2], p[3]
    beta = beta * (1 + e[f.BREAK] * f.logistic((t - 0.5 * STEPS) / 3))
    gamma = gamma * (1 + e[f.DRIFT] * f.logistic((t / STEPS - 0.5) * 9))
    infectious = np.exp(min(i, 0.0))
    caution = e[f.OUTSIDE] * np.cos(4.0 * (i + 2.7)) * (u[0] - 0.3)
    force = beta * max(1 + b * u[0], 0.1) * (1 + caution)
    force *= 1 + e[f.PERIODIC] * f.triangle(t / 29.3)
    mixing = max(x, 0.001) * (1 + e[f.COUPLING] * (infectious - 0.05) * 5)
    mean[0] = x - force * x * infectious + WANING * (1 - x - infectious)
    mean[1] = i + force * mixing - gamma + e[f.MISSING] * z1
    mean[2] = 0.93 * z1 + 0.07 * z2
    mean[3] = 0.93 * z2
    keep = f.forget(e[f.SENSOR_LAG])
    mean[4] = keep * lag + (1 - keep) * infectious
    sd[:] = 0
    sd[1] = q
    sd[3] = 0.52 if e[f.MISSING] != 0 else 0.0


@njit
def observe(s, u, t, p, e, mean, sd, wild):
    keep = f.forget(e[f.SENSOR_LAG])
    share = keep * s[4] + (1 - keep) * np.exp(min(s[1], 0.0))
    share *= 1 + e[f.SENSOR_DRIFT] * 0.5 * (1 - np.cos(np.pi * t / STEPS))
    mean[0] = 8000.0 * max(share, 1e-6)
    sd[0] = np.sqrt(mean[0])


def excite(rng, T):
    return f.lagged(f.holds(rng, T, 8, 25, (-1.0, -0.5, 0.0, 0.5, 1.0)), 2.0)[:, None]


SYSTEM = System(
    "epidemic",
    STEPS,
    {"beta": 0.5, "gamma": 0.25, "b": 0.6, "q": 0.02},
    ("u",),
    ("y",),
    ("s", "i", "missing force", "its rate", "reporting"),
    ((0.55, 0.05), (-3.4, 0.3), (0.0, 0.0), (0.0, 0.0), (0.033, 0.0)),
    step,
    observe,
    excite,
    {
        "break": Effect("break_", "parameter break", ("beta",), -0.125),
        "drift": Effect("drift", "parameter drift", ("gamma",), 0.1),
        "periodic": Effect("periodic", "periodic forcing", ("i",), 0.15),
        "delay": Effect("delay", "input delay", ("u",), 2.5),
        "asymmetry": Effect("asymmetry", "input asymmetry", ("u",), 0.5),
        "missing": Effect("missing", "missing input", ("i",), 0.03),
        "sensor lag": Effect("sensor_lag", "sensor lag", ("y",), 4.0),
        "sensor drift": Effect("sensor_drift", "sensor drift", ("y",), 0.3),
        "caution": Effect("outside", None, ("i",), 0.5),
    },
    counts=True,
)
