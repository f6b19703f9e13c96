"""Writes data.csv: 60 years simulated from the model, of which five were not counted."""

from pathlib import Path

import numpy as np
import pandas as pd
from model import ricker

import ssmppl as ssm

TRUTH = {"log_r": 3.8, "q": 0.09, "phi": 10.0}  # the values of Wood (2010)

if __name__ == "__main__":
    made = ssm.simulate(ricker, TRUTH, steps=60, seed=2010)
    table = pd.DataFrame({"time": np.arange(1, 61), "y": made["y"].values[0]})
    table["true_x"] = made["x"].values[0].round(4)
    table.loc[[11, 12, 29, 43, 50], "y"] = np.nan
    table["y"] = table["y"].astype("Int64")
    table.to_csv(Path(__file__).with_name("data.csv"), index=False)
