"""A model at given parameters with the filter that a diagnosis has for it.

A bootstrap filter loses next to noise-free systems, as a free pendulum, within a few rows; the tool
filters them by proposals that look ahead. What it hands back is measured by the same filters here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from ssmppl.data import Experiment
from ssmppl.diagnosis.diagnose import PARTICLES, TWISTED_PARTICLES
from ssmppl.diagnosis.fitting.augmented_models import AugmentedModels, proposal_of
from ssmppl.diagnosis.fitting.fit import Fitter
from ssmppl.diagnosis.heldout.predictions import stretches
from ssmppl.diagnosis.model.smoothing import Settings, samples_ahead
from ssmppl.inference.preparation.space import space_of
from ssmppl.inference.run.problem import missing_of, pose
from ssmppl.inference.run.seeds import random_state, seed_sequence
from ssmppl.inference.verbs.simulate import feeds_back
from ssmppl.language.model.model import Model

RUNS = 4  # of a particle filter, whose mean stands for the rows behind a cut


@dataclass(frozen=True)
class Diagnosed:
    """fitter : of the model. theta : (P,). experiment : the data."""

    fitter: Fitter
    theta: np.ndarray
    experiment: Experiment

    @classmethod
    def of(cls, model: Model, data: pd.DataFrame, parameters: Mapping[str, float]) -> Diagnosed:
        problem = pose(model, data)
        proposal = proposal_of(problem.program)
        number = (TWISTED_PARTICLES if proposal == "twisted" else PARTICLES)["full"]
        missing = missing_of(problem.experiments)
        fitter = AugmentedModels(problem.trace, missing, {}, Settings(number, proposal)).base_fitter
        given = {n: np.asarray(v) for n, v in parameters.items()}
        theta = space_of(fitter.problem, fitter.fixed, given).theta
        return cls(fitter, theta, problem.experiments[0])

    @property
    def _row_by_row(self) -> bool:
        return self.fitter.exact or self.fitter.settings.proposal != "twisted"

    def increments(self, run: int) -> np.ndarray:
        """(T,) log p(y_t | y_{1:t-1}) by one run of the filter."""
        found = self.fitter.smoother.run(
            [self.experiment], self.theta, random_state(seed_sequence(1), run), predicted=False
        )
        return found[0].log_increments

    def predictive(self, behind: np.ndarray, runs: int) -> np.ndarray:
        """(R, T) log predictive densities of the rows `behind` (T,), of stretches of them where the
        filter looks ahead; 0 at the others."""
        if self._row_by_row:
            return np.stack([np.where(behind, self.increments(r), 0.0) for r in range(runs)])
        streams = (random_state(seed_sequence(1), r) for r in range(runs))
        e, fit = self.experiment, self
        return np.stack([stretches(self.fitter, fit, e, behind, s) for s in streams])  # type: ignore[arg-type]

    def later(self, cut: int) -> float:
        """Log predictive density of all rows behind a cut."""
        if self._row_by_row:
            return float(self.increments(0)[cut:].sum())
        e = self.experiment
        until = replace(e, y=e.y[:cut], seen=e.seen[:cut], u=e.u[:cut], steps=cut)
        runs = []
        for r in range(RUNS):
            each = (self.fitter.estimate([x], self.theta, random_state(seed_sequence(1), r))
                    for x in (e, until))  # fmt: skip
            runs.append(np.subtract(*each))
        return float(np.mean(runs))

    def simulated(self, origins: np.ndarray, reach: int, draws: int) -> np.ndarray:
        """(O, reach, K) means of simulations from the filtered states of the rows `origins`."""
        stream, smoother = random_state(seed_sequence(1)), self.fitter.smoother
        filtered = smoother.filtered_draws(self.experiment, self.theta, stream)
        drawn = samples_ahead(
            smoother.program, self.experiment, self.theta, *filtered, stream,
            feeds_back(self.fitter.problem.trace), origins, reach, draws, np.arange(reach),
        )  # fmt: skip
        return drawn.mean(axis=-1)
