"""Rate of growth, noise of the births and the share that is counted, from 55 counts of 60 years."""

from pathlib import Path

import numpy as np
import pandas as pd
from model import ricker

import ssmppl as ssm

data = pd.read_csv(Path(__file__).with_name("data.csv"), index_col="time")
idata = ssm.sample(ricker, data, ssm.PGAS(), draws=2500, warmup=500, thin=4, seed=1)
table = ssm.summary(idata)
table.insert(0, "truth", pd.Series({"log_r": 3.8, "q": 0.09, "phi": 10.0}))
print(table.round(3), "\n")

x = idata["posterior"]["x"]
for year in data.index[data["y"].isna()]:
    low, middle, high = np.exp(x.sel(time=year).quantile([0.05, 0.5, 0.95]).values)
    truth = np.exp(data.loc[year, "true_x"])
    print(f"year {year}, not counted: N = {middle:.3g} (90%: {low:.2g} to {high:.3g}); "
          f"in truth {truth:.3g}")  # fmt: skip
