"""Tests of the gain of the best refit, by the distribution of the scores or by parametric
bootstrap.

Where noise has grown to swallow what is missing, the score at the fit is far smaller than what a
refit gains, as the refit lets the noise shrink again (a break in the level of a random walk). So
the gain itself is tested: by the distribution of the scores, which is the same to first order
(likelihood ratio and score tests); in short records, where a fit takes little time and first order
is a poor guide, by its own: data sets simulated at theta-hat are fitted, screened and refitted as
the data were. That test stops as soon as it cannot reject any more (J. Besag and P. Clifford,
*Biometrika* 78, 1991), and as soon as the gain lies far beyond the tail of the simulated ones
(`tail_p`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from ssmppl.analysis.structure import simulators
from ssmppl.data import Experiment
from ssmppl.diagnosis.fitting.augmented_models import AugmentedModels
from ssmppl.diagnosis.fitting.fit import APPROXIMATELY, Fit
from ssmppl.diagnosis.run.checkpoint import Checkpoint, Numbers
from ssmppl.diagnosis.run.seeds import Task, child_seed
from ssmppl.diagnosis.screening.efficient_score import Efficient
from ssmppl.diagnosis.screening.familywise import heights, tail_p
from ssmppl.diagnosis.screening.screen import Screen, compare_with_null
from ssmppl.diagnosis.selection.refit import Refit, start_at
from ssmppl.errors import SSMError
from ssmppl.inference.run.seeds import random_state

WORTH_A_TEST = 0.5  # p by the distribution of the scores, up to which the gain's own is simulated
TRIED = 5  # candidates refitted in each set, the highest on the common scale
SETS, CHUNK = 99, 10
SETS_FOR_TAIL = 30  # sets from which their tail is believed
TAIL_ALPHA_SHARE = 0.1  # of alpha, up to which p by that tail ends the test
MOST_WORK = 1.5e5  # rows times particles, beyond which the fits would take too long
MOST_ROWS = 300  # from which on the law of the scores is taken


def gain_p(screen: Screen, refit: Refit) -> float:
    """Family-wise p of what one effect's refit gains, had its score been as large.

    Twice the gain and the square of the score agree to first order where there is no effect; where
    there is one the gain is the larger of the two, as the refit lets the noise shrink again.
    """
    label = int(screen.groups[refit.index[0]])
    height = screen.family.put(label, float(np.sqrt(2.0 * max(refit.gain, 0.0))))
    return tail_p(height, screen.family.maxima)


@dataclass(frozen=True)
class GainTest:
    """The largest gain in the data, and those in the simulated sets, all finite.

    column : of the candidate that gains it; None where a fit failed. alpha : of the test.
    """

    gain: float
    column: int | None
    simulated: np.ndarray
    alpha: float

    def p_of(self, gain: float) -> float:
        """Family-wise p of a refit that gains so much, no smaller than that of the largest gain: by
        the sets' count 1 / (sets + 1) at least, smaller by their tail where that is far away."""
        gain = min(gain, self.gain)
        beyond = int(np.sum(self.simulated >= gain))
        if beyond == 0 and len(self.simulated) >= SETS_FOR_TAIL:
            p = tail_p(_height(gain), _height(self.simulated))
            if p <= TAIL_ALPHA_SHARE * self.alpha:
                return p
        return (beyond + 1.0) / (len(self.simulated) + 1.0)

    @property
    def decided(self) -> bool:
        """Whether further sets, `SETS` in all, would change nothing."""
        beyond = int(np.sum(self.simulated >= self.gain))
        lost = (beyond + 1.0) / (SETS + 1.0) > self.alpha
        return lost or self.p_of(self.gain) <= TAIL_ALPHA_SHARE * self.alpha


def _height(gain: Any) -> Any:
    """Of a gain in nats, on the scale of a score's statistic."""
    return np.sqrt(2.0 * np.maximum(gain, 0.0))


def gain_test(
    augmented: AugmentedModels, base: Fit, screen: Screen, alpha: float,
    seed: np.random.SeedSequence, checkpoint: Checkpoint,
) -> GainTest:  # fmt: skip
    """The test of the largest gain among the `TRIED` best, of the data fitted in the way in which
    the simulated sets are.

    base : the model's fit to the screen's experiments.
    """
    seen = checkpoint.computed(
        "the gain that is tested",
        lambda: _largest(augmented, base, screen, screen.experiments, seed, 0),
    )
    test = GainTest(float(seen["gain"]), int(seen["column"]), np.empty(0), alpha)
    if not np.isfinite(test.gain):
        return replace(test, gain=-np.inf, column=None)
    one = partial(_one, augmented, base, screen, seed)
    for last in range(CHUNK, SETS + CHUNK, CHUNK):
        found = checkpoint.map("refitting simulated data", min(last, SETS), one)
        for f in found:
            checkpoint.failures.record_task("a refit of simulated data", f)
        gains = np.array([float(f.get("gain", np.nan)) for f in found])
        test = replace(test, simulated=gains[np.isfinite(gains)])
        if test.decided:
            break
    return test


def _one(
    augmented: AugmentedModels, base: Fit, screen: Screen, seed: np.random.SeedSequence, k: int
) -> Numbers:
    """The gain in one simulated data set."""
    design, stream = screen.design, random_state(seed, k)
    given = design.theta(screen.theta)[: len(design.columns.base.parameter_symbols)]
    try:
        data = design.simulator.sets(screen.experiments, given, stream)
    except SSMError:
        return {"gain": np.asarray(np.nan)}
    return _largest(augmented, base, screen, data, seed, k + 1)


def _largest(
    augmented: AugmentedModels, base: Fit, screen: Screen, data: Sequence[Experiment],
    seed: np.random.SeedSequence, k: int,
) -> Numbers:  # fmt: skip
    """The largest gain in one data set, at least 0, and whose it is (its column); NaN and -1 where
    a fit failed."""
    design, plain = screen.design, augmented.base_fitter
    stream = random_state(seed, Task.TEST_SCORES, k)
    own = child_seed(seed, Task.TEST_FIT, k)
    try:
        fit = plain.fit(data, own, base.by_parameter, APPROXIMATELY)
        at = design.theta(fit.theta)
        passes = design.smoother.run(data, at, stream, predicted=False)
        seen = design.statistics(data, passes, stream, checks=False)
        found = compare_with_null(screen.null, screen.typical_squares, seen)
        gain, column = 0.0, -1
        for j in _best(screen, found):
            fitter = augmented.fitter((design.candidates[j],))
            start = start_at(fit, screen.design, found, [j])
            again = fitter.fit(data, own, start, APPROXIMATELY)
            if again.log_likelihood - fit.log_likelihood > gain:
                gain, column = again.log_likelihood - fit.log_likelihood, j
    except SSMError:
        gain, column = np.nan, -1
    return {"gain": np.asarray(gain), "column": np.asarray(column)}


def _best(screen: Screen, found: Efficient) -> list[int]:
    """Columns: the best shape of each of the groups that stand highest on the common scale."""
    groups, family = screen.groups, screen.family
    silent = np.array([bool(s) for s in found.status])
    high = np.where(silent, -np.inf, heights(found.statistic, found.sided))
    best = [
        int(m[np.argmax(high[m])]) for m in (np.flatnonzero(groups == g) for g in family.labels)
    ]
    order = np.argsort(-family.scale.put(high[best]), kind="stable")[:TRIED]
    return [best[i] for i in order if not silent[best[i]]]


def affordable(augmented: AugmentedModels, experiments: Sequence[Experiment]) -> bool:
    """Whether the fits of the test can be afforded: not those of a simulator, which is called for
    every point of them."""
    if simulators(augmented.base_fitter.problem.trace):
        return False
    rows = sum(e.steps for e in experiments)
    cheap = augmented.base_fitter.exact or rows * augmented.settings.particles <= MOST_WORK
    return cheap and rows < MOST_ROWS
