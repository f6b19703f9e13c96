"""Two tanks, the upper draining into the lower; both levels are measured, the pump is known.

Outside the catalogue: a pump whose gain wanders in an odd rhythm, and more so at low levels.
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
    h1, h2, z1, z2 = s[0], s[1], s[2], s[3]
    a1, a2, b, q = p[0], p[1], p[2], p[3]
    open2 = a2 * (1 - e[f.BREAK] * f.logistic((t - 0.6 * STEPS) / 5))
    between = a1 * np.sqrt(max(h1, 0.01))
    rate = np.sin(2 * np.pi * t / 71.0) ** 3 * np.exp(-0.25 * max(h1, 0.0))
    inflow = b * u[0] * (1 + e[f.OUTSIDE] * rate)
    spill = e[f.STOP] * 0.2 * f.softplus((h1 - 5.5) / 0.2)
    leak = e[f.LOSS] * max(h1, 0.0) ** 1.7 / 8
    mean[0] = h1 + DT * (inflow - between - spill - leak + e[f.MISSING] * z1)
    mean[1] = h2 + DT * (between - open2 * np.sqrt(max(h2, 0.01)))
    mean[2] = 0.93 * z1 + 0.07 * z2  # smooth noise of about unit variance
    mean[3] = 0.93 * z2
    sd[:] = 0
    sd[0] = q
    sd[1] = q
    sd[3] = 0.52 if e[f.MISSING] != 0 else 0.0


@njit
def observe(s, u, t, p, e, mean, sd, wild):
    mean[0] = s[0]
    mean[1] = s[1]
    clipped = 0.3 * f.softplus((s[0] - 6.0) / 0.3)
    mean[0] -= e[f.CLIPPING] * clipped
    sd[0] = p[4]
    sd[1] = p[4] * (1 + abs(e[f.SCEDASTIC]) * f.softplus((u[0] - 1.4) / 0.2))


def excite(rng, T):
    steps = f.holds(rng, T, 8, 24, np.linspace(0.6, 2.6, 5))
    return np.maximum(f.lagged(steps, 2.0) + 0.15 * f.smooth_noise(rng, T, 3.0), 0.1)[:, None]


SYSTEM = System(
    "two_tanks",
    STEPS,
    {"a1": 0.10, "a2": 0.11, "b": 0.12, "q": 0.04, "r": 0.08},
    ("u",),
    ("y1", "y2"),
    ("h1", "h2", "missing inflow", "its rate"),
    ((5.0, 1.0), (4.0, 1.0), (0.0, 0.0), (0.0, 0.0)),
    step,
    observe,
    excite,
    {
        "stop": Effect("stop", "hard stop", ("h1",), 0.08),
        "loss": Effect("loss", "extra loss", ("h1",), 0.01),
        "saturation": Effect("saturation", "input saturation", ("u",), 0.4),
        "delay": Effect("delay", "input delay", ("u",), 1.4),
        "break": Effect("break_", "parameter break", ("a2",), 0.05),
        "missing": Effect("missing", "missing input", ("h1",), 0.018),
        "scedastic": Effect("scedastic", "heteroscedastic noise", ("y2",), 0.2),
        "clipping": Effect("clipping", "sensor clipping", ("y1",), 0.12),
        "pump": Effect("outside", None, ("h1",), 0.4),
    },
)
