"""Growth of the economy of the United States: it switches between recessions and expansions.

J. D. Hamilton, "A new approach to the economic analysis of nonstationary time series and the
business cycle", *Econometrica* 57 (1989), without the autoregression. Annual rates in percent,
quarter by quarter. The priors of the two means say which state is which.
"""

import numpy as np

import ssmppl as ssm

growth = ssm.Model("growth that switches")


@growth.prior
def prior():
    return {
        "stay_low": ssm.Beta(8, 2),
        "stay_high": ssm.Beta(9, 1),
        "low": ssm.Normal(-2, sd=2),
        "high": ssm.Normal(4, sd=2),
        "precision": ssm.Gamma(2, rate=10),
    }


@growth.initial
def initial():
    return {"expansion": ssm.Bernoulli(0.8)}


@growth.transition
def transition(expansion, stay_low, stay_high):
    return {"expansion": ssm.Bernoulli(np.where(expansion, stay_high, 1 - stay_low))}


@growth.observation
def observation(expansion, low, high, precision):
    return {"growth": ssm.Normal(np.where(expansion, high, low), precision=precision)}
