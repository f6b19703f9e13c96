"""Whether each of several effects is still needed beside those that came after it.

An effect that is chosen first stands for what is missing as well as it can. The next one may be
what was missing, and leave nothing of the first.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from ssmppl.data import Experiment
from ssmppl.diagnosis.fitting.augmented_models import AugmentedModels
from ssmppl.diagnosis.fitting.fit import FROM_NEARBY
from ssmppl.diagnosis.run.checkpoint import Checkpoint, Numbers
from ssmppl.diagnosis.run.seeds import child_seed
from ssmppl.diagnosis.screening.screen import Screen
from ssmppl.diagnosis.selection.horizons import SimulationGain
from ssmppl.diagnosis.selection.refit import Refit
from ssmppl.diagnosis.selection.simulation_fit import fit_for_simulation
from ssmppl.errors import SSMError

NEEDED = 1.92  # nats of one strength at the 5% level: half the quantile of chi-square


def needed_only(
    augmented: AugmentedModels, screen: Screen, chosen: Refit, train: Sequence[Experiment],
    seed: np.random.SeedSequence, checkpoint: Checkpoint, stage: str,
    simulation: SimulationGain | None,
) -> Refit:  # fmt: skip
    """The refit without that of its effects, but for the last, whose strength is not significant in
    it and whose loss costs nothing further ahead; the refit itself where all are needed.

    simulation : as of `refit_all`.
    """
    before = len(chosen.candidates) - 1
    one = partial(_without, augmented, chosen, tuple(train), seed, simulation)
    found = []
    for k, numbers in enumerate(checkpoint.map(stage, before, one)):
        checkpoint.failures.record_task(f"the fit without {chosen.candidates[k]}", numbers)
        if "theta" not in numbers:
            continue
        index, candidates = (_left(of, k) for of in (chosen.index, chosen.candidates))
        fitter = augmented.fitter(candidates)
        fit = fitter.restored(train, numbers)
        lost = chosen.fit.log_likelihood - fit.log_likelihood
        cost = chosen.cost - screen.family.cost(int(screen.groups[chosen.index[k]]))
        new = Refit(index, candidates, fitter, fit, chosen.gain - lost, max(cost, 0.0))
        new = new.simulated(train, numbers, simulation)
        if lost < NEEDED and new.ahead > chosen.ahead - NEEDED:
            found.append(new)
    return max(found, key=lambda r: r.score, default=chosen)


def _left(items: tuple[Any, ...], k: int) -> tuple[Any, ...]:
    return (*items[:k], *items[k + 1 :])


def _without(
    augmented: AugmentedModels, chosen: Refit, train: Sequence[Experiment],
    seed: np.random.SeedSequence, simulation: SimulationGain | None, k: int,
) -> Numbers:  # fmt: skip
    """The fit without its k-th effect, from where it stands; empty where there is none."""
    candidates = _left(chosen.candidates, k)
    try:
        fitter = augmented.fitter(candidates)
        own = fitter.problem.trace.parameters
        start = {n: v for n, v in chosen.fit.by_parameter.items() if n in own}
        fit = fitter.fit(train, child_seed(seed, k), start, FROM_NEARBY)
    except SSMError:
        return {}
    if simulation is None:
        return fit.numbers
    return {**fit.numbers, **fit_for_simulation(fitter, fit, train, simulation).numbers}
