"""The report as one HTML file: readable on a phone, in print and in the dark, without JavaScript.

The answers come first, then how sure they are, then what to do next, then the evidence, and at the
end the model file. Plots are inside of it, once for narrow and once for wide screens.
"""

from __future__ import annotations

import base64
import html
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from ssmppl.diagnosis.report import words
from ssmppl.diagnosis.report.findings import Findings
from ssmppl.diagnosis.report.panels import TITLES, bars, curves, mapped, pictures, runs
from ssmppl.diagnosis.report.text import AHEAD, filled, horizon_rows
from ssmppl.diagnosis.verdict.verdicts import NO_GAP, NONE_OF_THESE
from ssmppl.drawing.numerals import interval, is_number, number, p_text, percent, span, with_error

if TYPE_CHECKING:
    import pandas as pd

GENERATOR = '<meta name="generator" content="ssmppl diagnose">'
PHONE = 4.1  # inches: what a phone is wide
LONGEST_TABLE = 60  # rows; the CSV files have all

# What the page calls columns and tables, and says below the panels.
HEADINGS = {
    "F": "share of the gain", "F_low": "from", "F_high": "to", "t_from": "from t", "t_to": "to t",
    "gain_screen": "gain, score test", "gain_refit": "gain, refitted", "class_id": "class",
    "estimate": "strength", "se": "±", "rho": "correlation", "separating_input": "separating input",
    "nats": "expected log-likelihood ratio",
    "nats_per_sample": "nats per sample", "gain_mean": "nats, conditional mean",
    "gain_noise": "nats, rest of the distribution", "rmse_before": "error before",
    "rmse_after": "error after", "p": "p", "horizon": "rows ahead", "share": "error reduced by",
    "low": "from", "high": "to", "named": "came first", "named_form": "form",
    "named_equation": "in",
    "probability": "of the sets", "behind": "nats behind, in the data",
    "cut": "nats behind, in 95% of its sets",
}  # fmt: skip
MODELS = {"before": "original model", "after": "augmented model",
          "simulation": "the same, for simulation"}  # fmt: skip
TABLES = {
    "causes": "All effects tried, best first",
    "classes": "Effects not distinguishable by these data",
    "probabilities": "Which effect came first, in data simulated with each",
    "signals": "Signals tried to distinguish them, best first",
    "where": "Places of misfit",
    "closed": "Held-out gain",
    "detection": "Tests of the one-step predictions",
}
CAPTIONS = {
    "residual_map": "Each cell is the standardised smoothed score (z) of one equation in one "
    "window of time. + and − mark |z| > 3; |z| > 2 is expected in about 5% of cells by chance.",
    "ranked_effects": "Log-likelihood gain (nats) when the effect is added. Filled: model "
    "refitted; hatched: score-test approximation. Effects with the same letter are not "
    "distinguishable by these data.",
    "gap_closed": "Share of the reference model's gain in held-out log predictive density: 0% is "
    "the original model, 100% the reference. Lines are 95% intervals; an arrow where they are "
    "unbounded or leave the axis.",
    "missing_term": "The term missing from the equation in each step, estimated by smooth "
    "functions, with its pointwise 95% band. Where the band contains zero, the term is not "
    "significant.",
    "free_run": "Open-loop simulation: each model is started once and uses no later data. "
    "Shaded: 95% prediction interval.",
    "experiment": "The input of the experiment, held over each row, and the one that was recorded. "
    "Other inputs, if there are any, stay as they were recorded.",
}

# One column of text, cards side by side where there is room.
CSS = """
:root {
  color-scheme: light dark;
  --page: #fbfbf9; --card: #ffffff; --ink: #1d1f21; --soft: #5a6068; --line: #dcdcd6;
  --accent: #0072b2; --found: #e7f1f8; --open: #fbeee4; --quiet: #eef0ee;
}
@media (prefers-color-scheme: dark) {
  :root {
    --page: #16181b; --card: #1f2226; --ink: #e8e8e6; --soft: #a8adb4; --line: #383c42;
    --accent: #6cb6e6; --found: #17303f; --open: #43301f; --quiet: #262a2e;
  }
}
* { box-sizing: border-box; }
html { -webkit-text-size-adjust: 100%; text-size-adjust: 100%; }
body {
  margin: 0; background: var(--page); color: var(--ink); overflow-wrap: break-word;
  font: 1rem/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", sans-serif;
}
main { max-width: 47rem; margin: 0 auto; padding: 1rem 1rem 3rem; }
h1 { font-size: 1.05rem; font-weight: 600; color: var(--soft); margin: 0.5rem 0 0.75rem; }
h2 { font-size: 1.3rem; line-height: 1.25; margin: 2.2rem 0 0.6rem; }
h3 { font-size: 1rem; margin: 1.2rem 0 0.3rem; }
p { margin: 0.4rem 0; }
a { color: var(--accent); }
ul { margin: 0.4rem 0; padding-left: 1.2rem; }
li { margin: 0.35rem 0; }
.verdict { border-left: 0.35rem solid var(--accent); background: var(--found);
  padding: 0.7rem 1rem; border-radius: 0 0.5rem 0.5rem 0; }
.verdict p { font-size: 1.22rem; line-height: 1.42; margin: 0; font-weight: 500; }
.none-of-these { background: var(--open); border-color: #d55e00; }
.no-measurable-gap { background: var(--quiet); border-color: var(--soft); }
.first { margin-top: 1.2rem; }
.first figure { margin-bottom: 0.6rem; }
.cards { display: grid; gap: 0.8rem; margin-top: 0.9rem; }
.card { background: var(--card); border: 1px solid var(--line); border-radius: 0.5rem;
  padding: 0.75rem 1rem; min-width: 0; }
.card h2 { font-size: 0.92rem; color: var(--soft); margin: 0; font-weight: 600; }
.card .large { font-size: 1.3rem; line-height: 1.25; font-weight: 650; margin: 0.3rem 0 0.4rem; }
.card small { display: block; font-size: 0.92rem; font-weight: 500; color: var(--soft); }
.card p { font-size: 0.95rem; }
figure { margin: 0 0 1.6rem; }
figcaption { font-weight: 600; margin-bottom: 0.4rem; }
picture { display: block; background: #ffffff; border: 1px solid var(--line);
  border-radius: 0.5rem; padding: 0.5rem; }
img { display: block; width: 100%; height: auto; }
figure p, footer { color: var(--soft); font-size: 0.9rem; }
details { border-top: 1px solid var(--line); }
details:last-of-type { border-bottom: 1px solid var(--line); }
summary { cursor: pointer; padding: 0.65rem 0; font-weight: 500; }
.scroll { overflow-x: auto; margin-bottom: 0.8rem; }
table { width: max-content; border-collapse: collapse; font-size: 0.88rem;
  font-variant-numeric: tabular-nums; }
caption { text-align: left; font-weight: 600; padding-bottom: 0.3rem; }
th, td { padding: 0.3rem 0.9rem 0.3rem 0; text-align: right; vertical-align: top;
  white-space: nowrap; border-bottom: 1px solid var(--line); }
th { color: var(--soft); font-weight: 600; }
.left { text-align: left; }
td.left div { white-space: normal; width: max-content; max-width: 18rem; }
pre { margin: 0; padding: 0.8rem 1rem; background: var(--card); border: 1px solid var(--line);
  border-radius: 0.5rem; font: 0.82rem/1.5 ui-monospace, Menlo, Consolas, monospace;
  width: max-content; min-width: 100%; }
dt { font-weight: 600; }
dd { margin: 0 0 0.5rem; color: var(--soft); }
footer { margin-top: 2.5rem; border-top: 1px solid var(--line); padding-top: 0.6rem; }
@media (min-width: 46rem) {
  .cards { grid-template-columns: repeat(3, minmax(0, 1fr)); }
  main { padding-top: 2rem; }
}
@media (min-width: 64rem) {
  .cards { margin-left: -5rem; margin-right: -5rem; }
}
@media print {
  body { background: #ffffff; font-size: 10pt; }
  .cards { margin-left: 0; margin-right: 0; }
  figure, .card { break-inside: avoid; }
}
"""


def page(report: Findings, wide: dict[str, bytes] | None = None) -> str:
    """The text of the page; nothing in it refers to another file or host.

    `wide`: the panels as `pictures(report)` makes them, where they are at hand already.
    """
    title = f"Diagnosis of {report.title}" if report.title else "Diagnosis of a model"
    kind = report.verdict.replace(" ", "-")
    # These first: what fails in them is among the parts left out.
    figures: dict[str, str] = {}
    with report.failures.guard("the page's pictures"):
        figures = _figures(report, pictures(report) if wide is None else wide)
    first, drawn_experiment = figures.pop("free_run", ""), figures.pop("experiment", "")
    opening = _part(report, "the page's first table", lambda: first + _by_horizon(report))
    tables = _part(report, "the page's tables", lambda: _section("Tables", _tables(report)))
    parts = [
        "<!DOCTYPE html>", '<html lang="en">', "<head>", '<meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">', GENERATOR,
        f"<title>{_text(title)}</title>", f"<style>{CSS}</style>", "</head>", "<body>", "<main>",
        f"<header><h1>{_text(title)}</h1></header>",
        f'<section class="verdict {kind}" aria-label="The answer">',
        f"<p>{_text(words.headline(report))}</p>", "</section>",
        f'<section class="first">{opening}</section>' if opening else "",
        _answers(report),
        _section("Evidence", _list(words.how_sure(report)) + _unknown(report)),
        _section("Discriminating experiment", _experiment(report, drawn_experiment)),
        _section("Next steps", _list(words.next_steps(report))),
        _section("Plots", "\n".join(figures.values())),
        tables,
        _section("Glossary", _glossary()),
        _model(report),
        f"<footer><p>{_text(_colophon(report))}</p></footer>",
        "</main>", "</body>", "</html>",
    ]  # fmt: skip
    return "\n".join(p for p in parts if p) + "\n"


def _part(report: Findings, name: str, make: Callable[[], str]) -> str:
    """A part of the page; nothing where an error ended it, which the report then says."""
    with report.failures.guard(name):
        return make()
    return ""


def _text(value: Any) -> str:
    """Escaped; "t = 411" and "p < 0.001" do not break over lines."""
    whole = str(value)
    for sign in "=<>±":
        whole = whole.replace(f" {sign} ", f"\N{NO-BREAK SPACE}{sign}\N{NO-BREAK SPACE}")
    return html.escape(whole)


def _section(title: str, body: str) -> str:
    return f"<section>\n<h2>{_text(title)}</h2>\n{body}\n</section>" if body else ""


def _list(items: Iterable[str]) -> str:
    found = "".join(f"<li>{_text(item)}</li>\n" for item in items)
    return f"<ul>\n{found}</ul>" if found else ""


# -- the answers
def _answers(report: Findings) -> str:
    """Three cards: a large word or number, and the sentences below it."""
    found = words.leaders(report)
    gap = words.rows(report.where)[:1] if report.verdict != NO_GAP else []
    spot = words.place(gap[0]) if gap else "no localised misfit"
    names = [words.listed(words.alternatives(report, row), "or") for row in found]
    cause = {NONE_OF_THESE: "none of these", NO_GAP: "no significant effect"}
    first = (words.rows(report.closed) or [{"F": None}])[0]
    far, ends = "not measured", ""
    window = words.windows(report)
    if words.simulated(report) and window is not None:
        far, ends = percent(window["share"]), interval(window["low"], window["high"])
    elif is_number(first["F"]):
        far, ends = percent(first["F"]), interval(first["F_low"], first["F_high"])
    cards = (
        ("Where is the misfit?", spot, "", words.where(report)),
        (
            "Which effect is missing?",
            cause.get(report.verdict, "; and ".join(names)),
            "",
            words.which(report),
        ),
        ("How much does it improve predictions?", far, ends, words.how_far(report)),
    )
    body = "\n".join(
        f'<section class="card"><h2>{_text(question)}</h2><p class="large">{_text(large)}'
        + (f"<small>{_text(small)}</small>" if small else "")
        + "</p>\n"
        + "".join(f"<p>{_text(s)}</p>\n" for s in sentences)
        + "</section>"
        for question, large, small, sentences in cards
    )
    return f'<div class="cards">\n{body}\n</div>'


def _unknown(report: Findings) -> str:
    """What could not be decided, and what has to be known before the figures are used."""
    out = ""
    for title, items in (
        ("Not distinguishable or not applicable", words.undecided(report)),
        ("Notes", [words.sentence(n) for n in report.notes]),
        ("Failed computations", words.left_out(report)),
    ):
        if items:
            out += f"\n<h3>{title}</h3>\n{_list(items)}"
    return out


def _experiment(report: Findings, picture: str) -> str:
    """What would distinguish the rivals, with its inputs as a file."""
    sentences = "".join(f"<p>{_text(s)}</p>\n" for s in words.to_decide(report))
    if report.experiment is None:
        return sentences
    csv = report.experiment.to_csv(index=False)
    return f"{sentences}{picture}\n{_download('experiment.csv', 'text/csv', csv)}"


# -- the pictures
def _figures(report: Findings, wide: dict[str, bytes]) -> dict[str, str]:
    """Each panel with its title and what it shows."""
    narrow = pictures(report, PHONE)
    return {
        name: f"<figure><figcaption>{_text(TITLES[name])}</figcaption>\n"
        f'<picture><source media="(min-width: 46rem), print" srcset="{_png(wide[name])}">'
        f'<img src="{_png(narrow[name])}" alt="{_text(_alt(report, name))}"></picture>\n'
        f"<p>{_text(CAPTIONS[name])}</p></figure>"
        for name in narrow
        if name in wide
    }


def _by_horizon(report: Findings) -> str:
    """The errors of simulations by horizon, open to the eye; nothing where none were measured."""
    head, *body = filled(horizon_rows(report))
    if not body or report.verdict == NO_GAP:
        return ""
    heads = "".join(f'<th scope="col">{_text(cell)}</th>' for cell in head)
    lines = "\n".join(
        "<tr>" + "".join(f"<td>{_text(cell)}</td>" for cell in row) + "</tr>" for row in body
    )
    return (
        f'\n<div class="scroll" tabindex="0" role="region" aria-label="{_text(AHEAD)}"><table>'
        f"<caption>{_text(AHEAD)}</caption><thead><tr>{heads}</tr></thead>\n"
        f"<tbody>\n{lines}\n</tbody></table></div>"
    )


def _alt(report: Findings, name: str) -> str:
    """What the picture shows, for those who cannot see it."""
    if name == "residual_map":
        table = report.residual_map.dropna(subset=["z"])
        text = f"Map of z by time for the equations {words.listed(mapped(report))}."
        if len(table):
            top = table.loc[table["z"].abs().idxmax()]
            text += f" Largest: {number(top['z'], 2)} for {top['equation']} at " \
                    f"{span(top['t_from'], top['t_to'], top['experiment'])}."  # fmt: skip
        return text
    if name == "ranked_effects":
        items = [f"{words.row_label(r)} {number(_gain(r), 2)}" for r in bars(report)]
        return f"Bars of the log-likelihood gain in nats: {'; '.join(items)}."
    if name == "gap_closed":
        items = [f"{r['effect']} {percent(r['F'])} ({interval(r['F_low'], r['F_high'])})"
                 for r in words.rows(report.closed) if is_number(r["F"])]  # fmt: skip
        return f"Share of the reference model's gain, with its 95% interval: {'; '.join(items)}."
    if name == "missing_term":
        items = [f"missing term in {e} over {v}" for e, v in curves(report)]
        return f"Curves with bands: {words.listed(items)}."
    if name == "experiment":
        best = report.separation.best if report.separation else None
        return f"Course of the input: {best.signal.words if best else ''}."
    shown = words.listed(list(dict.fromkeys(str(c) for _, c in runs(report))))
    first = (words.rows(report.closed) or [{}])[0]
    text = f"Data of {shown} with free runs of the original and the augmented model."
    if is_number(first.get("rmse_before")) and is_number(first.get("rmse_after")):
        text += f" The error goes from {number(first['rmse_before'])} to " \
                f"{number(first['rmse_after'])}."  # fmt: skip
    return text


def _gain(row: dict[str, Any]) -> Any:
    return row["gain_refit"] if is_number(row["gain_refit"]) else row["gain_screen"]


def _png(picture: bytes) -> str:
    """A picture as a data URI."""
    return "data:image/png;base64," + base64.b64encode(picture).decode("ascii")


# -- the tables
def _tables(report: Findings) -> str:
    out = []
    letters = words.class_letters(report)
    for name, title in TABLES.items():
        table = report.tables().get(name)
        if table is None:
            continue
        if name == "classes":
            table = table[table["class_id"].isin(list(letters))]
        if not len(table):
            continue
        body = [[_cell(column, row[column], letters) for column in table.columns]
                for row in words.rows(table.head(LONGEST_TABLE))]  # fmt: skip
        count = f" (first {LONGEST_TABLE} of {len(table)})" if len(table) > LONGEST_TABLE else ""
        heads = [HEADINGS.get(c, str(c).replace("_", " ")) for c in table.columns]
        out.append(_table(title + count, heads, body, _left(table)))
    estimates = _estimates(report)
    if estimates:
        heads = ["parameter", *(MODELS.get(when, when) if len(report.estimates) > 1 else "estimate"
                                for when in report.estimates)]  # fmt: skip
        out.append(_table("Parameters, with standard errors", heads, estimates, {0}))
    used = [[k, v if isinstance(v, str) else repr(v)] for k, v in report.settings.items()]
    if used:
        out.append(_table("Settings", ["setting", "value"], used, {0, 1}))
    return "\n".join(out)


def _left(table: pd.DataFrame) -> set[int]:
    """Columns of text."""
    return {i for i, c in enumerate(table.columns) if table[c].dtype.kind not in "iuf"}


def _cell(column: str, value: Any, letters: dict[Any, str]) -> str:
    if column == "class_id":
        return letters.get(value, "")
    if column == "p":
        return p_text(value).removeprefix("p ").removeprefix("= ") if is_number(value) else ""
    if column in ("F", "F_low", "F_high", "share", "low", "high"):
        return percent(value)
    if column.startswith("t_"):
        return span(value, value).removeprefix("t = ")
    if isinstance(value, str):
        return value
    return number(value) if is_number(value) else ""


def _estimates(report: Findings) -> list[list[str]]:
    """A line for each scalar parameter: its value before and after, or that it was held."""
    found: dict[str, dict[str, str]] = {}
    for when, values in report.estimates.items():
        for name, (value, error) in values.items():
            errors = np.broadcast_to(np.asarray(error, float), np.shape(value))
            for index in np.ndindex(np.shape(value)):
                text = name + (f"[{', '.join(map(str, index))}]" if index else "")
                v, e = np.asarray(value, float)[index], errors[index]
                found.setdefault(text, {})[when] = (
                    f"{number(v)} (fixed)" if e == 0 else with_error(v, e)
                )
    return [[name, *(by.get(w, "") for w in report.estimates)] for name, by in found.items()]


def _table(title: str, heads: list[str], body: list[list[str]], left: set[int]) -> str:
    """A table that opens on a tap, and scrolls inside its box where it is too wide."""
    keep = [i for i in range(len(heads)) if any(row[i] for row in body)]
    side = {i: ' class="left"' if i in left else "" for i in keep}
    head = "".join(f'<th scope="col"{side[i]}>{_text(heads[i])}</th>' for i in keep)
    lines = "\n".join(
        "<tr>" + "".join(f"<td{side[i]}><div>{_text(row[i])}</div></td>" for i in keep) + "</tr>"
        for row in body
    )
    return (
        f"<details><summary>{_text(title)}</summary>\n"
        f'<div class="scroll" tabindex="0" role="region" aria-label="{_text(title)}"><table>'
        f"<thead><tr>{head}</tr></thead>\n<tbody>\n{lines}\n</tbody></table></div></details>"
    )


# -- the end
def _glossary() -> str:
    terms = "\n".join(f"<dt>{_text(t)}</dt><dd>{_text(m)}.</dd>" for t, m in words.GLOSSARY.items())
    return f"<dl>\n{terms}\n</dl>"


def _model(report: Findings) -> str:
    if not report.model_text:
        return ""
    link = _download("augmented_model.py", "text/x-python", report.model_text)
    return _section(
        "Augmented model",
        f'{link}\n<div class="scroll" tabindex="0" role="region" aria-label="Model file">'
        f"<pre><code>{html.escape(report.model_text)}</code></pre></div>",
    )


def _download(name: str, kind: str, content: str) -> str:
    """A link that saves a file whose content is in the page."""
    coded = base64.b64encode(content.encode()).decode("ascii")
    return f'<p><a download="{name}" href="data:{kind};base64,{coded}">Download {name}</a></p>'


def _colophon(report: Findings) -> str:
    text = f"Made by ssmppl diagnose in {report.mode} mode, {report.seconds:.0f} seconds"
    seed = report.settings.get("seed")
    return f"{text}, seed {seed}." if seed is not None else f"{text}."
