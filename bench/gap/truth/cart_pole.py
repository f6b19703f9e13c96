"""A cart on a rail from which a pole hangs; position and angle are measured, the drive's voltage
is known, and the pole's pull on the cart is part of the model.

Outside the catalogue: a swaying rail, whose sway the drive's voltage and the angle excite together.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from bench.gap.truth import forms as f
from bench.gap.truth.system import Effect, System

DT = 0.04
STEPS = 600


@njit
def step(s, u, t, p, e, mean, sd):
    x, v, th, w, z, n = s[0], s[1], s[2], s[3], s[4], s[5]
    b, c, g, d, q, qw = p[0], p[1], p[2], p[3], p[4], p[5]
    z = f.bristle(z, v, DT, 0.03, 1.0) if e[f.COULOMB] != 0 else 0.0
    acc = b * u[0] - c * v - x
    acc -= e[f.COULOMB] * z
    acc -= e[f.STOP] * 0.05 * f.softplus((x - 0.5) / 0.05)
    acc += e[f.COUPLING] * np.tanh(th) * (1 + 0.2 * np.cos(th))
    acc += e[f.OUTSIDE] * np.sin(4 * x) * np.cos(2 * th) * u[0]
    turn = -g * np.sin(th) - d * w - acc * np.cos(th)
    turn -= e[f.DRAG] * f.signed_power(w, 1.85)
    mean[0] = x + DT * v
    mean[1] = v + DT * acc
    mean[2] = th + DT * w
    mean[3] = w + DT * turn
    mean[4] = z
    mean[5] = 0.92 * n
    sd[:] = 0
    sd[1] = q
    sd[3] = qw
    sd[5] = np.sqrt(1 - 0.92**2) if e[f.COLOURED] != 0 else 0.0


@njit
def observe(s, u, t, p, e, mean, sd, wild):
    mean[0] = s[0]
    mean[1] = f.arsinh_gain(s[2], e[f.GAIN])
    sd[0] = p[6]
    sd[1] = p[7]
    wild[0] = min(abs(e[f.OUTLIERS]), 0.5)


def excite(rng, T):
    return (1.5 * f.multisine(rng, T, 1, 6))[:, None]


SYSTEM = System(
    "cart_pole",
    STEPS,
    {"b": 1.0, "c": 0.8, "g": 5.0, "d": 0.5, "q": 0.005, "qw": 0.005, "rx": 0.005, "rth": 0.005},
    ("u",),
    ("yx", "yth"),
    ("x", "v", "th", "w", "bristle", "noise"),
    ((0.0, 0.1), (0.0, 0.1), (0.0, 0.1), (0.0, 0.1), (0.0, 0.0), (0.0, 0.0)),
    step,
    observe,
    excite,
    {
        "coulomb": Effect("coulomb", "coulomb friction", ("v",), 0.24),
        "stop": Effect("stop", "hard stop", ("v",), 1.3),
        "coupling": Effect("coupling", "cross-coupling", ("v",), 0.4),
        "drag": Effect("drag", "quadratic drag", ("w",), 0.3),
        "dead zone": Effect("dead_zone", "dead zone", ("u",), 0.28),
        "backlash": Effect("backlash", "backlash", ("u",), 0.25),
        "gain": Effect("gain", "sensor gain nonlinearity", ("yth",), 0.6),
        "outliers": Effect("outliers", "outliers", ("yx",), 0.018),
        "rail": Effect("outside", None, ("v",), 0.4),
    },
)
