"""A pendulum that is let go and swings freely; nothing drives it, its angle is measured.

The model given takes two steps of a fourth-order method in a row, by `ssm.integrate`, this one
eight.

Outside the catalogue: a worn pivot, whose drag depends on where in its turn it is.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from bench.gap.truth import forms as f
from bench.gap.truth.system import Effect, System

DT = 0.05
STEPS = 600
SUBSTEPS = 8


@njit
def rate(x, v, z, u, t, p, e):
    """Angular acceleration: z is the bristle's deflection."""
    pull = p[0] * (1 + e[f.BREAK] * f.logistic((t - 0.55 * STEPS) / 4))
    turn = -pull * np.sin(x) - p[1] * v
    turn -= e[f.COULOMB] * z
    turn -= e[f.DRAG] * f.signed_power(v, 1.85)
    bent = min(max(2 * x, -6.0), 6.0)
    turn -= e[f.STIFFNESS] * (np.sinh(bent) - bent) / 2
    turn -= e[f.STOP] * 0.05 * f.softplus((x - 0.7) / 0.05)
    turn -= e[f.DAMPING] * (np.cosh(1.2 * x) - 1) * v
    turn += e[f.PERIODIC] * f.triangle(t / 23.7)
    return turn - e[f.OUTSIDE] * np.sin(7 * x) * v


@njit
def step(s, u, t, p, e, mean, sd):
    x, v, z = s[0], s[1], s[2]
    h = DT / SUBSTEPS
    for _ in range(SUBSTEPS):
        if e[f.COULOMB] != 0:
            z = f.bristle(z, v, h, 0.03, 1.0)
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


def excite(rng, T):
    return np.empty((T, 0))


SYSTEM = System(
    "swing",
    STEPS,
    {"g": 12.0, "c": 0.06, "q": 0.003, "r": 0.003},
    (),
    ("y",),
    ("th", "om", "bristle"),
    ((1.7, 0.2), (0.0, 0.3), (0.0, 0.0)),
    step,
    observe,
    excite,
    {
        "coulomb": Effect("coulomb", "coulomb friction", ("om",), 0.05),
        "drag": Effect("drag", "quadratic drag", ("om",), 0.05),
        "stiffness": Effect("stiffness", "cubic stiffness", ("om",), 0.05),
        "stop": Effect("stop", "hard stop", ("om",), 0.3),
        "damping": Effect("damping", "state-dependent damping", ("om",), 0.05),
        "periodic": Effect("periodic", "periodic forcing", ("om",), 0.06),
        "break": Effect("break_", "parameter break", ("g",), 0.01),
        "gain": Effect("gain", "sensor gain nonlinearity", ("y",), 0.2),
        "pivot": Effect("outside", None, ("om",), 0.1),
    },
)
