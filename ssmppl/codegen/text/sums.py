"""Generated functions without a loop over particles: of scalars, and sums over a trajectory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from ssmppl.codegen.text.module import THETA, Layout, is_matrix, level_of
from ssmppl.codegen.text.render import Names, Writer, depends, symbol_name, topological_until
from ssmppl.expressions.expr import Expr


def scalar_function(
    layout: Layout, name: str, arguments: str, doc: str, outputs: list[tuple[str, Expr]],
    sources: dict[Expr, str] | None = None, returns: str = "",
) -> str:  # fmt: skip
    """A function without a loop: statements `target = expression`."""
    reserved, head = Names(), []
    names: dict[Expr, str] = {}
    for node in topological_until([e for _, e in outputs], names):
        if node.op == "symbol":
            names[node] = reserved.fresh(symbol_name(node))
            source = (sources or {}).get(node) or layout.element(node)
            head.append(f"    {names[node]} = {source}")
    writer = Writer(names, reserved, layout.trace.locations)
    writer.assign(outputs)
    lines = [f"@exact\ndef {name}({arguments}):", f'    """{doc}"""', *head, *writer.lines]
    return "\n".join([*lines, *([f"    return {returns}"] if returns else [])]) + "\n"


def time_sum(
    layout: Layout, name: str, doc: str, parts: Mapping[str, Sequence[Expr]], size: int,
    fixed: dict[str, list[tuple[Expr, Expr]]] | None = None,
) -> str:  # fmt: skip
    """A function that adds expressions up over a trajectory.

    parts : for "prior", "initial", "transition" and "observation" the summands of total[0], ...,
        total[size - 1]; rows 1..T count for the observation, 2..T for the transition.
    fixed : role -> (state component, value) pairs to be set in the trajectory first.
    """
    reserved = Names()
    lines = [
        f"@exact\ndef {name}(theta, y_data, seen_data, u_data, trajectory, total):",
        f'    """{doc}"""',
    ]
    head: list[str] = []
    names: dict[Expr, str] = {}
    fixed = fixed or {}
    roots = [e for es in parts.values() for e in es]
    roots += [e for pairs in fixed.values() for _, e in pairs]
    level = depends(roots, level_of)
    outer = {n: True for n, lv in level.items() if lv == THETA}
    used = topological_until(roots, outer)
    inside = {a for n in used if n not in outer for a in n.args} | set(roots)
    needed = [n for n in used if n in outer and n in inside]
    for node in topological_until(needed, {}):
        if node.op == "symbol":
            names[node] = reserved.fresh(symbol_name(node))
            head.append(f"    {names[node]} = {layout.element(node)}")
    writer = Writer(names, reserved, layout.trace.locations)
    compound = [n for n in needed if n.op != "symbol" and not is_matrix(n)]
    targets = [(reserved.fresh(f"c{k}"), n) for k, n in enumerate(compound)]
    writer.assign(targets)
    head += writer.lines
    names |= {n: text for text, n in targets}
    zero = [f"    total[{k}] = 0.0" for k in range(size)]
    prior = _sum_block(layout, parts.get("prior", ()), names, reserved, "    ")
    body: list[str] = []
    for role, condition in (("initial", "t == 0"), ("transition", "t > 0"), ("observation", "")):
        indent = "            " if condition else "        "
        block = _fix_block(layout, fixed.get(role, []), names, reserved, indent)
        block += _sum_block(layout, parts.get(role, ()), names, reserved, indent)
        if block:
            body += [*([f"        if {condition}:"] if condition else []), *block]
    loop = ["    for t in range(y_data.shape[0]):", *body] if body else []
    return "\n".join([*lines, *head, *zero, *prior, *loop]) + "\n"


def _fix_block(
    layout: Layout, pairs: list[tuple[Expr, Expr]], names: dict[Expr, str], reserved: Names,
    indent: str,
) -> list[str]:  # fmt: skip
    own, inner, head = dict(names), Names(reserved.taken), []
    for node in topological_until([e for _, e in pairs], own):
        if node.op == "symbol" and node not in own:
            own[node] = inner.fresh(symbol_name(node))
            head.append(f"{indent}{own[node]} = {layout.element(node)}")
    writer = Writer(own, inner, layout.trace.locations, indent)
    writer.assign([(layout.element(s), e) for s, e in pairs])
    return [*head, *writer.lines] if pairs else []


def _sum_block(
    layout: Layout, summands: Sequence[Expr], names: dict[Expr, str], reserved: Names, indent: str
) -> list[str]:
    pairs = [(k, e) for k, e in enumerate(summands) if not (e.op == "const" and e.data == 0.0)]
    own, inner, head = dict(names), Names(reserved.taken), []
    for node in topological_until([e for _, e in pairs], own):
        if node.op == "symbol" and node not in own:
            own[node] = inner.fresh(symbol_name(node))
            head.append(f"{indent}{own[node]} = {layout.element(node)}")
    writer = Writer(own, inner, layout.trace.locations, indent)
    writer.assign([(f"total[{k}]", e) for k, e in pairs], "+=")
    return [*head, *writer.lines] if pairs else []
