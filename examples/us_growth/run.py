"""When was there a recession? With two states the forward algorithm is exact: no particles."""

from pathlib import Path

import pandas as pd
from model import growth

import ssmppl as ssm

data = pd.read_csv(Path(__file__).with_name("data.csv"))
idata = ssm.sample(growth, data, draws=1000, warmup=200, seed=1, progress=False)
print(f"{idata['posterior'].attrs['method']}: {idata['posterior'].attrs['method_reason']}")
print(ssm.summary(idata).round(3), "\n")

recession = 1.0 - idata["posterior"]["expansion"].mean(["chain", "draw"]).to_series()
print("Quarters in recession with a probability above 0.7:")
print(", ".join(f"{quarter} ({p:.2f})" for quarter, p in recession[recession > 0.7].items()))

best = ssm.maximize(growth, data, ssm.EM(), seed=1)
print("\nMaximum likelihood, by Baum and Welch's EM:")
print({name: round(float(value), 3) for name, value in best.parameters.items()})

ahead = ssm.forecast(growth, idata, steps=4, seed=1)["growth"]
print("\nThe four quarters that follow:")
for k in range(4):
    low, middle, high = ahead.isel(time=k).quantile([0.05, 0.5, 0.95]).values
    print(f"  {middle:.1f}%  (90%: {low:.1f} to {high:.1f})")
