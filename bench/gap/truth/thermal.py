"""A heater in a casing: two temperatures above a reference, both measured; the heater's power and
the surroundings' temperature are known.

Outside the catalogue: a draught whose cooling depends on surroundings and core together, in bursts.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from bench.gap.truth import forms as f
from bench.gap.truth.system import Effect, System

STEPS = 500


@njit
def step(s, u, t, p, e, mean, sd):
    a, b_, z, n, z1, z2 = s[0], s[1], s[2], s[3], s[4], s[5]
    g, m, h, b, q = p[0], p[1], p[2], p[3], p[4]
    insulation = h * (1 + e[f.DRIFT] * f.logistic((t / STEPS - 0.5) * 8))
    over = b_ - u[1]
    cooling = e[f.LOSS] * (f.signed_power(over, 2.2) / 10 - over)
    bursts = max(np.sin(2 * np.pi * t / 53.0) + 0.6 * np.sin(2 * np.pi * t / 31.7), 0.0)
    draught = e[f.OUTSIDE] * bursts * np.sin(a / 6.0) * (u[1] + 3.0)
    mean[0] = a - g * (a - b_) + b * u[0] - e[f.LOAD] * (1 + 0.05 * np.tanh(a - 15.0)) + draught
    mean[1] = b_ + m * (a - b_) - insulation * over - cooling + e[f.MISSING] * z1
    keep = f.forget(e[f.SENSOR_LAG])
    mean[2] = keep * z + (1 - keep) * a
    mean[3] = 0.9 * n
    mean[4] = 0.93 * z1 + 0.07 * z2
    mean[5] = 0.93 * z2
    sd[:] = 0
    sd[0] = q
    sd[1] = q
    sd[3] = np.sqrt(1 - 0.81) if e[f.COLOURED] != 0 else 0.0
    sd[5] = 0.52 if e[f.MISSING] != 0 else 0.0


@njit
def observe(s, u, t, p, e, mean, sd, wild):
    keep = f.forget(e[f.SENSOR_LAG])
    mean[0] = keep * s[2] + (1 - keep) * s[0]
    mean[1] = s[1] + e[f.COLOURED] * s[3]
    sd[0] = p[5]
    sd[1] = p[5]
    wild[0] = min(abs(e[f.OUTLIERS]), 0.5)


def excite(rng, T):
    heater = f.lagged(f.holds(rng, T, 8, 30, (0.0, 0.5, 1.0, 1.5, 2.0)), 1.5)
    day = 3.0 * np.sin(2 * np.pi * (np.arange(T) / 96.0 + rng.random()))
    return np.stack([heater, day + f.smooth_noise(rng, T, 8.0)], axis=1)


SYSTEM = System(
    "thermal",
    STEPS,
    {"g": 0.10, "m": 0.06, "h": 0.08, "b": 1.4, "q": 0.08, "r": 0.15},
    ("u", "outside"),
    ("y1", "y2"),
    ("core", "casing", "sensor", "noise", "missing heat", "its rate"),
    ((25.0, 4.0), (11.0, 3.0), (25.0, 0.0), (0.0, 0.0), (0.0, 0.0), (0.0, 0.0)),
    step,
    observe,
    excite,
    {
        "loss": Effect("loss", "extra loss", ("casing",), 0.015),
        "saturation": Effect("saturation", "input saturation", ("u",), 0.3),
        "delay": Effect("delay", "input delay", ("u",), 0.8),
        "asymmetry": Effect("asymmetry", "input asymmetry", ("u", "core"), 0.18),
        "load": Effect("load", "constant load", ("core",), 0.12),
        "drift": Effect("drift", "parameter drift", ("h",), 0.12),
        "missing": Effect("missing", "missing input", ("casing",), 0.05),
        "sensor lag": Effect("sensor_lag", "sensor lag", ("y1",), 1.0),
        "coloured": Effect("coloured", "coloured noise", ("y2",), 0.25),
        "draught": Effect("outside", None, ("core",), 0.05),
    },
)
