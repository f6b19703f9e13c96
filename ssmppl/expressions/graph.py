"""Walking the graph under expressions: order, tables for pickling, dependence, substitution."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from ssmppl.expressions.node import Expr, behaviour
from ssmppl.expressions.simplify import FOLD, apply


def topological(roots: Iterable[Expr]) -> list[Expr]:
    """Every node under `roots`, arguments before users, each once; without recursion."""
    order: list[Expr] = []
    seen: set[Expr] = set()
    stack = [(r, False) for r in reversed(list(roots))]
    while stack:
        node, expanded = stack.pop()
        if expanded:
            order.append(node)
        elif node not in seen:
            seen.add(node)
            stack.append((node, True))
            stack.extend((a, False) for a in reversed(node.args) if a not in seen)
    return order


def pack(roots: Iterable[Expr]) -> list[tuple[str, tuple[int, ...], Any]]:
    """Every node under `roots` as (operation, places of its arguments in this list, data)."""
    place: dict[Expr, int] = {}
    table: list[tuple[str, tuple[int, ...], Any]] = []
    for node in topological(roots):
        place[node] = len(table)
        table.append((node.op, tuple(place[a] for a in node.args), node.data))
    return table


def unpack(table: list[tuple[str, tuple[int, ...], Any]]) -> list[Expr]:
    """The nodes of a table made by `pack`, interned."""
    nodes: list[Expr] = []
    for op, args, data in table:
        nodes.append(Expr(op, tuple(nodes[i] for i in args), data))
    return nodes


def unpack_one(table: list[tuple[str, tuple[int, ...], Any]]) -> Expr:
    """The last node of a table: the root it was made for."""
    return unpack(table)[-1]


def _reduced(node: Expr) -> tuple[Callable[..., Expr], tuple[Any, ...]]:
    """For pickling: as a flat table, for graphs deeper than Python's recursion limit."""
    return unpack_one, (pack([node]),)


behaviour["pickle"] = _reduced


def symbols_of(roots: Expr | Iterable[Expr]) -> frozenset[Expr]:
    """The symbols that occur under `roots`."""
    nodes = topological([roots] if isinstance(roots, Expr) else roots)
    return frozenset(n for n in nodes if n.op == "symbol")


def dependent(roots: Iterable[Expr], on: Iterable[Expr]) -> set[Expr]:
    """The nodes under `roots` (themselves included) that depend on some node of `on`."""
    found = set(on)
    for node in topological(roots):
        if any(a in found for a in node.args):
            found.add(node)
    return found


def depends_on(expression: Expr, symbols: Iterable[Expr]) -> bool:
    """Whether the expression depends on some symbol of `symbols`."""
    return expression in dependent([expression], symbols)


def substitute(roots: list[Expr], replacement: dict[Expr, Expr]) -> list[Expr]:
    """`roots` with nodes replaced, simplified again on the way up."""
    done = dict(replacement)
    for node in topological(roots):
        if node in done:
            continue
        args = tuple(done[a] for a in node.args)
        if all(new is old for new, old in zip(args, node.args, strict=True)):
            done[node] = node
        elif node.op in FOLD:
            done[node] = apply(node.op, *args)
        else:
            done[node] = Expr(node.op, args, node.data)
    return [done[r] for r in roots]
