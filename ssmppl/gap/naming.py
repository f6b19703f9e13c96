"""What things are called in a report's sentences: effects, their rivals and their classes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ssmppl.gap.report import GapReport

__all__ = [
    "alternatives", "class_letters", "label", "leaders", "listed", "named", "rivals",
    "row_label", "rows", "sentence", "tried",
]  # fmt: skip

NAMED_RIVALS = 3

# Effects that are something *of* an input, a sensor or a parameter; others act *in* an equation.
OF = ("input", "sensor", "actuator", "parameter", "wrong initial", "backlash", "dead zone")


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


def named(report: GapReport) -> str:
    """The model, as the subject of a sentence."""
    return f"the model “{report.title}”" if report.title else "the model"


def tried(report: GapReport) -> str:
    """How many effects were tried, as "87 effects tried"."""
    count = report.settings.get("candidates") or len(report.causes)
    return f"{count:,} effect{'s' * (count > 1)} tried" if count else "effects tried"


def leaders(report: GapReport) -> list[dict[str, Any]]:
    """The rows of `causes` that the verdict is about: the chosen ones, else a significant best."""
    found = rows(report.causes)
    out: list[dict[str, Any]] = []
    for name in report.chosen:
        names = [r for r in found if name in (r["effect"], f"{r['effect']} on {r['equation']}")]
        fresh = [r for r in names if r not in out]
        out.append(fresh[0] if fresh else {"effect": name, "equation": ""})
    if report.chosen or report.verdict != "effect":
        return out
    return found[:1]


def rivals(report: GapReport, row: dict[str, Any]) -> list[dict[str, Any]]:
    """The rows of `classes` that these data cannot tell from this cause."""
    mine = (row["effect"], row.get("equation"))
    return [
        r
        for r in rows(report.classes)
        if r["class_id"] == row.get("class_id") and (r["effect"], r["equation"]) != mine
    ]


def class_letters(report: GapReport) -> dict[Any, str]:
    """A, B, ... for the classes with several members, in the order of `causes`."""
    members: dict[Any, int] = {}
    for r in rows(report.classes):
        members[r["class_id"]] = members.get(r["class_id"], 0) + 1
    order = [*(r["class_id"] for r in rows(report.causes)), *members]
    several = [c for c in dict.fromkeys(order) if members.get(c, 0) > 1]
    return {c: chr(ord("A") + i % 26) * (i // 26 + 1) for i, c in enumerate(several)}


def alternatives(report: GapReport, row: dict[str, Any]) -> list[str]:
    """The cause and its rivals, by name; many are counted."""
    others = [row_label(r) for r in rivals(report, row)]
    if len(others) > NAMED_RIVALS:
        others = [*others[: NAMED_RIVALS - 1], f"{len(others) - NAMED_RIVALS + 1} more"]
    return [row_label(row), *others]
