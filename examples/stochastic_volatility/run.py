"""How strong is the leverage? The correlation of a day's return with the volatility after it."""

from pathlib import Path

import numpy as np
import pandas as pd
from model import volatility

import ssmppl as ssm

data = pd.read_csv(Path(__file__).with_name("data.csv"), index_col="time", parse_dates=True)
idata = ssm.sample(volatility, data, draws=500, warmup=200, thin=8, chains=2, seed=1)
posterior = idata["posterior"]
print(f"{posterior.attrs['method']}: {posterior.attrs['method_reason']}")
print(ssm.summary(idata).round(3), "\n")

psi, omega = posterior["psi"], posterior["omega"]
rho = psi / np.sqrt(psi**2 + omega)
low, high = rho.quantile([0.05, 0.95]).values
print(f"rho = {float(rho.mean()):.2f}  (90%: {low:.2f} to {high:.2f})")

ahead = ssm.forecast(volatility, idata, steps=10, seed=1)["y"]
for k in (0, 4, 9):
    low, high = ahead.isel(time=k).quantile([0.05, 0.95]).values
    print(f"return in {k + 1:2d} trading days: 90% between {low:.2f}% and {high:.2f}%")
