"""The results of a report in words, for readers who do not know score tests.

Every function takes the report and gives plain sentences: where the misfit is, which effect is
missing, how much adding it gains, the evidence, and an experiment where these data do not decide.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from ssmppl.diagnosis.effects.effect import MECHANISM, NOISE_LAW, UNKNOWN_INPUT
from ssmppl.diagnosis.experiment.design import ALIKE, OUTSIDE, SURE, Separation
from ssmppl.diagnosis.heldout.simulation import WINDOWED
from ssmppl.diagnosis.model.basis import WHERE
from ssmppl.diagnosis.verdict.verdicts import CURVES, EFFECT, NO_GAP, NONE_OF_THESE
from ssmppl.drawing.numerals import interval, is_number, number, p_text, percent, span, with_error

if TYPE_CHECKING:
    from ssmppl.diagnosis.report.findings import Findings

NAMED_RIVALS = 3
PICTURED = 3.0  # nats a row, up to which a ratio of densities is a picture of them
MOMENTS = {
    "mean": "the mean of",
    "scale": "the noise variance of",
    "tails": "the tails of the noise of",
    "time dependence": "the serial correlation of the noise of",
}

USE = {"screen": "effects were selected on", "confirm": "the held-out gain was evaluated on"}

GLOSSARY = {
    "log-likelihood gain": "the increase of the log-likelihood when the effect is added: 1 nat is "
    "a likelihood ratio of 2.7, 3 nats one of 20, 10 nats one of 22,000",
    "reference model": "the model with the effects and with smooth functions of states and inputs "
    "where they help; its gain in held-out log predictive density over the original model is 100%",
    "p": "the p-value corrected for multiple testing (family-wise): an upper bound on the "
    "probability, if the model were right, that any effect tried is this significant. The p-values "
    "of places and of tests of the predictions are multiplied by five. So the probability that an "
    "effect is named falsely is at most alpha, and that of any false finding at most about 1.4 "
    "alpha (fast mode: 1.6 alpha)",
    "expected log-likelihood ratio": "the log-likelihood of the right effect minus that of the "
    "wrong one fitted to the same record, on average over such records; with 5.4 nats the right "
    "one is ahead in 95% of records",
    "z": "a standardised deviation from what the model expects",
    "±": "one standard error; twice that, either way, is about a 95% interval",
}

# Effects that are something *of* an input, a sensor or a parameter; others act *in* an equation.
OF = ("input", "sensor", "actuator", "parameter", "wrong initial", "backlash", "dead zone")


# -- names
def rows(table: Any) -> list[dict[str, Any]]:
    """The rows of a table as mappings."""
    return [] if table is None else list(table.to_dict("records"))


def label(effect: str, equation: Any = "") -> str:
    """Quadratic drag on v is "quadratic drag in v", sensor bias on y "sensor bias of y"."""
    if not equation or not isinstance(equation, str):
        return str(effect)
    return f"{effect} {'of' if str(effect).lower().startswith(OF) else 'in'} {equation}"


def row_label(row: dict[str, Any]) -> str:
    """`label` of a row of a table."""
    return label(row["effect"], row.get("equation"))


def sentence(text: str) -> str:
    """The first letter large, a full stop at the end; the names in it as they are."""
    text = text.strip()
    text = text[:1].upper() + text[1:]
    return text if not text or text[-1] in ".!?:" else text + "."


def listed(items: list[str], word: str = "and") -> str:
    """a, b and c."""
    if len(items) < 2:
        return "".join(items)
    return f"{', '.join(items[:-1])} {word} {items[-1]}"


def named(report: Findings) -> str:
    """The model, as the subject of a sentence."""
    return f"the model “{report.title}”" if report.title else "the model"


def tried(report: Findings) -> str:
    """How many effects were tried, as "87 effects tried"."""
    count = report.settings.get("candidates") or len(report.causes)
    return f"{count:,} effect{'s' * (count > 1)} tried" if count else "effects tried"


def leaders(report: Findings) -> list[dict[str, Any]]:
    """The rows of `causes` that the verdict is about: the chosen ones, as they are in the model
    with all of them, else a significant best."""
    found = rows(report.causes)
    if report.leading:
        return [{**found[d["row"]], **{k: v for k, v in d.items() if k != "row"}}
                for d in report.leading]  # fmt: skip
    labels = report.chosen or [""]
    return [{"effect": labels[n], "equation": ""} if i is None else found[i]
            for n, i in enumerate(_places(report))]  # fmt: skip


def marked(report: Findings) -> set[int]:
    """Which rows of `causes` the verdict is about."""
    places = [d["row"] for d in report.leading] or _places(report)
    return {i for i in places if i is not None}


def _places(report: Findings) -> list[int | None]:
    """The same by the labels of what was chosen, None where there is no such row; the first where
    nothing was chosen."""
    found = rows(report.causes)
    out: list[int | None] = []
    for name in report.chosen:
        wanted = [f"{r['effect']} on {r['equation']}" == name for r in found]
        if not any(wanted):
            wanted = [r["effect"] == name for r in found]
        fresh = [i for i, same in enumerate(wanted) if same and i not in out]
        out.append(fresh[0] if fresh else None)
    if report.chosen or report.verdict != EFFECT:
        return out
    return [0] if found else []


def rivals(report: Findings, row: dict[str, Any]) -> list[dict[str, Any]]:
    """The rows of `classes` that these data cannot tell from this cause."""
    mine = (row["effect"], row.get("equation"))
    return [
        r
        for r in rows(report.classes)
        if r["class_id"] == row.get("class_id") and (r["effect"], r["equation"]) != mine
    ]


def class_letters(report: Findings) -> dict[Any, str]:
    """A, B, ... for the classes with several members, in the order of `causes`."""
    members: dict[Any, int] = {}
    for r in rows(report.classes):
        members[r["class_id"]] = members.get(r["class_id"], 0) + 1
    order = [*(r["class_id"] for r in rows(report.causes)), *members]
    several = [c for c in dict.fromkeys(order) if members.get(c, 0) > 1]
    return {c: chr(ord("A") + i % 26) * (i // 26 + 1) for i, c in enumerate(several)}


def alternatives(report: Findings, row: dict[str, Any]) -> list[str]:
    """The cause and its rivals, by name, forms of one taken together; many are counted."""
    others = [n for n in dict.fromkeys(map(row_label, rivals(report, row))) if n != row_label(row)]
    if len(others) > NAMED_RIVALS:
        others = [*others[: NAMED_RIVALS - 1], f"{len(others) - NAMED_RIVALS + 1} more"]
    return [row_label(row), *others]


# -- parts of sentences
def share(report: Findings) -> str:
    """The chosen model's share of the reference's gain, with its interval; "" if not measured."""
    closed = rows(report.closed)
    if not closed or not is_number(closed[0]["F"]):
        return ""
    first = closed[0]
    return f"achieves {percent(first['F'])} of the reference model's gain in held-out log " \
           f"predictive density ({interval(first['F_low'], first['F_high'])})"  # fmt: skip


def windows(report: Findings) -> dict[str, Any] | None:
    """The row of `closed` that the report leads with: simulations of a stretch of rows."""
    return next((r for r in rows(report.closed) if WINDOWED in str(r["horizon"])), None)


def simulated(report: Findings) -> str:
    """What the effect does to the error of simulations, with its interval; "" if not measured."""
    r = windows(report)
    if r is None or not all(is_number(r[c]) for c in ("share", "low", "high")):
        return ""
    count = str(r["horizon"]).partition(WINDOWED)[2]
    what = f"the error of simulations over {count} row{'s' * (count != '1')}"
    if r["low"] > 0.0:
        return f"reduces {what} by {percent(r['share'])} ({interval(r['low'], r['high'])})"
    if r["high"] < 0.0:
        ends = interval(-r["high"], -r["low"])
        return f"increases {what} by {percent(-r['share'])} ({ends})"
    return f"does not measurably reduce {what} ({percent(r['share'])}, " \
           f"{interval(r['low'], r['high'])})"  # fmt: skip


def kept_back(report: Findings) -> str:
    """Which data took no part in choosing."""
    if "cross-fitting" in report.parts:
        blocks = report.parts["cross-fitting"]
        return f"in {blocks}-fold blocked cross-validation"
    part = report.parts.get("confirm")
    when = _when(report, part) if isinstance(part, tuple | list) else str(part or "")
    if when and _experiment(report):
        when += " and the corresponding rows of the other experiments"
    own = "on held-out data"
    if "choice" in report.parts:
        own = "on held-out data that were also used to drop one effect"
    return own + (f" ({when})" if when else "")


def _experiment(report: Findings) -> str:
    """Whose rows stand for those of all experiments; "" where there is one."""
    return str(report.settings.get("experiment", ""))


def _when(report: Findings, part: Sequence[Any]) -> str:
    first, last = part
    return span(first, last, _experiment(report))


def significant_rows(report: Findings, table: Any) -> list[dict[str, Any]]:
    """The rows of `where` or `detection` that are more than chance."""
    alpha = report.settings.get("alpha", 0.05)
    return [r for r in rows(table) if is_number(r["p"]) and r["p"] <= alpha]


# -- the answers
def sections(report: Findings) -> list[tuple[str, list[str]]]:
    """The title and the sentences of each section: where, which, the gain, the evidence, and the
    experiment that would decide."""
    return [
        ("Where", where(report)), ("Which", which(report)), ("Gain", how_far(report)),
        ("Evidence", how_sure(report)), ("Experiment", to_decide(report)),
    ]  # fmt: skip


def headline(report: Findings) -> str:
    """The verdict in a sentence or two, with its number and its uncertainty."""
    if report.verdict == NO_GAP:
        return _no_gap(report)
    if report.verdict == NONE_OF_THESE:
        return _none_of_these(report)
    found = leaders(report) or [{"effect": "an unidentified effect", "equation": "", "p": None}]
    groups = [alternatives(report, row) for row in found]
    # Of the gap, whichever effect shows it most: the first in the class may be another one.
    tests = [r["p"] for r in rows(report.causes) if is_number(r["p"])]
    sure = p_text(min(tests, default=found[0].get("p")))
    unfitted = bool(found[0].get("unfitted"))
    if report.mode == "fast" or unfitted:
        text = f"the score tests indicate a missing effect in {named(report)}: " \
               f"{listed(groups[0], 'or')} ({sure}, corrected for {tried(report)})."  # fmt: skip
        text += " They are not distinguishable by these data." * (len(groups[0]) > 1)
        if unfitted:
            return sentence(f"{text} The model with {row_label(found[0])} could not be fitted (see "
                            "the notes), so that its held-out gain is not known")  # fmt: skip
        if mechanism := promising_mechanism(report):
            text += f" That stands for any cause; {mechanism}."
        return sentence(f"{text} The held-out gain has not been measured yet")
    lacks, adding = _lacks(groups)
    text, measured = f"{named(report)} lacks {lacks}", share(report)
    if told := simulated(report):
        own = "" if measured else f" ({sure})"
        rest = sentence(f"{kept_back(report)}, {adding[0].lower()}{adding[1:]} {told}")
        return f"{sentence(text + own)} {rest}"
    if measured:
        return sentence(f"{text}. {adding} {measured}")
    if not rows(report.closed):
        return sentence(f"{text} ({sure}). The held-out gain has not been measured")
    return sentence(
        f"{text} ({sure}), but {kept_back(report)} the gain is too uncertain for a share of the "
        "reference model's gain"
    )


def promising_mechanism(report: Findings) -> str:
    """Where a description leads by its score, which is of any misfit: the mechanism that promises
    most, as a clause; "" where a mechanism leads, or none is significant."""
    if report.mode != "fast" or not (found := leaders(report)):
        return ""
    alpha = report.settings.get("alpha", 0.05)
    sure = [
        r for r in rows(report.causes)
        if r.get("kind") == MECHANISM and is_number(r["p"]) and r["p"] <= alpha
        and is_number(r.get("gain_screen"))
    ]  # fmt: skip
    if found[0].get("kind") not in (UNKNOWN_INPUT, NOISE_LAW) or not sure:
        return ""
    best = max(sure, key=lambda r: r["gain_screen"])
    return (
        f"of the mechanisms tried, {row_label(best)} promises most "
        f"({number(best['gain_screen'], 2)} nats), and only refits, in full mode, decide between "
        "them"
    )


def _lacks(groups: list[list[str]]) -> tuple[str, str]:
    """What is lacking, one group of names for each effect, and what adding it is called."""
    many = len(groups) > 1
    if all(len(g) == 1 for g in groups):
        return listed([g[0] for g in groups]), "Adding them" if many else "Adding it"
    if not many:
        names = listed(groups[0], "or")
        return f"one of these, not distinguishable by these data: {names}", "Adding the first"
    numbered = "; ".join(f"({i}) {listed(g, 'or')}" for i, g in enumerate(groups, start=1))
    text = f"{len(groups)} effects: {numbered} (“or”: not distinguishable by these data)"
    return text, "Adding the first of each"


def _none_of_these(report: Findings) -> str:
    measured = share(report)
    found, failed = (
        significant_rows(report, report.where),
        significant_rows(report, report.detection),
    )
    spot = ""
    if found:
        when = span(found[0]["t_from"], found[0]["t_to"], found[0]["experiment"])
        spot = f" in {place(found[0])}{f', strongest at {when}' if when else ''}" \
               f" ({p_text(found[0]['p'])})"  # fmt: skip
    text = f"{named(report)} is misspecified{spot}; none of the {tried(report)} explains it."
    if failed and not found:
        check = f"{failed[0]['statistic']} of {failed[0]['channel']}, {p_text(failed[0]['p'])}"
        text += f" The evidence is a test of the one-step predictions ({check})."
    if measured and _best_tried(report):
        text += f" The best of them, {_best_tried(report)}, {measured}: a semiparametric model " \
                "(smooth functions) predicts held-out data significantly better."  # fmt: skip
    elif measured:
        text += f" A semiparametric model (smooth functions) {measured}."
    return sentence(text)


def _best_tried(report: Findings) -> str:
    """What of the catalogue was chosen, where that is not enough; "" for nothing."""
    closed = rows(report.closed)
    return str(closed[0]["effect"]) if closed and closed[0]["effect"] != CURVES else ""


def _no_gap(report: Findings) -> str:
    best = min(rows(report.causes), key=_by_p, default=None)
    where = f"No measurable gap between {named(report)} and its data"
    if best is None:
        return where + "."
    if is_number(best["p"]) and best["p"] <= report.settings.get("alpha", 0.05):
        text = f"{where}: {row_label(best)} was significant ({p_text(best['p'])}), but"
        if not rows(report.closed):
            return f"{text} its held-out gain has not been measured."
        return f"{text} {kept_back(report)} log predictive density did not improve measurably."
    return f"{where}: none of the {tried(report)} is significant after correction for multiple " \
           f"testing (the best, {row_label(best)}, has {p_text(best['p'])})."  # fmt: skip


def _by_p(row: dict[str, Any]) -> float:
    return float(row["p"]) if is_number(row["p"]) else 2.0


def place(row: dict[str, Any]) -> str:
    """Equation and moment: "the noise variance of y"."""
    moment = str(row["moment"])
    return f"{MOMENTS.get(moment, f'the {moment} of')} {row['equation']}"


def where(report: Findings) -> list[str]:
    """Which equation, which moment, when and in which region: the three strongest places."""
    found = significant_rows(report, report.where)
    if not found:
        return [
            "No equation shows misfit that is significant after correction for multiple testing."
        ]
    out = []
    for i, r in enumerate(found[:3]):
        region = r["region"] if isinstance(r["region"], str) else ""
        when = span(r["t_from"], r["t_to"], r["experiment"])
        spots = [s for s in (f"at {when}" if when else "", region) if s]
        strongest = f", strongest {' and '.join(spots)}" if spots else ""
        text = f"{'also ' if i else ''}in {place(r)}{strongest} (z = {number(r['z'], 2)}, " \
               f"{p_text(r['p'])})"  # fmt: skip
        out.append(sentence(text))
    return out


def which(report: Findings) -> list[str]:
    """The effects that explain it, with their strength, and what they cannot be told from."""
    if report.verdict == NONE_OF_THESE:
        text = f"None of the {tried(report)}. The remaining misfit is significant"
        return [sentence(text), *filter(None, [_curve_peak(report), formula(report)])]
    found = leaders(report)
    if not found:
        return [f"None of the {tried(report)} is significant."]
    out = []
    for row in found:
        form = f", {row['form']}" if isinstance(row.get("form"), str) and row["form"] else ""
        text = f"{row_label(row)}{form}"
        if is_number(row.get("estimate")):
            text += f": strength {with_error(row['estimate'], row.get('se'))}{_by_time(row)}"
        gains = [row.get("gain_refit"), row.get("gain_screen")]
        gain = next((g for g in gains if is_number(g)), None)
        if gain is not None:
            by = "" if is_number(gains[0]) else " (score-test approximation)"
            alone = " by itself" * (len(found) > 1)
            text += f"; log-likelihood gain {number(gain, 2)} nats{alone}{by}"
            text += f", {p_text(row.get('p'))}"
        out.append(sentence(text))
        carried = report.attributes.get(f"{row['effect']} in {row['equation']}")
        if carried:
            out.append(f"Corresponding attribute in the simulator's model file: {carried}.")
        others = rivals(report, row)
        if others:
            names = listed([row_label(r) for r in others], "or")
            text = f"not distinguishable by these data from {names}{_closeness(report, others)}"
            out.append(sentence(text))
        elif row is found[0] and (mechanism := promising_mechanism(report)):
            out.append(sentence(f"it stands for any cause: {mechanism}"))
        elif row.get("class_id") in [r["class_id"] for r in rows(report.classes)]:
            out.append("These data distinguish it from every other effect tried.")
    return out


def _by_time(row: dict[str, Any]) -> str:
    """What the strength is per unit of time, where it is added in each step of a known length."""
    rate: Any = row.get("rate")
    if not is_number(rate) or not row["estimate"]:
        return ""
    error = row["se"] * rate / row["estimate"] if is_number(row.get("se")) else math.nan
    return f" per row, {with_error(rate, error)} per unit of time"


def _closeness(report: Findings, others: Sequence[dict[str, Any]]) -> str:
    """What makes these one class with the effect before them: the gains of their refits, or how
    much their scores correlate with its own."""
    gains = {(r["effect"], r["equation"]): r.get("gain_refit") for r in rows(report.causes)}
    own = [gains.get((r["effect"], r["equation"])) for r in others]
    if all(is_number(g) for g in own):
        they = "it gains" if len(own) == 1 else "they gain"
        return f" (refitted, {they} {listed([number(g, 2) for g in own])} nats)"
    rhos = [abs(float(r["rho"])) for r in others if is_number(r["rho"])]
    return f" (efficient scores correlated up to |rho| = {max(rhos):.2f})" if rhos else ""


def _curve_peak(report: Findings) -> str:
    curve = [r for r in rows(report.missing) if is_number(r["estimate"])]
    sure = [r for r in curve if r["low"] > 0 or r["high"] < 0]
    if not sure:
        return ""
    top = max(sure, key=lambda r: abs(r["estimate"]))
    variable, _, where = str(top["variable"]).partition(WHERE)
    text = f"The estimated missing term in {top['equation']} is largest in magnitude at " \
           f"{variable} = {number(top['value'])}{where and f', {where}'}: " \
           f"{number(top['estimate'])}"  # fmt: skip
    return f"{text} (95% band {number(top['low'])} to {number(top['high'])})."


def formula(report: Findings) -> str:
    """The formula that comes nearest to what is missing, as a suggestion."""
    terms = rows(report.formula)
    if not terms:
        return ""
    text = " ".join(
        f"{'-' if r['coefficient'] < 0 else '+'} {number(abs(r['coefficient']))}*{r['term']}"
        for r in terms
    ).removeprefix("+ ")  # fmt: skip
    return (
        f"Suggested formula: add {text} to {terms[0]['equation']} in each step. It achieves "
        f"{percent(terms[0]['share'])} of the gain of the curves; other formulas may fit as well."
    )


def _subject(row: dict[str, Any]) -> str:
    """What a row of `closed` is about, as the subject of a sentence."""
    return f"a model with {CURVES}" if row["effect"] == CURVES else str(row["effect"])


def how_far(report: Findings) -> list[str]:
    """Share of the reference's gain, the gain per sample, and the error of a free run."""
    if report.mode == "fast":
        return ["Not measured: fast mode stops after the score tests."]
    closed = rows(report.closed)
    if not closed and any(r.get("unfitted") for r in leaders(report)):
        return ["Not measured: the effect could not be fitted."]
    if not closed:
        return ["Not measured."]
    first, out = closed[0], []
    r = windows(report)
    same = r is not None and r["rmse_before"] == r["rmse_after"]
    if report.verdict == NONE_OF_THESE and first["effect"] == CURVES and same:
        return [f"Not measured: {CURVES}, fitted to the first rows, do not predict other rows "
                "better than the original model."]  # fmt: skip
    told = simulated(report) if report.verdict != NO_GAP else ""
    if told:
        r = windows(report) or {}
        ends = f"{number(r['rmse_before'])} to {number(r['rmse_after'])}"
        out.append(
            sentence(f"{kept_back(report)}, {_subject(first)} {told}: from {ends} (RMS, units of "
                     "the data). Each simulation starts from the filtered state at its first row "
                     "and uses no later data")
        )  # fmt: skip
    if is_number(first["F"]):
        own = "it" if told else f"{kept_back(report)}, {_subject(first)}"
        out.append(sentence(f"{own} {share(report)}"))
        if first["F"] < 0:
            out.append("A share below zero means that it made the predictions worse.")
    elif report.verdict == NO_GAP:
        out.append(
            sentence(f"{kept_back(report)}, log predictive density did not improve measurably")
        )
    else:
        out.append(sentence(
            f"{kept_back(report)} no share of the reference model's gain is computed, because the "
            "interval of that gain includes zero (see the notes)"
        ))  # fmt: skip
    if report.verdict == NO_GAP:  # what no effect gained is no finding
        return out
    if is_number(first["nats_per_sample"]):
        nats = float(first["nats_per_sample"])
        text = f"mean gain in log predictive density {number(nats, 2)} nats per sample"
        if abs(nats) <= PICTURED:
            text += f" (a density ratio of {number(math.exp(nats))})"
        if is_number(first["gain_mean"]) and is_number(first["gain_noise"]):
            text += f"; in all {number(first['gain_mean'], 2)} nats from the conditional mean, " \
                    f"{number(first['gain_noise'], 2)} from the rest of the predictive " \
                    "distribution"  # fmt: skip
        out.append(sentence(text))
    before, after = first["rmse_before"], first["rmse_after"]
    if is_number(before) and is_number(after):
        way = "decreases" if after < before else "increases"
        out.append(f"Open-loop (free-run) simulation error, from the first row on, {way} from "
                   f"{number(before)} to {number(after)} (RMS, units of the data).")  # fmt: skip
    return out


# -- how sure, and what next
def how_sure(report: Findings) -> list[str]:
    """What the numbers rest on: the data used for what, the tests, what stands out at all."""
    out = []
    if "cross-fitting" in report.parts:
        out.append(f"{report.parts['cross-fitting']}-fold blocked cross-validation: each block is "
                   "predicted by models that were fitted, and whose effects were selected among "
                   "the leading ones, without it.")  # fmt: skip
    else:
        used = [(name, _when(report, report.parts[name])) for name in USE
                if isinstance(report.parts.get(name), tuple | list)]  # fmt: skip
        if used:
            text = listed([f"{USE[name]} {when}" for name, when in used])
            text = sentence(text)
            text += " The corresponding rows of the other experiments were used likewise." * bool(
                _experiment(report)
            )
            once = len(used) > 1 and "choice" not in report.parts
            out.append(text + " Selection and evaluation rows are disjoint." * once)
    out += [sentence(str(v)) for v in report.parts.values() if isinstance(v, str)]
    out += [sentence(text) for text in [_recognised(report)] if text]
    tests = [r for r in rows(report.detection) if is_number(r["p"])]
    bad = significant_rows(report, report.detection)
    if bad:
        names = [f"{r['statistic']} of {r['channel']} ({p_text(r['p'])})" for r in bad[:4]]
        out.append(f"The one-step predictions of the original model failed {len(bad)} of "
                   f"{len(tests)} tests: {listed(names)}.")  # fmt: skip
    elif tests:
        out.append(f"The one-step predictions of the original model passed all {len(tests)} "
                   "tests.")  # fmt: skip
    if report.verdict == NO_GAP:
        out.append("This does not validate the model: an effect that is not excited cannot be "
                   "identified from these data.")  # fmt: skip
    return out


def _recognised(report: Findings) -> str:
    """How often the first effect comes first where it is the truth, and which one else."""
    if report.verdict != EFFECT or not (found := leaders(report)):
        return ""
    own, table = row_label(found[0]), rows(report.probabilities)
    mine = table[: math.isqrt(len(table))]  # of the first effect
    if not mine or row_label(mine[0]) != own:
        return ""
    shares: dict[str, float] = {}
    for r in mine:
        name = label(r["named"], r["named_equation"])
        shares[name] = shares.get(name, 0.0) + r["probability"]
    if len(shares) == 1:  # forms of one effect
        return ""
    text = (
        f"in data sets simulated with {own} and the same inputs, and fitted in the same way, it "
        f"came first of {len(shares)} effects in {percent(shares.pop(own))} of the sets"
    )
    other = max(shares, key=lambda name: shares[name])
    return f"{text}, {other} in {percent(shares[other])}" if shares[other] > 0.0 else text


def to_decide(report: Findings) -> list[str]:
    """What would distinguish the rivals of the first class: an experiment, or more rows."""
    found = report.separation
    if found is None:
        return []
    names = list(dict.fromkeys(label(*e) for e in found.effects))
    two = len(found.effects) == 2
    pair = "between the two" if two else "between the two that are hardest to distinguish"
    needed, recorded = number(found.needed, 2), number(found.recorded, 2)
    out = [f"These records do not distinguish {listed(names, 'from')}."]
    if len(names) == 1:
        out = [f"These records do not distinguish the forms of {names[0]}."]
    if len(names) > 2:
        first = f" (the first {len(names)} of {found.members})" * (found.members > len(names))
        out = [f"These records do not distinguish {listed(names)}{first}."]
    if found.as_recorded:
        return [*out, f"Another {found.rows:,} rows {_recorded_kind(found)} are expected to "
                f"distinguish them (expected log-likelihood ratio {recorded} nats {pair}, "
                f"{needed} are enough): no other experiment is needed."]  # fmt: skip
    if found.best is not None and found.runs:
        again, each = "", ""
        if found.runs > 1:
            again, each = f", run {found.runs} times", " in each run"
        return [
            *out,
            sentence(f"{found.best.signal.words} would distinguish them{again} (expected "
                     f"log-likelihood ratio {number(found.best.nats, 2)} nats {pair}{each}, "
                     f"{needed} are enough; with the recorded inputs: {recorded}). The inputs are "
                     "in experiment.csv"),
            f"The signal keeps {found.best.input} within its recorded range, and the models "
            "predict that the outputs stay near theirs.",
            f"Without this experiment {_more_rows(found)} would be needed.",
        ]  # fmt: skip
    if found.tried:
        return [*out, *_none_separates(found, pair),
                sentence(f"{_more_rows(found)} would be needed")]  # fmt: skip
    return [*out, f"There is no input to vary: {_more_rows(found)} would be needed (expected "
            f"log-likelihood ratio of this record: {recorded} nats {pair}; {needed} are "
            "needed)."]  # fmt: skip


def _none_separates(found: Separation, pair: str) -> list[str]:
    """That no signal would do, with the best figure, and why most have none."""
    inputs = listed(list(dict.fromkeys(t.input for t in found.tried)))
    text = f"none of the {len(found.tried)} signals of {inputs} that were tried would " \
           "distinguish them"  # fmt: skip
    if found.best is not None and found.best.nats >= SURE:
        text += f"; the best, {found.best.signal.words}, has an expected log-likelihood ratio of " \
                f"{number(found.best.nats, 2)} nats {pair}, and {number(found.needed, 2)} are " \
                f"needed (with the recorded inputs: {number(found.recorded, 2)})"  # fmt: skip
    reasons = {ALIKE: "the fitted models predict nearly the same",
               OUTSIDE: "the outputs leave their recorded range"}  # fmt: skip
    counts = {note: sum(t.note == note for t in found.tried) for note in reasons}
    why = [f"for {counts[note]} of them {reasons[note]}" for note in reasons if counts[note]]
    out = [sentence(text), *([sentence(listed(why))] if why else [])]
    if 2 * counts[ALIKE] > len(found.tried):
        out.append("In the recorded range it makes little difference which of them is used.")
    return out


def _recorded_kind(found: Separation) -> str:
    return "with the recorded inputs" if found.recorded_inputs.shape[1] else "of this kind"


def _more_rows(found: Separation) -> str:
    """How many rows would be enough without another experiment."""
    kind, times = _recorded_kind(found), found.times_as_many
    whole = f"the {found.rows:,} of {'this' if found.records == 1 else 'the longest'} record"
    if math.isinf(times):
        return f"more than {number(found.needed / SURE, 1)} times as many rows {kind} as {whole}"
    return f"about {number(times * found.rows, 2)} rows {kind}, {number(times, 2)} times as many " \
           f"as {whole}"  # fmt: skip


def undecided(report: Findings) -> list[str]:
    """What these data could not decide, and the parts that do not apply, with their reasons."""
    out = []
    for row in leaders(report):
        if rivals(report, row):
            out.append(sentence(f"not distinguishable: {listed(alternatives(report, row), 'or')}"))
    parts: dict[tuple[str, str], list[str]] = {}
    for r in rows(report.not_applicable):
        equation = r["equation"] if isinstance(r["equation"], str) else ""
        parts.setdefault((equation, r["reason"]), []).append(r["part"])
    for (equation, reason), own in parts.items():
        about = f" for {equation}" if equation else ""
        out.append(sentence(f"{listed(list(dict.fromkeys(own)))}{about}: {reason}"))
    return out


def left_out(report: Findings) -> list[str]:
    """The parts that failed, each with its reason."""
    return [sentence(f"{r['part']}: {r['reason']}") for r in rows(report.left_out)]


def _to_distinguish(report: Findings, row: dict[str, Any]) -> list[str]:
    """What to record, or else to do, to distinguish a cause from its rivals; nothing in fast mode,
    whose classes are preliminary."""
    if report.mode == "fast":
        return []
    found, names = report.separation, listed(alternatives(report, row), "from")
    looked_for = found is not None and (row["effect"], row.get("equation")) in found.effects
    if found is not None and looked_for and found.as_recorded:
        return [f"To distinguish {names}, record as much data again, and diagnose all records "
                "together."]  # fmt: skip
    if report.experiment is not None and looked_for:
        return [f"To distinguish {names}, run experiment.csv (report.experiment in Python) on "
                "the system, record the outputs, and diagnose all records together."]  # fmt: skip
    return [f"To distinguish {names}, add a sensor, inspect the system, or record it under other "
            "conditions."]  # fmt: skip


def next_steps(report: Findings) -> list[str]:
    """What to do now: what to measure, and what to do with the model."""
    out = []
    if report.interrupted:
        out.append(
            "The run was interrupted: run it again, and it resumes from the completed stages."
        )
    elif len(report.left_out):
        out.append("Parts of this answer are missing (failed computations, below). Another run "
                   "tries them again; with debug=True (--debug) it raises the first internal "
                   "error.")  # fmt: skip
    if report.mode == "fast" and report.verdict != NO_GAP:
        out.append("Run it again in full mode: it refits the leading effects and measures the "
                   "held-out gain.")  # fmt: skip
    for row in leaders(report):
        others = rivals(report, row)
        if not others:
            continue
        out += _to_distinguish(report, row)
    if report.verdict == NONE_OF_THESE and report.missing is not None:
        out.append("Look at the estimated curve, consider which physical effect has this shape, "
                   "write it as an @ssm.effect and run again with it.")  # fmt: skip
    elif report.verdict == NONE_OF_THESE:
        out.append("Consider which physical effect changes the noise in this way, or acts in that "
                   "time window only; write it as an @ssm.effect and run again with "
                   "it.")  # fmt: skip
    elif report.verdict == NO_GAP:
        out.append(
            "To increase power, record more data, or drive the system over more of its range."
        )
    if report.model_text:
        out.append("The augmented model is ready to use: augmented_model.py, an ordinary model "
                   "file (report.model in Python).")  # fmt: skip
    return out
