"""Disasters in coal mines, by the year: a Poisson variable whose rate drifts."""

import numpy as np

import ssmppl as ssm

mines = ssm.Model("coal mines")


@mines.prior
def prior():
    return {"q": ssm.InverseGamma(2, scale=0.05)}


@mines.initial
def initial():
    return {"x": ssm.Normal(1, sd=1)}


@mines.transition
def transition(x, q):
    return {"x": ssm.Normal(x, variance=q)}


@mines.observation
def observation(x):
    return {"y": ssm.Poisson(np.exp(x))}
