"""Three tanks in a row: a pump at voltage u fills the first, each drains into the next.

Torricelli's law for every outlet. y2 and y3 are the levels of the second and the third, read with
noise; nobody reads the first. Steps of 2 s (Euler).
"""

import numpy as np

import ssmppl as ssm

GUESS = 1.0  # factor on the guesses of the physical constants
NOISE = 1.0  # factor on those of the noise scales
DT = 2.0

model = ssm.Model("three tanks", inputs=("u",))


@model.prior
def prior():
    return {
        "a1": ssm.LogNormal(np.log(0.12 * GUESS), sd=1.0),
        "a2": ssm.LogNormal(np.log(0.09 * GUESS), sd=1.0),
        "a3": ssm.LogNormal(np.log(0.10 * GUESS), sd=1.0),
        "b": ssm.LogNormal(np.log(0.15 * GUESS), sd=1.0),
        "q": ssm.LogNormal(np.log(0.022 * NOISE), sd=1.0),
        "r": ssm.LogNormal(np.log(0.045 * NOISE), sd=1.0),
    }


@model.initial
def initial():
    return {
        "h1": ssm.Normal(3.5, sd=1.0),
        "h2": ssm.Normal(3.0, sd=1.0),
        "h3": ssm.Normal(2.5, sd=0.8),
    }


@model.transition
def transition(h1, h2, h3, u, a1, a2, a3, b, q):
    one = a1 * np.sqrt(np.maximum(h1, 0.01))
    two = a2 * np.sqrt(np.maximum(h2, 0.01))
    three = a3 * np.sqrt(np.maximum(h3, 0.01))
    return {
        "h1": ssm.Normal(h1 + DT * (b * u - one), sd=q),
        "h2": ssm.Normal(h2 + DT * (one - two), sd=q),
        "h3": ssm.Normal(h3 + DT * (two - three), sd=q),
    }


@model.observation
def observation(h2, h3, r):
    return {"y2": ssm.Normal(h2, sd=r), "y3": ssm.Normal(h3, sd=r)}
