"""The results of the stages turned into the report."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ssmppl.data import Experiment
from ssmppl.diagnosis.effects.candidate import Candidate
from ssmppl.diagnosis.heldout.gain_ratio import HeldOutGain
from ssmppl.diagnosis.heldout.parts import Parts
from ssmppl.diagnosis.model.augment import augment
from ssmppl.diagnosis.report import tables
from ssmppl.diagnosis.report.findings import tabulate
from ssmppl.diagnosis.report.model_file import model_text, to_model
from ssmppl.diagnosis.report.report import GapReport
from ssmppl.diagnosis.report.words import CURVES
from ssmppl.diagnosis.run.failures import Failures
from ssmppl.diagnosis.screening.detection import Statistics, detection
from ssmppl.diagnosis.screening.screen import Screen
from ssmppl.diagnosis.selection.attribution import Attribution
from ssmppl.diagnosis.selection.equivalence import Classes, equivalence_classes, group_leaders
from ssmppl.diagnosis.selection.fit import Fit, Fitter, bounds_note
from ssmppl.diagnosis.selection.refit import Refit, standard_errors
from ssmppl.errors import SSMError
from ssmppl.language.model.model import Model
from ssmppl.language.model.trace import Trace

CLEARLY = 2.0  # standard errors
MATTERS = 0.15  # share of the gap that the catalogue must leave before it is "none of these"
LEFT = 0.2  # of alpha, for what the catalogue leaves where no held-out rows validate it
UNLIKE, NOTHING = "none of these", "no measurable gap"


@dataclass
class Results:
    """The results of the stages so far. attribution, held_out : None where not done.

    blocks : left out in turn, 0 for three parts. separating : by class, the input that would
    separate it.
    """

    trace: Trace
    experiments: Sequence[Experiment]
    parts: Parts | None
    mode: str
    alpha: float
    base: Fitter
    fit: Fit
    screen: Screen
    settings: dict[str, Any]
    notes: list[str]
    attribution: Attribution | None = None
    held_out: HeldOutGain | None = None
    blocks: int = 0
    separating: dict[int, str] = field(default_factory=dict)
    interrupted: bool = False
    failures: Failures = field(default_factory=Failures)

    @property
    def refits(self) -> list[Refit]:
        return self.attribution.refits if self.attribution else []

    @property
    def chosen(self) -> Refit | None:
        return self.attribution.chosen if self.attribution else None

    @property
    def names(self) -> list[str]:
        """Labels of the chosen effects."""
        offered = self.screen.design.candidates
        return labels(self.chosen.candidates, offered) if self.chosen else []

    @property
    def label(self) -> str:
        """What the share that is closed is about."""
        return " + ".join(self.names) if self.chosen else CURVES

    @property
    def unfitted(self) -> int | None:
        """Column of the effect that the verdict rests on, though it was not refitted."""
        return self.attribution.unfitted if self.attribution else None

    @property
    def screened(self) -> bool:
        """Whether the screen was run at the model's fit as it is known now."""
        return not (self.attribution and self.attribution.rebased)

    @property
    def tested(self) -> dict[int, float] | None:
        """p of the refits that were tested themselves, by column; None if none was to be."""
        return self.attribution.p if self.attribution else None

    def classes(self) -> tuple[list[int], Classes]:
        """The leading shapes of all groups, best first, and their classes."""
        order = group_leaders(self.screen, self.refits)
        return order, equivalence_classes(self.screen, self.refits, order)


def build_report(r: Results, seconds: float) -> GapReport:
    """The report of what is done; a table that an error ends is empty, and said to be left out."""
    screen, notes = r.screen, list(r.notes)

    def table(name: str, make: Callable[[], Any], nothing: Any = None) -> Any:
        with r.failures.part(f"the table {name!r}"):
            return make()
        return tabulate(name) if nothing is None else nothing

    where = table("where", lambda: tables.where_table(screen, r.alpha)[0])
    checks = table("detection", lambda: _detection(screen))
    order, found = table("classes", r.classes, ([], None))
    verdict, missing = _revised(r, *_verdict(r, where), where, checks)
    share, runs = tabulate("closed"), None
    if r.attribution:
        notes += r.attribution.notes
        notes += filter(None, [_bound(r)])
    if r.held_out is not None:
        notes += r.held_out.notes
        runs = (r.held_out.before, r.held_out.after)
        share = tabulate("closed", r.held_out.rows)
    augmented, text = None, ""
    estimates: dict[str, Any] = {"before": _estimates(r.base, r.fit)}
    if r.chosen is not None and verdict == "effect":
        values = _estimates(r.chosen.fitter, r.chosen.fit)
        own = augment(r.trace, list(r.chosen.candidates)).parameter_symbols
        estimates["after"] = {repr(s): values[repr(s)] for s in own}
        augmented, text = _written(r, r.chosen, notes)
    free = tabulate("free_run")
    if runs is not None:
        channels = [repr(s) for s in r.trace.observation_symbols]
        free = table("free_run", lambda: tables.run_table(r.experiments, channels, *runs))
    causes, classes = tabulate("causes"), tabulate("classes")
    leading: list[dict[str, Any]] = []
    if found is not None:
        causes = table("causes", lambda: tables.causes_table(
            screen, r.refits, found, order, r.tested, r.screened))  # fmt: skip
        classes = table("classes", lambda: tables.classes_table(
            screen, found, order, r.separating))  # fmt: skip
        if len(causes) and (text or r.unfitted is not None):
            leading = table("leading", lambda: _leading(r, order), leading)
    initial_law = next(
        (x.fitter.initial_law for x in [*r.refits, r.chosen] if x and x.fitter.initial_law), None
    )
    if initial_law:
        notes.append(f"only linear Gaussian models can start flat: others start with {initial_law}")
    return GapReport(
        verdict=verdict, where=where, causes=causes, classes=classes, closed=share,
        detection=checks, residual_map=table("residual_map", lambda: tables.map_table(screen)),
        free_run=free, not_applicable=_not_applicable(screen), missing=missing,
        model=augmented, model_text=text, chosen=r.names if text else [], estimates=estimates,
        leading=leading, parts=_parts(r), notes=notes,
        settings={**r.settings, "candidates": len(set(screen.groups.tolist())),
                  "shapes": len(screen.design.candidates),
                  "samples": sum(e.steps for e in r.experiments), "simulated sets": screen.sets,
                  "experiment": _longest(r.experiments) + 1 if len(r.experiments) > 1 else ""},
        seconds=seconds, mode=r.mode, interrupted=r.interrupted, failures=r.failures,
    )  # fmt: skip


def _stands_out(alpha: float, *found: Any) -> bool:
    """Whether a place or a check of the predictions is more than chance: then there is a gap."""
    return any(len(t) > 0 and float(np.nanmin(t["p"], initial=1.0)) <= alpha for t in found)


def _bound(r: Results) -> str:
    """A note on parameters of the chosen model that ran to a bound of their support."""
    if r.chosen is None:
        return ""
    names = " and ".join(r.names)
    return bounds_note(r.chosen.fit.bounds, r.chosen.fit.values(), f"the fit with {names}")


def labels(candidates: Sequence[Candidate], offered: Sequence[Candidate]) -> list[str]:
    """Names of effects, with their equations where one of that name is offered for several."""
    places: dict[str, set[str]] = {}
    for c in (*offered, *candidates):
        places.setdefault(c.effect.name, set()).add(c.equation)
    return [c.effect.name if len(places[c.effect.name]) == 1
            else f"{c.effect.name} on {c.equation}" for c in candidates]  # fmt: skip


def _leading(r: Results, order: Sequence[int]) -> list[dict[str, Any]]:
    """The chosen effects: their rows in `causes`, and what the model with all of them says; or the
    one that stands out and could not be refitted."""
    chosen, offered = r.chosen, r.screen.design.candidates
    groups = [offered[k].group for k in order]
    if r.unfitted is not None:
        return [{"row": groups.index(offered[r.unfitted].group), "unfitted": True}]
    if chosen is None:
        return []
    return [
        {"row": groups.index(c.group), **tables.estimated_strength(r.screen, chosen, c)}
        for c in chosen.candidates
        if c.group in groups
    ]


def _verdict(r: Results, where: Any) -> tuple[str, Any]:
    """The verdict but for whether a gap can be measured at all, and the missing curve."""
    least = float(np.min(r.screen.family.p, initial=1.0))
    refitted = r.attribution is not None and r.mode == "full" and r.unfitted is None
    if r.held_out is not None and _curves_beat(r.held_out, r.chosen is not None):
        best = r.chosen or (r.refits[0] if r.refits else None)
        tried = list(best.candidates) if best else []
        residual, key = tables.residual_group(r.screen, tried)
        if residual <= r.alpha and key is not None:
            return UNLIKE, _curve(r, key, tried)
    if r.chosen is not None or (least <= r.alpha and not refitted):
        return _effect(r, where)
    if not refitted:  # nothing is held out: what all of the catalogue leaves
        tried = tables.testable_candidates(r.screen)
        residual, key = tables.residual_group(r.screen, tried)
        if residual <= LEFT * r.alpha and key is not None:
            return UNLIKE, _curve(r, key, tried)
    return NOTHING, None


def _revised(r: Results, verdict: str, missing: Any, where: Any, checks: Any) -> tuple[str, Any]:
    """The verdict in the light of the gain on held-out rows and of what else stands out."""
    rows = r.held_out.rows if r.held_out else []
    # Few held-out rows leave the share open where the test of the effect does not; what gains
    # nothing on them was chance, and what curves gain beyond it is as open.
    if rows and not r.blocks and not np.isfinite(rows[0]["F"]):
        if rows[0]["nats_per_sample"] <= 0.0 or (verdict == UNLIKE and r.chosen is None):
            verdict, missing = NOTHING, None
        elif verdict == UNLIKE:
            verdict, missing = _effect(r, where)
    if verdict == NOTHING and not r.screened:  # they are of a fit that was not the best one
        where["p"], checks["p"] = np.nan, np.nan
    elif verdict == NOTHING and _stands_out(r.alpha, where, checks):
        verdict, missing = UNLIKE, _curve_of(r, where)
    return verdict, missing


def _effect(r: Results, where: Any) -> tuple[str, Any]:
    """The verdict "effect", with the curve of the equation where most is missing."""
    return "effect", _curve_of(r, where)


def _curve_of(r: Results, where: Any) -> Any:
    """The curve of the equation where most is missing, if that is in its mean."""
    head = where.iloc[0] if len(where) else None
    if head is not None and head["moment"] == "mean":
        return _curve(r, (head["equation"], "mean"), ())
    return None


def _curves_beat(far: HeldOutGain, chosen: bool) -> bool:
    """Whether smooth curves predict the held-out rows better than the best of the catalogue: more
    than chance explains, and, where effects were chosen, by more than a trifle of the gap."""
    if (
        far.beyond_catalogue is None
        or not far.beyond_catalogue.nats > CLEARLY * far.beyond_catalogue.error
    ):
        return False
    share = float(far.rows[0]["F"]) if chosen and far.rows else np.nan
    return not share > 1.0 - MATTERS


def _curve(r: Results, key: tuple[str, str], others: Sequence[Candidate]) -> Any:
    """The estimated curve of a mean; None of other moments, and where an error ended it."""
    with r.failures.part("the table 'missing'"):
        return tables.missing_table(r.screen, key, others) if key[1] == "mean" else None
    return None


def _detection(screen: Screen) -> Any:
    names = screen.design.detection_names(screen.experiments)
    found = detection(
        Statistics(names.names, screen.observed.detection, names.quadratic),
        screen.simulated.detection, screen.observed.nuisance, screen.simulated.nuisance,
    )  # fmt: skip
    found["p"] = tables.bonferroni(found["p"])
    return found


def _written(r: Results, chosen: Refit, notes: list[str]) -> tuple[Model | None, str]:
    names = " and ".join(r.names)
    try:
        added = augment(r.trace, list(chosen.candidates))
        if chosen.fitter.initial_law:
            added = chosen.fitter.initial_law.applied_to(added)
        values = {n: v for n, v in chosen.fit.values().items() if n.split("[")[0] in
                  added.parameters}  # fmt: skip
        text = model_text(
            added, title=f"{r.trace.name} with {names}",
            notes=["Fitted values:", *(f"{n} = {v:.6g}" for n, v in values.items())],
        )  # fmt: skip
        return to_model(added), text
    except SSMError as error:
        notes.append(f"the augmented model is not written: {error.found}")
    except Exception as error:
        r.failures.record("the augmented model", error)
    return None, ""


def _estimates(fitter: Fitter, fit: Fit) -> dict[str, tuple[float, float]]:
    errors = standard_errors(fit, fitter.fixed)
    return {n: (v, errors[n]) for n, v in fit.values().items()}


def _not_applicable(screen: Screen) -> Any:
    return tabulate("not_applicable", [
        {"part": f"{r.effect}{f' ({r.form})' if r.form else ''}", "equation": r.equation,
         "reason": r.reason}
        for r in screen.design.refused
    ])  # fmt: skip


def _parts(r: Results) -> dict[str, Any]:
    """What the rows were used for; those of the longest experiment stand for all."""
    i = _longest(r.experiments)
    e, measured = r.experiments[i], r.held_out is not None and bool(r.held_out.rows)
    blocks = {"cross-fitting": r.blocks} if r.blocks and measured else {}
    if r.parts is None:
        return blocks or {"screen": _span(e, 0, None)}
    out: dict[str, Any] = {"screen": _span(e, 0, r.parts.second[i]), **blocks}
    rows = np.flatnonzero(r.parts.held_out[i])
    if measured and not blocks and len(rows):
        out["confirm"] = _span(e, int(rows[0]), int(rows[-1]) + 1)
    if r.attribution and r.attribution.left_out:
        out["choice"] = "that fewer effects were kept than fitted best was decided on held-out rows"
    return out


def _longest(experiments: Sequence[Experiment]) -> int:
    return int(np.argmax([e.steps for e in experiments]))


def _span(e: Experiment, a: int, b: int | None) -> tuple[Any, Any]:
    labels = list(e.time) if e.time is not None else list(range(1, e.steps + 1))
    return labels[a], labels[(b or e.steps) - 1]
