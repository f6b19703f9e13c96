"""Gravity over length, damping and gain of a pendulum, from ten seconds of an encoder."""

from pathlib import Path

import pandas as pd
from model import pendulum

import ssmppl as ssm

data = pd.read_csv(Path(__file__).with_name("data.csv"), index_col="time")
idata = ssm.sample(pendulum, data, draws=2500, warmup=1000, thin=2, seed=1)
table = ssm.summary(idata)
table.insert(0, "truth", pd.Series({"k": 15.0, "c": 0.4, "b": 8.0, "q": 0.2}))
print(table.round(3), "\n")

speed = idata["posterior"]["x"][..., 1]
for time in (2.0, 6.2, 9.0):
    low, middle, high = speed.sel(time=time).quantile([0.05, 0.5, 0.95]).values
    print(f"speed at {time:.1f} s: {middle:5.2f} rad/s (90%: {low:.2f} to {high:.2f}), "
          f"in truth {data.loc[time, 'true_omega']:.2f}")  # fmt: skip
