"""The rate of disasters over a century: where it fell, and how sure of it one may be."""

from pathlib import Path

import numpy as np
import pandas as pd
from model import mines

import ssmppl as ssm

data = pd.read_csv(Path(__file__).with_name("data.csv"))
idata = ssm.sample(mines, data, draws=1500, warmup=500, chains=2, thin=3, seed=1)
print(ssm.summary(idata).round(3), "\n")

rate = np.exp(idata["posterior"]["x"])
for year in range(1855, 1962, 15):
    low, middle, high = rate.sel(time=year).quantile([0.05, 0.5, 0.95]).values
    print(f"{year}  {middle:4.1f} a year  (90%: {low:.1f} to {high:.1f})")

fall = rate.sel(time=1880) / rate.sel(time=1900)
print(f"\nBetween 1880 and 1900 it fell by a factor of {float(fall.median()):.1f}; "
      f"the probability that it fell at all is {float((fall > 1).mean()):.3f}.")  # fmt: skip
