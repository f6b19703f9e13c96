"""A pendulum driven by a measured torque; its angle is measured.

Outside the catalogue: the drive's torque ripples with three times the angle.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from bench.gap.truth import forms as f
from bench.gap.truth.system import Effect, System

DT = 0.04
STEPS = 800


@njit
def step(s, u, t, p, e, mean, sd):
    th, om, z, lag = s[0], s[1], s[2], s[3]
    g, c, b, q = p[0], p[1], p[2], p[3]
    damping = c * (1 + e[f.BREAK] * f.logistic((t - 0.55 * STEPS) / 4))
    torque = -g * np.sin(th) - damping * om + b * u[0]
    if e[f.STRIBECK] != 0:
        z = f.bristle(z, om, DT, 0.04, 0.5 + 1 / (1 + (om / 0.3) ** 2))
        torque -= e[f.STRIBECK] * z
    torque -= e[f.DRAG] * f.signed_power(om, 1.85)
    torque += e[f.LOAD] * (1 + 0.1 * np.sin(5 * th))
    torque -= e[f.DAMPING] * (np.cosh(1.2 * th) - 1) * om
    torque += e[f.OUTSIDE] * np.sin(3 * th) * u[0]
    mean[0] = th + DT * om
    mean[1] = om + DT * torque
    mean[2] = z
    keep = f.forget(e[f.SENSOR_LAG])
    mean[3] = keep * lag + (1 - keep) * th
    sd[:] = 0
    sd[1] = q


@njit
def observe(s, u, t, p, e, mean, sd, wild):
    keep = f.forget(e[f.SENSOR_LAG])
    mean[0] = keep * s[3] + (1 - keep) * s[0]
    sd[0] = p[4] * (1 + abs(e[f.SCEDASTIC]) * 0.3 * f.softplus((abs(s[1]) - 1.0) / 0.3))
    wild[0] = min(abs(e[f.OUTLIERS]), 0.5)


def excite(rng, T):
    steps = f.holds(rng, T, 10, 30, (-2.0, -1.0, 0.0, 1.0, 2.0))
    return (0.6 * steps + 2.0 * f.multisine(rng, T, 1, 16))[:, None]


SYSTEM = System(
    "pendulum",
    STEPS,
    {"g": 15.0, "c": 1.5, "b": 4.0, "q": 0.01, "r": 0.005},
    ("u",),
    ("y",),
    ("th", "om", "bristle", "sensor"),
    ((0.0, 0.3), (0.0, 0.3), (0.0, 0.0), (0.0, 0.0)),
    step,
    observe,
    excite,
    {
        "stribeck": Effect("stribeck", "stribeck", ("om",), 0.6),
        "drag": Effect("drag", "quadratic drag", ("om",), 0.3),
        "dead zone": Effect("dead_zone", "dead zone", ("u",), 0.4),
        "lag": Effect("lag", "actuator lag", ("u",), 0.7),
        "load": Effect("load", "constant load", ("om",), 0.2),
        "break": Effect("break_", "parameter break", ("c",), 0.12),
        "sensor lag": Effect("sensor_lag", "sensor lag", ("y",), 0.4),
        "scedastic": Effect("scedastic", "heteroscedastic noise", ("y",), 0.5),
        "ripple": Effect("outside", None, ("om",), 0.25),
    },
)
