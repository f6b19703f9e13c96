"""Prey that is fed and crowds itself, and predators that live on it (Lotka and Volterra).

n and m are the logarithms of prey and predators, u the feeding above or below the usual; y1 and y2
are the logarithms of what is counted. Steps of a fifth of a season (Euler).
"""

import numpy as np

import ssmppl as ssm

GUESS = 1.0  # factor on the guesses of the physical constants
NOISE = 1.0  # factor on those of the noise scales
DT = 0.2

model = ssm.Model("predators and prey", inputs=("u",))


@model.prior
def prior():
    return {
        "r": ssm.LogNormal(np.log(1.0 * GUESS), sd=1.0),
        "a": ssm.LogNormal(np.log(1.0 * GUESS), sd=1.0),
        "g": ssm.LogNormal(np.log(0.5 * GUESS), sd=1.0),
        "k": ssm.LogNormal(np.log(0.7 * GUESS), sd=1.0),
        "q": ssm.LogNormal(np.log(0.03 * NOISE), sd=1.0),
        "r_obs": ssm.LogNormal(np.log(0.08 * NOISE), sd=1.0),
    }


@model.initial
def initial():
    return {
        "n": ssm.Normal(0.0, sd=0.3),
        "m": ssm.Normal(0.0, sd=0.3),
    }


@model.transition
def transition(n, m, u, r, a, g, k, q):
    growth = r * (1 + 0.4 * u) * (1 - np.exp(n) / 3.0)
    return {
        "n": ssm.Normal(n + DT * (growth - a * np.exp(m)), sd=q),
        "m": ssm.Normal(m + DT * (g * np.exp(n) - k), sd=q),
    }


@model.observation
def observation(n, m, r_obs):
    return {"y1": ssm.Normal(n, sd=r_obs), "y2": ssm.Normal(m, sd=r_obs)}
