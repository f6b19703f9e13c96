"""Yeast in a stirred vessel that is fed and drained at the rate u: the cells and the sugar that is
left are measured.

Outside the catalogue: flocs, which hold the cells back from the outlet in a rhythm of sugar and
flow together.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from bench.gap.truth import forms as f
from bench.gap.truth.system import Effect, System

DT = 0.25
STEPS = 500
FEED = 10.0


@njit
def step(s, u, t, p, e, mean, sd):
    x, c, lag, z1, z2 = s[0], s[1], s[2], s[3], s[4]
    mu, half, yld, q = p[0], p[1], p[2], p[3]
    fast = mu * (1 - e[f.BREAK] * f.logistic((t - 0.5 * STEPS) / 4))
    gives = yld * (1 - e[f.DRIFT] * f.logistic((t / STEPS - 0.5) * 8))
    growth = fast * max(c, 0.0) / (half + max(c, 0.0)) * x
    death = e[f.LOSS] * f.signed_power(max(x, 0.0), 1.7) / 8
    out = u[0] * (1 - e[f.OUTSIDE] * np.sin(2.5 * c) * (u[0] - 0.1) / 0.2)
    mean[0] = x + DT * (growth - out * x - death)
    mean[1] = c + DT * (u[0] * (FEED - c) - growth / gives + e[f.MISSING] * z1)
    keep = f.forget(e[f.SENSOR_LAG])
    mean[2] = keep * lag + (1 - keep) * c
    mean[3] = 0.93 * z1 + 0.07 * z2  # smooth noise of about unit variance
    mean[4] = 0.93 * z2
    sd[:] = 0
    sd[0] = q
    sd[1] = q
    sd[4] = 0.52 if e[f.MISSING] != 0 else 0.0


@njit
def observe(s, u, t, p, e, mean, sd, wild):
    keep = f.forget(e[f.SENSOR_LAG])
    mean[0] = f.arsinh_gain(s[0], e[f.GAIN])
    mean[1] = keep * s[2] + (1 - keep) * s[1]
    sd[0] = p[4]
    sd[1] = p[5]


def excite(rng, T):
    steps = f.holds(rng, T, 12, 36, (0.06, 0.12, 0.18, 0.24, 0.30))
    return (f.lagged(steps, 1.0) + 0.005 * f.smooth_noise(rng, T, 4.0))[:, None]


SYSTEM = System(
    "chemostat",
    STEPS,
    {"mu": 0.45, "half": 2.0, "yld": 0.5, "q": 0.012, "rx": 0.03, "rs": 0.05},
    ("u",),
    ("cells", "sugar"),
    ("x", "s", "sensor", "missing feed", "its rate"),
    ((4.0, 0.3), (1.5, 0.3), (1.5, 0.0), (0.0, 0.0), (0.0, 0.0)),
    step,
    observe,
    excite,
    {
        "loss": Effect("loss", "extra loss", ("x",), 0.1),
        "saturation": Effect("saturation", "input saturation", ("u",), 2.5),
        "delay": Effect("delay", "input delay", ("u",), 1.0),
        "drift": Effect("drift", "parameter drift", ("yld",), 0.06),
        "break": Effect("break_", "parameter break", ("mu",), 0.06),
        "missing": Effect("missing", "missing input", ("s",), 0.06),
        "gain": Effect("gain", "sensor gain nonlinearity", ("cells",), 0.3),
        "sensor lag": Effect("sensor_lag", "sensor lag", ("sugar",), 1.5),
        "flocs": Effect("outside", None, ("x",), 0.2),
    },
)
