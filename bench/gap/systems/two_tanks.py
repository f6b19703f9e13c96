"""Two tanks: a pump at voltage u fills the upper, which drains into the lower, which drains away.

Torricelli's law for both outlets; y1 and y2 are the levels, read with noise. Steps of 2 s (Euler).
"""

import numpy as np

import ssmppl as ssm

GUESS = 1.0  # factor on the guesses of the physical constants
NOISE = 1.0  # factor on those of the noise scales
DT = 2.0

model = ssm.Model("two tanks", inputs=("u",))


@model.prior
def prior():
    return {
        "a1": ssm.LogNormal(np.log(0.13 * GUESS), sd=1.0),
        "a2": ssm.LogNormal(np.log(0.09 * GUESS), sd=1.0),
        "b": ssm.LogNormal(np.log(0.15 * GUESS), sd=1.0),
        "q": ssm.LogNormal(np.log(0.03 * NOISE), sd=1.0),
        "r": ssm.LogNormal(np.log(0.1 * NOISE), sd=1.0),
    }


@model.initial
def initial():
    return {
        "h1": ssm.Normal(5.0, sd=1.0),
        "h2": ssm.Normal(4.0, sd=1.0),
    }


@model.transition
def transition(h1, h2, u, a1, a2, b, q):
    between = a1 * np.sqrt(np.maximum(h1, 0.01))
    away = a2 * np.sqrt(np.maximum(h2, 0.01))
    return {
        "h1": ssm.Normal(h1 + DT * (b * u - between), sd=q),
        "h2": ssm.Normal(h2 + DT * (between - away), sd=q),
    }


@model.observation
def observation(h1, h2, r):
    return {"y1": ssm.Normal(h1, sd=r), "y2": ssm.Normal(h2, sd=r)}
