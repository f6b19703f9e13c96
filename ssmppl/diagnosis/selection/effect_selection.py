"""The choice of effects: leading candidates refitted, pairs of them, and forward selection.

Effects come together, and one at a time can look wrong: pairs are refitted beside single ones, and
a second screen is run around the model with the best of these, for one more effect. From the better
of the two pairs it goes on, as long as an effect stands out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from ssmppl.analysis.structure import simulators
from ssmppl.data import Experiment
from ssmppl.diagnosis.effects.candidate import Candidate
from ssmppl.diagnosis.effects.effect import (
    CHANGE_IN_TIME,
    MECHANISM,
    NOISE_LAW,
    UNKNOWN_INPUT,
)
from ssmppl.diagnosis.fitting.augmented_models import AugmentedModels
from ssmppl.diagnosis.fitting.fit import FROM_START, Fit
from ssmppl.diagnosis.run.checkpoint import Checkpoint
from ssmppl.diagnosis.run.seeds import Choice, Task, child_seed
from ssmppl.diagnosis.screening.familywise import threshold
from ssmppl.diagnosis.screening.screen import Screen, ScreenDesign, run_screen
from ssmppl.diagnosis.selection.backward import needed_only
from ssmppl.diagnosis.selection.equivalence import FORM
from ssmppl.diagnosis.selection.horizons import SimulationGain
from ssmppl.diagnosis.selection.input_delays import promising_delays
from ssmppl.diagnosis.selection.other_end import at_the_other_end
from ssmppl.diagnosis.selection.overlooked import (
    best_start,
    elsewhere,
    most_promising,
    overlooked,
    trials,
)
from ssmppl.diagnosis.selection.refit import (
    EXPLAINED,
    Begin,
    Refit,
    best_of_groups,
    correlated_candidates,
    delays,
    leading,
    one_signed_candidates,
    other_noise_laws,
    pairs,
    preferred,
    refit_all,
)
from ssmppl.diagnosis.selection.refit_test import WORTH_A_TEST, affordable, gain_p, gain_test
from ssmppl.diagnosis.selection.shapes import shaped_all
from ssmppl.diagnosis.selection.simulation_fit import SimulationFit, gain_of_base
from ssmppl.errors import ArgumentError, SSMError

AFRESH = "refitting from default start"
CLOSER_LOOK_FACTOR = 4.0  # times alpha, up to which a second screen is worth finishing
MOST_EFFECTS = 3
MOST_WORK = 1.5e6  # rows times particles of a data set, beyond which no second screen is run
CARRIES_ON = 0.1  # of what a further cause gains one row ahead, that it has to gain beyond
PROMISING = 0.25  # of the best refit's score, by moving an input alone: then its delay is refitted
MOST_LOST = 1.0  # nats, further ahead, by what only describes a misfit
# Refits after a second screen, of all and of mechanisms, and the simulated sets of that.
FOLLOWERS, AGAIN = 3, 100
AGAIN_CALLED = 60  # likewise, of a model that calls a simulator
PROMISED = 0.25  # of what a further effect has to gain, by its score: else it is not refitted
FIRST_LOOK, NOTHING = 30, 0.5  # of these sets first; a family-wise p of so much by them is no gap


@dataclass
class SelectionResult:
    """The results of the refits, filled in as they come to an end.

    base : the model's own fit. refits, doubles : with one effect, with two; best first.
    chosen : what is kept, None for the model as it is. fewer : what it grew from, the fewest
    effects first. p : by the candidate's column, where its refit was tested itself. notes : why
    others were not refitted. unfitted : the column of what stands out most, where it could not be
    refitted and nothing that could be gains as much. rebased : whether `base` is not what the
    screen was run at. left_out : whether fewer were chosen in the end, by the held-out rows.
    simulation : how well the model as it is predicts further ahead than one row, with the
    parameters of `simulating`.
    """

    base: Fit
    refits: list[Refit] = field(default_factory=list)
    doubles: list[Refit] = field(default_factory=list)
    chosen: Refit | None = None
    fewer: list[Refit] = field(default_factory=list)
    p: dict[int, float] = field(default_factory=dict)
    unfitted: int | None = None
    rebased: bool = False
    left_out: bool = False
    simulation: SimulationGain | None = None
    simulating: SimulationFit | None = None
    notes: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class EffectSelection:
    """One choice among the candidates of a screen: what it works with, step by step.

    screen, train : of the same experiments. alpha : family-wise error rate. always : choose the
    best one even where the screen finds nothing. singles : how many are refitted; None: the
    leading ones and what correlates with them. most : effects in all. approximate : by approximate
    fits (`Effort`), without standard errors. further : whether screens run again around what was
    chosen look for more. horizon : as of `diagnose`. searched : candidates, as a
    screen has them, that only a search at finite strengths found in a larger record, and where
    their refits began: they begin there here too.
    """

    augmented: AugmentedModels
    screen: Screen
    train: Sequence[Experiment]
    seed: np.random.SeedSequence
    alpha: float
    checkpoint: Checkpoint
    always: bool = False
    singles: int | None = None
    most: int = MOST_EFFECTS
    approximate: bool = False
    further: bool = True
    horizon: int | None = None
    searched: Sequence[tuple[Candidate, Begin]] = ()

    def run(self, out: SelectionResult) -> None:
        """Refit, choose, and step forward; into `out`, which keeps what came before an error."""
        guard = self.checkpoint.failures.guard
        with guard("predictions further ahead"):
            out.simulation, out.simulating = self._simulation(out.base)
        self._refit_singles(out)
        found = self.always or self._significant(out)
        if not found or not out.refits or out.unfitted is not None:
            return
        if not self.approximate:
            with guard("estimating shapes"):
                out.refits = self._shaped(out, out.refits, Choice.SHAPES, "estimating shapes")
        out.refits = preferred(out.refits, critical_gain(self.screen, self.alpha))
        with guard("whether the first explains what gains most"):
            self._name_what_explains(out)
        out.chosen = out.refits[0]
        single, pair = out.chosen, None
        if self.most > 1:
            rival = None
            with guard("pairs of effects"):
                rival = self._best_pair(out)
            # a step from the best one, against the best pair
            if self.further:
                with guard("whether a second effect is missing"):
                    self._forward(out, 2)
            if rival is not None:
                out.chosen = self._better(out.chosen, rival)
            if len(out.chosen.candidates) == 2 and self.further:
                pair = out.chosen
                with guard("whether a third effect is missing"):
                    self._forward(out, self.most)
            if len(out.chosen.candidates) > 1 and self.further and not self.approximate:
                with guard("whether all effects are still needed"):
                    out.chosen = needed_only(
                        self.augmented, self.screen, out.chosen, self.train,
                        self._seed(Choice.BACKWARD), self.checkpoint, "leaving out effects",
                        out.simulation,
                    )  # fmt: skip
        strengths = {c.strength for c in out.chosen.candidates}
        out.fewer = [r for r in (single, pair) if r is not None and r is not out.chosen
                     and {c.strength for c in r.candidates} < strengths]  # fmt: skip
        if self.approximate:
            return
        if len(out.chosen.candidates) > 1:
            with guard("the shapes of all that was chosen"):
                stage = "estimating the shapes of all that was chosen"
                (out.chosen,) = self._shaped(out, [out.chosen], Choice.CHOSEN_SHAPES, stage)
        add_standard_errors(out, self._seed(Choice.STANDARD_ERRORS), self.checkpoint)

    # -- single effects
    def _refit_singles(self, out: SelectionResult) -> None:
        screen, refits = self.screen, out.refits
        stages: dict[str, Callable[[], list[int]]] = {
            "refitting": lambda: leading(screen)[: self.singles]
        }
        if self.singles is None:
            stages["refitting correlated candidates"] = lambda: correlated_candidates(
                screen, refits
            )
            stages["refitting other laws of noises"] = lambda: other_noise_laws(screen, refits)
            stages["refitting other delays"] = lambda: delays(screen, refits)
            stages["refitting delays of inputs"] = lambda: self._delayed(out, refits)
            stages[AFRESH] = lambda: one_signed_candidates(screen)
        for stage, which in stages.items():
            with self.checkpoint.failures.guard(stage):
                more, failed = self._refit(
                    out, out.base, screen, [[k] for k in which()], self._seed(Choice.SINGLES),
                    stage, afresh=stage == AFRESH,
                )  # fmt: skip
                refits = best_of_groups(screen, refits + more)
                out.notes += [f"not refitted: {reason}" for reason in failed]
        with self.checkpoint.failures.guard("what a search found"):
            refits = best_of_groups(screen, refits + self._searched(out))
        if self.singles is None:
            with self.checkpoint.failures.guard("lags and delays at the other end"):
                refits = best_of_groups(screen, refits + self._at_the_other_end(out, refits))
            with self.checkpoint.failures.guard("mechanisms that the screen overlooks"):
                refits = best_of_groups(screen, refits + self._overlooked(out, refits))
        out.refits = refits

    def _searched(self, out: SelectionResult) -> list[Refit]:
        """What a search found in a larger record, refitted; its shapes are estimated at once, as
        those of the screen may be far from it."""
        column = {c.key: k for k, c in enumerate(self.screen.design.candidates)}
        known = [(column[c.key], begin) for c, begin in self.searched if c.key in column]
        more, failed = self._refit(
            out, out.base, self.screen, [[k] for k, _ in known], self._seed(Choice.SEARCHED),
            "refitting what a search found", begins=[begin for _, begin in known],
        )  # fmt: skip
        out.notes += [f"not refitted: {reason}" for reason in failed]
        if not more:
            return more
        stage = "estimating shapes of what a search found"
        return self._shaped(out, more, Choice.SEARCHED_SHAPES, stage)

    def _delayed(self, out: SelectionResult, refits: Sequence[Refit]) -> list[int]:
        """The best delay of an input that moving the inputs promises and that was not refitted."""
        done = {int(self.screen.groups[r.index[0]]) for r in refits}
        worth = PROMISING * max((r.score for r in refits), default=0.0)
        worth = max(worth, critical_gain(self.screen, self.alpha))
        found = promising_delays(
            self.augmented.base_fitter, out.base.theta, self.screen, self.train, worth
        )
        return [k for k in found if int(self.screen.groups[k]) not in done][:1]

    def _at_the_other_end(self, out: SelectionResult, refits: Sequence[Refit]) -> list[Refit]:
        """Lags and delays of inputs beside the best of a sensor, and the other way round."""
        worth = PROMISING * max((r.score for r in refits), default=0.0)
        worth = max(worth, critical_gain(self.screen, self.alpha))
        fitter = self.augmented.base_fitter
        found = at_the_other_end(fitter, self.screen, refits, self.train, worth)
        more, failed = self._refit(
            out, out.base, self.screen, [[k] for k, _ in found], self._seed(Choice.OTHER_END),
            "refitting lags and delays at the other end", begins=[begin for _, begin in found],
        )  # fmt: skip
        out.notes += [f"not refitted: {reason}" for reason in failed]
        return more

    def _overlooked(self, out: SelectionResult, refits: Sequence[Refit]) -> list[Refit]:
        """Mechanisms where what only describes a misfit gains most."""
        seed, stage = self._seed(Choice.OVERLOOKED), "refitting mechanisms of that equation"
        shapes = overlooked(self.screen, refits, critical_gain(self.screen, self.alpha))
        tried = [trials(self.screen, columns) for columns in shapes]
        one = partial(best_start, self.augmented, out.base, tried, tuple(self.train))
        starts = self.checkpoint.map("looking for mechanisms of that equation", len(shapes), one)
        for (k, *_), numbers in zip(shapes, starts, strict=True):
            name = f"the likelihood with {self.screen.design.candidates[k]}"
            self.checkpoint.failures.record_task(name, numbers)
        groups = {int(self.screen.groups[r.index[0]]): r.gain for r in refits}
        done = {k: groups[int(g)] for k, g in enumerate(self.screen.groups) if int(g) in groups}
        found = most_promising(starts, self.augmented.trace, done)
        more, failed = self._refit(
            out, out.base, self.screen, [[int(n["column"])] for n in found], seed, stage,
            begins=[Begin(float(n["strength"]), elsewhere(n)) for n in found],
        )  # fmt: skip
        out.notes += [f"not refitted: {reason}" for reason in failed]
        return more

    def _simulation(self, base: Fit) -> tuple[SimulationGain, SimulationFit]:
        fitter = self.augmented.base_fitter
        seed = self._seed(Choice.SIMULATION)
        return gain_of_base(fitter, base, self.train, seed, self.horizon)

    def _refit(
        self, out: SelectionResult, base: Fit, screen: Screen, sets: Sequence[Sequence[int]],
        seed: np.random.SeedSequence, stage: str, given: Sequence[Candidate] = (), *,
        checkpoint: Checkpoint | None = None, afresh: bool = False,
        begins: Sequence[Begin] | None = None,
    ) -> tuple[list[Refit], list[str]]:  # fmt: skip
        return refit_all(
            self.augmented, base, screen, sets, self.train, seed, checkpoint or self.checkpoint,
            stage, given, afresh=afresh, approximate=self.approximate, simulation=out.simulation,
            begins=begins,
        )  # fmt: skip

    def _shaped(
        self, out: SelectionResult, refits: Sequence[Refit], place: Choice, stage: str
    ) -> list[Refit]:
        return shaped_all(
            self.augmented, out.base, self.screen.design.scales, refits, self.train,
            self._seed(place), self.checkpoint, stage, out.simulation,
        )  # fmt: skip

    # -- tests
    def _significant(self, out: SelectionResult) -> bool:
        """Whether the screen or a refit finds more than chance: two tests, with half of alpha each;
        also whether what leads the screen could not be refitted."""
        guard, found = self.checkpoint.failures.guard, False
        with guard("the model fitted from the best refit"):
            self._refit_base(out)
        if out.rebased:  # the screen was run at the wrong place
            out.p |= {r.index[0]: gain_p(self.screen, r) for r in out.refits}
        else:
            found = bool(np.min(self.screen.family.p, initial=1.0) <= self.alpha / 2)
            out.unfitted = _unfitted(self.screen, out.refits, self.alpha / 2)
        with guard("the test of what a refit gains"):
            found |= self._by_refit(out, self.alpha / 2)
        return found

    def _refit_base(self, out: SelectionResult) -> None:
        """Fit the model itself from where the best refit ended, too: a refit that found a better
        place for the parameters gains by that, and not by its effect. Only where it gains enough.
        """
        worth = critical_gain(self.screen, self.alpha)
        highest = max(out.refits, key=lambda r: r.penalised_gain, default=None)
        if highest is None or highest.penalised_gain < worth:
            return
        fitter, best = self.augmented.base_fitter, highest.fit
        start = {n: v for n, v in best.by_parameter.items() if n in self.augmented.trace.parameters}
        numbers = self.checkpoint.computed(
            "fitting from the best refit",
            lambda: fitter.fit(self.train, self._seed(Choice.BASE), start, FROM_START).numbers,
        )
        found = fitter.restored(self.train, numbers)
        better = found.log_likelihood - out.base.log_likelihood
        if better > 2.0 * np.hypot(found.error, out.base.error) + 0.1:
            out.base, out.rebased = found, True
            out.notes.append(
                "restarting from the best refit found a better optimum of the base model "
                f"(+{better:.1f} nats): p-values are those of likelihood ratios, effects not "
                "refitted have none, and `where` and the tests of the one-step predictions refer "
                "to the earlier optimum"
            )
            before, lost = out.simulation, 0.0
            out.simulation, out.simulating = self._simulation(found)
            if before:
                lost = before.gain(out.simulation.before)
            out.refits = [
                replace(r, gain=r.gain - better, ahead=r.ahead - lost) for r in out.refits
            ]

    def _by_refit(self, out: SelectionResult, alpha: float) -> bool:
        """Whether a refit gains more than chance: by bootstrap where that is affordable, else by
        the distribution of the scores, the same to first order (likelihood ratio and score
        tests)."""
        found = {r.index[0]: gain_p(self.screen, r) for r in out.refits}
        if not found or min(found.values()) > WORTH_A_TEST:
            out.p |= found
            return False
        if affordable(self.augmented, self.train):
            anew = one_signed_candidates(self.screen)  # fits to simulated data would take too long
            rest = [p for k, p in found.items() if k not in anew]
            found = {k: p for k, p in found.items() if k in anew}
            if min(rest, default=1.0) <= WORTH_A_TEST:
                test = gain_test(
                    self.augmented, out.base, self.screen, alpha,
                    self._seed(Choice.REFIT_TEST), self.checkpoint,
                )  # fmt: skip
                if test.p_of(test.gain) <= alpha:
                    self._refit_tested(out, test.column)
                found |= {
                    r.index[0]: test.p_of(r.gain) for r in out.refits if r.index[0] not in anew
                }
        if not found:
            return False
        out.p |= found
        return min(found.values()) <= alpha

    def _refit_tested(self, out: SelectionResult, column: int | None) -> None:
        """Refit what gained most in the test, which looks at more of a kind than `leading` does."""
        groups = {int(self.screen.groups[r.index[0]]) for r in out.refits}
        if column is None or column < 0 or int(self.screen.groups[column]) in groups:
            return
        more, failed = self._refit(
            out, out.base, self.screen, [[column]], self._seed(Choice.TESTED),
            "refitting what gained most in the test",
        )  # fmt: skip
        out.refits = best_of_groups(self.screen, out.refits + more)
        out.notes += [f"not refitted: {reason}" for reason in failed]

    def _name_what_explains(self, out: SelectionResult) -> None:
        """A cause that was put before what gained more has to simulate as well, or to explain it:
        with the cause in the model, that must not go on gaining most of what it gains alone. Else
        it is named."""
        first, top = out.refits[0], max(out.refits, key=lambda r: r.score)
        if first.ahead >= top.ahead:
            return
        both, _ = self._refit(
            out, out.base, self.screen, [(first.index[0], top.index[0])],
            self._seed(Choice.EXPLAINED), "refitting the leading two together",
        )  # fmt: skip
        if both and both[0].score - first.score > (1.0 - EXPLAINED) * top.score:
            out.refits = sorted(out.refits, key=lambda r: -r.score)

    # -- several effects
    def _better(self, chosen: Refit, rival: Refit) -> Refit:
        """Of two choices the one that gains more; of two of as many effects the one of causes,
        where the other describes."""
        if len(chosen.candidates) == len(rival.candidates):
            return preferred([chosen, rival], critical_gain(self.screen, self.alpha))[0]
        return max(chosen, rival, key=lambda r: r.score)

    def _best_pair(self, out: SelectionResult) -> Refit | None:
        """The best of the pairs of which the screen promises most, where it is clearly better than
        the best single one."""
        out.doubles, failed = self._refit(
            out, out.base, self.screen, pairs(self.screen, out.refits), self._seed(Choice.PAIRS),
            "refitting pairs",
        )  # fmt: skip
        out.notes += [f"not refitted: {reason}" for reason in failed]
        if not out.doubles:
            return None
        worth = critical_gain(self.screen, self.alpha)
        best, single = preferred(out.doubles, worth)[0], out.refits[0]
        further = replace(
            best, gain=best.gain - single.gain, cost=best.cost - single.cost,
            ahead=best.ahead - single.ahead,
        )  # fmt: skip
        enough = further.penalised_gain >= worth and _simulates(further, best.candidates, worth)
        return best if enough and further.score >= FORM * single.score else None

    def _forward(self, out: SelectionResult, most: int) -> None:
        """Screen again around the chosen model, and add what stands out, up to `most` effects."""
        chosen, seed = out.chosen, self._seed(Choice.FURTHER)
        while chosen is not None and len(chosen.candidates) < most:
            number, rest = len(chosen.candidates), _others(self.screen, chosen)
            work = sum(e.steps for e in self.train) * self.augmented.settings.particles
            if not rest:
                return
            if not chosen.fitter.exact and work > MOST_WORK:
                out.notes.append(
                    "no further effect was tested (computational limit: too many rows)"
                )
                return
            try:
                again = self._screen_again(chosen, rest, child_seed(seed, number))
            except SSMError as error:
                out.notes.append(f"the test for a further effect failed: {error.found}")
                return
            if float(np.min(again.family.p, initial=1.0)) > CLOSER_LOOK_FACTOR * self.alpha:
                return
            least = PROMISED * FORM * chosen.score
            found = [k for k in _followers(again) if again.efficient.gain[k] >= least]
            if not found:
                return
            more, failed = self._refit(
                out, chosen.fit, again, [[k] for k in found],
                child_seed(seed, Task.FURTHER_REFITS + number), "refitting", chosen.candidates,
                checkpoint=self.checkpoint.within(f"with {number + 1} effects"),
            )  # fmt: skip
            out.notes += [f"not refitted: {reason}" for reason in failed]
            worth, so_far = critical_gain(again, self.alpha), chosen.ahead
            more = [replace(r, ahead=r.ahead - so_far) for r in more]
            more = [
                r for r in more
                if r.penalised_gain >= worth and _simulates(r, r.candidates[-1:], worth)
            ]  # fmt: skip
            if not more:
                return
            # No formula is the machine's own: what describes any misfit goes on gaining beside it.
            causes = [r for r in more if r.candidates[-1].effect.cause == MECHANISM
                      and r.score >= FORM * chosen.score]  # fmt: skip
            best = preferred(causes or more, worth)[0]
            if best.score < FORM * chosen.score:
                out.notes.append(
                    f"not included: {best.candidates[-1]}, which gains "
                    f"{best.penalised_gain:.1f} nats in addition to "
                    f"{' and '.join(map(str, chosen.candidates))}; with the gain in simulations "
                    f"this is less than {FORM:.0%} of the gain of the latter, and may only correct "
                    "for their approximate formulas"
                )
                return
            column = {c.key: k for k, c in enumerate(self.screen.design.candidates)}
            index = (*chosen.index, column[again.design.candidates[best.index[0]].key])
            out.chosen = chosen = Refit(
                index, best.candidates, best.fitter, best.fit, chosen.gain + best.gain,
                chosen.cost + best.cost, chosen.ahead + best.ahead, best.simulating,
            )  # fmt: skip

    def _seed(self, step: Choice) -> np.random.SeedSequence:
        return child_seed(self.seed, step)

    def _screen_again(
        self, chosen: Refit, rest: Sequence[Candidate], seed: np.random.SeedSequence
    ) -> Screen:
        fitter = chosen.fitter
        design = ScreenDesign(
            fitter.problem.trace, self.screen.design.scales, self.augmented.missing,
            (*fitter.fixed, *chosen.fit.bounds), fitter.settings, candidates=rest,
            simulator=fitter.simulator if fitter.initial_law else None,
            failures=self.checkpoint.failures,
        )  # fmt: skip
        sets = AGAIN_CALLED if simulators(self.augmented.trace) else AGAIN
        again = partial(
            run_screen, design, self.train, chosen.fit.theta, seed=seed,
            checkpoint=self.checkpoint, checks=False,
            stage=f"screening for effect {len(chosen.candidates) + 1}",
        )  # fmt: skip
        if CLOSER_LOOK_FACTOR * self.alpha < NOTHING:
            with suppress(ArgumentError):  # too few for so many parameters
                first = again(sets=min(self.screen.sets, FIRST_LOOK))
                if float(np.min(first.family.p, initial=1.0)) > NOTHING:
                    return first
        return again(sets=min(self.screen.sets, sets))


def _unfitted(screen: Screen, refits: Sequence[Refit], alpha: float) -> int | None:
    """The leading candidate, if it is significant, was not refitted, and promises more than the
    best refit gains: another one in its place would be the wrong answer."""
    for k in leading(screen)[:1]:
        done = {int(screen.groups[r.index[0]]) for r in refits}
        best = max((r.penalised_gain for r in refits), default=0.0)
        found = int(screen.groups[k]) not in done and screen.efficient.gain[k] > best
        return k if found and float(screen.candidate_p[k]) <= alpha else None
    return None


def _followers(again: Screen) -> list[int]:
    """What a second screen has refitted: the leading ones, and as many mechanisms. Where a first
    effect has but about the right formula, laws of the noise lead that fit what it leaves."""
    order = leading(again)
    causes = [k for k in order if again.design.candidates[k].effect.cause == MECHANISM]
    return list(dict.fromkeys([*order[:FOLLOWERS], *causes[:FOLLOWERS]]))


def _simulates(r: Refit, new: Sequence[Candidate], worth: float) -> bool:
    """Whether the effects `new` are of a simulator, by what they gain beside those chosen: a cause
    gains further ahead too, and what only describes a misfit loses next to nothing there."""
    if any(c.effect.cause in (UNKNOWN_INPUT, NOISE_LAW) for c in new):
        return r.score > 0.0 and r.ahead >= -MOST_LOST
    once = any(c.effect.cause == CHANGE_IN_TIME for c in new)  # no other record will have it
    return r.ahead >= CARRIES_ON * r.penalised_gain - worth * (not once)


def _others(screen: Screen, chosen: Refit) -> list[Candidate]:
    """The candidates of all other groups that the parameters do not absorb. Their scores so far are
    no guide: with an effect added noise shrinks, and others come to light."""
    groups = {c.group for c in chosen.candidates}
    return [
        c for c, status in zip(screen.design.candidates, screen.efficient.status, strict=True)
        if c.group not in groups and not status
    ]  # fmt: skip


def critical_gain(screen: Screen, alpha: float) -> float:
    """Nats, less the cost, that the best of all candidates gains by chance with probability
    alpha."""
    return 0.5 * threshold(screen.family.maxima, alpha) ** 2


def add_standard_errors(
    out: SelectionResult, seed: np.random.SeedSequence, checkpoint: Checkpoint
) -> None:
    """Standard errors of what was chosen, from scores simulated at its fit."""
    old = out.chosen
    assert old is not None
    number = len(old.candidates)
    what = "standard errors" if number == 1 else f"standard errors of {number} effects"
    with checkpoint.failures.guard(what):
        numbers = checkpoint.computed(
            what, lambda: {"information": old.fitter.with_information(old.fit, seed).information}
        )
        new = replace(old, fit=replace(old.fit, information=np.array(numbers["information"])))
        out.chosen = new
        out.refits = [new if r is old else r for r in out.refits]
