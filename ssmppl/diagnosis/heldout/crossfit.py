"""How far the gap closes where rows are too few, or the effect happens once: by leaving blocks out.

Contiguous blocks of rows are set missing in turn; fit and selection are repeated on the rest, the
latter among the `SINGLES` leading effects, pairs of them and steps from the best, with the shapes
that the screen has, up to as many effects as were chosen on all rows (M.
Stone, *JRSS B* 36, 1974; blocks for dependent rows: P. Burman, E. Chow and D. Nolan, *Biometrika*
81, 1994). l_b is the sum of the one-step log predictive densities of the block's rows, the filter
run over all rows with what the other blocks gave: the quantity that is measured on the confirm part
of longer records. (log p(y_b | y_-b) would look ahead: there a noisy level bridges the break that
it does not know from both sides, and hardly a gap is left.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ssmppl.data import Experiment, unpack_parameters
from ssmppl.diagnosis.effects.candidate import Candidate, one_off
from ssmppl.diagnosis.heldout.gain_ratio import (
    FEWEST_BLOCKS,
    NOT_GIVEN,
    HowFar,
    closed,
    interval_of,
    notes_of,
)
from ssmppl.diagnosis.heldout.parts import FOLDS, Fold, folds
from ssmppl.diagnosis.heldout.predictions import Predictions, free_run, gain_of_mean, predict, rmse
from ssmppl.diagnosis.heldout.reference import fit_reference
from ssmppl.diagnosis.run.checkpoint import Checkpoint, Numbers
from ssmppl.diagnosis.screening.screen import Question, Screen, ask, held_against
from ssmppl.diagnosis.selection.attribution import Attribution, attribute
from ssmppl.diagnosis.selection.augmented_models import Workshop
from ssmppl.diagnosis.selection.fit import Fit, Fitter
from ssmppl.diagnosis.selection.refit import Refit
from ssmppl.errors import ArgumentError, SSMError
from ssmppl.inference.run.tasks import run_tasks
from ssmppl.inference.verbs.simulate import feeds_back

SETS = 60  # simulated data sets in each fold
SINGLES = 4  # refits in each fold


@dataclass(frozen=True)
class CrossFit:
    """What every fold works with.

    question : the screen's. base : the model's fitter and its fit to all rows. alpha : family-wise
    error rate of the selection. chosen : on all rows; None: the reference stands for it. whole :
    the screen of all rows by that question, whose simulated sets serve all blocks; None: each
    block has its own.
    """

    workshop: Workshop
    question: Question
    base: tuple[Fitter, Fit]
    experiments: tuple[Experiment, ...]
    alpha: float
    chosen: Refit | None
    whole: Screen | None = None

    def how_far(self, label: str, seed: np.random.SeedSequence, kept: Checkpoint) -> HowFar:
        """Share of the gap that is closed on the blocks left out."""
        out = HowFar()
        out.runs(self.base, self.experiments, self.chosen, seed)
        fed_back = feeds_back(self.workshop.trace)
        parts = folds(self.experiments, FOLDS, fed_back=fed_back)

        def one(k: int) -> Numbers:
            own = np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, 20, k))
            name = f"block {k + 1} of {len(parts)}"
            where = kept.within(name)
            try:
                return where.of("held out", partial(self._one, parts[k], own, where))
            except SSMError:  # a block that a model cannot predict is no block to leave out
                raise
            except Exception as error:
                kept.failures.met(name, error)
                return {}

        try:  # in threads of this process: their tasks go over the executor
            each = [v for v in run_tasks(one, range(len(parts))) if v]
        except SSMError as error:
            out.notes.append(NOT_GIVEN.format(error.found))
            return out
        if len(each) < FEWEST_BLOCKS:
            out.notes.append(NOT_GIVEN.format(f"{len(each)} of {len(parts)} blocks are done"))
            return out
        table = {n: np.stack([v[n] for v in each], axis=-1) for n in each[0]}
        share = closed(table["base"], table["effect"], table["reference"], block=1)
        best, rival = table["reference"], table["effect" if self.chosen else "base"]
        out.beyond = closed(rival, best, best, block=1).gain
        size = table["rows"] / table["rows"].sum()
        mean = float(table["gain_mean"].sum())
        low, high = interval_of(share)
        out.rows.append({
            "effect": label, "F": share.F, "F_low": low, "F_high": high,
            "nats_per_sample": share.gain.nats / float(table["rows"].sum()), "gain_mean": mean,
            "gain_noise": share.gain.nats - mean,
            "rmse_before": float(np.sqrt(np.sum(size * table["before"] ** 2))),
            "rmse_after": float(np.sqrt(np.sum(size * table["after"] ** 2))),
        })  # fmt: skip
        out.notes += notes_of(share, self.chosen is not None)
        same = int(table["same"].sum()) if "same" in table else len(each)  # resumed from before
        if self.chosen is not None and same < len(each):
            out.notes.append(
                f"without the block, the effects chosen are those named here in {same} of "
                f"{len(each)} blocks: the share is of what was chosen each time"
            )
        return out

    def _one(self, fold: Fold, seed: np.random.SeedSequence, kept: Checkpoint) -> Numbers:
        """Fit, select and predict: log densities of the block, and free-run errors."""
        fitter, whole = self.base
        start = unpack_parameters(whole.problem.trace, whole.theta)
        numbers = kept.of(
            "fitting",
            lambda: fitter.fit(fold.train, seed, start, searched=True, rough=True).numbers,
        )
        fit = fitter.restored(fold.train, numbers)
        if self.whole is None:
            screen = ask(self.question, fold.train, fit.theta, SETS, seed, kept, checks=False)
        else:
            screen = held_against(self.whole, fold.train, fit.theta, seed)
        found = Attribution(fit)
        if self.chosen is not None:
            attribute(
                found, self.workshop, screen, fold.train, seed, self.alpha, kept, always=True,
                singles=SINGLES, steps=len(self.chosen.candidates), quick=True,
            )  # fmt: skip
        pick = found.chosen
        reference = fit_reference(
            self.workshop, pick.candidates if pick else (), pick.fit if pick else fit, screen,
            fold.train, seed, kept,
        )  # fmt: skip
        effect = (fitter, fit)
        if pick is not None:
            effect = (pick.fitter, pick.fit)
        elif self.chosen is None:
            effect = reference
        counts, models = list(fold.left_out), {"base": (fitter, fit), "effect": effect}
        events = [c for c in (pick.candidates if pick else ()) if one_off(c)]
        found_by = {"base": predict(fitter, fit, self.experiments, counts, seed)}
        for name, model in (("effect", effect), ("reference", reference)):
            found_by[name] = self._predict(model, events, fold, seed)
        out = {n: p.log_density.sum(axis=1) for n, p in found_by.items()}
        if not all(np.all(np.isfinite(v)) for v in out.values()):
            raise ArgumentError("a model fitted without a block gives the block no probability")
        out["gain_mean"] = np.asarray(gain_of_mean(found_by["base"], found_by["effect"]))
        measured = [(e.seen.any(axis=1) & c).sum()
                    for e, c in zip(self.experiments, counts, strict=True)]  # fmt: skip
        groups = [{c.group for c in r.candidates} for r in (pick, self.chosen) if r]
        out["same"] = np.asarray(float(len(groups) == 2 and groups[0] == groups[1]))
        out["rows"] = np.asarray(float(sum(measured)))
        inside = [i for i, m in enumerate(measured) if m]
        for name, model in (("before", models["base"]), ("after", effect)):
            at = [self.experiments[i] for i in inside]
            runs = [free_run(*model, e, seed) for e in at]
            value = rmse(runs, at, [counts[i] for i in inside]) if at else 0.0
            out[name] = np.asarray(value)
        return out

    def _predict(
        self, model: tuple[Fitter, Fit], events: Sequence[Candidate], fold: Fold,
        seed: np.random.SeedSequence,
    ) -> Predictions:  # fmt: skip
        """One-step predictions of the block, averaged over dates that the other rows cannot tell.

        The average is of the densities of the whole block: `log_density` has it as (R, 1).
        """
        fitter, fit = model
        counts = list(fold.left_out)
        names = [s.data[1] for s in fitter.problem.trace.parameter_symbols]
        for c in events:
            own, dates = f"{c.strength}_date", untold_dates(c, fold)
            if own in names and dates:
                each = []
                for date in dates:
                    theta = fit.theta.copy()
                    theta[names.index(own)] = date
                    at = replace(fit, theta=theta)
                    each.append(predict(fitter, at, self.experiments, counts, seed))
                total = np.stack([p.log_density.sum(axis=1) for p in each])
                top = total.max(axis=0)
                density = top + np.log(np.mean(np.exp(total - top), axis=0))
                mean = np.mean([p.mean for p in each], axis=0)
                return replace(each[0], log_density=density[:, None], mean=mean)
        return predict(fitter, fit, self.experiments, counts, seed)


def untold_dates(c: Candidate, fold: Fold) -> list[float]:
    """Dates between the rows on either side of the block, if the event's own is among them; they
    all say the same of the other rows. Of a single experiment: others tell the date."""
    if len(fold.left_out) != 1:
        return []
    rows = np.flatnonzero(fold.left_out[0]) + 1
    later = 0 if c.change == "transition" else 1
    first, last = max(int(rows[0]) - 1 + later, 1), int(rows[-1]) + later
    date = dict(c.shape).get("date", 0.0)
    return [float(d) for d in range(first, last + 1)] if first <= date <= last else []
