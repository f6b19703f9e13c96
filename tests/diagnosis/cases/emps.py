"""An electro-mechanical positioning system: a carriage on a screw, driven by a motor.

u is the force in 100 N, y the position in m, steps of 20 ms with the acceleration in the position.
The record is of the nonlinear benchmark of A. Janot, M. Gautier and M. Brunot (2019).
"""

import ssmppl as ssm

DT = 0.02

model = ssm.Model("EMPS", inputs=("u",))


@model.prior
def prior():
    return {
        "b": ssm.HalfNormal(sd=5),
        "d": ssm.HalfNormal(sd=5),
        "q": ssm.HalfNormal(sd=0.05),
        "r": ssm.HalfNormal(sd=0.01),
    }


@model.initial
def initial():
    return {"p": ssm.Normal(0, sd=0.01), "v": ssm.Normal(0, sd=0.01)}


@model.transition
def transition(p, v, u, b, d, q):
    a = b * u - d * v
    return {"p": ssm.Dirac(p + DT * v + DT**2 / 2 * a), "v": ssm.Normal(v + DT * a, sd=q)}


@model.observation
def observation(p, r):
    return {"y": ssm.Normal(p, sd=r)}
