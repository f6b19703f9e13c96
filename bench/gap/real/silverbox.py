"""The Silverbox as a linear oscillator: T. Wigren, J. Schoukens, "Three free data sets for
development and benchmarking in nonlinear system identification", European Control Conference 2013.

An electronic circuit; u is the voltage that drives it, y what it answers, both in volts, 610.35 Hz.
x is the answer without the sensor's noise, `before` that of one row before: with k and c every
linear oscillator of second order can be written so. `beside` is the sum of the voltages one row
before and after u, as the voltage between two rows is smooth.
"""

import ssmppl as ssm

model = ssm.Model("silverbox", inputs=("u", "beside"))


@model.prior
def prior():
    return {
        "k": ssm.LogNormal(-1.0, sd=1.0),
        "c": ssm.LogNormal(-3.0, sd=1.0),
        "b": ssm.Normal(0.0, sd=1.0),
        "b_beside": ssm.Normal(0.0, sd=1.0),
        "offset": ssm.Normal(0.0, sd=0.01),
        "q": ssm.LogNormal(-7.0, sd=2.0),
        "r": ssm.LogNormal(-9.0, sd=2.0),
    }


@model.initial
def initial():
    return {"x": ssm.Normal(0.0, sd=0.1), "before": ssm.Normal(0.0, sd=0.1)}


@model.transition
def transition(x, before, u, beside, k, c, b, b_beside, offset, q):
    speed = x - before
    force = -k * x - c * speed + b * u + b_beside * beside + offset
    return {"x": ssm.Normal(x + speed + force, sd=q), "before": ssm.Dirac(x)}


@model.observation
def observation(x, r):
    return {"y": ssm.Normal(x, sd=r)}
