"""The coupled electric drives with a linear model of the speed: T. Wigren, M. Schoukens, "Coupled
electric drives data set and reference models", Uppsala University, report 2017-024.

Two motors drive a pulley by a belt; the pulley hangs on a spring. u is the sum of the voltages of
the motors, y the speed of the pulley as its sensor gives it, 20 ms a row. m is the speed of the
motors, s that of the pulley, a what the pulley's speed changes in a row.
"""

import ssmppl as ssm

model = ssm.Model("coupled drives", inputs=("u",))


@model.prior
def prior():
    return {
        "gain": ssm.LogNormal(0.0, sd=1.0),
        "lag": ssm.LogNormal(-1.5, sd=1.0),
        "k": ssm.LogNormal(-2.0, sd=1.0),
        "c": ssm.LogNormal(-2.0, sd=1.0),
        "q": ssm.LogNormal(-3.0, sd=1.5),
        "r": ssm.LogNormal(-3.0, sd=1.5),
    }


@model.initial
def initial():
    return {
        "m": ssm.Normal(0.0, sd=0.1),
        "s": ssm.Normal(0.0, sd=0.1),
        "a": ssm.Normal(0.0, sd=0.1),
    }


@model.transition
def transition(m, s, a, u, gain, lag, k, c, q):
    return {
        "m": ssm.Dirac(m + lag * (gain * u - m)),
        "s": ssm.Dirac(s + a),
        "a": ssm.Normal(a - k * (s - m) - c * a, sd=q),
    }


@model.observation
def observation(s, r):
    return {"y": ssm.Normal(s, sd=r)}
