"""A motor at voltage u turns a load through an elastic belt with some damping of its own.

d is the belt's stretch, w1 and w2 the speeds of motor and load, which y1 and y2 read with noise.
Steps of 50 ms (Euler).
"""

import numpy as np

import ssmppl as ssm

GUESS = 1.0  # factor on the guesses of the physical constants
NOISE = 1.0  # factor on those of the noise scales
DT = 0.05

model = ssm.Model("motor, belt and load", inputs=("u",))


@model.prior
def prior():
    return {
        "b": ssm.LogNormal(np.log(2.5 * GUESS), sd=1.0),
        "c1": ssm.LogNormal(np.log(1.3 * GUESS), sd=1.0),
        "c2": ssm.LogNormal(np.log(0.5 * GUESS), sd=1.0),
        "k": ssm.LogNormal(np.log(10.0 * GUESS), sd=1.0),
        "q1": ssm.LogNormal(np.log(0.03 * NOISE), sd=1.0),
        "q2": ssm.LogNormal(np.log(0.03 * NOISE), sd=1.0),
        "r": ssm.LogNormal(np.log(0.02 * NOISE), sd=1.0),
    }


@model.initial
def initial():
    return {
        "d": ssm.Normal(0.0, sd=0.2),
        "w1": ssm.Normal(0.0, sd=0.5),
        "w2": ssm.Normal(0.0, sd=0.5),
    }


@model.transition
def transition(d, w1, w2, u, b, c1, c2, k, q1, q2):
    slip = w1 - w2
    pull = k * d + 0.5 * slip
    return {
        "d": ssm.Dirac(d + DT * slip),
        "w1": ssm.Normal(w1 + DT * (b * u - c1 * w1 - pull), sd=q1),
        "w2": ssm.Normal(w2 + DT * (pull - c2 * w2), sd=q2),
    }


@model.observation
def observation(w1, w2, r):
    return {"y1": ssm.Normal(w1, sd=r), "y2": ssm.Normal(w2, sd=r)}
