"""A cart on a rail with a pole hanging from it; a weak spring keeps the cart near the middle.

u is the voltage of the drive; yx and yth are the cart's position and the pole's angle, read with
noise. The cart is so heavy that the pole does not move it. Steps of 40 ms (Euler).
"""

import numpy as np

import ssmppl as ssm

GUESS = 1.0  # factor on the guesses of the physical constants
NOISE = 1.0  # factor on those of the noise scales
DT = 0.04

model = ssm.Model("cart and pole", inputs=("u",))


@model.prior
def prior():
    return {
        "b": ssm.LogNormal(np.log(1.3 * GUESS), sd=1.0),
        "c": ssm.LogNormal(np.log(0.6 * GUESS), sd=1.0),
        "g": ssm.LogNormal(np.log(6.0 * GUESS), sd=1.0),
        "d": ssm.LogNormal(np.log(0.4 * GUESS), sd=1.0),
        "q": ssm.LogNormal(np.log(0.01 * NOISE), sd=1.0),
        "qw": ssm.LogNormal(np.log(0.01 * NOISE), sd=1.0),
        "rx": ssm.LogNormal(np.log(0.01 * NOISE), sd=1.0),
        "rth": ssm.LogNormal(np.log(0.0075 * NOISE), sd=1.0),
    }


@model.initial
def initial():
    return {
        "x": ssm.Normal(0.0, sd=0.1),
        "v": ssm.Normal(0.0, sd=0.1),
        "th": ssm.Normal(0.0, sd=0.1),
        "w": ssm.Normal(0.0, sd=0.1),
    }


@model.transition
def transition(x, v, th, w, u, b, c, g, d, q, qw):
    acceleration = b * u - c * v - x
    turning = -g * np.sin(th) - d * w - acceleration * np.cos(th)
    return {
        "x": ssm.Dirac(x + DT * v),
        "v": ssm.Normal(v + DT * acceleration, sd=q),
        "th": ssm.Dirac(th + DT * w),
        "w": ssm.Normal(w + DT * turning, sd=qw),
    }


@model.observation
def observation(x, th, rx, rth):
    return {"yx": ssm.Normal(x, sd=rx), "yth": ssm.Normal(th, sd=rth)}
