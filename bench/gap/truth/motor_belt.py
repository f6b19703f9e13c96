"""A motor that turns a load through an elastic belt: both speeds are measured, the voltage is
known; the belt's stretch is not seen.

Outside the catalogue: a resonating belt guide on the load.
"""

from __future__ import annotations

from numba import njit

from bench.gap.truth import forms as f
from bench.gap.truth.system import Effect, System

DT = 0.05
STEPS = 500


@njit
def step(s, u, t, p, e, mean, sd):
    d, w1, w2, z, a, w = s[0], s[1], s[2], s[3], s[4], s[5]
    b, c1, c2, k, q1, q2 = p[0], p[1], p[2], p[3], p[4], p[5]
    if e[f.COULOMB] != 0 or e[f.LOAD_FRICTION] != 0:
        z = f.bristle(z, w1, DT, 0.05, 1.0)
    slip = w1 - w2
    motor = b * u[0] - c1 * w1 - k * d - 0.5 * slip
    motor -= e[f.COULOMB] * z
    motor -= e[f.LOAD_FRICTION] * abs(u[0]) ** 0.9 * z
    motor += e[f.PERIODIC] * f.triangle(t / 23.7)
    load = k * d + 0.5 * slip - c2 * w2
    load -= e[f.DRAG] * f.signed_power(w2, 1.85)
    load -= e[f.ASYMMETRIC] * 0.2 * f.softplus(w2 / 0.2)
    load -= e[f.OUTSIDE] * 40 * (w2 * DT * 4 - a)
    mean[0] = d + DT * slip
    mean[1] = w1 + DT * motor
    mean[2] = w2 + DT * load
    mean[3] = z
    w = w + DT * (40 * (w2 * DT * 4 - a) - 0.4 * w) if e[f.OUTSIDE] != 0 else 0.0
    mean[4] = a + DT * w
    mean[5] = w
    sd[:] = 0
    sd[1] = q1
    sd[2] = q2


@njit
def observe(s, u, t, p, e, mean, sd, wild):
    mean[0] = s[1]
    mean[1] = f.arsinh_gain(s[2], e[f.GAIN])
    sd[0] = p[6]
    sd[1] = p[6]
    wild[1] = min(abs(e[f.OUTLIERS]), 0.5)


def excite(rng, T):
    return (1.8 * f.multisine(rng, T, 1, 9) + 0.4)[:, None]


SYSTEM = System(
    "motor_belt",
    STEPS,
    {"b": 3.0, "c1": 1.0, "c2": 0.6, "k": 8.0, "q1": 0.02, "q2": 0.02, "r": 0.03},
    ("u",),
    ("y1", "y2"),
    ("d", "w1", "w2", "bristle", "guide", "its speed"),
    ((0.0, 0.2), (0.0, 0.5), (0.0, 0.5), (0.0, 0.0), (0.0, 0.0), (0.0, 0.0)),
    step,
    observe,
    excite,
    {
        "coulomb": Effect("coulomb", "coulomb friction", ("w1",), 0.55),
        "load friction": Effect("load_friction", "load-dependent friction", ("w1",), 0.27),
        "asymmetric": Effect("asymmetric", "asymmetric friction", ("w2",), 0.5),
        "drag": Effect("drag", "quadratic drag", ("w2",), 0.28),
        "dead zone": Effect("dead_zone", "dead zone", ("u",), 0.23),
        "saturation": Effect("saturation", "input saturation", ("u",), 0.18),
        "periodic": Effect("periodic", "periodic forcing", ("w1",), 0.5),
        "outliers": Effect("outliers", "outliers", ("y2",), 0.02),
        "guide": Effect("outside", None, ("w2",), 0.08),
    },
)
