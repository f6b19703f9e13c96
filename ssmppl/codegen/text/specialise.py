"""An algorithm's text with a model's functions put in place of its parameters.

What is kept on disk is found again for module-level functions only, and not for those that are
handed other compiled functions as arguments. So the kernels under `kernels/` are written with the
model's functions as their first parameters, readable and testable as they stand, and `specialise`
copies their text, comments included, into the generated module with these parameters bound to
names. Branches that the bound parameters decide are decided in the text: what a model does not need
is neither read nor compiled.
"""

from __future__ import annotations

import ast
import inspect
import io
import textwrap
import tokenize
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from ssmppl.compiling import literal, one_at_a_time, parse


@dataclass(frozen=True)
class Specialised:
    """Text of the function, and the names it needs: name -> module to import it from."""

    text: str
    imports: dict[str, str]


@one_at_a_time
def specialise(function: Callable[..., Any], name: str, bound: Mapping[str, str]) -> Specialised:
    """The text of `function`, renamed, without the parameters in `bound`, which stand for text."""
    plain = getattr(function, "py_func", inspect.unwrap(function))
    return _specialised(plain, name, tuple(sorted(bound.items())))


_source = lru_cache(inspect.getsource)


@lru_cache(maxsize=1024)  # the augmentations of one model have much in common
def _specialised(
    plain: Callable[..., Any], name: str, items: tuple[tuple[str, str], ...]
) -> Specialised:
    bound = dict(items)
    source = _decided(plain, _known(plain, items))
    tokens = _tokens(source)
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
            if (entry := _entry(bound[token.string], tokens[i + 1 : i + 4])) is not None:
                edits.append(_edit(token, tokens[i + 3], entry))
                continue
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


@lru_cache(maxsize=1024)
def _tokens(source: str) -> tuple[tokenize.TokenInfo, ...]:
    return tuple(tokenize.generate_tokens(io.StringIO(source).readline))


def _entry(text: str, following: Sequence[tokenize.TokenInfo]) -> str | None:
    """What `text` followed by these tokens, `[`, a number and `]`, is, if it is a tuple."""
    if [t.string for t in following[::2]] == ["[", "]"] and text.startswith("("):
        return repr(literal(text)[int(following[1].string)])
    return None


def _edit(
    first: tokenize.TokenInfo, last: tokenize.TokenInfo, text: str
) -> tuple[int, int, int, str]:
    return first.start[0], first.start[1], last.end[1], text


def _known(
    plain: Callable[..., Any], items: tuple[tuple[str, str], ...]
) -> tuple[tuple[str, bool], ...]:
    """The conditions, as text, that the bound parameters decide, and whether they hold."""
    values, bound = _constants(plain), set()
    for name, text in items:
        if name not in _asked(plain):
            continue
        try:
            values[name] = eval(text, _constants(plain))
        except (NameError, SyntaxError):  # a function
            continue
        bound.add(name)
    return tuple(
        (test, bool(eval(test, values.copy())))
        for test, names in _conditions(plain).items()
        if names & bound and names <= set(values)
    )


@lru_cache
def _conditions(plain: Callable[..., Any]) -> dict[str, frozenset[str]]:
    """The conditions of its `if` statements, as text, and the names in each."""
    tests = [n.test for n in ast.walk(parse(_source(plain))) if isinstance(n, ast.If)]
    return {
        ast.unparse(t): frozenset(n.id for n in ast.walk(t) if isinstance(n, ast.Name))
        for t in tests
    }


@lru_cache
def _asked(plain: Callable[..., Any]) -> frozenset[str]:
    return frozenset().union(*_conditions(plain).values())


def _constants(plain: Callable[..., Any]) -> dict[str, Any]:
    return {name: v for name, v in plain.__globals__.items() if isinstance(v, int)}


@lru_cache(maxsize=1024)  # models differ in names and sizes, and seldom in these
def _decided(plain: Callable[..., Any], known: tuple[tuple[str, bool], ...]) -> str:
    """Its text without the `if` statements whose condition is known."""
    source, truths = _source(plain), dict(known)
    while nodes := _outermost(parse(source), truths):
        for node, truth in reversed(nodes):  # from below: the lines above keep their numbers
            source = _keep_branch(source, node, truth)
    return source


def _outermost(tree: ast.AST, truths: Mapping[str, bool]) -> list[tuple[ast.If, bool]]:
    """The `if` statements with a known condition, from the top of the text, and whether it holds;
    of one inside another the outer."""
    out: list[tuple[ast.If, bool]] = []
    waiting = [tree]
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.If) and (test := ast.unparse(node.test)) in truths:
            out.append((node, truths[test]))
        elif not isinstance(node, ast.expr):
            waiting += ast.iter_child_nodes(node)
    return sorted(out, key=lambda pair: pair[0].lineno)


def _keep_branch(source: str, node: ast.If, truth: bool) -> str:
    """`source` with one branch of an `if` or `elif` statement in place of the whole."""
    lines = source.splitlines()
    indent = " " * node.col_offset
    before, after = lines[: node.lineno - 1], lines[node.end_lineno :]
    elif_ = lines[node.lineno - 1].lstrip().startswith("elif")
    body = lines[node.test.end_lineno : node.body[-1].end_lineno]
    rest = lines[node.body[-1].end_lineno : node.end_lineno]  # from `else:` or `elif` on
    if truth:
        kept = [f"{indent}else:", *body] if elif_ else _dedented(body)
    elif elif_ or not rest:
        kept = rest
    elif rest[0].lstrip().startswith("elif"):
        kept = [rest[0].replace("elif", "if", 1), *rest[1:]]
    else:
        kept = _dedented(rest[1:])
    return "\n".join([*before, *kept, *after]) + "\n"


def _dedented(lines: list[str]) -> list[str]:
    return [textwrap.dedent(li[:4]) + li[4:] for li in lines]
