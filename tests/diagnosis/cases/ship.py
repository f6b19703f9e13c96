"""The heading of a ship under its rudder, as a damped oscillator; steps of a second (Euler)."""

import ssmppl as ssm

DT = 1.0

model = ssm.Model("ship", inputs=("u",))


@model.prior
def prior():
    return {
        "k": ssm.HalfNormal(sd=1),
        "d": ssm.HalfNormal(sd=1),
        "b": ssm.Normal(0, sd=1),
        "q": ssm.HalfNormal(sd=0.5),
        "r": ssm.HalfNormal(sd=0.5),
    }


@model.initial
def initial():
    return {"p": ssm.Normal(0, sd=0.1), "v": ssm.Normal(0, sd=0.1)}


@model.transition
def transition(p, v, u, k, d, b, q):
    return {
        "p": ssm.Dirac(p + DT * v),
        "v": ssm.Normal(v + DT * (b * u - k * p - d * v), sd=q),
    }


@model.observation
def observation(p, r):
    return {"y": ssm.Normal(p, sd=r)}
