"""Distributions that a function computes with, as if they were draws, and how that is written here.

In pomp, PyMC and particle libraries `new = Binomial(S, p)` is a number, and `S - new` a number too.
Here a function declares: each draw has a distribution and a name of its own, and later functions
take it as an argument, `new_next` of a step. The fix shows just that, made of the user's own lines.
"""

from __future__ import annotations

import ast
import copy
import inspect
import re
import textwrap
from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import dataclass
from types import TracebackType
from typing import Any

from ssmppl.compiling import parse
from ssmppl.language.distributions import DISTRIBUTIONS, Distribution
from ssmppl.language.distributions.base import DistributionAsNumber
from ssmppl.language.model.closure_digest import plain_function

# Functions whose arguments may be distributions.
_TAKE_DISTRIBUTIONS = ("Censored", "Mixture", "Ordered", "Truncated", "ZeroInflated")
LONGEST = 80  # characters of a line
# The type of an operand in messages of Python and NumPy; other words may be the user's own.
_TYPE = re.compile(r"'([A-Z]\w+)'|\btype ([A-Z]\w+)\b")


def computed_with(
    error: Exception, function: Callable[..., Any], role: str
) -> tuple[str, str] | None:
    """What was found and the fix, where an error arose as a distribution was computed with."""
    held = _distributions_held(function, error.__traceback__)
    kind = _kind(error, {type(d).__name__ for d in held.values()} | set(DISTRIBUTIONS))
    if kind is None:
        return None
    names = [n for n, d in held.items() if type(d).__name__ == kind]
    what = f"{names[0]!r}, a {kind} distribution" if names else f"a {kind} distribution"
    found = f"@{role} {function.__name__} computes with {what}, as if it were a draw"
    return found, _fix(function, role, held)


def _kind(error: Exception, known: Set[str]) -> str | None:
    """The kind of distribution that something was asked of which numbers have."""
    if isinstance(error, DistributionAsNumber):
        return type(error.distribution).__name__
    if isinstance(error, AttributeError):
        return type(error.obj).__name__ if isinstance(error.obj, Distribution) else None
    if not isinstance(error, TypeError):
        return None
    met = [a or b for a, b in _TYPE.findall(str(error)) if (a or b) in known]
    return met[-1] if met else None


def _distributions_held(
    function: Callable[..., Any], trace: TracebackType | None
) -> dict[str, Distribution]:
    """The local variables of the user's function, as it failed, that are distributions."""
    code, held = plain_function(function).__code__, {}
    while trace is not None:
        if trace.tb_frame.f_code is code:
            held = dict(trace.tb_frame.f_locals)
        trace = trace.tb_next
    return {n: d for n, d in held.items() if isinstance(d, Distribution)}


def _fix(function: Callable[..., Any], role: str, held: Mapping[str, Distribution]) -> str:
    if role == "observation":
        return (
            "declare what is drawn as a state, in @initial and @transition, and take it here as an "
            "argument; or put it into the distribution that is returned (a larger variance, "
            "ssm.Mixture, ssm.NegativeBinomial for ssm.Poisson)"
        )
    if role == "initial":
        return "use a number, or a parameter with that distribution as its prior, as an argument"
    suffix = "_next" if role == "transition" else ""
    general = (
        f"return it under a name from a @{role} function of its own, above this one, and take it "
        f"here as the argument NAME{suffix}"
    )
    try:
        written = _rewritten(function, role, suffix, set(held))
    except (OSError, TypeError, SyntaxError, _NotSimple):
        return general
    return f"{general}:\n{textwrap.indent(written, '    ')}"


class _NotSimple(Exception):
    """The function is written in a way that is not taken apart here."""


@dataclass(frozen=True)
class _Taken:
    """A draw: its name, the assignment, and how many draws it is made of, one after the other."""

    name: str
    value: ast.Assign
    level: int


def _rewritten(function: Callable[..., Any], role: str, suffix: str, candidates: Set[str]) -> str:
    """The function's source, with a function above it for the draws it computes with."""
    tree = parse(textwrap.dedent(inspect.getsource(plain_function(function)))).body[0]
    if not isinstance(tree, ast.FunctionDef) or not isinstance(tree.body[-1], ast.Return):
        raise _NotSimple
    *before, last = tree.body
    if ast.get_docstring(tree) is not None:
        before = before[1:]
    assigned = [s for s in before if isinstance(s, ast.Assign)]
    if len(assigned) < len(before) or any(
        len(s.targets) > 1 or not isinstance(s.targets[0], ast.Name) for s in assigned
    ):
        raise _NotSimple
    if len({_target(s) for s in assigned}) < len(assigned) or tree.args.defaults:
        raise _NotSimple
    draws: list[_Taken] = []
    for s in assigned:
        name = _target(s)
        if (name in candidates or _distribution(s.value)) and _operand(name, tree):
            made_of = _names(s.value) | _names(*_needed(_names(s.value), assigned))
            levels = [d.level for d in draws if d.name in made_of]
            draws.append(_Taken(name, s, 1 + max(levels, default=0)))
    if not draws:
        raise _NotSimple
    own = [a.arg for a in tree.args.args]
    decorator = f"@{ast.unparse(tree.decorator_list[0])}" if tree.decorator_list else f"@{role}"
    others = [s for s in assigned if _target(s) not in {d.name for d in draws}]
    rename = _Rename({d.name: d.name + suffix for d in draws})
    texts = []
    for level in sorted({d.level for d in draws}):
        here = [d for d in draws if d.level == level]
        returned = ast.Dict([ast.Constant(d.name) for d in here], [d.value.value for d in here])
        title = "draws" if level == 1 else f"draws_{level}"
        texts.append(_function(title, own, draws, others, ast.Return(returned), rename, decorator))
    if isinstance(last, ast.Return) and isinstance(last.value, ast.Dict):
        _declare(last.value, {d.name for d in draws}, others, draws[0].value.value)
    texts.append(_function(tree.name, own, draws, others, last, rename, decorator))
    return "\n\n".join(texts)


def _function(
    name: str, own: Sequence[str], draws: Sequence[_Taken], others: Sequence[ast.Assign],
    returned: ast.stmt, rename: _Rename, decorator: str,
) -> str:  # fmt: skip
    """The source of a function with what it needs to return this."""
    needed = _needed(_names(returned), others)
    read = _names(returned, *needed)
    arguments = [a for a in own if a in read]
    arguments += [rename.names[d.name] for d in draws if d.name in read]
    body = [_written(rename.visit(copy.deepcopy(s))) for s in (*needed, returned)]
    head = f"{decorator}\ndef {name}({', '.join(arguments)}):\n"
    return head + textwrap.indent("\n".join(body), "    ")


def _written(statement: ast.stmt) -> str:
    """Its source, the returned distributions in lines of their own where one is too long."""
    text = ast.unparse(statement)
    if len(text) > LONGEST and isinstance(statement, ast.Return):
        if isinstance(statement.value, ast.Dict):
            pairs = zip(statement.value.keys, statement.value.values, strict=True)
            lines = [f"    {ast.unparse(k)}: {ast.unparse(v)},\n" for k, v in pairs if k]
            text = f"return {{\n{''.join(lines)}}}"
    return re.sub(r"'(\w+)'", r'"\1"', text)


def _declare(
    returned: ast.Dict, draws: Set[str], others: Sequence[ast.Assign], made: ast.expr
) -> None:
    """What is computed from draws is declared as Dirac; a draw that is returned as it is has its
    own name already."""
    kept = [
        (k, v)
        for k, v in zip(returned.keys, returned.values, strict=True)
        if not (isinstance(k, ast.Constant) and isinstance(v, ast.Name) and v.id == k.value)
        or v.id not in draws
    ]
    if isinstance(made, ast.Call) and isinstance(made.func, ast.Attribute):
        dirac: ast.expr = ast.Attribute(made.func.value, "Dirac", ast.Load())
    else:
        dirac = ast.Name("Dirac", ast.Load())
    declared = {_target(s) for s in others if _distribution(s.value)}

    def computed(value: ast.expr) -> bool:
        numbers = isinstance(value, (ast.BinOp, ast.UnaryOp, ast.Name))
        names = _names(value)
        read = names | _names(*_needed(names, others))
        return numbers and not names & declared and bool(read & draws)

    returned.keys = [k for k, _ in kept]
    returned.values = [ast.Call(dirac, [v], []) if computed(v) else v for _, v in kept]


def _distribution(value: ast.expr) -> bool:
    """Whether it calls one of the package's distributions, by the name."""
    if not isinstance(value, ast.Call):
        return False
    return ast.unparse(value.func).rpartition(".")[2] in DISTRIBUTIONS


def _operand(name: str, tree: ast.AST) -> bool:
    """Whether a name is computed with somewhere."""
    for node in ast.walk(tree):
        if isinstance(node, (ast.BinOp, ast.UnaryOp, ast.Compare, ast.Subscript)):
            inside = ast.iter_child_nodes(node)
        elif isinstance(node, ast.Call):
            called = ast.unparse(node.func).rpartition(".")[2]
            if called in _TAKE_DISTRIBUTIONS:
                continue
            inside = iter([*node.args, *(k.value for k in node.keywords)])
        else:
            continue
        if any(isinstance(n, ast.Name) and n.id == name for n in inside):
            return True
    return False


def _needed(names: Set[str], assigned: Sequence[ast.Assign]) -> list[ast.Assign]:
    """The assignments, in order, that these names are computed by."""
    found: list[ast.Assign] = []
    names = set(names)
    for s in reversed(assigned):
        if _target(s) in names:
            found.insert(0, s)
            names |= _names(s.value)
    return found


def _target(assignment: ast.Assign) -> str:
    target = assignment.targets[0]
    assert isinstance(target, ast.Name)
    return target.id


def _names(*nodes: ast.AST) -> set[str]:
    found = (n for node in nodes for n in ast.walk(node))
    return {n.id for n in found if isinstance(n, ast.Name)}


@dataclass
class _Rename(ast.NodeTransformer):
    names: Mapping[str, str]

    def visit_Name(self, node: ast.Name) -> ast.Name:
        return ast.Name(self.names.get(node.id, node.id), node.ctx)
