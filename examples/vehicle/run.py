"""The stiffness of both axles, from three experiments that share the parameters."""

from pathlib import Path

import pandas as pd
from model import vehicle

import ssmppl as ssm

TRUTH = {
    "c_front": 7.0, "c_rear": 8.5, "q_v": 1e-3, "q_w": 2e-5, "r_gyro": 1e-4, "r_position": 0.04,
}  # fmt: skip

files = sorted(Path(__file__).parent.glob("*.csv"))
data = [pd.read_csv(file, index_col="time") for file in files]
idata = ssm.sample(
    vehicle, data, ssm.MetropolisHastings(), draws=8000, warmup=1000, seed=1, states=False
)
table = ssm.summary(idata)[["mean", "sd", "ess_bulk", "r_hat"]]
table.insert(0, "truth", pd.Series(TRUTH))
print(table.to_string(float_format="{:.3g}".format), "\n")

means = {name: float(idata["posterior"][name].mean()) for name in TRUTH}
for file, table, states in zip(files, data, ssm.smooth(vehicle, data, means), strict=True):
    error = (states["v"].values[0] - table["true_v"]).std()
    print(f"{file.stem}: lateral velocity, which nothing measures, to {error:.3f} m/s")
