"""GapReport: what `diagnose` returns, and prints, draws and saves itself."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ssmppl.diagnosis.report.findings import Findings
from ssmppl.diagnosis.report.folder import save
from ssmppl.diagnosis.report.panels import plot
from ssmppl.diagnosis.report.text import report_html, report_text


@dataclass(frozen=True, eq=False, repr=False)
class GapReport(Findings):
    """Where a model differs from its data, which effect is missing, and how far the gap closes.

    `print` it for the answers in words; `plot()` draws them; `save(folder)` writes everything.

    Parameters
    ----------
    verdict : "effect", "none of these" or "no measurable gap".
    where : one row for each place that stands out, strongest first: the equation, the moment of
        its distribution (mean, scale, tails, time dependence), when (t_from, t_to), the region of
        states and inputs in words, z and its family-wise p.
    causes : candidate effects, best first. `kind` says what naming it means: "mechanism", "change
        in time", "unknown input" or "noise law". `gain_screen` is the gain in nats that the score
        predicts, `gain_refit` the one after refitting, NaN where it was not refitted; `sign` the
        constraint on the strength or the sign found, `estimate` and `se` that strength.
        Effects that these data cannot tell apart share a `class_id`.
    classes : the members of each class, their correlation `rho` with the best one, and in words
        the input that would separate them best ("" if none would, or none was looked for).
    closed : what the chosen effects do on data that took no part in choosing them, a row for each
        `horizon`: rows ahead of a filtered state ("10"), a window of them ("1 to 50"), or the "free
        run" from the first row on. `rmse_before`, `rmse_after`, the `share` of the error that is
        gone with a 95% interval `low`, `high`, and the gain in log predictive density a row,
        `nats_per_sample`. The first row has besides the one-step share F of the reference model's
        gain, with a 95% interval (infinite ends where the data do not bound it; F NaN where there
        is no measurable gap), and the parts of that gain, in all, from the mean and from the noise
        distribution; its `nats_per_sample` are of one row ahead.
    detection : tests of the one-step predictions by observation channel.
    residual_map : standardised smoothed score by equation and window of time.
    free_run : the data, and the models run without seeing them, before and after (NaN if there is
        no after), with 95% bands.
    not_applicable : parts that do not apply to this model, the equation ("" if all), and why.
    missing : estimated curve of what is missing over a state, input or time, with a 95% band.
    formula : where the verdict is "none of these", the terms of the formula that comes nearest to
        what is missing, a suggestion: the increment of the equation's mean a row is the sum of
        coefficient times term. `share` is that of the curves' gain which all of them have.
    probabilities : who is taken for whom, a row for each pair of the leading effects: in which
        share of the data sets simulated with `effect` on the same inputs, to which all of them were
        fitted, `named` came first; by how many nats `effect` lies `behind` the best in the data,
        and the `cut`, by how many it does at most in 95 of 100 of its own sets. None where there is
        one leading effect, or a model calls a simulator.
    signals : what was tried, best first: the expected log-likelihood ratio of each in `nats`, or a
        `note` why it has none. None if nothing was tried.
    experiment : inputs under which a further record is expected to tell the first class apart, to
        be run on the machine: one row for each of the longest record, its labels in `time` if it
        has any. None if there is no such class, or no signal within the recorded range would do.
        `ssm.simulate(model, values, inputs=report.experiment)` takes it.
    separation : how far the members of the first class come apart: `recorded`, the expected
        log-likelihood ratio in nats of the hardest pair with the recorded inputs, `best`, the
        signal with the largest one and its `nats`, `needed` (5.4), `runs` of the experiment that
        these take, and `times_as_many` records of the recorded kind. None if it was not looked for.
    model, model_text : the model with the chosen effects added, and its file; None and "" if
        nothing was chosen.
    chosen : labels of the chosen effects: the effect's name, or "<effect> on <equation>" where
        that effect was tried on several equations.
    leading : for each effect that the verdict names, its `row` in `causes`, and form, sign,
        estimate and se in the model with all of them; or `row` and `unfitted` for one that the
        screen found and that could not be fitted.
    attributes : of a model that calls a physics engine, "effect in equation" -> which attribute of
        the engine's own file would carry it, and at what value.
    estimates : {"before": {parameter: (value, standard error)}, "after": ...}; error 0 if fixed.
        "simulation" has those with which the augmented model simulates many rows ahead best, where
        they are others, without errors.
    parts : {"screen": (first, last), "confirm": ...}, row labels of the rows that were used, or
        {"cross-fitting": number of blocks}; any further entry is text, such as "choice".
    notes : what has to be known before the figures are used.
    settings : the arguments used; of these the words use `alpha`, `candidates` (number tried),
        `model` (name), `samples`, `seed`, `experiment` (whose rows `parts` tells, of several).
    seconds, mode, interrupted : run time; "full" or "fast" (which stops after the screen); whether
        it was interrupted, and only the stages done before are here.
    failures : the parts that an error ended, while the rest went on: see `left_out`.
    """

    def __str__(self) -> str:
        return report_text(self)

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return report_html(self)

    def plot(self) -> Any:
        """Draw the residual map, the ranked effects, the missing term and the free run.

        Returns
        -------
        Figure : of Matplotlib.
        """
        return plot(self)

    def save(self, folder: str | os.PathLike[str]) -> Path:
        """Write the tables (CSV), the plots (PNG), the model file and the page to a folder.

        Parameters
        ----------
        folder : made where there is none.

        Returns
        -------
        Path : of the page, `index.html`.
        """
        return save(self, folder)
