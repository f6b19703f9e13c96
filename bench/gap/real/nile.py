"""The annual flow of the Nile at Aswan, 1871 to 1970, about a fixed level.

Data: `nile` of `statsmodels` (also in every copy of R). y is in 1e8 cubic metres; x the flow
without what is peculiar to one reading.

What such a model lacks: the flow drops by a quarter in 1899, when the dam at Aswan is begun and the
rains over the tropics weaken (G. W. Cobb, Biometrika 65, 1978; N. S. Balke, J. Bus. Econ. Statist.
11, 1993; J. Durbin, S. J. Koopman, Time Series Analysis by State Space Methods, 2001, chapter 2).
Right: a break of a parameter or of the level from 1897 to 1901, rows 27 to 31. Written down before
the first run.
"""

import numpy as np
import pandas as pd

import ssmppl as ssm
from bench.gap.real.answers import Named, package_file

LACKS = "a break of the level in 1899 (row 29)"
DROP = 29  # the row of 1899, counted from 1

model = ssm.Model("Nile")


@model.prior
def prior():
    return {
        "mean": ssm.Normal(900.0, sd=200.0),
        "phi": ssm.Uniform(0.0, 1.0),
        "q": ssm.LogNormal(np.log(80.0), sd=0.7),
        "r": ssm.LogNormal(np.log(100.0), sd=0.7),
    }


@model.initial
def initial():
    return {"x": ssm.Normal(1000.0, sd=200.0)}


@model.transition
def transition(x, mean, phi, q):
    return {"x": ssm.Normal(mean + phi * (x - mean), sd=q)}


@model.observation
def observation(x, r):
    return {"y": ssm.Normal(x, sd=r)}


def records() -> pd.DataFrame:
    """(100, 1): y."""
    path = package_file("statsmodels", "datasets", "nile", "nile.csv")
    return pd.DataFrame({"y": pd.read_csv(path)["volume"].to_numpy(dtype=float)})


def right(n: Named) -> bool:
    return n.among("parameter break", "level break") and n.near("date", DROP - 2, DROP + 2)
