"""A heater in a casing: the core is heated with power u and warms the casing, which cools to the
surroundings.

Temperatures in degrees above a reference; `outside` is that of the surroundings, y1 and y2 those of
core and casing, read with noise. Steps of 15 minutes (Euler).
"""

import numpy as np

import ssmppl as ssm

GUESS = 1.0  # factor on the guesses of the physical constants
NOISE = 1.0  # factor on those of the noise scales

model = ssm.Model("heater in a casing", inputs=("u", "outside"))


@model.prior
def prior():
    return {
        "g": ssm.LogNormal(np.log(0.08 * GUESS), sd=1.0),
        "m": ssm.LogNormal(np.log(0.08 * GUESS), sd=1.0),
        "h": ssm.LogNormal(np.log(0.1 * GUESS), sd=1.0),
        "b": ssm.LogNormal(np.log(1.1 * GUESS), sd=1.0),
        "q": ssm.LogNormal(np.log(0.06 * NOISE), sd=1.0),
        "r": ssm.LogNormal(np.log(0.12 * NOISE), sd=1.0),
    }


@model.initial
def initial():
    return {
        "core": ssm.Normal(25.0, sd=4.0),
        "casing": ssm.Normal(11.0, sd=3.0),
    }


@model.transition
def transition(core, casing, u, outside, g, m, h, b, q):
    return {
        "core": ssm.Normal(core - g * (core - casing) + b * u, sd=q),
        "casing": ssm.Normal(casing + m * (core - casing) - h * (casing - outside), sd=q),
    }


@model.observation
def observation(core, casing, r):
    return {"y1": ssm.Normal(core, sd=r), "y2": ssm.Normal(casing, sd=r)}
