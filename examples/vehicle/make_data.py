"""Writes a CSV file for each experiment: a lane change, a sweep and a turn, four seconds each."""

from pathlib import Path

import numpy as np
import pandas as pd
from model import DT, vehicle

import ssmppl as ssm

TRUTH = {
    "c_front": 7.0, "c_rear": 8.5, "q_v": 1e-3, "q_w": 2e-5, "r_gyro": 1e-4, "r_position": 0.04,
}  # fmt: skip
STEPS = 100
TIME = (DT * np.arange(STEPS)).round(2)
EXPERIMENTS = {
    "lane_change": (20.0, 0.03 * np.sin(np.pi * TIME) * (TIME < 2)),
    "sweep": (15.0, 0.03 * np.sin(2 * np.pi * (0.3 + 0.2 * TIME) * TIME)),
    "turn": (10.0, 0.04 * (TIME > 0.5)),
}

if __name__ == "__main__":
    for seed, (name, (speed, steer)) in enumerate(EXPERIMENTS.items(), start=1):
        table = pd.DataFrame({"time": TIME, "steer": steer.round(5), "speed": speed})
        made = ssm.simulate(vehicle, TRUTH, inputs=table[["steer", "speed"]], seed=seed)
        table["gyro"] = made["gyro"].values[0].round(5)
        place = made["place"].values[0].round(3)
        table["place"] = np.where(np.arange(STEPS) % 5 == 0, place, np.nan)
        for state in ("v", "heading", "position"):
            table[f"true_{state}"] = made[state].values[0].round(4)
        table.to_csv(Path(__file__).with_name(f"{name}.csv"), index=False)
