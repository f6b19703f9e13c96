"""The tables of a report, from the results of the stages."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ssmppl.data import Experiment
from ssmppl.data.channels import column_names
from ssmppl.data.time_steps import lengths
from ssmppl.diagnosis.effects.candidate import (
    Candidate,
    is_dated,
    is_pulse,
    shape_text,
    starts_of,
)
from ssmppl.diagnosis.experiment.design import Separation
from ssmppl.diagnosis.experiment.recovery import Recovery
from ssmppl.diagnosis.heldout.predictions import FreeRun
from ssmppl.diagnosis.model.basis import WHERE
from ssmppl.diagnosis.report.findings import tabulate
from ssmppl.diagnosis.screening.location import BasisGroupScore, curve, localise, regions, when
from ssmppl.diagnosis.screening.nearest_formula import nearest_formula
from ssmppl.diagnosis.screening.screen import Screen
from ssmppl.diagnosis.selection.equivalence import Classes
from ssmppl.diagnosis.selection.refit import Refit
from ssmppl.drawing.numerals import label
from ssmppl.language.model.trace import Trace

if TYPE_CHECKING:
    import pandas as pd

CURVE_POINTS, WAVE_POINTS = 41, 161  # of curves, and of those that go up and down
FIRST = 1  # number of the class of the best
EVEN = 1e-6  # relative, by which the lengths of rows may differ that count as the same
AT_BOUND = 1e-3  # standard errors of the screen, below which a one-sided strength is none
STANDS_OUT = 3.0  # |z| of a region that is named
# Of the error rate, for the places and for the checks of the predictions: with the whole of it for
# the effects, at most 1.4 times as much in all.
SHARED = 0.2


def bonferroni(p: Any) -> Any:
    """p of the places, or of the checks, with what else is looked at counted (Bonferroni)."""
    return np.minimum(1.0, np.asarray(p, dtype=float) / SHARED)


def where_table(screen: Screen, alpha: float) -> tuple[pd.DataFrame, dict[Any, BasisGroupScore]]:
    """Equation, moment, stretch of time and region of each group of the basis; by p
    (`bonferroni`)."""
    observed, nuisance = screen.observed, screen.simulated.nuisance
    columns, terms = screen.simulated.basis, screen.design.terms
    places: dict[tuple[str, str, str], list[int]] = {}
    for i, t in enumerate(terms):
        places.setdefault((t.equation, t.moment, t.series), []).append(i)
    if not places:
        return tabulate("where"), {}
    groups: dict[Hashable, Any] = {k: (columns[:, p], observed.basis[p]) for k, p in places.items()}
    table, found = localise(groups, nuisance, observed.nuisance, {k: k[:2] for k in places})
    starts, edges = starts_of(screen.experiments), screen.edges
    labels = _labels(screen.experiments)
    bins, own = screen.simulated.basis_bins, screen.simulated.nuisance_bins
    rows = []
    for row in table.itertuples():
        key, p = row.key, float(bonferroni(row.p_either))
        stretch = (0, len(labels))
        if p <= alpha and len(edges) > 3:
            at = when(
                screen.basis_group(places[key]), bins[:, :, places[key]],
                observed.basis_bins[:, places[key]], own, observed.nuisance_bins, edges,
                alpha=alpha,
            )  # fmt: skip
            stretch = (at.first, at.last)
        rows.append({
            "equation": key[0], "moment": key[1], "t_from": labels[stretch[0]],
            "t_to": labels[stretch[1] - 1], "z": max(row.z, row.z_alone), "p": p,
            "region": _region(screen, places[key]) if p <= alpha else "",
            "experiment": _experiments(starts, *stretch),
        })  # fmt: skip
    rows.sort(key=lambda r: (r["p"], -r["z"]))
    first = {(r["equation"], r["moment"]): r for r in reversed(rows)}
    return tabulate("where", [r for r in rows if first[r["equation"], r["moment"]] is r]), found


def _labels(experiments: Sequence[Experiment]) -> list[Any]:
    """A label for each row: its time, else its number in its experiment."""
    out: list[Any] = []
    for e in experiments:
        out += list(e.time) if e.time is not None else list(range(1, e.steps + 1))
    return out


def _experiments(starts: Sequence[int], first: int, last: int) -> str:
    """Whose the rows first <= t < last are: "2", "1 to 3"; "" where there is one experiment."""
    if len(starts) < 2:
        return ""
    a, b = (int(np.searchsorted(starts, row, side="right")) for row in (first, last - 1))
    return str(a) if a == b else f"{a} to {b}"


def _region(screen: Screen, places: list[int]) -> str:
    """Where the strongest of the variables shows the gap most, in words."""
    terms, best = screen.design.terms, None
    for variable in dict.fromkeys(terms[i].variable for i in places):
        own = [i for i in places if terms[i].variable == variable]
        group = screen.basis_group(own)
        if best is None or group.z > best[0].z:
            best = group, variable, own
    if best is None:
        return ""
    group, variable, own = best
    if not terms[own[0]].is_curve:
        return f"with {variable}"
    values = screen.design.grid(variable)
    table = regions(group, [terms[i].at for i in own], values, variable)
    row = table.iloc[int(np.argmax(np.abs(table["z"].to_numpy())))]
    return f"where {row['region']}" if abs(row["z"]) >= STANDS_OUT else f"over {variable}"


def missing_table(
    screen: Screen, key: tuple[str, str], others: Sequence[Candidate]
) -> pd.DataFrame:
    """The estimated missing curve of the mean over each variable of an equation; before them a
    Fourier series, where that says more than any of them.

    others : candidates that are projected out.
    """
    terms, rows = screen.design.terms, []
    places: dict[tuple[str, str], list[int]] = {}
    for i, t in enumerate(terms):
        if (t.equation, t.moment) == key and (t.is_curve or t.series):
            places.setdefault((t.series, t.over or t.variable), []).append(i)
    groups = {k: screen.basis_group(own, others) for k, own in places.items()}
    best = max(groups, key=lambda k: groups[k].z, default=("", ""))
    shown = [k for k in groups if k == best or not (k[0] or (best[0] and k[1] == best[1]))]
    for series, variable in sorted(shown, key=lambda k: not k[0]):
        own, group = places[series, variable], groups[series, variable]
        values = screen.design.grid(variable.partition(WHERE)[0])
        low_end, high_end = np.quantile(values, (0.02, 0.98))
        points = WAVE_POINTS if series else CURVE_POINTS
        grid = np.linspace(float(low_end), float(high_end), points)
        design = np.stack([np.asarray(terms[i].at(grid)) for i in own], axis=1)
        found = curve(group, design)
        for x, e, low, high in zip(grid, found.estimate, found.low, found.high, strict=True):
            rows.append({"equation": key[0], "variable": variable, "value": x, "estimate": e,
                         "low": low, "high": high})  # fmt: skip
    return tabulate("missing", rows)


def formula_table(
    screen: Screen, key: tuple[str, str], others: Sequence[Candidate]
) -> pd.DataFrame | None:
    """The nearest formula of the missing term, a row for each of its terms; None where no formula
    comes near.

    others : candidates that are projected out.
    """
    found = nearest_formula(screen, key, others)
    if found is None:
        return None
    each = zip(found.terms, found.coefficients, found.errors, strict=True)
    return tabulate("formula", [
        {"equation": found.equation, "term": term, "coefficient": value, "se": error,
         "share": found.share}
        for term, value, error in each
    ])  # fmt: skip


def causes_table(
    screen: Screen, refits: Sequence[Refit], found: Classes, order: Sequence[int],
    tested: Mapping[int, float] | None, screen_is_current: bool = True,
) -> pd.DataFrame:  # fmt: skip
    """One row for each group of candidates, the refitted ones first; pairs are not listed.

    tested : p of refits whose own gain was tested, by column; None where no refit was to be tested.
    With two tests p is twice the smaller one (Bonferroni). screen_is_current : whether the
    screen's own p holds; else what was not tested has none.
    """
    tests, tested = (1, {}) if tested is None else (2, tested)
    by_head = {r.index[0]: r for r in refits if len(r.index) == 1}
    significant = screen.candidate_p
    rows = []
    for i, k in enumerate(order):
        c, s = screen.design.candidates[k], screen.efficient
        own = by_head.get(k)
        sided = screen.design.sided[k]
        strength = float(s.strength[k])
        error = 1.0 / np.sqrt(s.variance[k]) if s.variance[k] > 0.0 else np.nan
        if screen.design.quadratic[k]:  # the estimate is of its square
            strength = float(np.sqrt(max(strength, 0.0)))
            error = error / (2.0 * strength) if strength > 0.0 else np.sqrt(error)
        if own is not None:
            estimate = estimated_strength(screen, own, own.candidates[0], error)
        elif sided * strength < 0.0:  # the screen knows no bounds
            estimate = _strength_row(screen, c, 0.0, np.nan)
        else:
            estimate = _strength_row(screen, c, strength, error)
        p = tested.get(k, np.nan)
        if screen_is_current:
            p = min(float(significant[k]), tested.get(k, 1.0))
        rows.append({
            "effect": c.effect.name, "equation": c.place, "kind": c.effect.cause,
            "z": float(s.z[k]),
            "p": float(np.minimum(1.0, tests * p)),
            "gain_screen": float(s.gain[k]), "gain_refit": own.gain if own else np.nan,
            "class_id": int(found.class_id[i]), **estimate,
        })  # fmt: skip
    return tabulate("causes", rows)


def estimated_strength(
    screen: Screen, refit: Refit, c: Candidate, error: float = np.nan
) -> dict[str, Any]:
    """Form, sign, estimate and se of one of a refit's effects, whose shape need not be among those
    that the screen tried. error : of the strength by the screen, about, where it is known."""
    strengths = {own.strength: v for own, v in zip(refit.candidates, refit.strengths, strict=True)}
    strength = strengths[c.strength]
    at_bound = c.strength in refit.bounds
    if at_bound and np.isfinite(c.effect.upper) and strength > 0.5 * c.effect.upper:
        return _strength_row(screen, c, strength, np.nan)
    if c.sided and (abs(strength) < AT_BOUND * error or at_bound):
        return _strength_row(screen, c, 0.0, np.nan)  # the search runs towards the bound for ever
    return _strength_row(screen, c, strength, refit.errors[c.strength])


def _strength_row(screen: Screen, c: Candidate, strength: float, error: float) -> dict[str, Any]:
    times = [e.time for e in screen.experiments]
    shape = ", ".join(f"{n} = {shape_text(v)}{_when(c, n, v, times)}" for n, v in c.shape)
    return {
        "form": ", ".join(filter(None, [c.form, shape])),
        "sign": "one-sided" if c.sided else ("+" if strength > 0 else "-"),
        "estimate": float(strength), "se": float(error),
        "rate": float(strength / length_of_row(screen)) if _is_increment(c) else np.nan,
    }  # fmt: skip


def length_of_row(screen: Screen) -> float:
    """The model's time step, where it declares one and all rows have the same; else NaN."""
    step = screen.design.trace.time_step
    if step is None:
        return np.nan
    found = np.concatenate([e.inputs[step[0]][: max(e.steps - 1, 1)] for e in screen.experiments])
    even = found.min() > 0.0 and np.ptp(found) <= EVEN * found.min()
    return float(np.median(found)) if even else np.nan


def _is_increment(c: Candidate) -> bool:
    """Whether its strength is what it adds to a state in each step, which is a rate over time."""
    each = c.change == "transition" and not c.process and not is_pulse(c) and not c.force
    return each and "second order" not in c.effect.given.values()


def _when(c: Candidate, shape: str, value: float, times: Sequence[Any]) -> str:
    """The label of the row that a date is, if it is the same in all experiments that reach there;
    times : of each, None where its rows have none."""
    if shape != "date" or not is_dated(c) or any(t is None for t in times):
        return ""
    found = {label(t[int(value) - 1]) for t in times if 1 <= value <= len(t)}
    return f" ({found.pop()})" if len(found) == 1 else ""


def classes_table(
    screen: Screen, found: Classes, order: Sequence[int], separation: Separation | None
) -> pd.DataFrame:
    """The members of each class, the leader first; an effect that is a class by itself, too.

    separation : of the first class, None where it was not looked for.
    """
    rows, best = [], separation.best if separation and separation.runs else None
    for number in dict.fromkeys(found.class_id.tolist()):
        members = found.members(number)
        for m in members:
            c = screen.design.candidates[order[m]]
            rows.append({
                "class_id": int(number), "effect": c.effect.name, "equation": c.place,
                "rho": float(found.rho[m]),
                "separating_input": best.signal.words if best and number == FIRST else "",
            })  # fmt: skip
    return tabulate("classes", rows)


def probabilities_table(screen: Screen, found: Recovery) -> pd.DataFrame:
    """Each pair of leading effects: how often the second is the best in data of the first."""
    offered = [screen.design.candidates[k] for k in found.columns]
    named, behind, cuts = found.named, found.behind, found.cuts
    return tabulate("probabilities", [
        {"effect": c.effect.name, "form": c.form, "equation": c.place, "named": d.effect.name,
         "named_form": d.form, "named_equation": d.place, "probability": float(named[i, j]),
         "behind": float(behind[i]), "cut": float(cuts[i])}
        for i, c in enumerate(offered) for j, d in enumerate(offered)
    ])  # fmt: skip


def signals_table(separation: Separation) -> pd.DataFrame | None:
    """The signals that were tried, best first, behind the recorded inputs; None where no other was
    needed, or there was nothing to vary."""
    if not separation.tried:
        return None
    rows = [{"signal": "as recorded", "input": "", "nats": separation.recorded, "note": ""}]
    rows += [{"signal": t.signal.words, "input": t.input, "nats": t.nats, "note": t.note}
             for t in separation.tried]  # fmt: skip
    return tabulate("signals", rows)


def experiment_table(
    trace: Trace, experiments: Sequence[Experiment], separation: Separation
) -> pd.DataFrame | None:
    """The inputs of the best experiment under the names that data sets have, with the labels of the
    longest record; None where there is no such experiment."""
    import pandas as pd

    if separation.inputs is None:
        return None
    longest = max(experiments, key=lambda e: e.steps)
    step, columns = "", {} if longest.time is None else {"time": longest.time}
    if trace.time_step is not None and longest.time is not None:
        name, unit = trace.time_step
        step = name * np.array_equal(lengths(longest.time, unit), longest.inputs[name][:-1])
    for k, symbol in enumerate(trace.input_symbols):
        _, name, index = symbol.data
        if name != step:  # it follows from the labels
            columns[column_names(name, index)[0] if index else name] = separation.inputs[:, k]
    return pd.DataFrame(columns)


def map_table(screen: Screen) -> pd.DataFrame:
    """Standardised smoothed scores of each equation's linear term by window of time."""
    terms = screen.design.terms
    starts, edges = starts_of(screen.experiments), screen.edges
    labels, rows = _labels(screen.experiments), []
    null, seen = screen.simulated.basis_bins, screen.observed.basis_bins
    for equation in dict.fromkeys(t.equation for t in terms if t.moment == "mean"):
        own = [i for i, t in enumerate(terms) if t.equation == equation and t.moment == "mean"]
        spread = null[:, :, own].std(axis=0)
        z = np.divide(seen[:, own], spread, out=np.zeros_like(spread), where=spread > 0.0)
        strongest = np.argmax(np.abs(z).sum(axis=0))
        for j in range(len(edges) - 1):
            rows.append({
                "equation": equation, "t_from": labels[edges[j]],
                "t_to": labels[edges[j + 1] - 1], "z": float(z[j, strongest]),
                "experiment": _experiments(starts, edges[j], edges[j + 1]),
            })  # fmt: skip
    return tabulate("residual_map", rows)


def run_table(
    experiments: Sequence[Experiment], channels: Sequence[str], before: Sequence[FreeRun],
    after: Sequence[FreeRun] | None,
) -> pd.DataFrame:  # fmt: skip
    """The data beside free runs of the model before and after."""
    import pandas as pd

    frames = []
    for n, e in enumerate(experiments):
        labels = e.time if e.time is not None else np.arange(1, e.steps + 1)
        for k, channel in enumerate(channels):
            nothing = np.full(e.steps, np.nan)
            b, a = before[n], after[n] if after is not None else None
            frames.append(pd.DataFrame({
                "experiment": n + 1, "t": labels, "channel": channel,
                "observed": np.where(e.seen[:, k] == 1.0, e.y[:, k], np.nan),
                "before": b.mean[:, k], "before_low": b.low[:, k], "before_high": b.high[:, k],
                "after": a.mean[:, k] if a else nothing,
                "after_low": a.low[:, k] if a else nothing,
                "after_high": a.high[:, k] if a else nothing,
            }))  # fmt: skip
    return pd.concat(frames, ignore_index=True)
