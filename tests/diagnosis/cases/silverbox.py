"""An electronic mass on a spring, semi-implicit steps at 610.35 Hz; u and y in volts.

The record is of the Silverbox benchmark of T. Wigren and J. Schoukens (2013).
"""

import numpy as np

import ssmppl as ssm

DT = 1 / 610.35

model = ssm.Model("silverbox", inputs=("u",))


@model.prior
def prior():
    return {
        "k": ssm.LogNormal(np.log((2 * np.pi * 70) ** 2), sd=0.3),
        "c": ssm.LogNormal(np.log(50.0), sd=0.7),
        "b": ssm.LogNormal(np.log((2 * np.pi * 70) ** 2), sd=0.5),
        "bias": ssm.Normal(0, sd=0.02),
        "q": ssm.LogNormal(np.log(0.5), sd=1.5),
        "r": ssm.LogNormal(np.log(0.001), sd=1),
    }


@model.initial
def initial():
    return {"x": ssm.Normal(0, sd=0.1), "v": ssm.Normal(0, sd=40)}


@model.transition
def transition(x, v, u, k, c, b, bias, q):
    new = v + DT * (b * (u - bias) - k * x - c * v)
    return {"v": ssm.Normal(new, sd=q), "x": ssm.Dirac(x + DT * new)}


@model.observation
def observation(x, r):
    return {"y": ssm.Normal(x, sd=r)}
