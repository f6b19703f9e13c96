"""`print(report)`: the verdict, the four answers, one table, and what could not be decided."""

from __future__ import annotations

import re
import textwrap
from typing import TYPE_CHECKING

from ssmppl import markup
from ssmppl.diagnosis.heldout.simulation import FREE_RUN
from ssmppl.diagnosis.report import words
from ssmppl.diagnosis.verdict.verdicts import NO_GAP
from ssmppl.drawing.numerals import DASH, interval, is_number, number, p_text, percent, with_error

if TYPE_CHECKING:
    from ssmppl.diagnosis.report.findings import Findings

PAGE = 100  # columns
SHOWN_CAUSES = 8
PREDICTED = "* score-test approximation, model not refitted"
AHEAD = "Error of simulations of held-out rows, so many rows ahead (95% intervals)"
ALIKE = "Effects with the same letter are not distinguishable by these data."


def cause_rows(report: Findings, shown: int = SHOWN_CAUSES) -> list[tuple[str, ...]]:
    """Header and the best causes: name, form, strength, gain, p, class letter."""
    letters, chosen = words.class_letters(report), words.marked(report)
    out: list[tuple[str, ...]] = [("effect", "form", "strength", "log-lik. gain (nats)", "p",
                                    "class")]  # fmt: skip
    for i, r in enumerate(words.rows(report.causes)[:shown]):
        refit = is_number(r["gain_refit"])
        gain = number(r["gain_refit"] if refit else r["gain_screen"], 2)
        gain += "" if refit or gain == DASH else " *"
        name = ("→ " if i in chosen else "  ") + words.row_label(r)
        form = r["form"] if isinstance(r["form"], str) else ""
        out.append((name, form, with_error(r["estimate"], r["se"]), gain,
                    p_text(r["p"]).removeprefix("p ").removeprefix("= "),
                    letters.get(r["class_id"], "")))  # fmt: skip
    return out


def horizon_rows(report: Findings) -> list[tuple[str, ...]]:
    """Header and a line for each horizon: rows ahead, what is gained, errors before and after."""
    out: list[tuple[str, ...]] = [("rows ahead", "", "reduced by", "error before", "after",
                                    "nats per row")]  # fmt: skip
    for r in words.rows(report.closed):
        ends = f" ({interval(r['low'], r['high'])})" if is_number(r["low"]) else ""
        if is_number(r["rmse_before"]) and is_number(r["share"]):
            out.append((str(r["horizon"]), "",
                        percent(r["share"]) + ends.replace("95% interval ", ""),
                        number(r["rmse_before"]), number(r["rmse_after"]),
                        "" if r["horizon"] == FREE_RUN else number(r["nats_per_sample"], 2),
                        ))  # fmt: skip
    return out


def filled(cells: list[tuple[str, ...]]) -> list[tuple[str, ...]]:
    """A table, header first, without the columns in which nothing stands."""
    keep = [i for i in range(len(cells[0])) if any(row[i] for row in cells[1:])]
    return [tuple(row[i] for i in keep) for row in cells]


def _table(cells: list[tuple[str, ...]]) -> list[str]:
    """Columns side by side: the first two to the left, numbers to the right; forms cut to fit."""
    keep = [i for i in range(len(cells[0])) if any(row[i] for row in cells[1:])]
    widths = {i: max(len(row[i]) for row in cells) for i in keep}
    if 1 in widths:
        others = sum(w + 2 for i, w in widths.items() if i != 1)
        widths[1] = max(min(widths[1], PAGE - others - 2), 8)
    lines = []
    for row in cells:
        parts = []
        for i in keep:
            text = row[i] if len(row[i]) <= widths[i] else row[i][: widths[i] - 1] + "…"
            parts.append(text.ljust(widths[i]) if i < 2 else text.rjust(widths[i]))
        lines.append("  ".join(parts).rstrip())
    return lines


def report_text(report: Findings) -> str:
    """The verdict, the answers, one table, what is undecided and what would decide it."""
    lines = [*wrapped(words.headline(report)), ""]
    for name, sentences in words.sections(report):
        if sentences:
            lines += wrapped(" ".join(sentences), f"{name:<11}", " " * 11)
    cells = cause_rows(report)
    if len(cells) > 1:
        lines += ["", *_table(cells)]
        if any("*" in row[3] for row in cells[1:]):
            lines.append(PREDICTED)
        if words.class_letters(report):
            lines.append(ALIKE)
        for term in ("log-likelihood gain", "reference model", "p")[
            :: 1 if len(report.closed) else 2
        ]:
            lines += wrapped(f"{term}: {words.GLOSSARY[term]}.")
    ahead = horizon_rows(report)
    if len(ahead) > 1 and report.verdict != NO_GAP:
        lines += ["", AHEAD, *_table(ahead)]
    for name, found in _rest(report):
        lines += ["", name]
        for item in found:
            lines += wrapped(item, "- ", "  ")
    return "\n".join(lines)


def report_html(report: Findings) -> str:
    """What `report_text` says, for a notebook."""
    parts = [markup.heading(report.title or "Diagnosis"), markup.paragraph(words.headline(report))]
    rows_of_answers = [
        (markup.text(name), markup.text(" ".join(sentences)))
        for name, sentences in words.sections(report)
        if sentences
    ]
    parts.append(markup.table(rows_of_answers, left=(0, 1)))
    head, *ahead = filled(horizon_rows(report))
    if ahead and report.verdict != NO_GAP:
        parts.append(markup.paragraph(AHEAD))
        parts.append(markup.table([list(map(markup.text, row)) for row in ahead], head, [0]))
    head, *causes = cause_rows(report)
    if causes:
        keep = [i for i in range(len(head)) if any(row[i] for row in causes)]
        cells = [[markup.text(row[i].strip()) for i in keep] for row in causes]
        left = [k for k, i in enumerate(keep) if i < 2]
        parts.append(markup.table(cells, [head[i] for i in keep], left))
        if any("*" in row[3] for row in causes):
            parts.append(markup.paragraph(PREDICTED))
        if words.class_letters(report):
            parts.append(markup.paragraph(ALIKE))
    for name, found in _rest(report):
        items = "".join(f"<li>{markup.text(item)}</li>" for item in found)
        parts.append(markup.folded(f"{name} ({len(found)})", f"<ul>{items}</ul>"))
    return "".join(parts)


def _rest(report: Findings) -> list[tuple[str, list[str]]]:
    """What could not be decided, what would decide it, and what has to be known."""
    found = [
        ("Not distinguishable or not applicable", words.undecided(report)),
        ("Next steps", words.next_steps(report)),
        ("Notes", [words.sentence(n) for n in report.notes]),
        ("Failed computations", words.left_out(report)),
    ]  # fmt: skip
    return [(name, items) for name, items in found if items]


def wrapped(text: str, first: str = "", rest: str = "") -> list[str]:
    """Lines of the page's width; "t = 411" and "p < 0.001" are not broken."""
    whole = re.sub(r"\b([a-z]) ([=<]) ", "\\1\N{NO-BREAK SPACE}\\2\N{NO-BREAK SPACE}", text)
    lines = textwrap.wrap(
        whole, PAGE, initial_indent=first, subsequent_indent=rest, break_on_hyphens=False
    )
    return [line.replace("\N{NO-BREAK SPACE}", " ") for line in lines]
