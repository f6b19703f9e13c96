"""How noisy are the bearings and the target? PMMH: given a path, its noise is nearly fixed."""

from pathlib import Path

import numpy as np
import pandas as pd
from model import tracking

import ssmppl as ssm

data = pd.read_csv(Path(__file__).with_name("data.csv"), index_col="time")
idata = ssm.sample(
    tracking, data, ssm.PMMH(particles=50), draws=500, warmup=300, chains=2, seed=1
)  # fmt: skip
posterior = idata["posterior"]
for name, truth in (("q", 5e-4), ("r", 1e-4)):
    row = ssm.summary(idata).loc[name]
    low, middle, high = np.sqrt(posterior[name].quantile([0.05, 0.5, 0.95]).values)
    print(f"sqrt({name}) = {middle:.4f} (90%: {low:.4f} to {high:.4f}), in truth {truth**0.5:.4f}; "
          f"ESS {row['ess_bulk']:.0f}, R-hat {row['r_hat']:.2f}")  # fmt: skip

for time in (10, 30, 59):
    x = posterior["x"].sel(time=time).stack(sample=("chain", "draw")).values
    east, north = x[0].mean(), x[1].mean()
    print(f"minute {time}: {east:.1f} km east, {north:.1f} km north, give or take "
          f"{np.hypot(x[0].std(), x[1].std()):.1f} km; in truth {data.loc[time, 'true_east']:.1f} "
          f"and {data.loc[time, 'true_north']:.1f}")  # fmt: skip
