"""Yeast in a vessel that is fed and drained at the rate u (1/h): cells x and sugar s (g/l).

Growth after Monod; the feed has 10 g/l of sugar. Both are measured, with noise, every quarter of an
hour. Steps of a row (Euler).
"""

import numpy as np

import ssmppl as ssm

GUESS = 1.0  # factor on the guesses of the physical constants
NOISE = 1.0  # factor on those of the noise scales
DT = 0.25
FEED = 10.0

model = ssm.Model("yeast", inputs=("u",))


@model.prior
def prior():
    return {
        "mu": ssm.LogNormal(np.log(0.6 * GUESS), sd=1.0),
        "half": ssm.LogNormal(np.log(1.5 * GUESS), sd=1.0),
        "yld": ssm.LogNormal(np.log(0.4 * GUESS), sd=1.0),
        "q": ssm.LogNormal(np.log(0.02 * NOISE), sd=1.0),
        "rx": ssm.LogNormal(np.log(0.022 * NOISE), sd=1.0),
        "rs": ssm.LogNormal(np.log(0.08 * NOISE), sd=1.0),
    }


@model.initial
def initial():
    return {
        "x": ssm.Normal(4.0, sd=0.3),
        "s": ssm.Normal(1.5, sd=0.3),
    }


@model.transition
def transition(x, s, u, mu, half, yld, q):
    left = np.maximum(s, 0.0)
    growth = mu * left / (half + left) * x
    return {
        "x": ssm.Normal(x + DT * (growth - u * x), sd=q),
        "s": ssm.Normal(s + DT * (u * (FEED - s) - growth / yld), sd=q),
    }


@model.observation
def observation(x, s, rx, rs):
    return {"cells": ssm.Normal(x, sd=rx), "sugar": ssm.Normal(s, sd=rs)}
