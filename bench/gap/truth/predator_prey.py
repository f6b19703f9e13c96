"""Prey that is fed and predators that eat it, as logarithms; both are counted with error.

Outside the catalogue: predators that hunt together where prey is plenty, and take more than in
proportion.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from bench.gap.truth import forms as f
from bench.gap.truth.system import Effect, System

DT = 0.2
STEPS = 500
PARTS = 8


@njit
def rates(n, m, u, t, r, a, g, k, e):
    apart = 1 + e[f.OUTSIDE] * np.exp(n) / (1 + np.exp(-6 * (n + 0.3)))
    crowded = r * (1 + 0.4 * u) * (1 - np.exp(n) / 3.0)
    forced = e[f.PERIODIC] * f.triangle(t / 41.3)
    death = k * (1 + e[f.DRIFT] * f.logistic((t / STEPS - 0.5) * 9))
    death *= 1 + e[f.BREAK] * f.logistic((t - 0.45 * STEPS) / 3)
    dn = crowded - a * np.exp(m) / apart + forced
    dm = g * np.exp(n) / apart - death
    return dn, dm


@njit
def step(s, u, t, p, e, mean, sd):
    n, m, z1, z2, c = s[0], s[1], s[2], s[3], s[4]
    r, a, g, k, q = p[0], p[1], p[2], p[3], p[4]
    dn, dm = rates(n, m, u[0], t, r, a, g, k, e)
    mean[0] = n + DT * dn
    mean[1] = m + DT * dm
    if e[f.COARSE] != 0:
        fn, fm = n, m
        for i in range(PARTS):
            dn, dm = rates(fn, fm, u[0], t + i / PARTS, r, a, g, k, e)
            fn, fm = fn + DT / PARTS * dn, fm + DT / PARTS * dm
        mean[0] += e[f.COARSE] * (fn - mean[0])
        mean[1] += e[f.COARSE] * (fm - mean[1])
    mean[0] += DT * e[f.MISSING] * z1
    mean[2] = 0.93 * z1 + 0.07 * z2
    mean[3] = 0.93 * z2
    mean[4] = 0.85 * c
    sd[:] = 0
    sd[0] = q
    sd[1] = q
    sd[3] = 0.52 if e[f.MISSING] != 0 else 0.0
    sd[4] = np.sqrt(1 - 0.85**2) if e[f.COLOURED] != 0 else 0.0


@njit
def observe(s, u, t, p, e, mean, sd, wild):
    mean[0] = s[0]
    mean[1] = s[1] + e[f.COLOURED] * s[4]
    sd[0] = p[5]
    sd[1] = p[5]
    wild[0] = min(abs(e[f.OUTLIERS]), 0.5)


def excite(rng, T):
    return (f.holds(rng, T, 10, 30, (-1.0, 0.0, 1.0)) + 0.4 * f.smooth_noise(rng, T, 6))[:, None]


SYSTEM = System(
    "predator_prey",
    STEPS,
    {"r": 1.2, "a": 0.8, "g": 0.6, "k": 0.6, "q": 0.02, "r_obs": 0.06},
    ("u",),
    ("y1", "y2"),
    ("n", "m", "missing growth", "its rate", "noise"),
    ((0.0, 0.3), (0.0, 0.3), (0.0, 0.0), (0.0, 0.0), (0.0, 0.0)),
    step,
    observe,
    excite,
    {
        "saturation": Effect("saturation", "input saturation", ("u",), 0.9),
        "delay": Effect("delay", "input delay", ("u",), 2.8),
        "periodic": Effect("periodic", "periodic forcing", ("n",), 0.11),
        "drift": Effect("drift", "parameter drift", ("k",), 0.2),
        "break": Effect("break_", "parameter break", ("k",), 0.2),
        "missing": Effect("missing", "missing input", ("n",), 0.18),
        "coloured": Effect("coloured", "coloured noise", ("y2",), 0.11),
        "outliers": Effect("outliers", "outliers", ("y1",), 0.025),
        "packs": Effect("outside", None, ("n", "m"), -0.3),
    },
)
