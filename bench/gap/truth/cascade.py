"""Three tanks in a row, each draining into the next; a pump fills the first, the levels of the
other two are measured.

Outside the catalogue: a swirl over the second outlet, which throttles it in a rhythm of level and
pump together.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from bench.gap.truth import forms as f
from bench.gap.truth.system import Effect, System

DT = 2.0
STEPS = 500


@njit
def step(s, u, t, p, e, mean, sd):
    h1, h2, h3, z1, z2 = s[0], s[1], s[2], s[3], s[4]
    a1, a2, a3, b, q = p[0], p[1], p[2], p[3], p[4]
    open1 = a1 * (1 - e[f.DRIFT] * f.logistic((t / STEPS - 0.5) * 8))
    open3 = a3 * (1 - e[f.BREAK] * f.logistic((t - 0.55 * STEPS) / 5))
    swirl = 1 + e[f.OUTSIDE] * np.sin(3.0 * h2) * (u[0] - 1.6)
    one = open1 * np.sqrt(max(h1, 0.01))
    two = a2 * np.sqrt(max(h2, 0.01)) * swirl
    three = open3 * np.sqrt(max(h3, 0.01))
    spill = e[f.STOP] * 0.3 * f.softplus((h1 - 3.7) / 0.3)
    leak = e[f.LOSS] * f.signed_power(max(h2, 0.0), 1.7) / 8
    mean[0] = h1 + DT * (b * u[0] - one - spill + e[f.MISSING] * z1)
    mean[1] = h2 + DT * (one - two + 0.3 * spill - leak)  # a part of the spill is caught
    mean[2] = h3 + DT * (two - three)
    mean[3] = 0.95 * z1 + 0.05 * z2  # smooth noise of about unit variance
    mean[4] = 0.95 * z2
    sd[:] = 0
    sd[:3] = q
    sd[4] = 0.44 if e[f.MISSING] != 0 else 0.0


@njit
def observe(s, u, t, p, e, mean, sd, wild):
    mean[0] = s[1]
    mean[1] = s[2] - e[f.CLIPPING] * 0.2 * f.softplus((s[2] - 2.8) / 0.2)
    sd[0] = p[5]
    sd[1] = p[5]


def excite(rng, T):
    steps = f.holds(rng, T, 12, 32, np.linspace(0.7, 2.5, 5))
    return np.maximum(f.lagged(steps, 2.0) + 0.1 * f.smooth_noise(rng, T, 3.0), 0.1)[:, None]


SYSTEM = System(
    "cascade",
    STEPS,
    {"a1": 0.10, "a2": 0.11, "a3": 0.12, "b": 0.12, "q": 0.015, "r": 0.03},
    ("u",),
    ("y2", "y3"),
    ("h1", "h2", "h3", "missing inflow", "its rate"),
    ((3.5, 1.0), (3.0, 1.0), (2.5, 0.8), (0.0, 0.0), (0.0, 0.0)),
    step,
    observe,
    excite,
    {
        "overflow": Effect("stop", "hard stop", ("h1", "h2"), 0.03),
        "loss": Effect("loss", "extra loss", ("h2",), 0.02),
        "saturation": Effect("saturation", "input saturation", ("u",), 0.35),
        "delay": Effect("delay", "input delay", ("u",), 2.0),
        "drift": Effect("drift", "parameter drift", ("a1",), 0.15),
        "break": Effect("break_", "parameter break", ("a3",), 0.05),
        "missing": Effect("missing", "missing input", ("h1",), 0.02),
        "clipping": Effect("clipping", "sensor clipping", ("y3",), 0.6),
        "swirl": Effect("outside", None, ("h2", "h3"), 0.15),
    },
)
