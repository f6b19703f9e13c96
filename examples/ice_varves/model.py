"""Thickness of the yearly layers of a glacier's sediment: a Gamma variable around e^x."""

import numpy as np

import ssmppl as ssm

varves = ssm.Model("ice varves")


@varves.prior
def prior():
    return {"phi": ssm.Uniform(-1, 1), "tau": ssm.Gamma(0.01, rate=0.01)}


@varves.initial
def initial(phi, tau):  # as if the series had gone on for ever before
    return {"x": ssm.Normal(0, precision=(1 - phi**2) * tau)}


@varves.transition
def transition(x, phi, tau):
    return {"x": ssm.Normal(phi * x, precision=tau)}


@varves.observation
def observation(x):
    return {"y": ssm.Gamma(6.25, rate=0.256 * np.exp(-x))}
