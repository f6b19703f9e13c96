"""A heater under a plate: the plate's temperature is measured, the heater's power goes in a few
steps, and there are 200 rows.

Outside the catalogue: something on the plate melts, and takes up heat near its melting point.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from bench.gap.truth import forms as f
from bench.gap.truth.system import Effect, System

STEPS = 200
ROOM = 21.0
SHARE = 0.5  # the heater's heat per degree over the plate's


@njit
def step(s, u, t, p, e, mean, sd):
    a, c, z1, z2 = s[0], s[1], s[2], s[3]
    g, h, b, q = p[0], p[1], p[2], p[3]
    open_ = h * (1 + e[f.BREAK] * f.logistic((t - 0.4 * STEPS) / 2))
    over = c - ROOM
    gain = SHARE * g * (a - c) - open_ * over
    gain -= e[f.LOSS] * (f.signed_power(over, 2.3) / 60 - over)
    gain -= e[f.LOAD] * (1 + 0.05 * np.tanh(over / 10 - 2))
    gain /= 1 + abs(e[f.OUTSIDE]) * np.exp(-(((c - 42.0) / 5.0) ** 2))  # more heat per degree
    mean[0] = a - g * (a - c) + b * u[0]
    mean[1] = c + gain + e[f.MISSING] * z1
    mean[2] = 0.92 * z1 + 0.08 * z2  # smooth noise of about unit variance
    mean[3] = 0.92 * z2
    sd[:] = 0
    sd[0] = q
    sd[1] = q
    sd[3] = 0.56 if e[f.MISSING] != 0 else 0.0


@njit
def observe(s, u, t, p, e, mean, sd, wild):
    mean[0] = s[1] - e[f.CLIPPING] * 2.0 * f.softplus((s[1] - 44.0) / 2.0)
    sd[0] = p[4]


def excite(rng, T):
    """The plan of a step test: off at first, then levels in an order that is the same for all sets,
    since with so few steps their gains would be far apart; each for a random time and 5% off."""
    out, t = np.zeros(T), int(rng.integers(5, 16))
    for level in (0.7, 1.1, 0.3, 0.9, 0.2, 0.5):
        out[t:] = level * np.exp(0.05 * rng.standard_normal())
        t += int(rng.integers(38, 45))
    return out[:, None]


SYSTEM = System(
    "hot_plate",
    STEPS,
    {"g": 0.12, "h": 0.04, "b": 3.0, "q": 0.04, "r": 0.025},
    ("u",),
    ("y",),
    ("heater", "plate", "missing heat", "its rate"),
    ((ROOM, 1.0), (ROOM, 1.0), (0.0, 0.0), (0.0, 0.0)),
    step,
    observe,
    excite,
    {
        "loss": Effect("loss", "extra loss", ("plate",), 0.015),
        "lag": Effect("lag", "actuator lag", ("u",), 6.0),
        "delay": Effect("delay", "input delay", ("u",), 4.0),
        "load": Effect("load", "constant load", ("plate",), 0.12),
        "break": Effect("break_", "parameter break", ("h",), 0.2),
        "missing": Effect("missing", "missing input", ("plate",), 0.05),
        "clipping": Effect("clipping", "sensor clipping", ("y",), 0.25),
        "melting": Effect("outside", None, ("plate",), 2.0),
    },
)
