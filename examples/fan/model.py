"""A fan on a motor: its speed in thousands of turns a minute, every 50 ms.

The voltage u drives it, either way round, and a resistance in proportion to the speed slows it
down. That is the whole simulator; the machine itself knows better.
"""

import numpy as np

import ssmppl as ssm

DT = 0.05

fan = ssm.Model("fan", inputs=("u",))


@fan.prior
def prior():
    return {
        "b": ssm.LogNormal(np.log(0.5), sd=1),
        "c": ssm.LogNormal(np.log(0.5), sd=1),
        "q": ssm.LogNormal(np.log(0.05), sd=1),
        "r": ssm.LogNormal(np.log(0.05), sd=1),
    }


@fan.initial
def initial():
    return {"w": ssm.Normal(0, sd=0.5)}


@fan.transition
def transition(w, u, b, c, q):
    return {"w": ssm.Normal(w + DT * (b * u - c * w), sd=q)}


@fan.observation
def observation(w, r):
    return {"y": ssm.Normal(w, sd=r)}
