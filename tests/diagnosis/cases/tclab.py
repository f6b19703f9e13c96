"""The temperature of a heated transistor in degrees Celsius, as one thermal mass; steps of 4 s.

u is the heater's power in per cent. The device is the Temperature Control Lab.
"""

import ssmppl as ssm

DT = 4

model = ssm.Model("heater", inputs=("u",))


@model.prior
def prior():
    return {
        "a": ssm.HalfNormal(sd=0.1),
        "b": ssm.HalfNormal(sd=0.1),
        "Ta": ssm.Normal(21, sd=2),
        "q": ssm.HalfNormal(sd=0.5),
        "r": ssm.HalfNormal(sd=0.5),
    }


@model.initial
def initial(Ta):
    return {"T": ssm.Normal(Ta, sd=1)}


@model.transition
def transition(T, u, a, b, Ta, q):
    return {"T": ssm.Normal(T + DT * (b * u / 10 - a * (T - Ta)), sd=q)}


@model.observation
def observation(T, r):
    return {"y": ssm.Normal(T, sd=r)}
