"""An algorithm's text with a model's functions put in place of its parameters.

Numba's disk cache finds only module-level functions again, and not those that are handed other
compiled functions as arguments. So the kernels under `kernels/` are written with the model's
functions as their first parameters, readable and testable as they stand, and `specialise` copies
their text, comments included, into the generated module with these parameters bound to names.
"""

from __future__ import annotations

import inspect
import io
import tokenize
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Specialised:
    """Text of the function, and the names it needs: name -> module to import it from."""

    text: str
    imports: dict[str, str]


def specialise(function: Callable[..., Any], name: str, bound: Mapping[str, str]) -> Specialised:
    """The text of `function`, renamed, without the parameters in `bound`, which stand for text."""
    plain = getattr(function, "py_func", inspect.unwrap(function))
    source = inspect.getsource(plain)
    tokens = list(tokenize.generate_tokens(io.StringIO(source).readline))
    start = next(i for i, t in enumerate(tokens) if t.string == "def")
    depth, end = 0, start
    for i in range(start, len(tokens)):
        depth += {"(": 1, ")": -1}.get(tokens[i].string, 0)
        if tokens[i].string == ")" and depth == 0:
            end = i
            break
    edits: list[tuple[int, int, int, str]] = []  # line, from column, to column, text
    imports: dict[str, str] = {}
    for i, token in enumerate(tokens):
        if token.type != tokenize.NAME:
            continue
        previous = tokens[i - 1].string if i else ""
        if i == start + 1:
            edits.append(_edit(token, token, name))
        elif token.string in bound and start < i < end:
            after = tokens[i + 1] if tokens[i + 1].string == "," else token
            edits.append(_edit(token, after, ""))
        elif token.string in bound and previous != ".":
            edits.append(_edit(token, token, bound[token.string]))
        elif previous != "." and token.string in plain.__globals__:
            if token.string not in ("np", "math"):
                value = plain.__globals__[token.string]
                home = getattr(value, "__module__", None)
                imports[token.string] = home if callable(value) and home else plain.__module__
    lines = source.splitlines()
    for row, first, last, text in sorted(edits, reverse=True):
        line = lines[row - 1]
        rest = line[last:]
        lines[row - 1] = line[:first] + (text + rest if text else rest.lstrip(" "))
    kept = [li for li in lines if li.strip() or li == ""]
    text = "\n".join(li.rstrip() for li in kept) + "\n"
    return Specialised(text.replace("(\n    \n", "(\n"), imports)


def _edit(
    first: tokenize.TokenInfo, last: tokenize.TokenInfo, text: str
) -> tuple[int, int, int, str]:
    return first.start[0], first.start[1], last.end[1], text
