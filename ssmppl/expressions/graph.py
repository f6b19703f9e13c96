"""Walking the graph under expressions: order, tables for pickling, dependence, substitution."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable
from typing import Any

from ssmppl.expressions.node import Expr, behaviour
from ssmppl.expressions.simplify import FOLD, apply


def topological(roots: Iterable[Expr], within: Container[Expr] | None = None) -> list[Expr]:
    """Every node under `roots`, arguments before users, each once; without recursion.

    within : other nodes are left out, with whatever is reached only through them.
    """
    order: list[Expr] = []
    seen: set[Expr] = set()
    stack = [(r, False) for r in reversed(list(roots)) if within is None or r in within]
    while stack:
        node, expanded = stack.pop()
        if expanded:
            order.append(node)
        elif node not in seen:
            seen.add(node)
            stack.append((node, True))
            stack.extend(
                (a, False) for a in reversed(node.args)
                if a not in seen and (within is None or a in within)
            )  # fmt: skip
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


def symbols_in(node: Expr) -> frozenset[Expr]:
    """The symbols that occur under one node; kept, as large models ask for them again and again."""
    if node._symbols is not None:
        return node._symbols
    stack = [node]
    while stack:
        top = stack[-1]
        unknown = [a for a in top.args if a._symbols is None]
        if unknown:
            stack += unknown
            continue
        stack.pop()
        if top._symbols is None:
            object.__setattr__(top, "_symbols", _united(top))
    assert node._symbols is not None
    return node._symbols


def _united(node: Expr) -> frozenset[Expr]:
    """Of the arguments' symbols; the largest of them itself where it holds the others, so that
    few sets are made."""
    if node.op == "symbol":
        return frozenset((node,))
    each = [a._symbols for a in node.args if a._symbols]
    if not each:
        return frozenset()
    largest = max(each, key=len)
    return largest if all(s <= largest for s in each) else frozenset().union(*each)


def symbols_of(roots: Expr | Iterable[Expr]) -> frozenset[Expr]:
    """The symbols that occur under `roots`."""
    if isinstance(roots, Expr):
        return symbols_in(roots)
    return frozenset[Expr]().union(*(symbols_in(r) for r in roots))


def dependent(roots: Iterable[Expr], on: Iterable[Expr]) -> set[Expr]:
    """The nodes under `roots` (themselves included) that depend on some node of `on`."""
    found = set(on)
    if all(n.op == "symbol" for n in found):  # only where they occur
        wanted = frozenset(found)
        stack = [r for r in roots if not wanted.isdisjoint(symbols_in(r))]
        while stack:
            node = stack.pop()
            if node in found:
                continue
            found.add(node)
            stack += [a for a in node.args if not wanted.isdisjoint(symbols_in(a))]
        return found
    for node in topological(roots):
        if any(a in found for a in node.args):
            found.add(node)
    return found


def depends_on(expression: Expr, symbols: Iterable[Expr]) -> bool:
    """Whether the expression depends on some symbol of `symbols`."""
    return not symbols_in(expression).isdisjoint(symbols)


def substitute(roots: list[Expr], replacement: dict[Expr, Expr]) -> list[Expr]:
    """`roots` with nodes replaced, simplified again on the way up."""
    done = dict(replacement)
    for node in topological(roots):
        if node in done:
            continue
        done[node] = rebuilt(node, tuple(done[a] for a in node.args))
    return [done[r] for r in roots]


def rebuilt(node: Expr, args: tuple[Expr, ...]) -> Expr:
    """The node with other arguments, simplified."""
    if all(new is old for new, old in zip(args, node.args, strict=True)):
        return node
    return apply(node.op, *args) if node.op in FOLD else Expr(node.op, args, node.data)
