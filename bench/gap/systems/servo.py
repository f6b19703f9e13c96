"""An axis with a drive whose command u is recorded; y is the carriage's position (m), by encoder.

A controller outside of the model makes u from the encoder's counts. Rows of 10 ms; the command is
held over a row. Per unit of mass: b the drive's force, d the friction of the guides.
"""

import numpy as np

import ssmppl as ssm

GUESS = 1.0  # factor on the guesses of the physical constants
NOISE = 1.0  # factor on those of the noise scales
DT = 0.01

model = ssm.Model("servo axis", inputs=("u",))


@model.prior
def prior():
    return {
        "b": ssm.LogNormal(np.log(15.0 * GUESS), sd=1.0),
        "d": ssm.LogNormal(np.log(4.0 * GUESS), sd=1.0),
        "q": ssm.LogNormal(np.log(8e-5 * NOISE), sd=1.0),
        "r": ssm.LogNormal(np.log(1.5e-5 * NOISE), sd=1.0),
    }


@model.initial
def initial():
    return {
        "p": ssm.Normal(0.0, sd=1e-3),
        "v": ssm.Normal(0.0, sd=1e-3),
    }


@model.transition
def transition(p, v, u, b, d, q):
    def moved(p, v):
        return {"p": v, "v": b * u - d * v}

    after = ssm.integrate(moved, {"p": p, "v": v}, DT)
    return {"p": ssm.Dirac(after["p"]), "v": ssm.Normal(after["v"], sd=q)}


@model.observation
def observation(p, r):
    return {"y": ssm.Normal(p, sd=r)}
