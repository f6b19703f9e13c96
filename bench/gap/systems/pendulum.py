"""A pendulum with the torque u on its axis; y is its angle, read with noise.

Per unit of inertia, steps of 40 ms (Euler).
"""

import numpy as np

import ssmppl as ssm

GUESS = 1.0  # factor on the guesses of the physical constants
NOISE = 1.0  # factor on those of the noise scales
DT = 0.04

model = ssm.Model("pendulum", inputs=("u",))


@model.prior
def prior():
    return {
        "g": ssm.LogNormal(np.log(12.0 * GUESS), sd=1.0),
        "c": ssm.LogNormal(np.log(2.0 * GUESS), sd=1.0),
        "b": ssm.LogNormal(np.log(3.0 * GUESS), sd=1.0),
        "q": ssm.LogNormal(np.log(0.015 * NOISE), sd=1.0),
        "r": ssm.LogNormal(np.log(0.007 * NOISE), sd=1.0),
    }


@model.initial
def initial():
    return {
        "th": ssm.Normal(0.0, sd=0.3),
        "om": ssm.Normal(0.0, sd=0.3),
    }


@model.transition
def transition(th, om, u, g, c, b, q):
    return {
        "th": ssm.Dirac(th + DT * om),
        "om": ssm.Normal(om + DT * (-g * np.sin(th) - c * om + b * u), sd=q),
    }


@model.observation
def observation(th, r):
    return {"y": ssm.Normal(th, sd=r)}
