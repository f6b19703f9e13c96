"""Which effect does the fan's model lack? Fast mode: the screen alone, nothing is fitted again.

What cannot be in this machine (gravity, a spring, hard stops) is not asked about.
"""

from pathlib import Path

import pandas as pd
from model import fan

import ssmppl as ssm

SUSPECTS = [
    "coulomb friction", "stribeck", "asymmetric friction", "quadratic drag", "constant load",
    "missing input", "input saturation", "dead zone", "input asymmetry", "actuator lag",
    "parameter drift", "sensor bias", "sensor gain nonlinearity", "sensor lag", "outliers",
    "coloured noise",
]  # fmt: skip

data = pd.read_csv(Path(__file__).with_name("data.csv"), index_col="time")
report = ssm.diagnose(fan, data, SUSPECTS, mode="fast", seed=1)
print(report)

leading = report.causes.head(5)
print(leading[["effect", "equation", "z", "p", "gain_screen"]].round(3).to_string(index=False))
