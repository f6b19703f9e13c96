"""A ship's steering at a steady speed: u is the rudder's angle (rad).

Of first order in the rate of turn r (Nomoto); turning pushes the ship sideways, at the speed v
across the bow. The compass reads the heading psi (rad), the log the speed v (m/s), both with noise.
Steps of 1 s (Euler).
"""

import numpy as np

import ssmppl as ssm

GUESS = 1.0  # factor on the guesses of the physical constants
NOISE = 1.0  # factor on those of the noise scales

model = ssm.Model("ship", inputs=("u",))


@model.prior
def prior():
    return {
        "a": ssm.LogNormal(np.log(0.13 * GUESS), sd=1.0),
        "k": ssm.LogNormal(np.log(0.006 * GUESS), sd=1.0),
        "d": ssm.LogNormal(np.log(0.05 * GUESS), sd=1.0),
        "c": ssm.LogNormal(np.log(1.6 * GUESS), sd=1.0),
        "qr": ssm.LogNormal(np.log(9e-5 * NOISE), sd=1.0),
        "qv": ssm.LogNormal(np.log(0.015 * NOISE), sd=1.0),
        "rp": ssm.LogNormal(np.log(0.0022 * NOISE), sd=1.0),
        "rv": ssm.LogNormal(np.log(0.02 * NOISE), sd=1.0),
    }


@model.initial
def initial():
    return {
        "psi": ssm.Normal(0.0, sd=0.05),
        "r": ssm.Normal(0.0, sd=0.005),
        "v": ssm.Normal(0.0, sd=0.1),
    }


@model.transition
def transition(psi, r, v, u, a, k, d, c, qr, qv):
    return {
        "psi": ssm.Dirac(psi + r),
        "r": ssm.Normal(r + k * u - a * r, sd=qr),
        "v": ssm.Normal(v - d * v + c * r, sd=qv),
    }


@model.observation
def observation(psi, v, rp, rv):
    return {"compass": ssm.Normal(psi, sd=rp), "log": ssm.Normal(v, sd=rv)}
