"""A user's program, for mypy: the installed package brings its types, and they tell faults."""

from typing import Any, assert_type

import numpy as np

import ssmppl as ssm
from ssmppl.datasets import nile

model = ssm.Model("local level")


@model.prior
def prior() -> dict[str, Any]:
    return {"q": ssm.InverseGamma(2.0, scale=1500.0)}


@model.transition
def transition(level: Any, q: Any) -> dict[str, Any]:
    return {"level": ssm.Normal(level, variance=q)}


flow: np.ndarray[Any, Any] = nile()
assert_type(ssm.compile(model).source(), str)
assert_type(ssm.diagnose(model, {"flow": flow}), ssm.GapReport)
estimates: np.ndarray[Any, Any] = ssm.log_likelihood(model, {"flow": flow}, {"q": 1500.0}, seed=1)
idata = ssm.sample(model, {"flow": flow}, ssm.PGAS(particles=20), draws=10, seed=1)
print(ssm.summary(idata).loc["q", "mean"])

# Faults, each of which mypy has to see: an `ignore` that nothing needs is an error here.
ssm.sample("model.py", {"flow": flow})  # type: ignore[arg-type]
ssm.sample(model, {"flow": flow}, draw=10)  # type: ignore[call-arg]
text: str = nile()  # type: ignore[assignment]
ssm.PGAS(particles="many")  # type: ignore[arg-type]
ssm.Normal(0, spread=1)  # type: ignore[call-arg]
