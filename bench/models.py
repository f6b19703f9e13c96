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


# Two states that are nonlinear and four that are linear given them, after the example of section
# 6 of T. Schön, F. Gustafsson and P.-J. Nordlund, IEEE Trans. Signal Processing 53 (2005).
mixed = ssm.Model("2 + 4 states")
ROTATIONS = np.array([
    [0.9 * np.cos(0.3), -0.9 * np.sin(0.3), 0.0, 0.0], [0.9 * np.sin(0.3), 0.9 * np.cos(0.3), 0, 0],
    [0.0, 0.0, 0.8 * np.cos(0.9), -0.8 * np.sin(0.9)], [0, 0, 0.8 * np.sin(0.9), 0.8 * np.cos(0.9)],
])  # fmt: skip


@mixed.initial
def mixed_initial():
    return {"x": ssm.Normal(np.zeros(2), sd=1.0), "z": ssm.Normal(np.zeros(4), sd=1.0)}


@mixed.transition
def mixed_transition(x, z):
    return {
        "x": ssm.Normal(
            np.stack([np.arctan(x[0]) + z[0], 0.8 * x[1] + np.sin(x[0]) + z[2]]), sd=0.3
        ),
        "z": ssm.Normal(ROTATIONS @ z, sd=0.3),
    }


@mixed.observation
def mixed_observation(x, z):
    return {
        "y": ssm.Normal(
            np.stack([0.1 * x[0] * np.abs(x[0]), x[1], z[0] - z[1] + z[2] - z[3]]), sd=0.3
        )
    }


regimes = ssm.Model("two regimes")


@regimes.initial
def regimes_initial():
    return {"k": ssm.Bernoulli(0.5), "z": ssm.Normal(np.zeros(2), sd=1.0)}


@regimes.transition
def regimes_transition(k, z):
    return {
        "k": ssm.Bernoulli(np.where(k == 1, 0.95, 0.1)),
        "z": ssm.Normal(
            np.where(k == 1, np.stack([0.95 * z[0] + z[1], 0.8 * z[1]]), 0.5 * z), sd=0.3
        ),
    }


@regimes.observation
def regimes_observation(z):
    return {"y": ssm.Normal(z[0], sd=0.3)}


def lorenz(states: int, step: float) -> ssm.Model:
    """The atmosphere of E. N. Lorenz, "Predictability: a problem partly solved" (1996), with
    forcing 8, by Heun's method; every other component is seen, with noise of sd 0.5."""
    model = ssm.Model(f"Lorenz-96, {states} states")

    def drift(x):
        return (np.roll(x, -1) - np.roll(x, 2)) * np.roll(x, 1) - x + 8.0

    @model.initial
    def initial():
        return {"x": ssm.Normal(8.0 * np.ones(states), sd=2.0)}

    @model.transition
    def transition(x):
        first = drift(x)
        return {"x": ssm.Normal(x + 0.5 * step * (first + drift(x + step * first)), sd=0.1)}

    @model.observation
    def observation(x):
        return {"y": ssm.Normal(x[::2], sd=0.5)}

    return model


@ssm.primitive
def sensor(x):
    """A characteristic that the language does not see through."""
    return x + 0.3 * np.sin(3.0 * x)


sharp = ssm.Model("sharp sensor")


@sharp.initial
def sharp_initial():
    return {"x": ssm.Normal(np.zeros(2), sd=1.0)}


@sharp.transition
def sharp_transition(x):
    return {"x": ssm.Normal(0.8 * x, sd=1.0)}


@sharp.observation
def sharp_observation(x):
    return {"y": ssm.Normal(sensor(x[0]), sd=0.01)}


both = ssm.Model("two sharp sensors")
both.initial(sharp_initial)
both.transition(sharp_transition)


@both.observation
def both_observation(x):
    return {"y": ssm.Normal(sensor(x), sd=0.01)}


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
    """The varves; an LGSS with observation variance 0.001; Poisson counts around 500; two models
    that are linear given some of their states; and two whose observation is an opaque function,
    with a hundredth of the noise of their transition."""
    return [
        Case("varves", varves, {"y": ice_varves()}, {"phi": 0.95, "tau": 50.0}),
        Case("LGSS, variance 0.001", precise, simulated(precise, 300), {}),
        Case("Poisson, mean 500", counts, simulated(counts, 300), {}),
        Case("2 + 4 states", mixed, simulated(mixed, 300), {}),
        Case("two regimes", regimes, simulated(regimes, 300), {}),
        Case("sharp sensor", sharp, simulated(sharp, 100), {}),
        Case("two sharp sensors", both, simulated(both, 100), {}),
    ]
