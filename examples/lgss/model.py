"""A linear Gaussian series, the first example of Schön et al. (2015): one unknown precision."""

import ssmppl as ssm

lgss = ssm.Model("linear Gaussian")


@lgss.prior
def prior():
    return {"theta": ssm.Gamma(0.01, rate=0.01)}


@lgss.initial
def initial(theta):
    return {"x": ssm.Normal(0, precision=0.51 * theta)}


@lgss.transition
def transition(x, theta):
    return {"x": ssm.Normal(0.7 * x, precision=theta)}


@lgss.observation
def observation(x):
    return {"y": ssm.Normal(0.5 * x, variance=0.1)}
