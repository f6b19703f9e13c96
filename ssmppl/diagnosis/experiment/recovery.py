"""Who is taken for whom: the leading effects fitted to data simulated from each of them in turn.

How far the truth may lie behind the best by chance is not read off a table: data sets are drawn
from each leading refit, with the same inputs and gaps, and all of them are fitted to every set, as
to the data (the parametric bootstrap with cross-fitting of E.-J. Wagenmakers, R. Ratcliff, P. Gomez
and G. Iverson, *Journal of Mathematical Psychology* 48, 2004; D. Cox's tests of separate families,
1961). An effect stays in the confidence set where it lies no further behind in the data than in 95
of 100 sets of its own. Shapes are those of the refits; fits climb the extended Kalman filter's
likelihood, with the prior, and are looked at one row ahead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ssmppl.analysis.structure import simulators
from ssmppl.codegen.modules.gaussian import GaussianApproximation
from ssmppl.data import Experiment
from ssmppl.diagnosis.experiment.rivals import Rival
from ssmppl.diagnosis.fitting.augmented_models import AugmentedModels
from ssmppl.diagnosis.fitting.fit import Fitter
from ssmppl.diagnosis.fitting.scoring import climb_by_scoring
from ssmppl.diagnosis.run.checkpoint import Checkpoint, Numbers
from ssmppl.diagnosis.run.seeds import child_seed
from ssmppl.diagnosis.selection.refit import Refit
from ssmppl.errors import SSMError
from ssmppl.inference.preparation.space import space_of
from ssmppl.inference.run.seeds import random_state

FINALISTS, SETS = 4, 20
REACH = 0.5  # of what the best gains: effects that gain less are no rivals
LEAST = 10  # sets that have come to numbers, without which nothing is said
LEVEL = 0.95


@dataclass(frozen=True)
class Recovery:
    """Log posterior densities of F fitted rivals, less what the choice of their shapes is worth.

    columns : (F,) of the screen's candidates. observed : (F,) in the data. simulated : (F, S, F) in
    the sets of each of them as the truth, NaN where a set came to no numbers.
    """

    columns: tuple[int, ...]
    observed: np.ndarray
    simulated: np.ndarray

    @property
    def behind(self) -> np.ndarray:
        """(F,) nats behind the best, in the data."""
        return np.max(self.observed) - self.observed

    @property
    def cuts(self) -> np.ndarray:
        """(F,) nats by which the truth lies behind the best at most, in 95 of 100 of its sets."""
        own = np.array([self._own(k) for k in range(len(self.columns))])
        return np.array([np.quantile(v[np.isfinite(v)], LEVEL, method="higher") for v in own])

    @property
    def named(self) -> np.ndarray:
        """(F, F) the share of the sets of the truth in the row in which the one in the column is
        the best."""
        out = np.zeros((len(self.columns), len(self.columns)))
        for k, sets in enumerate(self.simulated):
            known = sets[np.isfinite(sets).all(axis=1)]
            out[k] = np.bincount(known.argmax(axis=1), minlength=len(out)) / len(known)
        return out

    @property
    def inside(self) -> set[int]:
        """The columns of the confidence set."""
        kept = self.behind <= self.cuts
        return {k for k, held in zip(self.columns, kept, strict=True) if held}

    def _own(self, k: int) -> np.ndarray:
        """(S,) how far the truth lies behind in its own sets."""
        sets = self.simulated[k]
        found: np.ndarray = np.max(sets, axis=1) - sets[:, k]
        return found


def recovery(
    augmented: AugmentedModels, refits: Sequence[Refit], train: Sequence[Experiment],
    seed: np.random.SeedSequence, checkpoint: Checkpoint,
) -> Recovery | None:  # fmt: skip
    """Of the first refit and those that come near it; None where there is no other, where a model
    calls a simulator, and where there is no such climb.

    refits : with one effect each, the one that is named first.
    """
    near = finalists(refits)
    if len(near) < 2 or simulators(augmented.trace):
        return None
    rivals, costs = [Rival.of(r) for r in near], np.array([r.cost for r in near])
    observed = np.array([_value(r, r.fitter(augmented), train) for r in rivals])
    if not np.isfinite(observed).all():
        return None
    one = partial(_one_set, augmented, rivals, tuple(train), seed)
    done = checkpoint.map("simulating from the leading effects", len(rivals) * SETS, one)
    values = np.full((len(done), len(rivals)), np.nan)
    for i, numbers in enumerate(done):
        name = f"data simulated with {near[i // SETS].candidates[0]}"
        if not checkpoint.failures.record_task(name, numbers):
            values[i] = numbers["values"]
    values[~np.isfinite(values).all(axis=1)] = np.nan
    values = values.reshape(len(rivals), SETS, len(rivals)) - costs
    if np.isfinite(values[:, :, 0]).sum(axis=1).min() < LEAST:
        return None
    return Recovery(tuple(r.index[0] for r in near), observed - costs, values)


def finalists(refits: Sequence[Refit]) -> list[Refit]:
    """The first, and the best of the others that gain nearly as much and were not passed over for
    it."""
    if not refits:
        return []
    first = refits[0]
    near = [r for r in refits[1:] if REACH * first.score <= r.score <= first.score]
    return [first, *sorted(near, key=lambda r: -r.score)[: FINALISTS - 1]]


def _one_set(
    augmented: AugmentedModels, rivals: Sequence[Rival], train: Sequence[Experiment],
    seed: np.random.SeedSequence, i: int,
) -> Numbers:  # fmt: skip
    """The densities (F,) of all rivals fitted to the set i; NaN where it comes to none."""
    truth = rivals[i // SETS]
    own = truth.fitter(augmented)
    theta = space_of(own.problem, own.fixed, truth.values).theta
    try:
        drawn = own.simulator.sets(train, theta, random_state(child_seed(seed, i)))
    except SSMError:
        return {"values": np.full(len(rivals), np.nan)}
    return {"values": np.array([_value(r, r.fitter(augmented), drawn) for r in rivals])}


def _value(rival: Rival, fitter: Fitter, data: Sequence[Experiment]) -> float:
    """The log posterior density at the top near where the rival is; NaN where there is none."""
    gaussian = fitter.problem.program.gaussian
    if not isinstance(gaussian, GaussianApproximation):
        return np.nan
    problem = replace(fitter.problem, experiments=tuple(data))
    space = space_of(problem, fitter.fixed, rival.values)
    top = climb_by_scoring(space, gaussian, space.z[space.positions], fitter.log_correction)
    return top.value if top is not None else np.nan
