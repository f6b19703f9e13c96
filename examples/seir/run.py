"""How many fell ill, when not all of them report it? by PMMH, which suits this model."""

from pathlib import Path

import numpy as np
import pandas as pd
from model import epidemic

import ssmppl as ssm

data = pd.read_csv(Path(__file__).with_name("data.csv"), index_col="time")
idata = ssm.sample(
    epidemic, data, ssm.PMMH(particles=100), draws=1000, warmup=400, chains=2, seed=1
)
table = ssm.summary(idata)
table.insert(0, "truth", pd.Series({"beta": 0.5, "fall_ill": 0.33, "recover": 0.25, "rho": 0.4}))
print(table.round(3), "\n")

total = idata["posterior"]["onsets"].sum("time").values.ravel()
low, middle, high = np.quantile(total, [0.05, 0.5, 0.95])
print(f"{data['reported'].sum():.0f} cases were reported; {middle:.0f} people fell ill "
      f"(90%: {low:.0f} to {high:.0f}). In truth it was {data['true_onsets'].sum()}.")  # fmt: skip
