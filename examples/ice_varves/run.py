"""PGAS and PMMH side by side: two algorithms that share little, and one posterior."""

from model import varves

import ssmppl as ssm
from ssmppl.datasets import ice_varves

data = {"y": ice_varves()}
by_pgas = ssm.sample(varves, data, ssm.PGAS(), draws=1500, warmup=300, thin=4, states=False, seed=1)
by_pmmh = ssm.sample(varves, data, ssm.PMMH(), draws=600, warmup=300, states=False, seed=1)

columns = ["mean", "sd", "mcse_mean", "r_hat"]
for idata in (by_pgas, by_pmmh):
    print(idata["posterior"].attrs["method"])
    print(ssm.summary(idata)[columns].round(4), "\n")
