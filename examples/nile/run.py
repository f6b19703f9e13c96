"""Did the flow drop in 1899? The size of the step, and the evidence for it."""

from pathlib import Path

import pandas as pd
from model import nile

import ssmppl as ssm

data = pd.read_csv(Path(__file__).with_name("data.csv"), index_col="time")
idata = ssm.sample(nile, data, draws=1500, warmup=500, chains=2, seed=1)
print(ssm.summary(idata).round(2), "\n")

step = idata["posterior"]["step"]
low, middle, high = step.quantile([0.05, 0.5, 0.95]).values
print(f"From 1899 on the flow is lower by {-middle:.0f} (90%: {-high:.0f} to {-low:.0f}); "
      f"the probability that it is lower at all is {float((step < 0).mean()):.3f}.")  # fmt: skip

with_step = ssm.evidence(nile, data, seed=1)
without = ssm.evidence(nile, data, fixed={"step": 0.0}, seed=1)
difference = with_step.log_evidence - without.log_evidence
print(f"The data speak for the step by a Bayes factor of exp({difference:.2f}).")
