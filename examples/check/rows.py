"""What a check is, and what it gives: a number of ssmppl's beside the same by another road."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import ssmppl as ssm
from ssmppl.modelfile import load_model, read_csv

EXAMPLES = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Estimate:
    """A number and its Monte Carlo standard error, 0 where it is exact up to rounding."""

    value: float
    error: float = 0.0


@dataclass(frozen=True)
class Row:
    """One comparison: `quantity` of an example, by ssmppl and by `peer`."""

    example: str
    quantity: str
    by: str
    peer: str
    ours: Estimate
    theirs: Estimate

    @property
    def difference(self) -> float:
        return self.ours.value - self.theirs.value

    @property
    def error(self) -> float:
        return math.hypot(self.ours.error, self.theirs.error)

    @property
    def z(self) -> float:
        """The difference in standard errors; NaN where both numbers are exact."""
        return self.difference / self.error if self.error else math.nan

    @property
    def holds(self) -> bool:
        """|z| below 4, or where both are exact no more than rounding (1e-8, relative)."""
        if self.error:
            return abs(self.z) < 4.0
        return abs(self.difference) <= 1e-8 * max(1.0, abs(self.theirs.value))


@dataclass(frozen=True)
class Check:
    """A function that yields rows, and the packages that it asks for beyond ssmppl's own."""

    example: str
    needs: tuple[str, ...]
    run: Callable[[], Iterator[Row]]


CHECKS: list[Check] = []


def check(example: str, *needs: str) -> Callable[[Callable[[], Iterator[Row]]], Any]:
    """Put a function on the list, under the example that it checks."""

    def enlist(run: Callable[[], Iterator[Row]]) -> Callable[[], Iterator[Row]]:
        CHECKS.append(Check(example, needs, run))
        return run

    return enlist


def files(example: str) -> tuple[ssm.Model, list[pd.DataFrame]]:
    """Model and data sets of an example, as the command line reads them."""
    folder = EXAMPLES / example
    return load_model(str(folder / "model.py")), [read_csv(p) for p in sorted(folder.glob("*.csv"))]


def mean_likelihood(log_z: np.ndarray) -> Estimate:
    """log of the mean of exp(log_z), estimates (R,) that are unbiased for the likelihood, and its
    standard error to first order."""
    top = log_z.max()
    ratio = np.exp(log_z - top)
    mean = ratio.mean()
    error = ratio.std(ddof=1) / mean / math.sqrt(len(ratio)) if len(ratio) > 1 else 0.0
    return Estimate(float(top + np.log(mean)), float(error))


def log_likelihood(
    example: str, parameters: dict[str, Any], particles: int = 0, repeats: int = 20, **options: Any
) -> Estimate:
    """ssmppl's own, exact where it is exact: then the repeats are equal and the error is 0."""
    model, data = files(example)
    if particles:
        options |= {"particles": particles, "repeats": repeats, "seed": 1}
    return mean_likelihood(ssm.log_likelihood(model, data, parameters, **options))


def posterior_mean(idata: Any, name: str) -> Estimate:
    """Mean of a parameter over all chains, with ArviZ's Monte Carlo standard error."""
    row = ssm.summary(idata).loc[name]
    return Estimate(float(row["mean"]), float(row["mcse_mean"]))


def stated(parameters: dict[str, Any]) -> str:
    """The name of a log-likelihood in the table."""
    return "log-likelihood at " + ", ".join(f"{k} {v:g}" for k, v in parameters.items())
