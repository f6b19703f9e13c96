"""A mass on a spring with a damper, pushed by the force u; y is its position, read with noise.

Mass 1 kg, steps of 40 ms (Euler).
"""

import numpy as np

import ssmppl as ssm

GUESS = 1.0  # factor on the guesses of the physical constants
NOISE = 1.0  # factor on those of the noise scales
DT = 0.04

model = ssm.Model("oscillator", inputs=("u",))


@model.prior
def prior():
    return {
        "k": ssm.LogNormal(np.log(20.0 * GUESS), sd=1.0),
        "c": ssm.LogNormal(np.log(1.5 * GUESS), sd=1.0),
        "b": ssm.LogNormal(np.log(5.0 * GUESS), sd=1.0),
        "q": ssm.LogNormal(np.log(0.015 * NOISE), sd=1.0),
        "r": ssm.LogNormal(np.log(0.007 * NOISE), sd=1.0),
    }


@model.initial
def initial():
    return {
        "x": ssm.Normal(0.0, sd=0.3),
        "v": ssm.Normal(0.0, sd=0.3),
    }


@model.transition
def transition(x, v, u, k, c, b, q):
    return {
        "x": ssm.Dirac(x + DT * v),
        "v": ssm.Normal(v + DT * (-k * x - c * v + b * u), sd=q),
    }


@model.observation
def observation(x, r):
    return {"y": ssm.Normal(x, sd=r)}
