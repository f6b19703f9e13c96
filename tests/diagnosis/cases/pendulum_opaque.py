"""The pendulum of `pendulum_steps`, its steps done by a simulator that cannot be looked into."""

import math

import ssmppl as ssm

model = ssm.Model("pendulum by a simulator", inputs=("u",))


@ssm.primitive
def step_angle(q, v, u, k, d):
    h = 0.005
    for _ in range(10):
        a = u - k * math.sin(q) - d * v
        moved = q + h * v + 0.5 * h * h * a
        v = v + h * a
        q = moved
    return q


@ssm.primitive
def step_rate(q, v, u, k, d):
    h = 0.005
    for _ in range(10):
        a = u - k * math.sin(q) - d * v
        moved = q + h * v + 0.5 * h * h * a
        v = v + h * a
        q = moved
    return v


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
    return {
        "q": ssm.Dirac(step_angle(q, v, u, k, d)),
        "v": ssm.Normal(step_rate(q, v, u, k, d), sd=s),
    }


@model.observation
def observation(q, r):
    return {"y": ssm.Normal(q, sd=r)}
