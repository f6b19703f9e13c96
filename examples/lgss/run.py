"""Four ways to the same parameter: two maxima of the likelihood and two posteriors, all exact."""

from pathlib import Path

import pandas as pd
from model import lgss

import ssmppl as ssm

data = pd.read_csv(Path(__file__).with_name("data.csv"), index_col="time")
for climber in (ssm.DirectOptimization(), ssm.EM()):
    best = ssm.maximize(lgss, data, climber, seed=1)
    print(f"{type(climber).__name__}: theta = {best.parameters['theta']:.5f}, "
          f"standard error {best.standard_errors['theta']:.5f}")  # fmt: skip
for sampler in (ssm.Gibbs(), ssm.MetropolisHastings()):
    idata = ssm.sample(lgss, data, sampler, draws=2000, warmup=500, chains=2, states=False, seed=1)
    row = ssm.summary(idata).loc["theta"]
    print(f"{type(sampler).__name__}: theta = {row['mean']:.3f}, sd {row['sd']:.3f}, "
          f"ESS {row['ess_bulk']:.0f}")  # fmt: skip
