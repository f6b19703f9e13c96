"""Cross-validation by blocks: the held-out gain where rows are few, or the effect happens once.

Contiguous blocks of rows are set missing in turn; fit and selection are repeated on the rest, the
latter among the `SINGLES` leading effects, pairs of them and steps from the best, with the shapes
that the screen has, up to as many effects as were chosen on all rows (M. Stone, *JRSS B* 36, 1974;
blocks for dependent rows: P. Burman, E. Chow and D. Nolan, *Biometrika* 81, 1994). Where a
simulator is called there are fewer blocks, of single effects and pairs alone. l_b is the sum of the
one-step log predictive densities of the block's rows, the filter run over all rows with what the
other blocks gave: the quantity that is measured on the held-out rows of longer records. (log
p(y_b | y_-b) would look ahead: there a noisy level bridges the break that it does not know from
both sides, and hardly a gap is left.)
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ssmppl.analysis.structure import simulators
from ssmppl.data import Experiment, unpack_parameters
from ssmppl.diagnosis.effects.candidate import Candidate, is_dated
from ssmppl.diagnosis.fitting.augmented_models import AugmentedModels
from ssmppl.diagnosis.fitting.fit import APPROXIMATELY, Fit, Fitter
from ssmppl.diagnosis.heldout.gain_ratio import FEWEST_BLOCKS, NOT_GIVEN, HeldOutGain, gain_ratio
from ssmppl.diagnosis.heldout.predictions import Predictions, free_run, gain_of_mean, predict, rmse
from ssmppl.diagnosis.heldout.reference import fit_reference
from ssmppl.diagnosis.heldout.row_split import FOLDS, Fold, folds
from ssmppl.diagnosis.heldout.simulation import compared, horizons, table_rows
from ssmppl.diagnosis.run.checkpoint import Checkpoint, Numbers
from ssmppl.diagnosis.run.seeds import Task, child_seed
from ssmppl.diagnosis.screening.screen import Screen, ScreenDesign, run_screen, screen_part
from ssmppl.diagnosis.selection.effect_selection import EffectSelection, SelectionResult
from ssmppl.diagnosis.selection.refit import Begin, Refit
from ssmppl.errors import ArgumentError, SSMError
from ssmppl.inference.run.tasks import run_tasks
from ssmppl.inference.verbs.simulate import feeds_back

SETS = 60  # simulated data sets in each fold
SINGLES = 4  # refits in each fold
FOLDS_CALLED, SINGLES_CALLED = FEWEST_BLOCKS, 2  # likewise, of a model that calls a simulator


@dataclass(frozen=True)
class _FoldModels:
    """Fitter and fit of each model without a block. chosen : the effects, None without any.
    simulators : base model and model with effects as they are simulated."""

    base: tuple[Fitter, Fit]
    effect: tuple[Fitter, Fit]
    reference: tuple[Fitter, Fit]
    chosen: Refit | None
    simulators: tuple[tuple[Fitter, Fit], tuple[Fitter, Fit]]


@dataclass(frozen=True)
class CrossValidation:
    """The gain on blocks left out: what every fold works with.

    design : of the screen. base : the model's fitter and its fit to all rows. alpha : family-wise
    error rate of the selection. chosen : on all rows; None: the reference stands for it. whole :
    the screen of all rows by that design, whose simulated sets serve all blocks; None: each block
    has its own. simulator : the base model as it is simulated; None: as it was fitted. horizon : as
    of `HeldOutRows`. searched : as of `EffectSelection`, of the effects that are chosen.
    """

    augmented: AugmentedModels
    design: ScreenDesign
    base: tuple[Fitter, Fit]
    experiments: tuple[Experiment, ...]
    alpha: float
    chosen: Refit | None
    whole: Screen | None = None
    simulator: tuple[Fitter, Fit] | None = None
    horizon: int | None = None
    searched: Sequence[tuple[Candidate, Begin]] = ()

    def gain(self, label: str, seed: np.random.SeedSequence, checkpoint: Checkpoint) -> HeldOutGain:
        """Share of the gap that is closed on the blocks left out."""
        out = HeldOutGain()
        out.simulate(self.simulator or self.base, self.experiments, self.chosen, seed)
        fed_back = feeds_back(self.augmented.trace)
        number = FOLDS_CALLED if simulators(self.augmented.trace) else FOLDS
        blocks = folds(self.experiments, number, fed_back=fed_back)

        def one(k: int) -> Numbers:
            name = f"block {k + 1} of {len(blocks)}"
            own, kept = child_seed(seed, Task.BLOCK, k), checkpoint.within(name)
            try:
                one = partial(self._one, blocks[k], blocks[0].left_out, own, kept)
                return kept.computed("held out", one)
            except SSMError:  # a block that a model cannot predict is no block to leave out
                raise
            except Exception as error:
                checkpoint.failures.record(name, error)
                return {}

        try:  # in threads of this process: their tasks go over the executor
            each = [v for v in run_tasks(one, range(len(blocks))) if v]
        except SSMError as error:
            out.notes.append(NOT_GIVEN.format(error.found))
            return out
        if len(each) < FEWEST_BLOCKS:
            out.notes.append(NOT_GIVEN.format(f"{len(each)} of {len(blocks)} blocks are done"))
            return out
        table = {n: np.stack([v[n] for v in each], axis=-1) for n in each[0]}
        ratio = gain_ratio(table["base"], table["effect"], table["reference"], block=1)
        best, rival = table["reference"], table["effect" if self.chosen else "base"]
        out.beyond_catalogue = gain_ratio(rival, best, best, block=1).gain
        rows = table["rows"].sum()
        before, after = (
            float(np.sqrt(np.sum(table["rows"] / rows * table[n] ** 2)))
            for n in ("before", "after")
        )
        out.add(
            label, ratio, ratio.gain.nats / float(rows), float(table["gain_mean"].sum()),
            (before, after), self.chosen is not None,
        )  # fmt: skip
        if "ahead" in table:
            which = horizons(self.experiments, blocks[0].left_out, self.horizon)
            ahead = [table["ahead"][h].T for h in range(len(which))]
            out.rows += table_rows(label, which, ahead, None)
        same = int(table["same"].sum()) if "same" in table else len(each)  # resumed from before
        if self.chosen is not None and same < len(each):
            out.notes.append(
                f"the effects selected without a block are those named here in {same} of "
                f"{len(each)} folds: the share is that of the selection in each fold"
            )
        return out

    def _one(
        self, fold: Fold, first: Sequence[np.ndarray], seed: np.random.SeedSequence,
        checkpoint: Checkpoint,
    ) -> Numbers:  # fmt: skip
        """Fit, select and predict: log densities of the block, and errors of simulations; first :
        the rows of the first block, by which the horizons of all are chosen."""
        models = self._models(fold, seed, checkpoint)
        counts, chosen = list(fold.left_out), models.chosen
        events = [c for c in (chosen.candidates if chosen else ()) if is_dated(c)]
        found = {"base": predict(*models.base, self.experiments, counts, seed, checkpoint.executor)}
        for name, model in (("effect", models.effect), ("reference", models.reference)):
            found[name] = self._predict(model, events, fold, seed, checkpoint.executor)
        out = {n: p.log_density.sum(axis=1) for n, p in found.items()}
        if not all(np.all(np.isfinite(v)) for v in out.values()):
            raise ArgumentError("zero predictive density for a held-out block")
        out["gain_mean"] = np.asarray(gain_of_mean(found["base"], found["effect"]))
        measured = [(e.seen.any(axis=1) & c).sum()
                    for e, c in zip(self.experiments, counts, strict=True)]  # fmt: skip
        groups = [{c.group for c in r.candidates} for r in (chosen, self.chosen) if r]
        out["same"] = np.asarray(float(len(groups) == 2 and groups[0] == groups[1]))
        out["rows"] = np.asarray(float(sum(measured)))
        inside = [i for i, m in enumerate(measured) if m]
        at = [self.experiments[i] for i in inside]
        which = horizons(self.experiments, first, self.horizon)
        ahead = compared(*models.simulators, self.experiments, counts, which, seed)
        with np.errstate(all="ignore"):
            out["ahead"] = np.array([v.mean(axis=0) if len(v) else np.full(3, np.nan)
                                     for v in ahead])  # fmt: skip
        for name, model in zip(("before", "after"), models.simulators, strict=True):
            runs = [free_run(*model, e, seed) for e in at]
            out[name] = np.asarray(rmse(runs, at, [counts[i] for i in inside]) if at else 0.0)
        return out

    def _models(
        self, fold: Fold, seed: np.random.SeedSequence, checkpoint: Checkpoint
    ) -> _FoldModels:
        """Base model, model with effects and reference, fitted and chosen without the block."""
        fitter, whole = self.base
        start = unpack_parameters(whole.problem.trace, whole.theta)
        numbers = checkpoint.computed(
            "fitting", lambda: fitter.fit(fold.train, seed, start, APPROXIMATELY).numbers
        )
        fit = fitter.restored(fold.train, numbers)
        if self.whole is None:
            screen = run_screen(
                self.design, fold.train, fit.theta, SETS, seed, checkpoint, checks=False
            )
        else:
            screen = screen_part(self.whole, fold.train, fit.theta, seed)
        found = SelectionResult(fit)
        if self.chosen is not None:
            called = bool(simulators(self.augmented.trace))
            EffectSelection(
                self.augmented, screen, fold.train, seed, self.alpha, checkpoint, always=True,
                singles=SINGLES_CALLED if called else SINGLES, approximate=True,
                most=len(self.chosen.candidates), further=not called, horizon=self.horizon,
                searched=self.searched,
            ).run(found)  # fmt: skip
        chosen = found.chosen
        reference = fit_reference(
            self.augmented, chosen.candidates if chosen else (), chosen.fit if chosen else fit,
            screen, fold.train, seed, checkpoint,
        )  # fmt: skip
        effect = (fitter, fit) if self.chosen else reference
        if chosen is not None:
            effect = (chosen.fitter, chosen.fit)
        before = found.simulating.model if found.simulating else (fitter, fit)
        after = chosen.simulator if chosen else effect
        return _FoldModels((fitter, fit), effect, reference, chosen, (before, after))

    def _predict(
        self, model: tuple[Fitter, Fit], events: Sequence[Candidate], fold: Fold,
        seed: np.random.SeedSequence, executor: Executor | None,
    ) -> Predictions:  # fmt: skip
        """One-step predictions of the block, averaged over dates that other rows cannot separate.

        The average is of the densities of the whole block: `log_density` has it as (R, 1).
        """
        fitter, fit = model
        counts = list(fold.left_out)
        names = [s.data[1] for s in fitter.problem.trace.parameter_symbols]
        for c in events:
            own, dates = f"{c.strength}_date", indistinguishable_dates(c, fold)
            if own in names and dates:
                each = []
                for date in dates:
                    theta = fit.theta.copy()
                    theta[names.index(own)] = date
                    at = replace(fit, theta=theta)
                    each.append(predict(fitter, at, self.experiments, counts, seed, executor))
                total = np.stack([p.log_density.sum(axis=1) for p in each])
                top = total.max(axis=0)
                density = top + np.log(np.mean(np.exp(total - top), axis=0))
                mean = np.mean([p.mean for p in each], axis=0)
                return replace(each[0], log_density=density[:, None], mean=mean)
        return predict(fitter, fit, self.experiments, counts, seed, executor)


def indistinguishable_dates(c: Candidate, fold: Fold) -> list[float]:
    """Dates between the rows on either side of the block, if the event's own is among them; they
    have the same likelihood of the other rows. Of one experiment: others tell the date."""
    if len(fold.left_out) != 1:
        return []
    rows = np.flatnonzero(fold.left_out[0]) + 1
    later = 0 if c.change == "transition" else 1
    first, last = max(int(rows[0]) - 1 + later, 1), int(rows[-1]) + later
    date = dict(c.shape).get("date", 0.0)
    return [float(d) for d in range(first, last + 1)] if first <= date <= last else []
