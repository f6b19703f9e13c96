"""The annual flow of the Nile: a level that drifts, and drops when the dam at Aswan is built.

J. Durbin and S. J. Koopman, *Time Series Analysis by State Space Methods*, chapter 2, has the local
level model for this series; the step in 1899 is an intervention with a size to be estimated. The
input `dam` is 1 from 1899 on.
"""

import ssmppl as ssm

nile = ssm.Model("Nile", inputs=("dam",))


@nile.prior
def prior():
    return {
        "step": ssm.Normal(0, sd=300),
        "q": ssm.InverseGamma(1.5, scale=1000),
        "r": ssm.InverseGamma(1.5, scale=10000),
    }


@nile.initial
def initial():
    return {"level": ssm.Normal(1000, sd=300)}


@nile.transition
def transition(level, q):
    return {"level": ssm.Normal(level, variance=q)}


@nile.observation
def observation(level, dam, step, r):
    return {"y": ssm.Normal(level + step * dam, variance=r)}
