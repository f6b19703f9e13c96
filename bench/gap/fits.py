"""What the rivals start from: a set's base model fitted, its smoothed states and its residuals.

The fit is by the benchmark's own filter of the base system, of which `tests/bench_gap` shows that
it is the model given. It starts at the usual values: a wrong start in the model given does not
hurt the rivals. Smoothed states are those of `ssm.smooth`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

import ssmppl as ssm
from bench.gap.filter import terms
from bench.gap.fit import Fitted, fit
from bench.gap.plan import entries
from bench.gap.terms import Residuals
from bench.gap.truth import SYSTEMS, System
from ssmppl.modelfile import load_model, read_csv

FIT = 0.7  # share of the rows that the fit uses
PARTICLES = 600


def fitted(system: System, data: pd.DataFrame) -> tuple[Fitted, np.ndarray, np.ndarray]:
    """The base model's mode on the first 70% of the rows, with inputs and observations."""
    U = data[list(system.inputs)].to_numpy(float)
    Y = data[list(system.channels)].to_numpy(float)
    p = np.array(list(system.parameters.values()))
    found = fit(system, U, Y, (), p, system.strengths({}), int(FIT * len(Y)))
    return found, U, Y


def prepare(folder: Path) -> Residuals:
    """The residuals of one set's folder."""
    name = next(e.system for e in entries() if e.id == folder.name)
    return residuals(SYSTEMS[name], load_model(str(folder / "model.py")),
                     read_csv(folder / "data.csv"))  # fmt: skip


def residuals(system: System, model: ssm.Model, data: pd.DataFrame) -> Residuals:
    """Smoothed states, what their equations leave over, and standardised prediction errors."""
    found, U, Y = fitted(system, data)
    parameters = dict(zip(system.parameters, found.p.tolist(), strict=True))
    smoothed = ssm.smooth(model, data, parameters, ssm.FixedLag(proposal="bootstrap"),
                          particles=PARTICLES, seed=1)  # fmt: skip
    assert not isinstance(smoothed, list)  # one experiment, one Dataset
    names = [s for s in system.states if s in smoothed]
    X = np.stack([smoothed[n].values.reshape(-1) for n in names], axis=1)
    T, n = len(Y), len(system.start)
    mean, sd, ahead = np.zeros(n), np.zeros(n), np.empty((T - 1, len(names)))
    none = system.strengths({})
    for t in range(T - 1):
        s = np.zeros(n)
        s[: len(names)] = X[t]
        system.step(s, U[t], t + 1, found.p, none, mean, sd)
        ahead[t] = mean[: len(names)]
    noisy = [k for k in range(len(names)) if sd[k] > 0]
    _, eps, half = terms(system, found.p, none, U, Y)
    return Residuals(
        {name: X[:, k] for k, name in enumerate(names)},
        tuple(name for k, name in enumerate(names) if k not in noisy),
        {names[k]: X[1:, k] - ahead[:, k] for k in noisy},
        dict(zip(system.channels, eps.T, strict=True)),
        dict(zip(system.channels, (Y - eps * np.exp(half)).T, strict=True)),
        dict(zip(system.inputs, U.T, strict=True)),
    )
