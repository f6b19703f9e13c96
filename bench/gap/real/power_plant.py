"""The pressure of the steam of a 120 MW power plant, of first order in the five inputs.

Data: the plant at Pont-sur-Sambre in normal operation, 200 rows of 20 minutes (R. P. Guidorzi, P.
Rossi, Automatic Control Theory and Applications 2, 1974; of the collection DaISy, B. De Moor et
al., IFAC SYSID 1997), standardised, as `simbapy` carries them. Inputs: flow of the gas, opening of
the turbine's valves, flow of the spray, opening of the gas dampers, flow of the air.

What such a model lacks: fire, water, steam and metal store heat one after the other, and the plant
is identified with several states an output (P. Moonen, B. De Moor, L. Vandenberghe, J. Vandewalle,
Int. J. Control 49, 1989). Right: a lag or a delay of an input or of the sensor. Nothing in the
literature singles one out, so the rule is wide. Written down before the first run.
"""

import numpy as np
import pandas as pd
from scipy.io import loadmat

import ssmppl as ssm
from bench.gap.real.answers import Named, package_file

LACKS = "a second store of heat: a lag or a delay of an input or of the sensor"
INPUTS = ("gas", "valves", "spray", "dampers", "air")

model = ssm.Model("power plant", inputs=INPUTS)


@model.prior
def prior():
    weights = {f"b_{n}": ssm.Normal(0.0, sd=0.3) for n in INPUTS}
    return {
        "rate": ssm.LogNormal(np.log(0.1), sd=1.0),
        **weights,
        "q": ssm.LogNormal(np.log(0.1), sd=1.0),
        "r": ssm.LogNormal(np.log(0.03), sd=1.0),
    }


@model.initial
def initial():
    return {"p": ssm.Normal(0.0, sd=1.0)}


@model.transition
def transition(p, gas, valves, spray, dampers, air, rate, b_gas, b_valves, b_spray, b_dampers,
               b_air, q):  # fmt: skip
    drive = b_gas * gas + b_valves * valves + b_spray * spray + b_dampers * dampers + b_air * air
    return {"p": ssm.Normal(p - rate * p + drive, sd=q)}


@model.observation
def observation(p, r):
    return {"pressure": ssm.Normal(p, sd=r)}


def records() -> pd.DataFrame:
    """(200, 6): pressure and the inputs."""
    raw = loadmat(package_file("mat", "data", "daisy.mat"))
    return pd.DataFrame({"pressure": raw["Y"][:, 0], **dict(zip(INPUTS, raw["U"].T, strict=True))})


def right(n: Named) -> bool:
    return n.among("actuator lag", "input delay", "sensor lag", "sensor delay")
