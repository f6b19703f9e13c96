"""A pendulum under the torque u, in ten small steps for each row of 50 ms; y is its angle."""

import numpy as np

import ssmppl as ssm

H, STEPS = 0.005, 10

model = ssm.Model("pendulum in ten small steps", inputs=("u",))


@model.prior
def prior():
    return {
        "k": ssm.HalfNormal(sd=20),
        "d": ssm.HalfNormal(sd=2),
        "s": ssm.HalfNormal(sd=1),
        "r": ssm.HalfNormal(sd=1),
    }


@model.initial
def initial():
    return {"q": ssm.Normal(0, sd=0.2), "v": ssm.Normal(0, sd=0.2)}


@model.transition
def transition(q, v, u, k, d, s):
    for _ in range(STEPS):
        a = u - k * np.sin(q) - d * v
        q = q + H * v + H**2 / 2 * a
        v = v + H * a
    return {"q": ssm.Dirac(q), "v": ssm.Normal(v, sd=s)}


@model.observation
def observation(q, r):
    return {"y": ssm.Normal(q, sd=r)}
