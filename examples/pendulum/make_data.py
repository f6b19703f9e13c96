"""Writes data.csv: ten seconds simulated from the model, the angle rounded as an encoder does.

The torque switches between four levels at random.
"""

from pathlib import Path

import numpy as np
import pandas as pd
from model import COUNT, DT, pendulum

import ssmppl as ssm

TRUTH = {"k": 15.0, "c": 0.4, "b": 8.0, "q": 0.2}
STEPS = 200

if __name__ == "__main__":
    levels = np.random.default_rng(5).choice([-1.0, -0.3, 0.3, 1.0], size=STEPS // 10)
    torque = np.repeat(levels, 10)
    made = ssm.simulate(pendulum, TRUTH, inputs={"torque": torque}, seed=5)
    x = made["x"].values[0]
    table = pd.DataFrame({"time": (DT * np.arange(STEPS)).round(2), "torque": torque})
    table["angle"] = (COUNT * np.round(x[:, 0] / COUNT)).round(6)
    table["true_omega"] = x[:, 1].round(4)
    table.loc[120:127, "angle"] = np.nan  # the cable was loose for 0.4 s
    table.to_csv(Path(__file__).with_name("data.csv"), index=False)
