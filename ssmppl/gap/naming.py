"""What things are called in a report's sentences: effects, their rivals and their classes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ssmppl.gap.report import GapReport

__all__ = [
    "alternatives", "class_letters", "label", "leaders", "listed", "marked", "named", "rivals",
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
    """The rows of `causes` that the verdict is about: the chosen ones, as they are in the model
    with all of them, else a significant best."""
    found = rows(report.causes)
    if report.leading:
        return [{**found[d["row"]], **{k: v for k, v in d.items() if k != "row"}}
                for d in report.leading]  # fmt: skip
    labels = report.chosen or [""]
    return [{"effect": labels[n], "equation": ""} if i is None else found[i]
            for n, i in enumerate(_places(report))]  # fmt: skip


def marked(report: GapReport) -> set[int]:
    """Which rows of `causes` the verdict is about."""
    places = [d["row"] for d in report.leading] or _places(report)
    return {i for i in places if i is not None}


def _places(report: GapReport) -> list[int | None]:
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
    if report.chosen or report.verdict != "effect":
        return out
    return [0] if found else []


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
