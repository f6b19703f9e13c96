"""The results of the stages turned into the report."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ssmppl.analysis.structure import simulators
from ssmppl.data import Experiment
from ssmppl.diagnosis.fitting.bounds import bounds_note
from ssmppl.diagnosis.fitting.fit import Fit, Fitter, standard_errors
from ssmppl.diagnosis.model.augment import augment
from ssmppl.diagnosis.report import tables
from ssmppl.diagnosis.report.engine_attributes import attribute_of
from ssmppl.diagnosis.report.findings import tabulate
from ssmppl.diagnosis.report.model_file import model_text, to_model
from ssmppl.diagnosis.report.report import GapReport
from ssmppl.diagnosis.screening.detection import PredictionChecks, detection
from ssmppl.diagnosis.screening.screen import Screen
from ssmppl.diagnosis.selection.refit import Refit
from ssmppl.diagnosis.verdict.decision import Decision, decide
from ssmppl.diagnosis.verdict.results import Results
from ssmppl.diagnosis.verdict.verdicts import EFFECT, NO_GAP, NONE_OF_THESE
from ssmppl.errors import SSMError
from ssmppl.language.model.model import Model
from ssmppl.language.model.trace import Trace

MAX_ATTRIBUTES = 12  # causes whose attribute in an engine's file is looked up


def build_report(r: Results, seconds: float) -> GapReport:
    """The report of what is done; a table that an error ends is empty, and said to be left out."""
    screen, notes = r.screen, list(r.notes)

    def table(name: str, make: Callable[[], Any], nothing: Any = None) -> Any:
        with r.failures.guard(f"the table {name!r}"):
            return make()
        return tabulate(name) if nothing is None else nothing

    where = table("where", lambda: tables.where_table(screen, r.alpha)[0])
    checks = table("detection", lambda: _detection(screen))
    order, found = table("classes", r.classes, ([], None))
    decision = decide(r, where, checks)
    missing, formula = _curve(r, decision), None
    if decision.verdict == NONE_OF_THESE and decision.curve is not None:
        with r.failures.guard("the table 'formula'"):
            formula = tables.formula_table(screen, decision.curve, decision.others)
    if (
        decision.verdict == NO_GAP and not r.screen_is_current
    ):  # they are of a fit that was not the best one
        where["p"], checks["p"] = np.nan, np.nan
    share, runs = tabulate("closed"), None
    if r.selection:
        notes += r.selection.notes
        notes += filter(None, [_bound(r)])
    if r.held_out is not None:
        notes += r.held_out.notes
        runs = (r.held_out.before, r.held_out.after)
        share = tabulate("closed", r.held_out.rows)
    augmented, text = None, ""
    estimates: dict[str, Any] = {"before": _estimates(r.base, r.fit)}
    if r.chosen is not None and decision.verdict == EFFECT:
        values = _estimates(r.chosen.fitter, r.chosen.fit)
        own = augment(r.trace, list(r.chosen.candidates)).parameter_symbols
        estimates["after"] = {repr(s): values[repr(s)] for s in own}
        if r.chosen.simulating and r.chosen.simulating.share < 1.0:
            there = r.chosen.simulator[1].by_component
            estimates["simulation"] = {repr(s): (there[repr(s)], np.nan) for s in own}
        augmented, text = _written(r, r.chosen, notes)
    free = tabulate("free_run")
    if runs is not None:
        channels = [repr(s) for s in r.trace.observation_symbols]
        free = table("free_run", lambda: tables.run_table(r.experiments, channels, *runs))
    causes, classes = tabulate("causes"), tabulate("classes")
    leading: list[dict[str, Any]] = []
    attributes: dict[str, str] = {}
    if found is not None:
        causes = table("causes", lambda: tables.causes_table(
            screen, r.refits, found, order, r.tested, r.screen_is_current))  # fmt: skip
        classes = table("classes", lambda: tables.classes_table(
            screen, found, order, r.separation))  # fmt: skip
        if len(causes) and (text or r.unfitted is not None):
            leading = table("leading", lambda: _leading(r, order), leading)
        attributes = table("attributes", lambda: _attributes(r, order, causes, leading), {})
    signals = experiment = taken = None
    if (recovered := r.recovery) is not None:
        with r.failures.guard("the table 'probabilities'"):
            taken = tables.probabilities_table(screen, recovered)
    if (found_apart := r.separation) is not None:
        with r.failures.guard("the experiment"):
            signals = tables.signals_table(found_apart)
            experiment = tables.experiment_table(r.trace, r.experiments, found_apart)
    initial_law = next(
        (x.fitter.initial_law for x in [*r.refits, r.chosen] if x and x.fitter.initial_law), None
    )
    if initial_law:
        notes.append(
            "a diffuse initial distribution needs a linear Gaussian model: augmented models that "
            f"are not linear Gaussian start with {initial_law}"
        )
    return GapReport(
        verdict=decision.verdict, where=where, causes=causes, classes=classes, closed=share,
        detection=checks, residual_map=table("residual_map", lambda: tables.map_table(screen)),
        free_run=free, not_applicable=_not_applicable(screen), missing=missing,
        formula=formula, probabilities=taken,
        signals=signals, experiment=experiment, separation=r.separation,
        model=augmented, model_text=text, chosen=r.names if text else [], estimates=estimates,
        leading=leading, attributes=attributes, parts=_parts(r),
        notes=list(dict.fromkeys(notes)),
        settings={**r.settings, "candidates": len(set(screen.groups.tolist())),
                  "shapes": len(screen.design.candidates),
                  "samples": sum(e.steps for e in r.experiments), "simulated sets": screen.sets,
                  "experiment": _longest(r.experiments) + 1 if len(r.experiments) > 1 else ""},
        seconds=seconds, mode=r.mode, interrupted=r.interrupted, failures=r.failures,
    )  # fmt: skip


def _bound(r: Results) -> str:
    """A note on parameters of the chosen model that ran to a bound of their support."""
    if r.chosen is None:
        return ""
    names = " and ".join(r.names)
    return bounds_note(r.chosen.fit.bounds, r.chosen.fit.by_component, f"the fit with {names}")


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


def _attributes(
    r: Results, order: Sequence[int], causes: Any, leading: Sequence[dict[str, Any]]
) -> dict[str, str]:
    """ "effect in equation" -> what in the engine's own file would carry it; of those among the
    first rows that are significant."""
    if not simulators(r.trace):
        return {}
    refitted = {refit.index[0]: refit.candidates[0] for refit in r.refits if len(refit.index) == 1}
    strengths = dict(enumerate(causes["estimate"]))
    strengths |= {d["row"]: d["estimate"] for d in leading if "estimate" in d}
    out = {}
    for i, k in enumerate(order[: min(len(causes), MAX_ATTRIBUTES)]):
        named = i in {d["row"] for d in leading} or float(causes["p"].iloc[i]) <= r.alpha
        if not named:
            continue
        c = refitted.get(k, r.screen.design.candidates[k])
        found = attribute_of(r.trace, c, float(strengths[i]))
        if found:
            out[f"{c.effect.name} in {c.place}"] = found
    return out


def _curve(r: Results, decision: Decision) -> Any:
    """The estimated curve that goes with the verdict; None where there is none, or an error ended
    it."""
    if decision.curve is not None:
        with r.failures.guard("the table 'missing'"):
            return tables.missing_table(r.screen, decision.curve, decision.others)
    return None


def _detection(screen: Screen) -> Any:
    names = screen.design.detection_names(screen.experiments)
    found = detection(
        PredictionChecks(names.names, screen.observed.detection, names.quadratic),
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
        lines = _values("Fitted values:", chosen.fit, added)
        if chosen.simulating and chosen.simulating.share < 1.0:
            what = "Values with which it simulates many rows ahead best:"
            lines += ["", *_values(what, chosen.simulator[1], added)]
        text = model_text(
            added, title=f"{r.trace.name} with {names}", notes=lines, added=chosen.candidates
        )
        return to_model(added), text
    except SSMError as error:
        notes.append(f"the augmented model is not written: {error.found}")
    except Exception as error:
        r.failures.record("the augmented model", error)
    return None, ""


def _values(title: str, fit: Fit, added: Trace) -> list[str]:
    """Lines of the values of the model's own parameters."""
    values = fit.by_component.items()
    return [title, *(f"{n} = {v:.6g}" for n, v in values if n.split("[")[0] in added.parameters)]


def _estimates(fitter: Fitter, fit: Fit) -> dict[str, tuple[float, float]]:
    errors = standard_errors(fit, fitter.fixed)
    return {n: (v, errors[n]) for n, v in fit.by_component.items()}


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
    if r.split is None:
        return blocks or {"screen": _span(e, 0, None)}
    out: dict[str, Any] = {"screen": _span(e, 0, r.split.second[i]), **blocks}
    rows = np.flatnonzero(r.split.held_out[i])
    if measured and not blocks and len(rows):
        out["confirm"] = _span(e, int(rows[0]), int(rows[-1]) + 1)
    if r.selection and r.selection.left_out:
        out["choice"] = "the number of effects was reduced by their held-out gain"
    return out


def _longest(experiments: Sequence[Experiment]) -> int:
    return int(np.argmax([e.steps for e in experiments]))


def _span(e: Experiment, a: int, b: int | None) -> tuple[Any, Any]:
    labels = list(e.time) if e.time is not None else list(range(1, e.steps + 1))
    return labels[a], labels[(b or e.steps) - 1]
