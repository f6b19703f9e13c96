"""A ship under way at a steady speed: the rudder turns it, turning pushes it sideways; heading and
speed through the water across the bow are measured, the rudder's angle is known.

Outside the catalogue: a rudder in the ship's own wake, which bites differently as drift and heading
change together.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from bench.gap.truth import forms as f
from bench.gap.truth.system import Effect, System

STEPS = 600


@njit
def step(s, u, t, p, e, mean, sd):
    psi, r, v, z1, z2 = s[0], s[1], s[2], s[3], s[4]
    a, k, d, c, qr, qv = p[0], p[1], p[2], p[3], p[4], p[5]
    turn = k * u[0] - a * r
    turn -= e[f.DRAG] * f.signed_power(r / 0.02, 1.85) * 1e-3
    turn += e[f.COUPLING] * 1e-3 * np.tanh(v / 0.4) * (1 + 0.2 * np.cos(psi))
    turn += e[f.PERIODIC] * 1e-3 * f.triangle(t / 13.3)
    turn += e[f.LOAD] * 1e-3 * (1 + 0.1 * np.cos(psi))
    turn += e[f.OUTSIDE] * 1e-2 * np.cos(3 * psi) * np.tanh(4 * v) * u[0]
    mean[0] = psi + r
    mean[1] = r + turn
    mean[2] = v - d * v + c * r + e[f.MISSING] * z1
    mean[3] = 0.93 * z1 + 0.07 * z2  # smooth noise of about unit variance
    mean[4] = 0.93 * z2
    sd[:] = 0
    sd[1] = qr
    sd[2] = qv
    sd[4] = 0.52 if e[f.MISSING] != 0 else 0.0


@njit
def observe(s, u, t, p, e, mean, sd, wild):
    mean[0] = s[0]
    mean[1] = s[2]
    sd[0] = p[6]
    sd[1] = p[7]


def excite(rng, T):
    """Orders of a helmsman who steers to and fro, and a rudder that takes some seconds."""
    orders = f.holds(rng, T, 8, 24, (-0.4, -0.2, -0.1, 0.1, 0.2, 0.4))
    return f.lagged(orders, 2.0)[:, None]


SYSTEM = System(
    "ship_steering",
    STEPS,
    {"a": 0.10, "k": 0.008, "d": 0.06, "c": 1.2, "qr": 6e-5, "qv": 0.01, "rp": 0.0015, "rv": 0.03},
    ("u",),
    ("compass", "log"),
    ("psi", "r", "v", "missing force", "its rate"),
    ((0.0, 0.05), (0.0, 0.005), (0.0, 0.1), (0.0, 0.0), (0.0, 0.0)),
    step,
    observe,
    excite,
    {
        "drag": Effect("drag", "quadratic drag", ("r",), 0.5),
        "coupling": Effect("coupling", "cross-coupling", ("r",), 0.4),
        "dead zone": Effect("dead_zone", "dead zone", ("u",), 0.04),
        "backlash": Effect("backlash", "backlash", ("u",), 0.05),
        "lag": Effect("lag", "actuator lag", ("u",), 1.5),
        "periodic": Effect("periodic", "periodic forcing", ("r",), 0.3),
        "missing": Effect("missing", "missing input", ("v",), 0.015),
        "load": Effect("load", "constant load", ("r",), 0.15),
        "wake": Effect("outside", None, ("r",), 0.2),
    },
)
