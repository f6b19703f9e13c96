"""A population that overshoots: Ricker's map with noise in the births, seen through counts.

Each year a population N becomes r N exp(-N + e), with e ~ N(0, q); of it, phi N are counted on
average. The state is x = log N. W. E. Ricker, "Stock and recruitment", *Journal of the Fisheries
Research Board of Canada* 11 (1954); with noise and counts as here: S. N. Wood, "Statistical
inference for noisy nonlinear ecological dynamic systems", *Nature* 466 (2010).
"""

import numpy as np

import ssmppl as ssm

ricker = ssm.Model("Ricker population")


@ricker.prior
def prior():
    return {
        "log_r": ssm.Normal(3, sd=1),
        "q": ssm.InverseGamma(3, scale=0.3),
        "phi": ssm.Gamma(2, rate=0.2),
    }


@ricker.initial
def initial():
    return {"x": ssm.Normal(0, sd=1)}


@ricker.transition
def transition(x, log_r, q):
    return {"x": ssm.Normal(x + log_r - np.exp(x), variance=q)}


@ricker.observation
def observation(x, phi):
    return {"y": ssm.Poisson(phi * np.exp(x))}
