"""Simulated readings, of which one in seven is missing, and the parameters that made them."""

from pathlib import Path

import pandas as pd
from model import room

import ssmppl as ssm

TRUTH = {"a": 0.85, "b": 1.5, "q": 0.04, "r": 0.25}

data = pd.read_csv(Path(__file__).with_name("data.csv"))
print(ssm.explain(room, data))

idata = ssm.sample(room, data, draws=1000, warmup=300, chains=2, seed=1)
table = ssm.summary(idata)
table.insert(0, "truth", pd.Series(TRUTH))
print(table.round(3))

x = idata["posterior"]["x"]
gap = int(data["y"].isna().to_numpy().argmax())
there = x.isel(time=gap)
print(f"\nIn row {gap + 1} nothing was read; the room was at {float(there.mean()):.1f}, "
      f"give or take {float(there.std()):.1f} degrees.")  # fmt: skip
