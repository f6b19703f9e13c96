"""A servo axis in a closed loop: a controller reads the encoder and commands the drive; both are
recorded. Almost nothing but the commands moves it.

The model given has the exact solution of its linear equations over a row, by `ssm.integrate`; here
four steps of a fourth-order method take its place, since effects may enter within the row.

Outside the catalogue: a spindle whose pitch the drive's force feels.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from bench.gap.truth import forms as f
from bench.gap.truth.system import Effect, System

DT = 0.01
STEPS = 800
SUBSTEPS = 4


@njit
def rate(x, v, z, u, t, p, e):
    """Acceleration: z is the bristle's deflection."""
    drive = p[0] * (1 - e[f.DRIFT] * f.logistic((t / STEPS - 0.5) * 8))
    push = drive * u[0] - p[1] * v
    push -= (e[f.COULOMB] + e[f.STRIBECK] + e[f.LOAD_FRICTION] * abs(u[0]) ** 0.9) * z
    push -= e[f.ASYMMETRIC] * 0.03 * f.softplus(v / 0.03)
    return push + e[f.OUTSIDE] * np.sin(2 * np.pi * x / 0.012) * u[0]


@njit
def step(s, u, t, p, e, mean, sd):
    x, v, z = s[0], s[1], s[2]
    h = DT / SUBSTEPS
    for _ in range(SUBSTEPS):
        if e[f.COULOMB] != 0 or e[f.LOAD_FRICTION] != 0:
            z = f.bristle(z, v, h, 0.0004, 1.0)
        elif e[f.STRIBECK] != 0:
            z = f.bristle(z, v, h, 0.0004, 0.4 + 1 / (1 + (v / 0.03) ** 2))
        x, v = f.rk4(rate, x, v, h, z, u, t, p, e)
    mean[0] = x
    mean[1] = v
    mean[2] = z
    sd[:] = 0
    sd[1] = p[2]


@njit
def observe(s, u, t, p, e, mean, sd, wild):
    mean[0] = f.arsinh_gain(s[0], e[f.GAIN])
    sd[0] = p[3]


def control(y, reference, memory):
    """Position by proportion, speed from smoothed differences of the encoder; the command is
    limited. memory: the last reading and the speed."""
    memory[1] += 0.5 * ((y[0] - memory[0]) / DT - memory[1])
    memory[0] = y[0]
    return np.clip(18.0 * (reference - y) - 0.9 * memory[1], -1.0, 1.0)


def excite(rng, T):
    """References in metres: moves between places, each along a smooth path, and small waves."""
    moves = f.holds(rng, T, 25, 55, (-0.1, -0.06, -0.02, 0.02, 0.06, 0.1))
    path = f.lagged(f.lagged(moves, 6.0), 6.0) - moves[0]
    return (path + 0.008 * f.multisine(rng, T, 2, 14))[:, None]


SYSTEM = System(
    "servo",
    STEPS,
    {"b": 20.0, "d": 6.0, "q": 5e-5, "r": 1e-5},
    ("u",),
    ("y",),
    ("p", "v", "bristle"),
    ((0.0, 1e-3), (0.0, 1e-3), (0.0, 0.0)),
    step,
    observe,
    excite,
    {
        "coulomb": Effect("coulomb", "coulomb friction", ("v",), 0.008),
        "stribeck": Effect("stribeck", "stribeck", ("v",), 0.01),
        "asymmetric": Effect("asymmetric", "asymmetric friction", ("v",), 0.05),
        "dead zone": Effect("dead_zone", "dead zone", ("u",), 0.0007),
        "saturation": Effect("saturation", "input saturation", ("u",), 0.15),
        "load friction": Effect("load_friction", "load-dependent friction", ("v",), 0.05),
        "drift": Effect("drift", "parameter drift", ("b",), 0.001),
        "gain": Effect("gain", "sensor gain nonlinearity", ("y",), 0.4),
        "spindle": Effect("outside", None, ("v",), 0.08),
    },
    control=control,
    memory=2,
    resolution=5e-6,
)
