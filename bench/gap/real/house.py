"""A heated house as one thermal mass behind one resistance.

Data: 33 days by the hour of the tutorials of `darkgreybox` (Ti, Ta, Ph), which only its source
archive carries. T is the temperature inside, `outside` that outside, both in degrees C, `heating`
the power of the heating (in units of 10 of the file's).

What such a model lacks: a second thermal mass, of the walls or of the radiators (P. Bacher, H.
Madsen, Energy and Buildings 43, 2011, who start from this very model and add those first), and
gains that nobody recorded, the sun's by day among them (Bacher and Madsen; the tutorial says so of
its own data). Right: a lag or a delay of an input or of the sensor, or a forcing of 24 hours, one
more or less. An input that was not recorded, with no more said, is wrong here. Written down before
the first run.
"""

from pathlib import Path

import numpy as np
import pandas as pd

import ssmppl as ssm
from bench.gap.real.answers import Named, source_file

LACKS = "a second thermal mass (a lag or delay), or the sun (a forcing of 24 rows)"
ARCHIVE, FILE = "darkgreybox-0.3.2.tar.gz", "docs/tutorials/data/demo_data.csv"

model = ssm.Model("house", inputs=("outside", "heating"))


@model.prior
def prior():
    return {
        "loss": ssm.LogNormal(np.log(0.02), sd=1.0),  # 1 / h
        "gain": ssm.LogNormal(np.log(0.1), sd=1.0),
        "q": ssm.LogNormal(np.log(0.1), sd=0.7),
        "r": ssm.LogNormal(np.log(0.05), sd=0.7),
    }


@model.initial
def initial():
    return {"T": ssm.Normal(18.0, sd=1.0)}


@model.transition
def transition(T, outside, heating, loss, gain, q):
    return {"T": ssm.Normal(T - loss * (T - outside) + gain * heating, sd=q)}


@model.observation
def observation(T, r):
    return {"inside": ssm.Normal(T, sd=r)}


def records(sources: Path | None = None) -> pd.DataFrame:
    """(792, 3): inside, outside, heating. sources : folder with the archive."""
    with source_file(sources, ARCHIVE, FILE) as file:
        raw = pd.read_csv(file)
    return pd.DataFrame({"inside": raw["Ti"], "outside": raw["Ta"], "heating": raw["Ph"] / 10})


def right(n: Named) -> bool:
    memory = n.among("actuator lag", "input delay", "sensor lag", "sensor delay")
    return memory or (n.among("periodic forcing") and n.near("period", 23, 25))
