"""Rival models of the same data, and how far an experiment is expected to tell them apart.

A rival is the model with one effect, as it was fitted. Data are simulated from it as the truth,
with the inputs of the experiment, and each other rival is fitted to them, as it may explain them
with other parameters. What is left is the log-likelihood ratio of the truth to the other. Its mean
is the expected discrimination of G. Box and W. Hill (*Technometrics* 9, 1967), here by simulation,
with no quadratic approximation; the pair with the least of it is what counts, as in the T-criterion
of A. Atkinson and V. Fedorov (*Biometrika* 62, 1975).

A ratio of mean m is about N(m, 2 m), and of the wrong sign with probability Phi(-sqrt(m / 2)): 5%
at m = 2 * 1.645^2 = 5.4 nats. That is the inequality of `selection/equivalence.py` again, by which
a gain g tells two effects apart whose efficient scores are correlated by rho if g (1 - |rho|) is
2.7: their ratio has the mean g (1 - rho^2), which is about twice as much.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ssmppl.codegen.modules.gaussian import GaussianApproximation
from ssmppl.data import Experiment
from ssmppl.diagnosis.effects.candidate import Candidate, is_dated
from ssmppl.diagnosis.fitting.augmented_models import AugmentedModels
from ssmppl.diagnosis.fitting.densities import densities_of, density_of
from ssmppl.diagnosis.fitting.fit import Fitter
from ssmppl.diagnosis.fitting.scoring import increments_with_predictions
from ssmppl.diagnosis.run.checkpoint import Numbers
from ssmppl.diagnosis.selection.equivalence import SEPARATING
from ssmppl.diagnosis.selection.refit import Refit
from ssmppl.errors import SSMError
from ssmppl.expressions.batched.call import thriftily
from ssmppl.inference.batched.extended import Extended, extended_model
from ssmppl.inference.exact.kalman import KalmanModel
from ssmppl.inference.optimisation.batched_newton import climb_together
from ssmppl.inference.optimisation.newton import climb
from ssmppl.inference.optimisation.parts import Increments, Predictions
from ssmppl.inference.preparation.space import space_of
from ssmppl.inference.run.seeds import random_state

NEEDED = 2.0 * SEPARATING  # nats of the expected log-likelihood ratio that tell two rivals apart
PLENTY = 4.0 * NEEDED  # nats of a ratio that a second climb has to confirm
FAR = 2.0  # of a logarithm, beyond which it runs towards a bound: there a climb could not leave


@dataclass(frozen=True)
class Rival:
    """A model with one effect, as it was fitted.

    values : of all parameters, by name. held : names of those that ran to a bound of their support.
    """

    candidates: tuple[Candidate, ...]
    values: dict[str, np.ndarray]
    held: tuple[str, ...] = ()

    @classmethod
    def of(cls, refit: Refit) -> Rival:
        """The rival that a refit is."""
        values = refit.fit.by_parameter
        return cls(refit.candidates, values, tuple(n for n in refit.bounds if n in values))

    @property
    def happens_once(self) -> bool:
        """Whether it is an event, which another record would not have."""
        return any(map(is_dated, self.candidates))

    def fitter(self, augmented: AugmentedModels) -> Fitter:
        """Its fitter, with what is at a bound held there."""
        own = augmented.fitter(self.candidates)
        return own.with_fixed({n: self.values[n] for n in self.held})


@dataclass(frozen=True)
class Look:
    """How closely rivals are looked at. sets : simulated from each of them as the truth. fitted :
    whether the others are fitted to these; else they stay as they are, which bounds the ratio from
    above at hardly any cost. within : the least and the largest value (K,) of each channel, which
    most of the sets may not leave; None: any. apart : whether each rival as the truth is a task of
    its own, for one alternative that would keep a single process busy."""

    sets: int
    fitted: bool
    within: tuple[np.ndarray, np.ndarray] | None = None
    apart: bool = False


def look_at(
    augmented: AugmentedModels, rivals: Sequence[Rival], alternatives: Sequence[Experiment],
    look: Look, seed: np.random.SeedSequence, k: int,
) -> Numbers:  # fmt: skip
    """The rivals in data simulated with the inputs of the alternative k; where truths are `apart`,
    k counts these first, the rest is NaN, and `together` puts together what came of them.

    "ratios" (S, R, R) : log-likelihood ratios in each set, of the truth in the row to the rival in
    the column; NaN where there is none. "low", "high" (K,) : of what was observed in all sets.
    "inside" : whether most of the sets are `within`; else there are no ratios. "left" : of each
    set, whether it is not; of truths apart, which have ratios then too.
    """
    truths = list(range(len(rivals)))
    if look.apart:
        k, own_truth = divmod(k, len(rivals))
        truths = [own_truth]
    e, models = alternatives[k], [_Model.of(r, r.fitter(augmented)) for r in rivals]
    drawn: dict[tuple[int, int], list[Experiment]] = {}
    for i, truth in ((i, models[i]) for i in truths):
        for s in range(0 if rivals[i].happens_once else look.sets):
            with suppress(SSMError):  # the same random numbers under all alternatives
                drawn[s, i] = truth.simulated(e, random_state(seed, s, i))
    ends = [observed_range([e]), *(observed_range(data) for data in drawn.values())]
    low, high = (np.stack(part) for part in zip(*ends, strict=True))
    left = np.zeros(len(low) - 1, dtype=bool)
    if look.within is not None:
        left = np.any((low[1:] < look.within[0]) | (high[1:] > look.within[1]), axis=1)
        if not look.apart and 2 * left.sum() > len(left):
            return {"inside": np.array(False), "left": left}
    ratios = np.full((look.sets, len(models), len(models)), np.nan)
    for i, truth in ((i, models[i]) for i in truths):
        for j, other in enumerate(models):
            start = other.z  # of the first set; of the next where the one before ended
            for s in range(look.sets if i != j else 0):
                if (s, i) not in drawn:
                    continue
                data = drawn[s, i]
                own = truth.value(data)
                if look.fitted:
                    sure = look.sets > 1 and start is other.z
                    value, start = other.fitted(data, start, own - PLENTY if sure else -np.inf)
                else:
                    value = other.value(data)
                ratios[s, i, j] = own - value
    return {"ratios": ratios, "inside": np.array(True), "low": low.min(axis=0),
            "high": high.max(axis=0), "left": left}  # fmt: skip


def together(found: Sequence[Numbers]) -> Numbers:
    """What came of one alternative, from what came of each truth; nothing where one has none."""
    if not all(found):
        return {}
    left = np.concatenate([f["left"] for f in found])
    if 2 * left.sum() > len(left):
        return {"inside": np.array(False), "left": left}
    own = [f["ratios"][:, i] for i, f in enumerate(found)]  # (S, R) with each as the truth
    low, high = (np.stack([f[n] for f in found]) for n in ("low", "high"))
    return {"ratios": np.stack(own, axis=1), "inside": np.array(True), "low": low.min(axis=0),
            "high": high.max(axis=0), "left": left}  # fmt: skip


def observed_range(experiments: Sequence[Experiment]) -> tuple[np.ndarray, np.ndarray]:
    """(K,) the least and the largest measured value of each channel; inf and -inf where nothing
    was measured."""
    y = np.concatenate([e.y for e in experiments])
    seen = np.concatenate([e.seen for e in experiments]) == 1.0
    return np.where(seen, y, np.inf).min(axis=0), np.where(seen, y, -np.inf).max(axis=0)


@dataclass(frozen=True)
class _Model:
    """A rival's fitter, and its parameters: all of them (P,), and the free numbers z (F,)."""

    fitter: Fitter
    values: dict[str, np.ndarray]
    theta: np.ndarray
    z: np.ndarray

    @classmethod
    def of(cls, rival: Rival, fitter: Fitter) -> _Model:
        space = space_of(fitter.problem, fitter.fixed, rival.values)
        return cls(fitter, rival.values, space.theta, space.z[space.positions])

    def simulated(self, e: Experiment, stream: np.ndarray) -> list[Experiment]:
        """A data set from it, of one experiment."""
        return self.fitter.simulator.sets([e], self.theta, stream)

    def value(self, data: Sequence[Experiment]) -> float:
        """The log-likelihood of data; NaN where it has none."""
        with suppress(SSMError):
            value = self._log_likelihood(data, self.theta)
            return value if np.isfinite(value) else np.nan
        return np.nan

    def fitted(
        self, data: Sequence[Experiment], start: np.ndarray, least: float
    ) -> tuple[float, np.ndarray]:
        """The log-likelihood once fitted to data, from a start z (F,), NaN where there is none; and
        a start for other data of this kind: where it ended, but for what ran towards a bound.

        Half a nat for each free number is taken off: by so much it is higher, on average, than at
        the same place in other data of this kind. least : a climb that does not come to its end, or
        only so far, is tried another way; of a simulator, which takes many points at once and whose
        other way is ten times as long, where it does not come to its end.
        """
        problem = replace(self.fitter.problem, experiments=tuple(data))
        space = space_of(problem, self.fitter.fixed, self.values)
        likelihood = partial(self._log_likelihood, data)

        def at(z: np.ndarray) -> float:
            return likelihood(space.parameters(z)[0].copy())

        try:
            rows = self._increments(data, len(start))
            found = climb_together(densities_of(space, rows), start[None], precise=False)
            if found is None:
                return np.nan, self.z
            z, value = found.z, at(found.z)
            called = isinstance(extended_model(self.fitter.problem.trace), Extended)
            if not found.ended or (value < least and not called):
                top = climb(density_of(space, likelihood), start)
                if top is not None and at(top.z) > value:
                    z, value = top.z, at(top.z)
        except SSMError:
            return np.nan, self.z
        astray = ~space.on_the_line & (np.abs(z - self.z) > FAR)
        after = np.where(astray, self.z, z)
        return (value if np.isfinite(value) else np.nan) - 0.5 * len(z), after

    def _increments(self, data: Sequence[Experiment], free: int) -> Increments:
        """Those of a climb of so many free numbers, with predictions where there are any."""
        gaussian = self.fitter.problem.program.gaussian
        if isinstance(gaussian, GaussianApproximation) and not self.fitter.exact:
            trace = self.fitter.problem.trace
            if not isinstance(extended_model(trace), Extended):
                found = increments_with_predictions(trace, gaussian, data, free)
                if found is not None:
                    return found
        return partial(increments, self.fitter, data)

    def _log_likelihood(self, data: Sequence[Experiment], theta: np.ndarray) -> float:
        found = float(increments(self.fitter, data, theta[None])[0].sum())
        return found + len(data) * self.fitter.log_correction


def has_filter(fitter: Fitter) -> bool:
    """Whether there is a Kalman filter of the model, exact or extended: likelihoods by particles
    are too rough, and take too long, for differences of a few nats between many fits."""
    gaussian = fitter.problem.program.gaussian
    return fitter.exact or isinstance(gaussian, GaussianApproximation)


def increments(
    fitter: Fitter, data: Sequence[Experiment], theta: np.ndarray
) -> tuple[np.ndarray, Predictions | None]:
    """(B, R) the increments of the log-likelihood at theta (B, P) in the R rows of all experiments,
    by the Kalman filter, -inf where it comes to no number; and its predictions where a simulator is
    called."""
    called = extended_model(fitter.problem.trace)
    if isinstance(called, Extended):  # a simulator takes many points at once
        with thriftily():
            return called.increments_and_predictions(data, theta)
    rows = [np.concatenate([_rows(fitter, e, one) for e in data]) for one in theta]
    return np.stack(rows), None


def _rows(fitter: Fitter, e: Experiment, theta: np.ndarray) -> np.ndarray:
    """(T,) those of one experiment at theta (P,)."""
    gaussian, found = fitter.problem.program.gaussian, np.full(e.steps, -np.inf)
    if isinstance(gaussian, GaussianApproximation):
        found = gaussian.extended_increments(theta, e.y, e.seen, e.u)
    if isinstance(fitter.kalman, KalmanModel) and not np.isfinite(found).all():
        return fitter.kalman.filter(e, theta).log_increments
    return found
