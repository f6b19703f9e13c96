"""A mass on a spring with a damper, driven by a measured force; its position is measured.

Outside the catalogue: a small resonator on the mass, which takes and gives back energy.
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
    x, v, z, a, w, n = s[0], s[1], s[2], s[3], s[4], s[5]
    k, c, b, q = p[0], p[1], p[2], p[3]
    drift = e[f.DRIFT] * f.logistic((t / STEPS - 0.5) * 10)
    force = -k * (1 + drift) * x - c * v + b * u[0]
    z = f.bristle(z, v, DT, 0.03, 1.0) if e[f.COULOMB] != 0 else 0.0
    force -= e[f.COULOMB] * z
    force -= e[f.DRAG] * f.signed_power(v, 1.85)
    bent = min(max(2 * x, -6.0), 6.0)
    force -= e[f.STIFFNESS] * (np.sinh(bent) - bent) / 2
    force -= e[f.STOP] * 0.05 * f.softplus((x - 0.7) / 0.05)
    force += e[f.PERIODIC] * f.triangle(t / 37.3)
    force += e[f.OUTSIDE] * 30 * (a - x)
    mean[0] = x + DT * v
    mean[1] = v + DT * force
    mean[2] = z
    w = w + DT * (-30 * (a - x) - 0.3 * (w - v)) if e[f.OUTSIDE] != 0 else 0.0
    mean[3] = a + DT * w
    mean[4] = w
    mean[5] = 0.9 * n
    sd[:] = 0
    sd[1] = q
    sd[5] = np.sqrt(1 - 0.81) if e[f.COLOURED] != 0 else 0.0


@njit
def observe(s, u, t, p, e, mean, sd, wild):
    mean[0] = f.arsinh_gain(s[0], e[f.GAIN]) + e[f.COLOURED] * s[5]
    sd[0] = p[4]
    wild[0] = min(abs(e[f.OUTLIERS]), 0.5)


def excite(rng, T):
    return (2.0 * f.multisine(rng, T, 1, 16))[:, None]


SYSTEM = System(
    "oscillator",
    STEPS,
    {"k": 16.0, "c": 2.0, "b": 4.0, "q": 0.01, "r": 0.005},
    ("u",),
    ("y",),
    ("x", "v", "bristle", "resonator", "its speed", "noise"),
    ((0.0, 0.3), (0.0, 0.3), (0.0, 0.0), (0.0, 0.0), (0.0, 0.0), (0.0, 0.0)),
    step,
    observe,
    excite,
    {
        "coulomb": Effect("coulomb", "coulomb friction", ("v",), 0.5),
        "drag": Effect("drag", "quadratic drag", ("v",), 0.3),
        "stiffness": Effect("stiffness", "cubic stiffness", ("v",), 0.7),
        "stop": Effect("stop", "hard stop", ("v",), 2.0),
        "saturation": Effect("saturation", "input saturation", ("u",), 0.3),
        "delay": Effect("delay", "input delay", ("u",), 0.2),
        "periodic": Effect("periodic", "periodic forcing", ("v",), 0.4),
        "coloured": Effect("coloured", "coloured noise", ("y",), 0.03),
        "resonator": Effect("outside", None, ("v",), 0.03),
    },
)
