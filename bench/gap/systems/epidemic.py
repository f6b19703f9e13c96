"""An epidemic that smoulders: who was ill becomes susceptible again.

s is the share of the people who are susceptible, i the logarithm of the share who are infectious, u
their contacts above or below the usual; y counts the day's cases.
"""

import numpy as np

import ssmppl as ssm

GUESS = 1.0  # factor on the guesses of the physical constants
NOISE = 1.0  # factor on those of the noise scales
WANING = 0.02
PEOPLE = 8000.0

model = ssm.Model("epidemic", inputs=("u",))


@model.prior
def prior():
    return {
        "beta": ssm.LogNormal(np.log(0.4 * GUESS), sd=1.0),
        "gamma": ssm.LogNormal(np.log(0.2 * GUESS), sd=1.0),
        "b": ssm.LogNormal(np.log(0.5 * GUESS), sd=1.0),
        "q": ssm.LogNormal(np.log(0.03 * NOISE), sd=1.0),
    }


@model.initial
def initial():
    return {
        "s": ssm.Normal(0.55, sd=0.05),
        "i": ssm.Normal(-3.4, sd=0.3),
    }


@model.transition
def transition(s, i, u, beta, gamma, b, q):
    force = beta * np.maximum(1 + b * u, 0.1)
    share = np.exp(np.minimum(i, 0.0))
    return {
        "s": ssm.Dirac(s - force * s * share + WANING * (1 - s - share)),
        "i": ssm.Normal(i + force * np.maximum(s, 0.001) - gamma, sd=q),
    }


@model.observation
def observation(i):
    return {"y": ssm.Poisson(PEOPLE * np.maximum(np.exp(np.minimum(i, 0.0)), 1e-6))}
