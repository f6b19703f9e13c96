"""The models on which proposals are compared, with their data and parameters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

import ssmppl as ssm
from ssmppl.datasets import ice_varves
from ssmppl.demo import varves

precise = ssm.Model("precise observations")


@precise.initial
def precise_initial():
    return {"x": ssm.Normal(0, variance=1 / 0.51)}


@precise.transition
def precise_transition(x):
    return {"x": ssm.Normal(0.7 * x, variance=1.0)}


@precise.observation
def precise_observation(x):
    return {"y": ssm.Normal(x, variance=0.001)}


counts = ssm.Model("large counts")
LEVEL = np.log(500.0)


@counts.initial
def counts_initial():
    return {"x": ssm.Normal(LEVEL, sd=0.7)}


@counts.transition
def counts_transition(x):
    return {"x": ssm.Normal(LEVEL + 0.9 * (x - LEVEL), sd=0.3)}


@counts.observation
def counts_observation(x):
    return {"y": ssm.Poisson(np.exp(x))}


@dataclass(frozen=True)
class Case:
    """A model with data and parameters at which its likelihood is estimated."""

    label: str
    model: ssm.Model
    data: dict[str, np.ndarray]
    parameters: dict[str, Any]


def simulated(model: ssm.Model, steps: int) -> dict[str, np.ndarray]:
    """Observations drawn from a model without parameters."""
    return {"y": ssm.simulate(model, {}, steps=steps, seed=1)["y"].values[0]}


def cases() -> list[Case]:
    """The varves; an LGSS with observation variance 0.001; Poisson counts around 500."""
    return [
        Case("varves", varves, {"y": ice_varves()}, {"phi": 0.95, "tau": 50.0}),
        Case("LGSS, variance 0.001", precise, simulated(precise, 300), {}),
        Case("Poisson, mean 500", counts, simulated(counts, 300), {}),
    ]
