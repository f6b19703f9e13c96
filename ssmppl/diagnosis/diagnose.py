"""The verb `diagnose`: where a model differs from data, which effect causes it, how far it closes.

The stages are the fit, the screen, the refits and the gain on held-out rows; each has a module.
"""

from __future__ import annotations

import itertools
import os
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np

from ssmppl.analysis.structure import simulators
from ssmppl.arguments import checked
from ssmppl.counts import check_count, check_number
from ssmppl.data import Experiment, check_values
from ssmppl.diagnosis.effects.candidate import is_pulse
from ssmppl.diagnosis.experiment.design import MOST_ROWS, separate
from ssmppl.diagnosis.experiment.recovery import recovery
from ssmppl.diagnosis.experiment.rivals import Rival, has_filter
from ssmppl.diagnosis.fitting.augmented_models import AugmentedModels, proposal_of
from ssmppl.diagnosis.fitting.bounds import bounds_note
from ssmppl.diagnosis.fitting.fit import Fit, Fitter
from ssmppl.diagnosis.heldout.cross_validation import FOLDS_CALLED, CrossValidation
from ssmppl.diagnosis.heldout.fewer_effects import (
    HeldOutTest,
    drop_by_held_out_rows,
    drop_by_later_rows,
)
from ssmppl.diagnosis.heldout.gain_ratio import HeldOutGain, HeldOutRows
from ssmppl.diagnosis.heldout.reference import gain_of_curves
from ssmppl.diagnosis.heldout.row_split import FOLDS, RowSplit, long_enough, three_parts
from ssmppl.diagnosis.model.candidates import Chosen
from ssmppl.diagnosis.model.candidates import chosen as chosen_effects
from ssmppl.diagnosis.model.initial_law import proper_initial_law
from ssmppl.diagnosis.model.scales import Scales
from ssmppl.diagnosis.model.smoothing import Settings
from ssmppl.diagnosis.report.build import build_report
from ssmppl.diagnosis.report.findings import MODES
from ssmppl.diagnosis.report.report import GapReport
from ssmppl.diagnosis.run.checkpoint import Checkpoint, Numbers, digests
from ssmppl.diagnosis.run.expected_time import Timed, in_words, timed
from ssmppl.diagnosis.run.expected_time import seconds as expected
from ssmppl.diagnosis.run.failures import Failures, reason_of
from ssmppl.diagnosis.run.seeds import Stage, child_seed
from ssmppl.diagnosis.screening.screen import ScreenDesign, run_screen
from ssmppl.diagnosis.selection.effect_selection import (
    EffectSelection,
    SelectionResult,
)
from ssmppl.diagnosis.verdict.results import Results
from ssmppl.errors import ArgumentError, SSMError, listing
from ssmppl.inference.methods.requirements import need_density
from ssmppl.inference.run.executors import check_executor
from ssmppl.inference.run.problem import pose
from ssmppl.inference.run.progress import announced
from ssmppl.inference.run.seeds import random_state, seed_sequence
from ssmppl.inference.verbs.simulate import check_samplers
from ssmppl.language.distributions.from_density import UserDefined
from ssmppl.language.model.model import Model

BY_EXTENDED = (
    "The model calls a simulator: likelihoods, and the states behind the scores, are those of an "
    "extended Kalman filter, which is an approximation."
)
LEFT = 0.05  # share of simulated records that leave the domain, from which that is said
SETS = {"fast": 100, "full": 200}  # simulated data sets; of a simulator 100 in both
PARTICLES = {"fast": 500, "full": 1000}
TWISTED_PARTICLES = {"fast": 100, "full": 100}  # a few that know where to go do more


@checked
def diagnose(
    model: Model,
    data: Any,
    effects: Chosen = None,
    *,
    mode: str = "full",
    alpha: float = 0.05,
    fixed: Mapping[str, Any] | None = None,
    particles: int | None = None,
    executor: Executor | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
    progress: bool = True,
    seed: int | None = 1,
    debug: bool = False,
    horizon: int | None = None,
) -> GapReport:
    """Find where a model differs from reality, and which effect that it lacks causes this.

    Also how far the gap closes once that effect is added, on rows that took no part in choosing it.

    Parameters
    ----------
    model : the model, as declared.
    data : mapping of arrays, pandas DataFrame, xarray Dataset, or a list of those.
    effects : names that restrict the catalogue (`ssm.effects.names()`), effects made by
        `@ssm.effect` that join it, or a mapping that renames; None: the whole catalogue.
    mode : "fast" stops after the screen; "full" refits, confirms on held-out rows and writes the
        augmented model.
    alpha : family-wise error rate of the effects, below 0.5: the chance that a correct model is
        said to lack one (in full mode half of it for the score tests, half for the refits). Places
        and checks of the predictions have a fifth of it each, so that the chance of any finding on
        a correct model is at most about 1.4 alpha; 1.6 alpha in fast mode, which also tests what
        the catalogue leaves unexplained, at a fifth.
    fixed : values of known parameters.
    particles : of the particle filters; None: 500 in fast mode, 1000 in full mode, 100
        where the twisted proposal applies.
    executor : any `concurrent.futures.Executor`, over which simulated sets and refits are shared
        out; None: threads.
    checkpoint : a file, or a folder, that keeps what is done: the same call again goes on from
        there and gives the same report. None: nothing is kept.
    progress : whether to show the stages and the time that they will take, on stderr.
    seed : the same seed gives the same report.
    debug : the first internal error is raised, where else the part that it ended (a
        candidate, a refit, a block, a table) is left out: see `GapReport.left_out`.
    horizon : rows of the simulations by which the report says how far the gap closes: from the
        filtered state of one row on, so many rows without looking at the data. None: a tenth of the
        longest record.

    Returns
    -------
    GapReport : `print` it. After Ctrl-C it is of the stages that are done, with `interrupted` set,
        if the screen is among them; else KeyboardInterrupt is raised.

    Raises
    ------
    ModelError, DataError, ArgumentError : what is wrong with model, data or call, and the fix.
    SSMError : the fit or the screen, without which there is no answer, ended in a fault.
    """
    if mode not in MODES:
        raise ArgumentError(f"mode={mode!r}", fix=f"use one of: {listing(str(mode), MODES)}")
    check_number("alpha", alpha, lambda v: 0.0 < v < 0.5, "give an error rate such as 0.05")
    if particles is not None:
        check_count("particles", particles, 10)
    if horizon is not None:
        check_count("horizon", horizon, 1)
    check_executor(executor)
    return _Diagnosis(
        model, data, effects, mode, alpha, fixed, particles, executor, checkpoint, progress, seed,
        Failures(debug), horizon,
    ).run()  # fmt: skip


class _Diagnosis:
    """One run, stage by stage."""

    def __init__(
        self, model: Model, data: Any, effects: Chosen, mode: str, alpha: float,
        fixed: Mapping[str, Any] | None, particles: int | None, executor: Executor | None,
        checkpoint: str | os.PathLike[str] | None, progress: bool, seed: int | None,
        failures: Failures, horizon: int | None,
    ):  # fmt: skip
        self.failures, self.horizon = failures, horizon
        self.began = time.perf_counter()
        self.problem = pose(model, data, noting=True)
        self.trace = self.problem.trace
        check_samplers(self.trace)
        need_density(self.trace, "the diagnosis", "diagnose")
        self.experiments = self.problem.experiments
        self.fixed = check_values(self.trace, fixed, argument="fixed")
        self.effects, self.mode, self.alpha = effects, mode, alpha
        self.root = seed_sequence(seed)
        self.split: RowSplit | None = None
        if mode == "full" and long_enough(self.experiments):
            self.split = three_parts(self.experiments)
        self.called = bool(simulators(self.trace))
        self.sets = SETS["fast" if self.called else mode]
        self.folds = FOLDS_CALLED if self.called else FOLDS
        missing = self.problem.program.missing
        if mode == "full" and self.split is None:  # blocks of rows will be set missing
            missing = replace(missing, none=False)
        proposal = proposal_of(self.problem.program)
        number = particles or (TWISTED_PARTICLES if proposal == "twisted" else PARTICLES)[mode]
        self.settings = Settings(number, proposal)
        self.augmented = AugmentedModels(self.trace, missing, self.fixed, self.settings)
        self.notes = [
            f"No CDF is defined for {n} ({type(s.distribution).__name__}): no PIT checks of its "
            "one-step predictions."
            for n, s in self.trace.observations.items()
            if isinstance(s.distribution, UserDefined) and not s.distribution.has_cdf
        ]
        self.notes += [BY_EXTENDED] * self.called
        described = {
            "alpha": alpha, "seed": self.root.entropy, "fixed": self.fixed, "particles": number,
            "sets": self.sets, "horizon": horizon,
        }  # fmt: skip
        made_from = digests(self.trace, self.experiments, chosen_effects(effects), mode, described)
        # Threads that wait for one simulator take turns, which takes longer than one alone.
        self.own = ThreadPoolExecutor(1) if executor is None and self.called else None
        self.checkpoint = Checkpoint(
            checkpoint, made_from, executor or self.own, progress, failures
        )

    def run(self) -> GapReport:
        """All stages, and the report; after an interrupt, of those that are done."""
        try:
            results = self._screen()
            if self.mode == "full":
                try:
                    self._select(results)
                except KeyboardInterrupt:
                    results.interrupted = True
                    self.checkpoint.say("interrupted: the report is of the stages that are done")
            return build_report(results, time.perf_counter() - self.began)
        except SSMError:
            raise
        except Exception as error:
            if self.failures.raised:
                raise
            raise SSMError(
                f"the diagnosis of {self.trace.name!r} could not be finished: {reason_of(error)}",
                fix="please report it with the model and the data; debug=True shows where it is",
            ) from error
        finally:
            self.checkpoint.flush()
            if self.own is not None:
                self.own.shutdown()

    # -- stages
    def _screen(self) -> Results:
        """Fit, and screen."""
        base = self.augmented.base_fitter
        training = self.split.train if self.split else self.experiments
        fit = self._fit(base, training)
        states = [
            base.states(e, fit.theta, random_state(self._seed(Stage.STATES))) for e in training
        ]
        self.augmented.initial_law = proper_initial_law(
            self.trace, [x[0].mean(axis=0) for x in states], states
        )
        design = ScreenDesign(
            self.trace, self._scales(states, training), self.augmented.missing,
            (*self.fixed, *fit.bounds), self.settings, self.effects, failures=self.failures,
        )  # fmt: skip
        if not design.candidates:
            raise ArgumentError(
                "none of the effects applies to this model: "
                + "; ".join(map(str, design.refused[:3])),
                fix="name others in effects=; ssm.effects.names() lists them",
            )
        with self.failures.guard("the time that is expected"):
            self._tell_time(base, fit, design, training)
        screen = run_screen(
            design, training, fit.theta, self.sets, self._seed(Stage.SCREEN), self.checkpoint
        )
        if screen.left > LEFT:
            self.notes.append(
                f"Of the records simulated from the fitted model, {screen.left:.0%} leave its "
                "domain (values that are not finite, or far outside the range of the data): "
                "p-values are conditional on records that stay in it, and simulations may leave it."
            )
        settings = {
            "model": self.trace.name, "alpha": self.alpha, "seed": str(self.root.entropy),
            "particles": 0 if base.exact else self.settings.particles,
        }  # fmt: skip
        return Results(
            self.trace, self.experiments, self.split, self.mode, self.alpha, base, fit, screen,
            settings, self.notes, failures=self.failures,
        )  # fmt: skip

    def _select(self, r: Results) -> None:
        """Refit and choose, find the equivalence class, measure the held-out gain; into `r`."""
        found = SelectionResult(r.fit)
        with self.failures.guard("the choice of an effect"):
            EffectSelection(
                self.augmented, r.screen, r.screen.experiments, self._seed(Stage.SELECTION),
                self.alpha, self.checkpoint, horizon=self.horizon,
            ).run(found)  # fmt: skip
        r.selection, r.fit = found, found.base
        if found.unfitted is not None:  # nothing to measure, then
            return
        with self.failures.guard("whether several effects predict better than fewer"):
            if self.split:
                seed = self._seed(Stage.SELECTION)
                drop_by_later_rows(found, self.split, seed, self.checkpoint)
                held_out = HeldOutTest(
                    (r.base, r.fit), r.simulator, self.split, self.horizon,
                    self._seed(Stage.HELD_OUT), self.checkpoint.executor,
                )  # fmt: skip
                drop_by_held_out_rows(found, held_out, seed, self.checkpoint)
        if found.chosen is not None:
            with self.failures.guard("who is taken for whom"):
                r.recovery = recovery(
                    self.augmented, [x for x in r.refits if len(x.index) == 1],
                    r.screen.experiments, self._seed(Stage.RECOVERY), self.checkpoint,
                )  # fmt: skip
            with self.failures.guard("what curves explain by themselves"):
                r.curves_alone = gain_of_curves(
                    self.augmented, r.fit, found.chosen.candidates, r.screen,
                    r.screen.experiments, self._seed(Stage.CURVES), self.checkpoint,
                )  # fmt: skip
        with self.failures.guard("the experiment that would separate the class best"):
            self._separating_experiment(r)
        with self.failures.guard("how far the gap closes"):
            r.held_out = self._held_out_gain(r)

    def _held_out_gain(self, r: Results) -> HeldOutGain:
        # Beside a pulse, which later rows cannot tell of, they tell what carries on.
        once = r.chosen is not None and all(is_pulse(c) for c in r.chosen.candidates)
        if self.split and not once:
            best = r.refits[0] if r.refits else None
            simulation = r.selection.simulation if r.selection else None
            return HeldOutRows(
                self.augmented, self.split, (r.base, r.fit), r.screen, r.chosen, best, r.simulator,
                simulation, self.horizon,
            ).gain(r.label, self._seed(Stage.HELD_OUT), self.checkpoint)  # fmt: skip
        r.blocks = self.folds
        augmented, design, base = self.augmented, r.screen.design, (r.base, r.fit)
        if self.split:  # the code so far knows no missing rows
            missing = replace(self.augmented.missing, none=False)
            augmented = AugmentedModels(
                self.trace, missing, self.fixed, self.settings, self.augmented.initial_law
            )
            design = ScreenDesign(
                self.trace, design.scales, missing, (*self.fixed, *r.fit.bounds),
                self.settings, self.effects, failures=self.failures,
            )  # fmt: skip
            fitter = augmented.base_fitter
            base = fitter, fitter.restored(self.experiments, r.fit.numbers)
        whole = None if self.split or (r.selection and r.selection.rebased) else r.screen
        return CrossValidation(
            augmented, design, base, self.experiments, self.alpha, r.chosen, whole, r.simulator,
            self.horizon, r.searched,
        ).gain(r.label, self._seed(Stage.HELD_OUT), self.checkpoint)  # fmt: skip

    def _separating_experiment(self, r: Results) -> None:
        """How far the members of the first class come apart, where it has several, and in which
        experiment they would."""
        order, found = r.classes()
        members = [order[i] for i in found.members(1)] if len(order) else []
        if r.chosen is None or len(members) < 2:
            return
        refitted = {refit.index[0]: refit for refit in r.refits if len(refit.index) == 1}
        rivals = [refitted[k] for k in members if k in refitted and has_filter(refitted[k].fitter)]
        rivals[1:] = sorted(rivals[1:], key=lambda refit: -refit.score)
        longest, why = max(e.steps for e in self.experiments), ""
        if longest > MOST_ROWS:
            why = f"the record is too long ({longest:,} rows)"
        elif len(rivals) < 2:
            why = "this needs fits of at least two of them with likelihoods by a Kalman filter"
        else:
            r.separation = separate(
                self.augmented, self.trace, list(map(Rival.of, rivals)), len(members),
                self.experiments, self._seed(Stage.EXPERIMENT), self.checkpoint,
            )  # fmt: skip
            why = "" if r.separation else "they happen once, or fail under the recorded inputs"
        if why:
            names = " and ".join(str(r.screen.design.candidates[k]) for k in members[:2])
            self.notes.append(f"no experiment to distinguish {names} was designed: {why}")

    # -- small parts
    def _fit(self, base: Fitter, experiments: Sequence[Experiment]) -> Fit:
        """The model's own fit."""
        stage = "fitting"
        if stage not in self.checkpoint:
            self.checkpoint.say(f"{stage} {self.trace.name!r}")

        def numbers() -> Numbers:
            return base.fit(experiments, self._seed(Stage.FIT), {}).numbers

        with announced("diagnose", stage, shown=self.checkpoint.progress):
            fit = base.restored(experiments, self.checkpoint.computed(stage, numbers))
        if not fit.converged:
            left = f"; estimated remaining gain {fit.distance:.1f} nats" * (fit.distance > 0.0)
            self.notes.append(f"the optimiser did not converge ({stage}){left}")
        if fit.bounds:
            self.notes.append(
                bounds_note(fit.bounds, fit.by_component, f"the fit of {self.trace.name!r}")
            )
        return fit

    def _tell_time(
        self, base: Fitter, fit: Fit, design: ScreenDesign, experiments: Sequence[Experiment]
    ) -> None:
        """Show how long the mode will take, from passes over the data."""
        done = sum(f"screening/{k}" in self.checkpoint for k in range(self.sets))
        if not self.checkpoint.progress or done > self.sets // 2:
            return
        whole, runs = design.theta(fit.theta), itertools.count()

        def stream() -> np.ndarray:  # another one each time: a simulator's values are kept
            return random_state(self._seed(Stage.TIMING), next(runs))

        # A refit's code is about as much to compile as the screen's.
        for_screen, generating = timed(
            lambda: design.smoother.run(experiments, whole, stream(), ahead=self.called)
        )
        for_fit, _ = timed(lambda: base.smoother.run(experiments, fit.theta, stream()))
        of_climbs = base.seconds_of_value(experiments, fit.theta)
        blocks = 0 if self.split else self.folds
        rest = expected(
            Timed(for_screen, for_fit, generating, of_climbs), self.sets, self.mode, blocks,
            self.checkpoint.executor, simulator=self.called,
        )  # fmt: skip
        self.checkpoint.say(f"{self.mode} mode: {in_words(rest)} expected from here on")

    def _scales(self, states: Sequence[np.ndarray], experiments: Sequence[Experiment]) -> Scales:
        """The scales of filtered states, observations and inputs."""
        y = np.concatenate([np.where(e.seen == 1.0, e.y, np.nan) for e in experiments])
        u = np.concatenate([e.u for e in experiments])
        longest = max(e.steps for e in experiments)
        return Scales.of(self.trace, np.concatenate(states), y, u, longest)

    def _seed(self, stage: Stage) -> np.random.SeedSequence:
        return child_seed(self.root, stage)
