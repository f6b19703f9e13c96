"""A plate with a heater below it; y is the plate's temperature (deg C), u the heater's power.

Two thermal masses, of which the heater's, half of the plate's, is not measured. The room has 21
degrees. Steps of a row, 5 s (Euler).
"""

import numpy as np

import ssmppl as ssm

GUESS = 1.0  # factor on the guesses of the physical constants
NOISE = 1.0  # factor on those of the noise scales
ROOM = 21.0
SHARE = 0.5

model = ssm.Model("hot plate", inputs=("u",))


@model.prior
def prior():
    return {
        "g": ssm.LogNormal(np.log(0.15 * GUESS), sd=1.0),
        "h": ssm.LogNormal(np.log(0.03 * GUESS), sd=1.0),
        "b": ssm.LogNormal(np.log(2.0 * GUESS), sd=1.0),
        "q": ssm.LogNormal(np.log(0.06 * NOISE), sd=1.0),
        "r": ssm.LogNormal(np.log(0.04 * NOISE), sd=1.0),
    }


@model.initial
def initial():
    return {
        "heater": ssm.Normal(ROOM, sd=1.0),
        "plate": ssm.Normal(ROOM, sd=1.0),
    }


@model.transition
def transition(heater, plate, u, g, h, b, q):
    up = heater - plate
    return {
        "heater": ssm.Normal(heater - g * up + b * u, sd=q),
        "plate": ssm.Normal(plate + SHARE * g * up - h * (plate - ROOM), sd=q),
    }


@model.observation
def observation(plate, r):
    return {"y": ssm.Normal(plate, sd=r)}
