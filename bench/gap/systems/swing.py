"""A pendulum that is let go and swings by itself; y is its angle (rad), read with noise.

Rows of 50 ms. g stands for gravity over length, c for the friction of the pivot.
"""

import numpy as np

import ssmppl as ssm

GUESS = 1.0  # factor on the guesses of the physical constants
NOISE = 1.0  # factor on those of the noise scales
DT = 0.05

model = ssm.Model("free pendulum")


@model.prior
def prior():
    return {
        "g": ssm.LogNormal(np.log(10.0 * GUESS), sd=1.0),
        "c": ssm.LogNormal(np.log(0.09 * GUESS), sd=1.0),
        "q": ssm.LogNormal(np.log(0.005 * NOISE), sd=1.0),
        "r": ssm.LogNormal(np.log(0.005 * NOISE), sd=1.0),
    }


@model.initial
def initial():
    return {
        "th": ssm.Normal(1.7, sd=0.2),
        "om": ssm.Normal(0.0, sd=0.3),
    }


@model.transition
def transition(th, om, g, c, q):
    def swing(th, om):
        return {"th": om, "om": -g * np.sin(th) - c * om}

    after = ssm.integrate(swing, {"th": th, "om": om}, DT, steps=2)
    return {"th": ssm.Dirac(after["th"]), "om": ssm.Normal(after["om"], sd=q)}


@model.observation
def observation(th, r):
    return {"y": ssm.Normal(th, sd=r)}
