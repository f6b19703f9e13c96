"""A heated room: its temperature above that outside, by the hour.

The room loses the share 1 - a of its warmth in an hour, and a heater of u kilowatt adds b u. The
thermometer is read with noise, when it is read.
"""

import ssmppl as ssm

room = ssm.Model("heated room", inputs=("u",))


@room.prior
def prior():
    return {
        "a": ssm.Truncated(ssm.Normal(0.9, sd=0.5), lower=0, upper=1),
        "b": ssm.Normal(0, sd=5),
        "q": ssm.InverseGamma(2, scale=0.1),
        "r": ssm.InverseGamma(2, scale=0.5),
    }


@room.initial
def initial():
    return {"x": ssm.Normal(0, sd=5)}


@room.transition
def transition(x, u, a, b, q):
    return {"x": ssm.Normal(a * x + b * u, variance=q)}


@room.observation
def observation(x, r):
    return {"y": ssm.Normal(x, variance=r)}
