"""Generated functions without a loop over particles: of scalars, and sums over a trajectory."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from ssmppl.codegen.text.module import THETA, Layout, ModuleText, Section, level_of
from ssmppl.codegen.text.render import Names, Writer, depends
from ssmppl.expressions.expr import Expr, several, topological

SUM = "theta, y_data, seen_data, u_data, steps, trajectory, total"


def add_entry(
    out: ModuleText, title: str, name: str, kernel: Callable[..., Any], roles: dict[str, str],
    text: str,
) -> None:  # fmt: skip
    """A function without particles, and the entry point of that name by which Python calls it.

    kernel : the way in. roles : its parameter for the function, and the function's arguments.
    """
    section = Section(out.layout, name, functions=[text], roles=roles, per_step=False)
    out.add(title, section)
    out.algorithm(kernel, name, section, "entry")


def add_sums(out: ModuleText, title: str, name: str, kernel: Callable[..., Any], text: str) -> None:
    """A function of `time_sum`, under a title, and the entry point by which Python calls it."""
    add_entry(out, title, name, kernel, {"sums": SUM}, text)


def scalar_function(
    layout: Layout, name: str, arguments: str, doc: str, outputs: list[tuple[str, Expr]],
    sources: dict[Expr, str] | None = None,
) -> str:  # fmt: skip
    """A function without a loop: statements `target = expression`."""
    reserved, names = Names(), dict[Expr, str]()
    head = layout.read([e for _, e in outputs], names, reserved, sources=sources)
    writer = Writer(names, reserved, layout.trace.locations)
    writer.assign(outputs)
    lines = [f"@exact\ndef {name}({arguments}):", f'    """{doc}"""', *head, *writer.lines]
    return "\n".join(lines) + "\n"


def time_sum(
    layout: Layout, name: str, doc: str, parts: Mapping[str, Sequence[Expr]], size: int,
    fixed: dict[str, list[tuple[Expr, Expr]]] | None = None,
) -> str:  # fmt: skip
    """`sums_NAME`, a function that adds expressions up over a trajectory.

    parts : for "prior", "initial", "transition" and "observation" the summands of total[0], ...,
        total[size - 1]; rows 1..T count for the observation, 2..T for the transition.
    fixed : role -> (state component, value) pairs to be set in the trajectory first.
    """
    reserved = Names()
    lines = [
        f"@exact\ndef sums_{name}({SUM}):",
        f'    """{doc}"""',
    ]
    names: dict[Expr, str] = {}
    fixed = fixed or {}
    roots = [e for es in parts.values() for e in es]
    roots += [e for pairs in fixed.values() for _, e in pairs]
    level = depends(roots, level_of)
    outer = {n: True for n, lv in level.items() if lv == THETA}
    used = topological(roots, until=outer)
    inside = {a for n in used if n not in outer for a in n.args} | set(roots)
    needed = [n for n in used if n in outer and n in inside]
    head = layout.read(needed, names, reserved)
    writer = Writer(names, reserved, layout.trace.locations)
    compound = [n for n in needed if n.op != "symbol" and not several(n)]
    targets = [(reserved.fresh(f"c{k}"), n) for k, n in enumerate(compound)]
    writer.assign(targets)
    head += writer.lines
    names |= {n: text for text, n in targets}
    zero = [f"    total[{k}] = 0.0" for k in range(size)]
    prior = _block(layout, _added(parts.get("prior", ())), names, reserved, "    ", "+=")
    body: list[str] = []
    for role, condition in (("initial", "t == 0"), ("transition", "t > 0"), ("observation", "")):
        indent = "            " if condition else "        "
        set_first = [(layout.element(s), e) for s, e in fixed.get(role, [])]
        block = _block(layout, set_first, names, reserved, indent, "=")
        block += _block(layout, _added(parts.get(role, ())), names, reserved, indent, "+=")
        if block:
            body += [*([f"        if {condition}:"] if condition else []), *block]
    loop = ["    for t in range(steps):", *body] if body else []
    return "\n".join([*lines, *head, *zero, *prior, *loop]) + "\n"


def _added(summands: Sequence[Expr]) -> list[tuple[str, Expr]]:
    """What is added to each total, where that is anything."""
    pairs = [(f"total[{k}]", e) for k, e in enumerate(summands)]
    return [(t, e) for t, e in pairs if not (e.op == "const" and e.data == 0.0)]


def _block(
    layout: Layout, pairs: list[tuple[str, Expr]], names: dict[Expr, str], reserved: Names,
    indent: str, operator: str,
) -> list[str]:  # fmt: skip
    """The statements `target operator expression` of a block, with the symbols that it reads."""
    own, inner = dict(names), Names(reserved.taken)
    head = layout.read([e for _, e in pairs], own, inner, indent)
    writer = Writer(own, inner, layout.trace.locations, indent)
    writer.assign(pairs, operator)
    return [*head, *writer.lines]
