"""Writes data.csv: 70 days simulated from the model; on three days nothing was reported."""

from pathlib import Path

import numpy as np
import pandas as pd
from model import epidemic

import ssmppl as ssm

TRUTH = {"beta": 0.5, "fall_ill": 0.33, "recover": 0.25, "rho": 0.4}

if __name__ == "__main__":
    made = ssm.simulate(epidemic, TRUTH, steps=70, seed=1)
    table = pd.DataFrame({"time": np.arange(1, 71), "reported": made["reported"].values[0]})
    table["true_onsets"] = made["onsets"].values[0].astype(int)
    table.loc[[30, 31, 47], "reported"] = np.nan
    table["reported"] = table["reported"].astype("Int64")
    table.to_csv(Path(__file__).with_name("data.csv"), index=False)
