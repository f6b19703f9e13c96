"""Small HTML tables for notebooks: no style sheet, no colours of their own, every value escaped.

Colours are inherited, so that the tables can be read on light and on dark pages.
"""

from __future__ import annotations

import html
from collections.abc import Collection, Iterable, Sequence

__all__ = ["code", "folded", "heading", "paragraph", "table", "text"]

# Notebooks align the cells of tables to the right, and do not keep the lines of text.
LEFT = "text-align:left;vertical-align:top;white-space:pre-wrap"
RIGHT = "text-align:right;vertical-align:top;white-space:nowrap"


def text(value: object) -> str:
    """Any value as text that is shown as it is."""
    return html.escape(str(value))


def code(value: object) -> str:
    """The value in the type of programs."""
    return f"<code>{text(value)}</code>"


def heading(value: object) -> str:
    """The name of the whole."""
    return f"<h4>{text(value)}</h4>"


def paragraph(value: object) -> str:
    """A paragraph of plain text."""
    return f"<p>{text(value)}</p>"


def folded(title: object, inside: str) -> str:
    """What is shown when its title is clicked; `inside` is HTML."""
    return f"<details><summary>{text(title)}</summary>{inside}</details>"


def table(
    rows: Iterable[Sequence[str]], head: Sequence[object] = (), left: Collection[int] = (0,)
) -> str:
    """Rows of cells, HTML already, under a head of plain text; `left` columns hold words."""

    def row(cells: Sequence[str], tag: str) -> str:
        inside = "".join(
            f"<{tag} style='{LEFT if k in left else RIGHT}'>{cell}</{tag}>"
            for k, cell in enumerate(cells)
        )
        return f"<tr>{inside}</tr>"

    top = f"<thead>{row([text(h) for h in head], 'th')}</thead>" if head else ""
    return f"<table>{top}<tbody>{''.join(row(r, 'td') for r in rows)}</tbody></table>"
