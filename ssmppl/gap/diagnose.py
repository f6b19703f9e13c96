"""The verb `diagnose`: where a model differs from data, which effect causes it, how far it closes.

The stages are fit, screen, refit and confirm; each has a module of its own.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from concurrent.futures import Executor
from typing import Any

import numpy as np

from ssmppl.data import check_values, unpack_parameters
from ssmppl.errors import ArgumentError, listing
from ssmppl.gap import tables
from ssmppl.gap.augment import augment
from ssmppl.gap.candidate import Candidate
from ssmppl.gap.candidates import Chosen
from ssmppl.gap.classes import Classes, classes
from ssmppl.gap.detect import detection
from ssmppl.gap.familywise import threshold
from ssmppl.gap.fit import Fit, Fitter
from ssmppl.gap.parts import Parts, long_enough, three_parts
from ssmppl.gap.refit import (
    Refit,
    Workshop,
    leading,
    pairs,
    proposal_of,
    refit_all,
    standard_errors,
)
from ssmppl.gap.report import MODES, GapReport, tabulate
from ssmppl.gap.scales import Scales
from ssmppl.gap.screen import Question, Screen, ask
from ssmppl.gap.share import how_far
from ssmppl.gap.smoothing import Settings
from ssmppl.gap.writing import model_text, to_model
from ssmppl.inference.particles.filtering import check_count, random_state, seed_sequence
from ssmppl.inference.problem import pose
from ssmppl.language.model import Model

SETS = {"fast": 100, "full": 200}  # simulated data sets
PARTICLES = {"fast": 500, "full": 1000}
MOST_EFFECTS = 3


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
    checkpoint: Any = None,
    progress: bool = True,
    seed: int | None = 1,
) -> GapReport:
    """Find where a model differs from reality, which unmodelled effect causes it, and how far the
    gap shrinks once that effect is added.

    Parameters
    ----------
    model : the model, as declared. data : mapping of arrays, DataFrame, Dataset, or a list of them.
    effects : names that restrict the catalogue (`ssm.effects.names()`), effects made by
        `@ssm.effect` that join it, or a mapping that renames; None: the whole catalogue.
    mode : "fast" stops after the screen; "full" refits, confirms on held-out rows and writes the
        augmented model.
    alpha : family-wise error rate of every verdict.
    fixed : values of known parameters.
    particles : of the particle filters; None: 500 in fast mode, 1000 in full mode.
    executor : any `concurrent.futures.Executor` that runs in this process; None: threads.
    checkpoint : reserved.
    progress : whether to show the stages, on stderr.
    seed : the same seed gives the same report.

    Returns
    -------
    GapReport

    Raises
    ------
    ModelError, DataError, ArgumentError : what is wrong with model, data or call, and the fix.
    """
    if mode not in MODES:
        raise ArgumentError(f"mode={mode!r}", fix=f"use one of: {listing(str(mode), MODES)}")
    if not 0.0 < alpha < 0.5:
        raise ArgumentError(f"alpha={alpha!r}", fix="give an error rate such as 0.05")
    if particles is not None:
        check_count("particles", particles, 10)
    return _Diagnosis(
        model, data, effects, mode, alpha, fixed, particles, executor, progress, seed
    ).run()


class _Diagnosis:
    """One run, stage by stage."""

    def __init__(
        self, model: Model, data: Any, effects: Chosen, mode: str, alpha: float,
        fixed: Mapping[str, Any] | None, particles: int | None, executor: Executor | None,
        progress: bool, seed: int | None,
    ):  # fmt: skip
        self.began = time.perf_counter()
        self.problem = pose(model, data)
        self.trace = self.problem.trace
        self.experiments = self.problem.experiments
        self.fixed = check_values(self.trace, fixed, argument="fixed")
        self.effects, self.mode, self.alpha = effects, mode, alpha
        self.executor, self.progress = executor, progress
        self.root = seed_sequence(seed)
        number = particles or PARTICLES[mode]
        self.settings = Settings(number, proposal_of(self.problem.program))
        self.workshop = Workshop(
            self.trace, self.problem.program.missing, self.fixed, self.settings
        )
        self.notes: list[str] = []
        self.parts: Parts | None = None
        if mode == "full" and long_enough(self.experiments):
            self.parts = three_parts(self.experiments)

    # -- stages
    def run(self) -> GapReport:
        """All stages, and the report."""
        base = self.workshop.fitter(())
        training = self.parts.screen if self.parts else self.experiments
        fit = base.fit(training, self._seed(1), {})
        self._tell_convergence(fit, "the model")
        scales = self._scales(base, fit, training)
        question = Question(
            self.trace, scales, self.problem.program.missing, tuple(self.fixed), self.settings,
            self.effects,
        )  # fmt: skip
        screen = ask(
            question, training, fit.theta, SETS[self.mode], self._seed(2), self.executor,
            self.progress, "screening",
        )  # fmt: skip
        if self.mode == "fast":
            return self._report(base, fit, screen, [], None)
        return self._attributed(base, fit, screen)

    def _attributed(self, base: Fitter, fit: Fit, screen: Screen) -> GapReport:
        train = self.parts.train if self.parts else self.experiments
        if self.parts:
            fit = base.fit(train, self._seed(3), self._values(fit), searched=True)
        heads = leading(screen)
        refits, failed = refit_all(
            self.workshop, fit, screen, [[k] for k in heads], train, self._seed(4), self.executor,
            self.progress, "refitting",
        )  # fmt: skip
        double, more = refit_all(
            self.workshop, fit, screen, pairs(screen, refits), train, self._seed(5),
            self.executor, self.progress, "refitting pairs",
        )  # fmt: skip
        self.notes += [f"not refitted: {r.reason}" for r in (*failed, *more)]
        needed = 0.5 * threshold(screen.family.maxima, self.alpha) ** 2
        significant = bool(np.min(screen.family.p, initial=1.0) <= self.alpha)
        chosen: Refit | None = refits[0] if refits and significant else None
        if double and chosen and double[0].gain - chosen.gain >= needed:
            chosen = double[0]
        return self._report(base, fit, screen, refits, chosen)

    # -- the report
    def _report(
        self, base: Fitter, fit: Fit, screen: Screen, refits: list[Refit], chosen: Refit | None
    ) -> GapReport:
        where, _ = tables.where_table(screen, self.alpha)
        names = screen.question.detection_names(screen.experiments)
        observed = type(names)(names.names, screen.observed.detection, names.quadratic)
        detected = detection(
            observed, screen.stacked("detection"), screen.observed.nuisance,
            screen.stacked("nuisance"),
        )  # fmt: skip
        order = self._order(screen, refits)
        found = self._classes(screen, refits, order)
        verdict, missing = self._verdict(screen, chosen, where)
        share, runs = tabulate("closed"), None
        labels = self._labels(chosen.candidates) if chosen else []
        label = " + ".join(labels) or "smooth functions of states and inputs"
        if self.mode == "full":
            full = how_far(
                self.workshop, self.parts, self.experiments, (base, fit), screen, chosen,
                label, self._seed(8),
            )  # fmt: skip
            self.notes += full.notes
            if full.rows:
                share, runs = tabulate("closed", full.rows), (full.before, full.after)
                if verdict == "effect" and not np.isfinite(share["F"].iloc[0]):
                    verdict = "no measurable gap"
        augmented, text = None, ""
        estimates: dict[str, Any] = {"before": self._estimates(base, fit)}
        if chosen is not None and verdict == "effect":
            estimates["after"] = self._estimates(chosen.fitter, chosen.fit)
            augmented, text = self._written(chosen)
        free = tabulate("free_run")
        if runs is not None:
            channels = [repr(s) for s in self.trace.observation_symbols]
            free = tables.run_table(self.experiments, channels, *runs)
        return GapReport(
            verdict=verdict, where=where,
            causes=tables.causes_table(screen, refits, found, order),
            classes=tables.classes_table(screen, found, order, {}),
            closed=share, detection=detected, residual_map=tables.map_table(screen),
            free_run=free, not_applicable=self._not_applicable(screen), missing=missing,
            model=augmented, model_text=text, chosen=labels if text else [], estimates=estimates,
            parts=self._parts(), notes=self.notes,
            settings={
                "model": self.trace.name, "alpha": self.alpha, "seed": str(self.root.entropy),
                "candidates": len(screen.question.candidates),
                "samples": sum(e.steps for e in self.experiments),
                "particles": self.settings.particles, "simulated sets": len(screen.null),
            },
            seconds=time.perf_counter() - self.began, mode=self.mode,
        )  # fmt: skip

    def _verdict(self, screen: Screen, chosen: Refit | None, where: Any) -> tuple[str, Any]:
        """The verdict before the held-out rows have spoken, and the missing curve."""
        residual, key = tables.residual_group(screen)
        least = float(np.min(screen.family.p, initial=1.0))
        if least <= self.alpha and (chosen is not None or self.mode == "fast"):
            head = where.iloc[0] if len(where) else None
            if head is not None and head["moment"] == "mean":
                return "effect", tables.missing_table(screen, (head["equation"], "mean"), False)
            return "effect", None
        if residual <= self.alpha and key is not None:
            moment_is_mean = key[1] == "mean"
            return "none of these", (
                tables.missing_table(screen, key, True) if moment_is_mean else None
            )
        return "no measurable gap", None

    # -- small parts
    def _order(self, screen: Screen, refits: list[Refit]) -> list[int]:
        """Heads of the groups: the refitted by their gain, then the others by the screen's."""
        done = [r.index[0] for r in refits if len(r.index) == 1]
        rest = [int(k) for k in screen.family.best if int(k) not in done]
        rest = [k for k in rest if not screen.found.status[k]]
        return done + sorted(rest, key=lambda k: -screen.found.gain[k])

    def _classes(self, screen: Screen, refits: list[Refit], order: list[int]) -> Classes:
        gains = {r.index[0]: r.gain for r in refits if len(r.index) == 1}
        values = [max(gains.get(k, 0.0), 0.0) if gains else screen.found.gain[k] for k in order]
        rho = screen.found.rho[np.ix_(order, order)]
        return classes(rho, np.array(values), screen.found.sided[order])

    def _labels(self, candidates: tuple[Candidate, ...]) -> list[str]:
        names = [c.effect.name for c in candidates]
        return [n if names.count(n) == 1 else f"{n} on {c.equation}"
                for n, c in zip(names, candidates, strict=True)]  # fmt: skip

    def _written(self, chosen: Refit) -> tuple[Model | None, str]:
        trace = augment(self.trace, list(chosen.candidates))
        values = {n: v for n, v in chosen.fit.values().items() if n in trace.parameters}
        notes = [f"{n} = {v:.6g}" for n, v in values.items()]
        try:
            names = " and ".join(self._labels(chosen.candidates))
            text = model_text(
                trace, title=f"{self.trace.name} with {names}", notes=["Fitted values:", *notes]
            )
            return to_model(trace), text
        except ArgumentError as error:
            self.notes.append(f"the augmented model is not written: {error.found}")
            return None, ""

    def _estimates(self, fitter: Fitter, fit: Fit) -> dict[str, tuple[float, float]]:
        errors = standard_errors(fit, fitter.fixed)
        return {n: (v, errors[n]) for n, v in fit.values().items()}

    def _not_applicable(self, screen: Screen) -> Any:
        return tabulate("not_applicable", [
            {"part": f"{r.effect}{f' ({r.form})' if r.form else ''}", "equation": r.equation,
             "reason": r.reason}
            for r in screen.question.refused
        ])  # fmt: skip

    def _parts(self) -> dict[str, Any]:
        if self.parts is None:
            return {"screen": self._span(0, None)}
        first, second = self.parts.first[0], self.parts.second[0]
        return {"screen": self._span(0, first), "choose": self._span(first, second),
                "confirm": self._span(second, None)}  # fmt: skip

    def _span(self, a: int, b: int | None) -> tuple[Any, Any]:
        e = self.experiments[0]
        labels = list(e.time) if e.time is not None else list(range(1, e.steps + 1))
        return labels[a], labels[(b or e.steps) - 1]

    def _scales(self, base: Fitter, fit: Fit, experiments: Any) -> Scales:
        """From filtered states, observations and inputs."""
        states = np.concatenate(
            [base.states(e, fit.theta, random_state(self._seed(11))) for e in experiments]
        )
        y = np.concatenate([np.where(e.seen == 1.0, e.y, np.nan) for e in experiments])
        u = np.concatenate([e.u for e in experiments])
        return Scales.of(self.trace, states, y, u, max(e.steps for e in experiments))

    def _values(self, fit: Fit) -> dict[str, np.ndarray]:
        return unpack_parameters(fit.problem.trace, fit.theta)

    def _tell_convergence(self, fit: Fit, what: str) -> None:
        if not fit.converged:
            self.notes.append(
                f"the fit of {what} did not settle: about {fit.distance:.1f} nats may be left"
            )

    def _seed(self, stage: int) -> np.random.SeedSequence:
        return np.random.SeedSequence(self.root.entropy, spawn_key=(*self.root.spawn_key, stage))
